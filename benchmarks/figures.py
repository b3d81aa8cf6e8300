"""What a benchmark reports: figures with a spread, and goals they meet or miss."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any


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
    for section in sections:
        rows = [("", "median", "lowest", "highest", "", "goal", "met in runs")]
        for figure in section.figures:
            low, high = min(figure.values), max(figure.values)
            alone = len(figure.values) == 1
            rows.append(
                (
                    figure.what,
                    _digits(figure.value),
                    "" if alone else _digits(low),
                    "" if alone else _digits(high),
                    figure.unit,
                    "" if figure.goal is None else str(figure.goal),
                    figure.verdict,
                )
            )
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        print(section.title)
        for row in rows:
            cells = [
                text.rjust(width) if 1 <= column <= 3 else text.ljust(width)
                for column, (text, width) in enumerate(zip(row, widths, strict=True))
            ]
            print("  " + "  ".join(cells).rstrip())
        for note in section.notes:
            print(f"  ({note})")
        print(flush=True)


def _digits(value: float) -> str:
    """Four significant digits, thousands apart."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(0, 3 - math.floor(math.log10(abs(value))))
    return f"{value:,.{places}f}".replace(",", " ")
