"""All chapters, one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

from dwell.errors import DwellError, SimulationError
from dwell.model import Problem
from dwell.study.chapter import Chapter
from dwell.study.paper.running import Runner, Scale, Show

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["CHAPTERS", "Paper", "paper_study"]

#: Takes the cell, or all cells that replay measurements.
Write: TypeAlias = "Callable[[Problem | Sequence[Problem], Scale, Runner], Chapter]"

#: Modules with a function `chapter`, in the order of the report.
CHAPTERS = (
    "table",
    "dynamic",
    "concurrent",
    "reversion",
    "chatter",
    "weights",
    "hysteresis",
    "jitter",
    "dominance",
)
#: The chapter on cells that replay measurements; it takes them all.
REAL = "real"


@dataclass(frozen=True, slots=True)
class Paper:
    """What came of the chapters.

    Parameters
    ----------
    chapters : tuple of Chapter
        Those that were finished, in order.
    failures : mapping of str to DwellError
        What the others failed with, by their names; their finished runs stay.
    """

    chapters: tuple[Chapter, ...]
    failures: Mapping[str, DwellError]


def paper_study(
    problem: Problem,
    *,
    folder: Path,
    scale: Scale,
    processes: int | None = None,
    dask: str | None = None,
    show: Show | None = None,
    done: Callable[[Chapter], None] | None = None,
    only: Iterable[str] | None = None,
    real: Sequence[Problem] = (),
) -> Paper:
    """Write every chapter; runs that are finished in the folder are not done again.

    Parameters
    ----------
    problem : Problem
        See `dwell.study.paper.cell.paper_problem`.
    folder : Path
        The studies' folders go to ``runs`` below it.
    scale : Scale
    processes : int, optional
    dask : str, optional
        See `dwell.study.run_study`.
    show : callable, optional
        Shows progress; see `Runner`.
    done : callable, optional
        Called with every chapter as soon as it is finished.
    only : iterable of str, optional
        Names of the chapters to be written; all where None.
    real : sequence of Problem
        Cells that replay measurements; their chapter is left out where there are none.

    Returns
    -------
    Paper
        A chapter that fails keeps no other from being written.

    Raises
    ------
    SimulationError
        If `only` names no chapter.
    """
    shown = {} if show is None else {"show": show}
    runner = Runner(folder / "runs", processes, dask, **shown)
    chapters: list[Chapter] = []
    failures: dict[str, DwellError] = {}
    for name in _chosen(only, with_real=bool(real)):
        try:
            chapter = chapter_of(name)(real if name == REAL else problem, scale, runner)
        except DwellError as error:
            failures[name] = error
            continue
        chapters.append(chapter)
        if done is not None:
            done(chapter)
    return Paper(tuple(chapters), failures)


def chapter_of(name: str) -> Write:
    """Return the function that writes a chapter."""
    # By name: a chapter's own imports take time, and only those that are asked for are read.
    return cast("Write", import_module(f"dwell.study.paper.{name}").chapter)


def _chosen(only: Iterable[str] | None, *, with_real: bool) -> tuple[str, ...]:
    known: tuple[str, ...] = (*CHAPTERS, REAL) if with_real else CHAPTERS
    if only is None:
        return known
    asked = tuple(only)
    unknown = [name for name in asked if name not in known]
    if unknown or not asked:
        what = f"there is no chapter {unknown[0]!r}" if unknown else "no chapter is named"
        raise SimulationError(f"{what}; the chapters are {', '.join(known)}")
    return tuple(name for name in known if name in asked)
