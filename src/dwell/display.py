"""Display of results: a summary on a screen, and a picture in a notebook.

Both are made by `dwell.report`, which is imported when something is shown.
"""

from __future__ import annotations

import math

#: Decimals of a nanosecond in milliseconds: nobody asks for what is behind them.
OF_A_NANOSECOND = 6


def decimals_for(value: float, decimals: int) -> int:
    """Return decimals for a time in ms, s or minutes, so that at least two of its digits count.

    Parameters
    ----------
    decimals : int
        The least.
    """
    size = abs(value)
    if not math.isfinite(size) or size < 0.5 * 10.0**-OF_A_NANOSECOND:
        return decimals
    return max(decimals, min(1 - math.floor(math.log10(size)), OF_A_NANOSECOND))


def milliseconds(value: float, decimals: int = 1) -> str:
    """Write a time in milliseconds: ``12.34``, ``0.0042``; ∞ where it never ends."""
    if math.isinf(value):
        return "∞"
    return f"{value:.{decimals_for(value, decimals)}f}"


class Displayed:
    """Has a summary, and in a notebook a picture with its numbers."""

    __slots__ = ()

    def summary(self) -> str:
        """Return what it comes to as text: 24 lines of 80 columns at most."""
        from dwell.report.answer import summary_of

        return summary_of(self)

    def _repr_html_(self) -> str:
        from dwell.report.answer import html_of

        return html_of(self)
