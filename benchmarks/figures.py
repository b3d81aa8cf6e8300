"""What a benchmark reports: figures with a spread, and goals they meet or miss."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

__all__ = ["Figure", "Goal", "Section", "as_json", "print_sections"]


@dataclass(frozen=True, slots=True)
class Goal:
    """Bounds that a figure is meant to keep."""

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        if math.isinf(self.low):
            return f"≤ {self.high:g}"
        if math.isinf(self.high):
            return f"≥ {self.low:g}"
        return f"{self.low:g} to {self.high:g}"

    def met(self, value: float) -> bool:
        """Whether the value keeps the bounds."""
        return self.low <= value <= self.high


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured quantity, a value a run.

    Parameters
    ----------
    what : str
    values : sequence of float
        One a run, at least one.
    unit : str
    goal : Goal, optional
        Compared with the median.
    """

    what: str
    values: Sequence[float]
    unit: str
    goal: Goal | None = None

    @property
    def value(self) -> float:
        """The median."""
        return median(self.values)

    @property
    def met(self) -> bool | None:
        """Whether the median keeps the goal; None without one."""
        return None if self.goal is None else self.goal.met(self.value)

    @property
    def verdict(self) -> str:
        """Whether the goal is met, and in how many of the runs."""
        if self.goal is None:
            return ""
        kept = sum(self.goal.met(value) for value in self.values)
        return f"{'yes' if self.met else 'NO'} ({kept} of {len(self.values)})"


@dataclass(frozen=True, slots=True)
class Section:
    """What one benchmark found."""

    title: str
    figures: Sequence[Figure]
    notes: Sequence[str] = ()


def as_json(name: str, section: Section) -> dict[str, Any]:
    """Everything in a section as plain values."""
    return {
        "benchmark": name,
        "title": section.title,
        "figures": [
            {
                "what": figure.what,
                "median": figure.value,
                "low": min(figure.values),
                "high": max(figure.values),
                "runs": len(figure.values),
                "unit": figure.unit,
                "goal": None if figure.goal is None else str(figure.goal),
                "met": figure.met,
            }
            for figure in section.figures
        ],
        "notes": list(section.notes),
    }


def print_sections(sections: Iterable[Section]) -> None:
    """Print a table a section as soon as it is there."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    for section in sections:
        table = Table(title=section.title, title_justify="left", title_style="bold")
        table.add_column("figure", overflow="fold")
        for heading in ("median", "lowest", "highest"):
            table.add_column(heading, justify="right", no_wrap=True)
        table.add_column("unit")
        table.add_column("goal", no_wrap=True)
        table.add_column("met (runs)", no_wrap=True)
        for figure in section.figures:
            low, high = min(figure.values), max(figure.values)
            spread = (_digits(low), _digits(high)) if len(figure.values) > 1 else ("", "")
            goal = "" if figure.goal is None else str(figure.goal)
            style = "red" if figure.met is False else None
            table.add_row(
                figure.what,
                _digits(figure.value),
                *spread,
                figure.unit,
                goal,
                figure.verdict,
                style=style,
            )
        console.print(table)
        for note in section.notes:
            console.print(f"  {note}", style="dim")
        console.print()


def _digits(value: float) -> str:
    """Four significant digits, whole numbers with thin groups of thousands."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(0, 3 - math.floor(math.log10(abs(value))))
    return f"{value:,.{places}f}".replace(",", " ")
