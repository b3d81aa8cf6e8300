"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dwell.files import write_whole


@pytest.mark.parametrize("content", [b"a\nb", "a\nb", lambda draft: draft.write_bytes(b"a\nb")])
@pytest.mark.parametrize("durable", [True, False])
def test_a_file_holds_what_it_was_given(content: object, durable: bool, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"older, and longer than what comes")
    write_whole(file, content, durable=durable)  # type: ignore[arg-type]
    assert file.read_bytes() == b"a\nb"
    assert list(tmp_path.iterdir()) == [file]


def test_a_fault_leaves_the_older_file_and_no_draft(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"older")

    def half(draft: Path) -> None:
        draft.write_bytes(b"ha")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write_whole(file, half)
    assert file.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "none" / "file", b"")


def test_who_may_read_it_is_the_users_to_say(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "shared", b"")
        write_whole(tmp_path / "private", b"", private=True)
    finally:
        os.umask(before)
    assert (tmp_path / "shared").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o600


def test_a_process_that_is_killed_leaves_the_older_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"older")
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom dwell.files import write_whole\n"
        "def half(draft):\n"
        "    draft.write_bytes(b'ha')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "write_whole(Path(sys.argv[1]), half)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(file)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert file.read_bytes() == b"older"
    # The next one is not kept from writing by what was left.
    write_whole(file, b"newer")
    assert file.read_bytes() == b"newer"


def test_what_lies_at_the_drafts_place_is_neither_followed_nor_kept(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(b"somebody's")
    draft = tmp_path / f".file.{os.getpid()}.draft"
    draft.symlink_to(elsewhere)
    write_whole(tmp_path / "file", b"ours", private=True)
    assert elsewhere.read_bytes() == b"somebody's"
    assert (tmp_path / "file").read_bytes() == b"ours"
    assert not (tmp_path / "file").is_symlink()
    draft.touch(0o666)
    draft.chmod(0o666)
    write_whole(tmp_path / "file", b"ours", private=True)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o600
