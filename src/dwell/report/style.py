"""Style of a page: the labels and colours of policies and scenarios in all of its figures."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dwell.model import Problem
from dwell.report.formatting import shown_contender, shown_in_sentence, shown_scenario
from dwell.report.palette import BELIEFS, FAMILIES, VARIANTS, Palette, Style, contended, ramp_styles
from dwell.study.chapter import Chapter, Figure

if TYPE_CHECKING:
    import polars as pl

__all__ = ["CONTENDERS", "PageStyle", "key"]

#: A contender's name as studies have it, in a sentence; two words are what they say there.
WORDS = tuple(name for name in FAMILIES if " " not in name)
CALLED = re.compile(
    rf"(?<![\w+-])(?:{'|'.join(WORDS)})(?:-(?:{'|'.join(VARIANTS)}))?"
    rf"(?:\+(?:{'|'.join(BELIEFS)}))?(?![\w+-])"
)
#: Columns of tables that hold contenders.
CONTENDERS = ("policy", "contender")


def key(value: object) -> str:
    """Return a value of a column as the text that stands for it."""
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, slots=True)
class PageStyle:
    """Colours, styles and names that are the same wherever something is shown.

    Parameters
    ----------
    palette : Palette
    scenarios : frozenset of str
        Names as in the cell file.
    """

    palette: Palette
    scenarios: frozenset[str]

    @classmethod
    def of(cls, problem: Problem, chapters: Iterable[Chapter] = ()) -> PageStyle:
        """Collect every candidate and contender that chapters show.

        A candidate that a chapter adds to those of the cell has the next colour, in every chapter.
        """
        chapters = tuple(chapters)
        known = frozenset(problem.candidates)
        figures = [figure for chapter in chapters for figure in chapter.figures]
        added = (name for figure in figures for name in _candidates(figure, known))
        candidates = dict.fromkeys((*problem.candidates, *added))
        shown = dict.fromkeys(name for chapter in chapters for name in _texts(chapter))
        policies = [name for name in shown if name in candidates or contended(name)]
        scenarios = {*problem.scenarios, *_scenarios(chapters)}
        return cls(Palette.of(candidates, policies), frozenset(scenarios))

    @property
    def placements(self) -> Mapping[str, str]:
        """Colour of every candidate."""
        return self.palette.placements

    def is_named(self, name: str) -> bool:
        """Whether a name is a candidate's or a contender's, whose style is the same everywhere."""
        return name in self.palette.policies or name in self.placements

    def styles(self, names: Sequence[str]) -> dict[str, Style]:
        """Return how each of several series is drawn; those that are values share a ramp."""
        values = [name for name in names if not self.is_named(name)]
        found = ramp_styles(values)
        for name in names:
            if name in self.palette.policies:
                found[name] = self.palette.policies[name]
            elif name in self.placements:
                found[name] = Style(self.placements[name], "o", "solid", 1.3)
        return {name: found[name] for name in names}

    def shown(self, value: object) -> str:
        """Return what a value is called: a scenario, a contender, or itself."""
        text = key(value)
        if text in self.scenarios:
            return shown_scenario(text)
        return shown_contender(text).replace("->", "→")

    def titled(self, value: object) -> str:
        """Return what a value is called over a panel or a group of rows: it begins large."""
        text = self.shown(value)
        word = re.match(r"[a-z]{2,}(?![\w.])", text)
        return text[:1].upper() + text[1:] if word else text

    def prose(self, text: str) -> str:
        """Return a sentence in which contenders are called as in tables and figures.

        ``dtp+corrected`` becomes ``DTP (corrected)``, ``R1->E`` becomes R1→E; what stands in
        `code` stays.
        """
        parts = text.split("`")
        parts[::2] = [self._called(part) for part in parts[::2]]
        return "`".join(parts)

    def _called(self, text: str) -> str:
        text = CALLED.sub(lambda found: shown_contender(found.group(0)), text).replace("->", "→")
        for scenario in self.scenarios:
            # A word of a sentence is no name; one with a hyphen is.
            if "-" in scenario:
                text = re.sub(
                    rf"(?<![\w-]){re.escape(scenario)}(?![\w-])", shown_in_sentence(scenario), text
                )
        return text


def _candidates(figure: Figure, known: frozenset[str]) -> Iterator[str]:
    """Yield the names in a figure that can only be candidates."""
    if figure.kind == "map":
        winners = tuple(_values(figure.frame, figure.series))
        # A map may also be of something else than winners.
        yield from winners if known.intersection(winners) else ()
    if figure.kind == "timeline":
        yield from _values(figure.frame, "placement")


def _scenarios(chapters: Iterable[Chapter]) -> Iterator[str]:
    """Yield the scenarios that chapters add to those of the cell: what is called as these are."""
    for chapter in chapters:
        frames = [item.frame for item in chapter.figures] + [item.frame for item in chapter.tables]
        for frame in frames:
            for name in _values(frame, "scenario"):
                if re.fullmatch(r"\w+(-\w+)*", name) and contended(name) is None:
                    yield name


def _texts(chapter: Chapter) -> Iterator[str]:
    """Yield what may be a contender's name in a chapter."""
    for figure in chapter.figures:
        for column in (figure.series, figure.x, figure.facet, figure.facet_row):
            if column is not None:
                yield from _values(figure.frame, column)
    for table in chapter.tables:
        for column in CONTENDERS:
            yield from _values(table.frame, column)


def _values(frame: pl.DataFrame, column: str) -> Iterator[str]:
    """Yield what a column holds, each once; nothing where there is none or it holds numbers."""
    if column not in frame.columns or frame[column].dtype.is_numeric():
        return
    yield from (str(value) for value in frame[column].unique(maintain_order=True).drop_nulls())
