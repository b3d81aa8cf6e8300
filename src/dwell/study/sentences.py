"""Numbers and names as they stand in the sentences of a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable

__all__ = ["counted", "listed", "number", "percent", "points"]


def percent(share: float, decimals: int = 1) -> str:
    """``4.2 %``; infinity is ∞, what is not known a dash."""
    text = number(100 * share, decimals)
    return f"{text} %"


def points(share: float, decimals: int = 1, interval: tuple[float, float] | None = None) -> str:
    """A difference of shares, with its sign: ``+1.3 points``, ``+1.3 [0.9, 1.8] points``."""

    def signed(value: float) -> str:
        return f"{'+' if value > 0 else ''}{number(100 * value, decimals)}"

    ends = "" if interval is None else f" [{', '.join(map(signed, interval))}]"
    return f"{signed(share)}{ends} points"


def number(value: float, decimals: int = 1) -> str:
    """Write a number with a true minus sign and no digits that say nothing."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:.{decimals}f}"
    if float(text) == 0:
        text = text.removeprefix("-")
    return text.replace("-", "−")


def listed(items: Iterable[str], last: str = "and") -> str:
    """``a``, ``a and b``, ``a, b and c``; ``none`` where there is nothing."""
    words = list(items)
    if len(words) < 2:
        return "".join(words) or "none"
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def counted(count: int, of: int, what: str) -> str:
    """``3 of 5 scenarios``."""
    return f"{count} of {of} {what}"
