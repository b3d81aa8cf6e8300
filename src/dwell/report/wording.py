"""How numbers and names are written: the same in pages, figures and on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from dwell.study import Interval

__all__ = [
    "Measure",
    "Written",
    "listed",
    "shown_policy",
    "shown_scenario",
    "write_interval",
    "write_number",
]

POLICY_NAMES = {
    "dtp": "DTP",
    "atp": "ATP (our reconstruction)",
    "latency-first": "Latency-first",
    "work-function": "Work-function",
}
ABBREVIATIONS = {"cpu": "CPU"}


class Measure(NamedTuple):
    """How a column is written.

    Parameters
    ----------
    column : str
        Of ``Comparison.runs``.
    name : str
        Its heading.
    unit : str
        Behind the name; empty where there is none.
    factor : float
        From the column's unit to the one shown.
    decimals : int
    """

    column: str
    name: str
    unit: str = ""
    factor: float = 1.0
    decimals: int = 1

    @property
    def heading(self) -> str:
        """``L95 (ms)``."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


class Written(NamedTuple):
    """A number and what is known of its error, each as text."""

    value: str
    error: str

    def __str__(self) -> str:
        """Return ``3.4 ± 0.2``."""
        return f"{self.value} {self.error}".strip()


def write_number(value: float, decimals: int = 1) -> str:
    """Write a number; large ones without decimals and with thin spaces, infinity as ∞."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    places = decimals if abs(value) < 1000 else 0
    text = f"{value:,.{places}f}".replace(",", "\u2009")
    return text.replace("-", "−")


def write_interval(interval: Interval, measure: Measure) -> Written:
    """Write a number over seeds with its 95 % interval.

    Symmetric intervals become ``± half``; others, and those with an infinite end, ``[low, high]``.
    A number that was the same for every seed has no error beside it.
    """
    factor, decimals = measure.factor, measure.decimals
    value, low, high = (end * factor for end in interval)
    text = write_number(value, decimals)
    if not interval.known or low == high:
        return Written(text, "")
    if value in (low, high) or not math.isfinite(high):
        # One end only: every seed showed the same extreme.
        if interval.value in (0.0, 1.0):
            return Written(text, "")
        return Written(text, _between(low, high, decimals))
    half, other = high - value, value - low
    if abs(half - other) > 0.02 * (high - low):
        return Written(text, _between(low, high, decimals))
    places = decimals if abs(value) < 1000 else 0
    least = 10.0**-places
    if half < least / 2:
        return Written(text, f"± <{least:.{places}f}")
    return Written(text, f"± {write_number(half, places)}")


def _between(low: float, high: float, decimals: int) -> str:
    return f"[{write_number(low, decimals)}, {write_number(high, decimals)}]"


def shown_policy(name: str) -> str:
    """Name of a policy as tables show it; a candidate's, or your own, stays what it is."""
    return POLICY_NAMES.get(name, name)


def shown_scenario(name: str) -> str:
    """``robot-cpu-stress`` as ``Robot CPU stress``."""
    words = [ABBREVIATIONS.get(word, word) for word in name.replace("_", "-").split("-")]
    text = " ".join(words)
    return text[:1].upper() + text[1:]


def listed(items: Iterable[str], last: str = "and") -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    words = list(items)
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
