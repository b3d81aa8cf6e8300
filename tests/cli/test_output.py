"""What commands write."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.cli.output import aligned, progress, working, write_file
from tests.waiting import wait_until


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


def test_short_work_prints_nothing_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with working("thinking"), progress("simulating") as shown:
        shown(1, 2)
    captured = capsys.readouterr()
    assert captured.out + captured.err == ""


def test_long_work_prints_lines_without_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dwell.cli.output.EVERY_S", 0.001)
    printed = ""

    def has(line: str) -> bool:
        nonlocal printed
        printed += capsys.readouterr().err
        return line in printed.splitlines()

    with progress("playing up to 24 robots") as shown:
        wait_until(lambda: has("playing up to 24 robots"))
        shown(3, 24)
        wait_until(lambda: has("playing up to 24 robots: 3 of 24"))
    capsys.readouterr()
    assert capsys.readouterr().err == ""
