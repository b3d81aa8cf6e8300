"""Display of results: a summary on a screen, a picture in a notebook, the colours of placements.

The package `dwell` registers the functions that make summaries and pictures. They are imported at
the first display.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import ClassVar, Protocol

#: Decimals of a nanosecond in milliseconds, the finest digit that is shown.
OF_A_NANOSECOND = 6
#: Hues that colour-blind readers can distinguish, after Okabe and Ito (2008). Each has a contrast
#: of at least 3:1 with the paper of light and of dark pages.
HUES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#998a4c", "#007fff", "#7f6040")


def placement_hues(candidates: Iterable[str]) -> dict[str, str]:
    """Return the hue of every candidate, in the order of the cell file."""
    return {name: HUES[i % len(HUES)] for i, name in enumerate(candidates)}


def decimals_for(value: float, decimals: int) -> int:
    """Return the number of decimals, at least `decimals`, that shows two significant digits."""
    size = abs(value)
    if not math.isfinite(size) or size < 0.5 * 10.0**-OF_A_NANOSECOND:
        return decimals
    return max(decimals, min(1 - math.floor(math.log10(size)), OF_A_NANOSECOND))


def milliseconds(value: float, decimals: int = 1) -> str:
    """Return a time in milliseconds as text: ``12.34``, ``0.0042``, or ∞."""
    if math.isinf(value):
        return "∞"
    return f"{value:.{decimals_for(value, decimals)}f}"


class Answers(Protocol):
    """Functions that make summaries and pictures."""

    def summary_of(self, shown: object) -> str:
        """Return the summary: at most 24 lines of 80 columns."""
        ...

    def html_of(self, shown: object) -> str:
        """Return the picture as HTML for a notebook."""
        ...


class Displayed:
    """Base of results: a summary as text, and a picture with its numbers in notebooks."""

    __slots__ = ()
    _answers: ClassVar[Callable[[], Answers]]

    @staticmethod
    def shown_by(answers: Callable[[], Answers]) -> None:
        """Register the functions that make summaries and pictures."""
        Displayed._answers = answers

    def summary(self) -> str:
        """Return the result as text: at most 24 lines of 80 columns."""
        return Displayed._answers().summary_of(self)

    def _repr_html_(self) -> str:
        return Displayed._answers().html_of(self)
