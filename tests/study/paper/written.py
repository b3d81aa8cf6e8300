"""What every chapter has to be: its tables and figures have the columns that they name."""

from __future__ import annotations

from dwell.study.chapter import Answer, Outcome
from dwell.study.paper import Chapter

__all__ = ["check_written", "told"]

ANSWERS = ("yes", "no", "in part", "not shown", "none asked")


def check_written(chapter: Chapter) -> None:
    """Assert that a chapter says something and can be drawn."""
    assert chapter.title
    assert chapter.design
    # A verdict is a sentence or two; the numbers are evidence.
    assert chapter.verdict
    assert len(chapter.verdict) < 340
    assert chapter.answer in ANSWERS
    texts = (chapter.verdict, *chapter.evidence, chapter.design, *chapter.findings)
    assert not any("nan" in text for text in texts)
    slugs = [table.slug for table in chapter.tables]
    assert len(set(slugs)) == len(slugs)
    assert all(slug.startswith(chapter.slug) for slug in slugs)
    for table in chapter.tables:
        assert table.frame.height, table.slug
        assert set(table.units) <= set(table.frame.columns), table.slug
        assert set(table.headings) <= set(table.units), table.slug
    slugs = [figure.slug for figure in chapter.figures]
    assert len(set(slugs)) == len(slugs)
    for figure in chapter.figures:
        assert figure.slug.startswith(chapter.slug)
        assert figure.frame.height, figure.slug
        columns = {figure.x, figure.y, figure.series, figure.facet, figure.facet_row} - {None}
        assert columns <= set(figure.frame.columns), figure.slug
        if figure.kind in ("intervals", "bars", "map"):
            place = {figure.x, figure.series, figure.facet, figure.facet_row} - {None}
            place |= {figure.y} if figure.kind == "map" else set()
            assert not figure.frame.select(sorted(map(str, place))).is_duplicated().any()


def told(outcome: Outcome) -> tuple[Answer, str]:
    """Return an answer, and the verdict with its evidence as one text."""
    return outcome.answer, " ".join((outcome.verdict, *outcome.evidence))
