"""Tables, figures and chapters of a page: the data, and which of its columns means what.

Chapters hold data and what is to be seen in them, never a drawing: `dwell.report` draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from dwell.model import FrozenDict

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Answer", "Chapter", "ChapterOutcome", "Figure", "FigureKind", "Panel", "Table", "Unit"]

Answer: TypeAlias = Literal["yes", "no", "in part", "not shown", "none asked"]

#: How the numbers of a column are written: ``percent`` and ``change`` multiply by 100 (the second
#: with its sign), ``ms`` has two digits, ``cost`` three, ``p`` writes small ones as a bound.
Unit: TypeAlias = Literal["text", "count", "number", "percent", "change", "ms", "cost", "p"]

FigureKind: TypeAlias = Literal["intervals", "lines", "bars", "map", "ecdf", "timeline"]


class ChapterOutcome(NamedTuple):
    """What came out of a chapter's question.

    Parameters
    ----------
    answer : Answer
    verdict : str
        A sentence or two.
    evidence : tuple of str
        Sentences with the numbers that carry it.
    """

    answer: Answer
    verdict: str
    evidence: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Table:
    """A table of a chapter.

    Parameters
    ----------
    slug : str
        Name of its files.
    title : str
    frame : DataFrame
        One row a line. A column x that has an interval has it in ``x_low`` and ``x_high``.
    units : mapping of str to Unit
        Of the columns to be shown, in their order.
    headings : mapping of str to str
        What stands over a column; its name where missing.
    note : str
        What a reader has to know of it: n, intervals, families of tests.
    """

    slug: str
    title: str
    frame: pl.DataFrame
    units: Mapping[str, Unit]
    headings: Mapping[str, str] = field(default_factory=FrozenDict)
    note: str = ""


@dataclass(frozen=True, slots=True)
class Panel:
    """What a panel of a figure shows where its panels do not show the same.

    Parameters
    ----------
    y_label : str
        The panel's value of ``facet`` where empty.
    y_unit : Unit
    line_at : float, optional
        As 0.05 beside V_D, or the deadline beside L95.
    line_label : str
    log_y : bool
    """

    y_label: str = ""
    y_unit: Unit = "number"
    line_at: float | None = None
    line_label: str = ""
    log_y: bool = False


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of a chapter: a long frame, and which of its columns means what.

    Parameters
    ----------
    slug : str
        Name of its files.
    title : str
    kind : str
        * ``intervals``: a dot with its interval (``y``, ``y_low``, ``y_high``) for every ``x`` (a
          name) and ``series``;
        * ``lines``: ``y`` over a numeric ``x``, one line a ``series``, its band where there are
          ``y_low`` and ``y_high``;
        * ``bars``: ``y`` for every ``x`` (a name) and ``series``, with whiskers; where the series
          are measures and no candidates or policies, as S1 and ST, the first is filled and the
          second an outline;
        * ``map``: the winner ``series`` (a candidate; null where there is none) at each ``x`` and
          ``y`` of a grid; an optional numeric column ``margin`` (in ``y_unit``) is how much it
          wins by, an optional bool column ``marked`` hatches a cell, and ``line_label`` says what
          that means;
        * ``ecdf``: ``y``, the share of cycles within ``x`` milliseconds, one line a ``series``;
        * ``timeline``: several lines of ``y`` over ``x`` (window), stacked in panels by ``facet``,
          with the placement of each window in a column ``placement``. A series that is a
          candidate is drawn as a line, with a mark in every window in which it is the one that
          is active; one that is called after a candidate (``LOC alone``) as a dashed line in its
          colour; any other as one mark a window in the colour of the placement. Nulls are gaps.
    frame : DataFrame
    x, y : str
        Columns.
    series : str
        Column of a candidate's or a policy's name (coloured as everywhere), or of a value.
    facet : str, optional
        Column that parts the figure into panels.
    facet_row : str, optional
        Column that parts it again: panels of one value of it stand in one row (not in a timeline).
    x_label, y_label : str
    y_unit : Unit
    line_at : float, optional
        A level to be marked, as 0.05 for V_D, or the deadline in ``ecdf``.
    line_label : str
    log_x, log_y : bool
    note : str
    panels : mapping of str to Panel
        By the value of ``facet``: what a panel shows that has a measure of its own. Takes the
        place of ``y_label``, ``y_unit``, ``line_at``, ``line_label`` and ``log_y`` there.
    spans : DataFrame, optional
        Of a timeline: what happened ``begin`` to ``end`` (in units of ``x``) and its ``label``,
        one row a disturbance.
    """

    slug: str
    title: str
    kind: FigureKind
    frame: pl.DataFrame
    x: str
    y: str
    series: str
    facet: str | None = None
    x_label: str = ""
    y_label: str = ""
    y_unit: Unit = "number"
    line_at: float | None = None
    line_label: str = ""
    log_x: bool = False
    log_y: bool = False
    note: str = ""
    facet_row: str | None = None
    panels: Mapping[str, Panel] = field(default_factory=FrozenDict)
    spans: pl.DataFrame | None = None


@dataclass(frozen=True, slots=True)
class Chapter:
    """One question.

    Parameters
    ----------
    slug : str
    title : str
        The question.
    design : str
        What was compared, varied and held, on how many seeds and windows, and by which test.
    answer : Answer
    verdict : str
        One or two sentences.
    findings : tuple of str
        What else came out, the results that speak against the method included.
    tables : tuple of Table
    figures : tuple of Figure
    evidence : tuple of str
        Sentences with the numbers that carry the verdict.
    """

    slug: str
    title: str
    design: str
    answer: Answer
    verdict: str
    findings: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    evidence: tuple[str, ...] = ()
