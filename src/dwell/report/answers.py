"""Answers: the questions of a page's chapters, as its first table and as their headings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

from dwell.report.page import Cell, marked, table
from dwell.report.style import PageStyle
from dwell.study.chapter import Answer, Chapter

__all__ = ["answers", "beginning"]

TAGS: dict[Answer, tuple[str, str]] = {
    "yes": ("yes", "good"),
    "no": ("no", "bad"),
    "in part": ("in part", "open"),
    "not shown": ("not shown", "open"),
    "none asked": ("", ""),
}


def answers(chapters: Sequence[Chapter], look: PageStyle) -> Iterator[str]:
    """Return every question with its answer, as a table; nothing without chapters."""
    rows: list[tuple[str, Sequence[Cell]]] = [
        (
            "",
            [
                Cell(f'<a href="#{_anchor(chapter)}">{marked(look.prose(chapter.title))}</a>'),
                Cell(_tagged(chapter.answer, "nowrap answer")),
                Cell(marked(look.prose(chapter.verdict))),
            ],
        )
        for chapter in chapters
    ]
    if rows:
        yield table([Cell("question"), Cell("answer"), Cell("")], rows, kind="summary")


def beginning(chapter: Chapter, look: PageStyle) -> str:
    """Return the beginning of a chapter's section: where the table leads to, and its heading."""
    tag = _tagged(chapter.answer, "tag")
    heading = f"<h2>{marked(look.prose(chapter.title))}{tag}</h2>"
    return f'<section id="{_anchor(chapter)}">\n{heading}'


def _tagged(answer: Answer, kinds: str) -> str:
    word, kind = TAGS[answer]
    return f'<span class="{kinds} {kind}">{word}</span>' if word else ""


def _anchor(chapter: Chapter) -> str:
    return f"chapter-{escape(chapter.slug)}"
