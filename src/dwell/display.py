"""Display of results: a summary on a screen, a picture in a notebook, the colours of placements.

Summary and picture are made by what the package `dwell` has given `Displayed`, and only when
something is shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import ClassVar, Protocol

#: Decimals of a nanosecond in milliseconds: nobody asks for what is behind them.
OF_A_NANOSECOND = 6
#: Hues that colour-blind readers tell apart, too: those of Okabe and Ito (2008).
HUES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#b8a800")


def placement_hues(candidates: Iterable[str]) -> dict[str, str]:
    """Give every candidate its hue, in the order of the cell file."""
    return {name: HUES[i % len(HUES)] for i, name in enumerate(candidates)}


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


class Answers(Protocol):
    """What makes summaries and pictures."""

    def summary_of(self, shown: object) -> str:
        """Return the answer as text: 24 lines of 80 columns at most."""
        ...

    def html_of(self, shown: object) -> str:
        """Return the answer as HTML for a notebook."""
        ...


class Displayed:
    """Has a summary, and in a notebook a picture with its numbers."""

    __slots__ = ()
    _answers: ClassVar[Callable[[], Answers]]

    @staticmethod
    def shown_by(answers: Callable[[], Answers]) -> None:
        """Have this called whenever something is shown."""
        Displayed._answers = answers

    def summary(self) -> str:
        """Return what it comes to as text: 24 lines of 80 columns at most."""
        return Displayed._answers().summary_of(self)

    def _repr_html_(self) -> str:
        return Displayed._answers().html_of(self)
