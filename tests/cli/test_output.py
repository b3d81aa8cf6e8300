"""What commands write."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.cli.output import aligned, progress, working, write_file


def test_aligned() -> None:
    text = aligned(["name", "a"], [["x", "1.0"], ["longer", "10.0"]])
    assert text.splitlines() == ["name       a", "x        1.0", "longer  10.0"]
    assert aligned(["name", "a"], []) == "name  a"


def test_a_file_appears_complete_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "deep" / "report.html"
    write_file(path, "old")

    def crash(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", crash)
        with pytest.raises(KeyboardInterrupt):
            write_file(path, "new")
    assert path.read_text() == "old"
    assert list(path.parent.iterdir()) == [path]
    write_file(path, "new")
    assert path.read_text() == "new"


def test_a_folder_is_not_overwritten(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError, match="is a folder"):
        write_file(tmp_path, "text")


def test_no_progress_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with working("thinking"), progress("simulating") as shown:
        assert shown is None
    captured = capsys.readouterr()
    assert captured.out + captured.err == ""
