"""The measure of plain English, and the hook that reads commit titles."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.plain_english import HABITS, READERS, habits, texts

FOLDER = Path(__file__).parent / "english"
HOOK = Path(__file__).parents[1] / ".githooks" / "commit-msg"
CONTORTED = (FOLDER / "contorted.txt").read_text(encoding="utf-8").splitlines()
HONEST = (FOLDER / "honest.txt").read_text(encoding="utf-8").splitlines()


def test_plain_sentences_score_nothing() -> None:
    assert len(HONEST) == 30
    assert [sentence for sentence in HONEST if habits(sentence)] == []


def test_contorted_sentences_score() -> None:
    """Real sentences that once stood in the sources; each habit occurs in one of them."""
    assert len(CONTORTED) == 30
    assert [sentence for sentence in CONTORTED if not habits(sentence)] == []
    assert {advice for sentence in CONTORTED for advice in habits(sentence)} == set(HABITS)


WRITTEN = {
    ".py": '"""{0}"""\n\nx = 1  # {1}\nprint("{2}")\n',
    ".h": "// {0}\nint x;  // {1}\n/* {2} */\n",
    ".js": "// {0}\nconst x = `{1}`;\n/** {2} */\n",
    ".md": "# A heading of four words\n\n**{0}**\n\n* [{1}](page.md)\n\n| a | {2} |\n"
    "```sh\ndwell run a cell with options\n```\n",
    ".html": '<p>{0}</p>\n<!-- {1} -->\n<b title="{2}">x</b>\n',
}


@pytest.mark.parametrize("suffix", WRITTEN)
def test_all_kinds_of_text_are_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"text{suffix}"
    path.write_text(WRITTEN[suffix].format(*HONEST[:3]), encoding="utf-8")
    assert sorted(sentence for _, sentence in texts(path)) == sorted(HONEST[:3])


def test_each_kind_of_source_is_written_here() -> None:
    assert set(READERS) - {".pyi", ".cpp"} == set(WRITTEN)


@pytest.mark.parametrize(
    ("title", "passes"),
    [
        ("Add a table of moves", True),
        ("Process events in order of their time", True),
        (
            "Merge branch 'main' into a branch whose name is longer than a title may be, by far",
            True,
        ),
        ("Added a table of moves", False),
        ("Adds a table of moves", False),
        ("Adding a table of moves", False),
        ("The table of moves", False),
        ("Moves: one table", False),
        ("add a table of moves", False),
        ("Add a table of moves.", False),
        ("Add " + 69 * "x", False),
    ],
)
def test_titles_of_commits(title: str, passes: bool, tmp_path: Path) -> None:
    message = tmp_path / "message"
    message.write_text(
        f"{title}\n\nThe body may be longer.\n# A comment of git\n", encoding="utf-8"
    )
    ended = subprocess.run(
        [sys.executable, HOOK, message], check=False, capture_output=True, text=True
    )
    assert (ended.returncode == 0) is passes
    assert bool(ended.stderr) is not passes
