"""The README and pages to start with: their commands print the output that the pages show."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: Pages whose commands run, one after another, in an empty folder.
PAGES = ("README.md", *(f"docs/start/{name}.md" for name in ("first-result", "your-cell")))
CONSOLE = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Stands for lines that are left out.
LEFT_OUT = re.compile("…\n?")
#: Runs real processes: its numbers are other ones each time.
LIVE = "dwell live run"
#: The page's seconds, and fewer that have the same phases: the last disturbance ends at 18 s.
SHORTER = ("--seconds 30", "--seconds 23")


def transcript(page: str) -> list[tuple[str, str]]:
    """Return the commands of a page, each with its output."""
    text = "".join(CONSOLE.findall(page))
    commands = re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]
    return [(words, printed) for words, _, printed in (one.partition("\n") for one in commands)]


def expected(printed: str) -> re.Pattern[str]:
    """Return a pattern of what a command prints, whatever stands in lines that are left out."""
    return re.compile("(?s:.*)".join(map(re.escape, LEFT_OUT.split(printed))))


def without_numbers(printed: str) -> str:
    """Return what stands in every line before its first number."""
    return "\n".join(" ".join(re.split(r"\d", line)[0].split()) for line in printed.splitlines())


@pytest.mark.parametrize("page", [*PAGES, "docs/start/first-live-cell.md"])
def test_commands_print_what_the_page_says(page: str, tmp_path: Path) -> None:
    commands = transcript((ROOT / page).read_text(encoding="utf-8"))
    assert commands
    if page == "README.md":  # docs/start/first-live-cell.md has the same live run.
        commands = [one for one in commands if not one[0].startswith(LIVE)]
    check(commands, tmp_path)


def test_the_readme_has_at_most_600_words() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 600


def test_commands_print_what_the_page_on_capacity_says(tmp_path: Path) -> None:
    """Without its rows of possible changes: each takes as long as all rows above them."""
    page = ROOT / "docs" / "howto" / "capacity.md"
    ((words, printed),) = transcript(page.read_text(encoding="utf-8"))
    rows, changes, _ = printed.partition("\nwhat if ")
    assert changes
    check([(words.replace(" --what-if", ""), f"{rows}…\n")], tmp_path)


def check(commands: list[tuple[str, str]], tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for words, printed in commands:
        if words.startswith(LIVE):
            assert SHORTER[0] in words
            words = words.replace(*SHORTER)
        done = subprocess.run(
            ("bash", "-c", words),
            cwd=tmp_path,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        if words.startswith(LIVE):
            assert expected(without_numbers(printed)).fullmatch(without_numbers(done.stdout))
        else:
            assert expected(printed).fullmatch(done.stdout), f"$ {words}\n{done.stdout}"
