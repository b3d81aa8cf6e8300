"""Display of results: formats of numbers, summaries, pictures in a notebook, colours of placements.

The package `dwell` registers the functions that make summaries and pictures. They are imported at
the first display.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

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


def write_number(
    value: float, decimals: int = 1, *, signed: bool = False, fixed: bool = False
) -> str:
    """Write a number with `decimals` decimals, or fewer if that makes more than three digits.

    `fixed` keeps the number of decimals. Thin spaces separate thousands; infinity is ∞; NaN is a
    dash.
    """
    if math.isnan(value):
        return "–"
    plus = "+" if signed and value > 0 else ""
    if math.isinf(value):
        return f"{plus}∞" if value > 0 else "−∞"
    return plus + write_places(value, decimals if fixed else places_for(value, decimals))


def places_for(value: float, decimals: int) -> int:
    """Return the number of decimals for three digits in total, at most `decimals`."""
    whole = 1 + math.floor(math.log10(abs(value))) if value else 1
    return max(0, min(decimals, 3 - whole))


def write_places(value: float, places: int) -> str:
    """Write a finite number with `places` decimals."""
    # Adding 0.0 turns -0.0 into 0.0.
    return f"{round(value, places) + 0.0:,.{places}f}".replace(",", "\u2009").replace("-", "−")


@dataclass(frozen=True, slots=True)
class Measure:
    """Name and format of a column of numbers.

    Parameters
    ----------
    column : str
        Key of the rows; for many runs a column of ``Comparison.runs``.
    name : str
        Heading without the unit.
    unit : str
        Unit after the name; empty for numbers without a unit.
    factor : float
        Factor from the column's unit to the shown unit.
    ends : bool
        Whether the interval is always written as ``[low, high]``.
    signed : bool
        Whether positive numbers have a plus sign.
    fixed : bool
        Whether all numbers have `decimals` decimals, even with more than three digits.
    """

    column: str
    name: str
    unit: str = ""
    factor: float = 1.0
    decimals: int = 1
    ends: bool = False
    signed: bool = False
    fixed: bool = False

    @property
    def heading(self) -> str:
        """The name with its unit: ``L95 (ms)``."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def called(self, name: str, column: str | None = None) -> Self:
        """Return the measure under another name, and of another column."""
        return replace(self, name=name, column=column or self.column)

    def places(self, shown: float) -> int:
        """Return the number of decimals for a number in the shown unit."""
        return self.decimals if self.fixed else places_for(shown, self.decimals)

    def number(self, value: float) -> str:
        """Write a value in the shown unit, without the unit.

        An integer has no decimals. Zero is ``0`` unless the measure is `fixed`.
        """
        shown = self.factor * value
        if not self.fixed and (not shown or (isinstance(value, int) and self.factor == 1.0)):
            return write_number(shown, 0, signed=self.signed)
        return write_number(shown, self.decimals, signed=self.signed, fixed=self.fixed)

    def text(self, value: float) -> str:
        """Write a value with its unit: ``12.3 ms``."""
        return f"{self.for_size(self.factor * value).number(value)} {self.unit}".rstrip()

    def for_size(self, *values: float) -> Self:
        """Return the measure with enough decimals for the largest of these numbers.

        Only times get more decimals, if all of them would be rounded to 0.
        """
        size = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
        if self.unit not in ("ms", "s") or size >= 10.0**-self.decimals:
            return self
        return replace(self, decimals=decimals_for(size, self.decimals))


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
