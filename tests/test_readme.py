"""The README, and the planner's page: their commands run, and print what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SECTIONS = re.split(r"^## ", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
CONSOLE = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Stands for lines that are left out.
LEFT_OUT = "…\n"
#: Runs real processes: its numbers are other ones each time.
LIVE = "dwell live run"


def transcript(section: str) -> list[tuple[str, str]]:
    """Return the commands of a section, each with what it prints."""
    text = "".join(CONSOLE.findall(section))
    commands = re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]
    return [(words, printed) for words, _, printed in (one.partition("\n") for one in commands)]


def expected(printed: str) -> re.Pattern[str]:
    """Return a pattern of what a command prints, whatever stands in lines that are left out."""
    return re.compile("(?:.*\n)*".join(map(re.escape, printed.split(LEFT_OUT))))


def without_numbers(printed: str) -> str:
    """Return what stands in every line before its first number."""
    return "\n".join(" ".join(re.split(r"\d", line)[0].split()) for line in printed.splitlines())


@pytest.mark.parametrize(
    "commands",
    [
        pytest.param(commands, id=section.partition("\n")[0])
        for section in SECTIONS
        if (commands := transcript(section))
    ],
)
def test_commands_print_what_the_readme_says(
    commands: list[tuple[str, str]], tmp_path: Path
) -> None:
    check(commands, tmp_path)


def test_commands_print_what_the_page_on_capacity_says(tmp_path: Path) -> None:
    page = ROOT / "docs" / "capacity.md"
    check(transcript(page.read_text(encoding="utf-8")), tmp_path)


def check(commands: list[tuple[str, str]], tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for words, printed in commands:
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
            assert without_numbers(done.stdout) == without_numbers(printed)
        else:
            assert expected(printed).fullmatch(done.stdout), f"$ {words}\n{done.stdout}"
