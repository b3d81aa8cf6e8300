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
    "percent",
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
ABBREVIATIONS = {"cpu": "CPU", "gpu": "GPU", "lan": "LAN", "wan": "WAN", "5g": "5G"}


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
    ends : bool
        Whether the interval is always written by its ends.
    """

    column: str
    name: str
    unit: str = ""
    factor: float = 1.0
    decimals: int = 1
    ends: bool = False

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
    """Write a number with three digits that count, or fewer decimals where it is large.

    Thousands are parted by thin spaces, infinity is ∞, and what is not known is a dash.
    """
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return _fixed(value, _places(value, decimals))


def write_interval(interval: Interval, measure: Measure) -> Written:
    """Write a number over seeds with its 95 % interval.

    Symmetric intervals become ``± half``, others ``[low, high]``. Where every seed showed the same
    number, or the same extreme of a share, nothing stands beside it.
    """
    value, low, high = (end * measure.factor for end in interval)
    text = write_number(value, measure.decimals)
    if not interval.known or low == high or (value in (low, high) and interval.value in (0, 1)):
        return Written(text if value else "0", "")
    half = high - value
    even = math.isfinite(half) and abs(half - (value - low)) <= 0.02 * (high - low)
    if measure.ends or not even:
        return Written(text, _between(low, high, measure.decimals))
    places = _places(value, measure.decimals)
    least = 10.0**-places
    if half < least / 2:
        return Written(text, f"± <{_fixed(least, places)}")
    return Written(text, f"± {_fixed(half, places)}")


def _places(value: float, decimals: int) -> int:
    """Decimals that leave three digits, at most `decimals`."""
    whole = len(str(int(abs(value))))
    return max(0, min(decimals, 3 - whole))


def _fixed(value: float, places: int) -> str:
    return f"{value:,.{places}f}".replace(",", "\u2009").replace("-", "−")


def _between(low: float, high: float, decimals: int) -> str:
    return f"[{write_number(low, decimals)}, {write_number(high, decimals)}]"


def percent(share: float, decimals: int = 0) -> str:
    """Write a share in percent: ``5 %``."""
    return f"{write_number(100 * share, decimals)} %"


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
