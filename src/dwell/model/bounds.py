"""Bounds on the numbers of a cell, shared by constructors and file readers."""

from __future__ import annotations

import math
import numbers
import re
from dataclasses import dataclass

from dwell.errors import Fault, ProblemError

LARGEST = 1e9
MAX_COUNT = 1_000_000
LONGEST_SHOWN = 80


def require(holds: bool, path: str, value: object, bound: str) -> None:
    """Raise a ProblemError that names field, value and bound unless `holds`."""
    if not holds:
        raise ProblemError([Fault(path, f"{shown(value)} is not allowed; it must be {bound}")])


def shown(value: object) -> str:
    """Return a value's repr for messages, shortened if it is long."""
    if isinstance(value, int) and abs(value) >= 10**18:
        # Python refuses to print numbers of more than some thousand digits.
        return f"a whole number of about {int(value.bit_length() * math.log10(2)) + 1} digits"
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."


def as_read(value: object) -> str:
    """Return a single value as its author wrote it, or the kind of a compound value."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "infinity" if value > 0 else "-infinity"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return shown(value)


def counted(count: float, noun: str) -> str:
    """Return a count with its noun: ``1 window``, ``2 windows``, ``2 policies``."""
    if count == 1:
        return f"1 {noun}"
    stem, ending = (noun[:-1], "ies") if re.search("[^aeiou]y$", noun) else (noun, "s")
    return f"{count} {stem}{'es' if noun.endswith('s') else ending}"


@dataclass(frozen=True, slots=True)
class Bound:
    """An interval of numbers; its text completes the sentence "it must be ...".

    Parameters
    ----------
    low, high : float
        Ends of the interval; an infinite `high` allows infinity.
    above, below : bool
        Whether the interval excludes `low`, and `high`.
    whole : bool
        Whether only whole numbers are allowed.
    word : str
        A text that is also allowed; empty for none.
    """

    low: float
    high: float = math.inf
    above: bool = False
    below: bool = False
    whole: bool = False
    word: str = ""

    def holds(self, value: object) -> bool:
        """Return whether `value` is a number inside; NaN and truth values never are."""
        if self.word and value == self.word:
            return True
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            return False
        if self.whole and not isinstance(value, numbers.Integral):
            return False
        number = float(max(min(value, 10**18), -(10**18)) if isinstance(value, int) else value)
        over = number > self.low if self.above else number >= self.low
        under = number < self.high if self.below else number <= self.high
        return over and under

    def check(self, path: str, value: object) -> None:
        """Raise a ProblemError that names `path`, `value` and the bound unless it holds."""
        require(self.holds(value), path, value, str(self))

    def __str__(self) -> str:
        """Return a description of the interval, as ``a number from 0 to 1e9``."""
        kind = "a whole number" if self.whole else "a number"
        kind = f"{self.word} or {kind}" if self.word else kind
        low, high = short(self.low), short(self.high)
        if self.high == math.inf:
            return f"{kind} above {low}" if self.above else f"{kind} of at least {low}"
        if not self.above and not self.below:
            return f"{kind} from {low} to {high}"
        first = f"above {low}" if self.above else f"of at least {low}"
        last = f"below {high}" if self.below else f"at most {high}"
        return f"{kind} {first} and {last}"


@dataclass(frozen=True, slots=True)
class Pattern:
    """Texts that match a regular expression as a whole.

    Parameters
    ----------
    words : str
        Description of the texts; completes the sentence "it must be ...".
    """

    expression: str
    words: str

    def holds(self, value: object) -> bool:
        """Return whether `value` is a text that matches."""
        return isinstance(value, str) and re.fullmatch(self.expression, value) is not None

    def check(self, path: str, value: object) -> None:
        """Raise a ProblemError that names `path`, `value` and the description unless it matches."""
        require(self.holds(value), path, value, self.words)

    def __str__(self) -> str:
        return self.words


def short(value: float) -> str:
    """Return a number as people write it: 1e9 and 1000000, not 1e+09."""
    if abs(value) <= MAX_COUNT and value == int(value):
        return str(int(value))
    return f"{value:g}".replace("e+0", "e").replace("e+", "e").replace("e-0", "e-")


NOT_EMPTY = Pattern(r"[\s\S]+", "a text that is not empty")

# Bounds that several keys, or modules outside the model, use.
VALUE = Bound(0, LARGEST)
TIME_MS = Bound(0, LARGEST)
PERIOD_MS = Bound(1e-3, LARGEST)
EVERY_MS = Bound(0, LARGEST, above=True)
BURST_MEAN = Bound(0.01, LARGEST)
FOREIGN_THREADS = Bound(0, MAX_COUNT, whole=True)
BACKGROUND_HZ = Bound(0, 100_000)
RATE_MBPS = Bound(1e-4)
MIN_DWELL = Bound(0, MAX_COUNT, whole=True)
MIN_IMPROVEMENT = Bound(0, LARGEST)

# Length of a run: the simulator counts cycles in 32 bits, and time in 64 bits of nanoseconds.
CYCLES = Bound(1, 2**32 - 1, whole=True)
LENGTH_S = Bound(0, 9.2e9)

# Seeds of a study are 1 to N.
SEEDS = Bound(1, 100_000, whole=True)
#: Names of a user's own classes.
CLASS_PATH = Pattern(r"[^\W\d]\w*(?:\.[^\W\d]\w*)*:[^\W\d]\w*", "package.module:Class")
#: Names of a user's own functions.
FUNCTION_PATH = Pattern(CLASS_PATH.expression, "package.module:function")
