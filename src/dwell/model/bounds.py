"""Bounds on the numbers of a cell, each stated once: constructors and file readers both use it."""

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
    """Return a value as messages show it: its repr, unless that is very long."""
    if isinstance(value, int) and abs(value) >= 10**18:
        # Python refuses to print numbers of more than some thousand digits.
        return f"a whole number of about {int(value.bit_length() * math.log10(2)) + 1} digits"
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."


def counted(count: float, noun: str) -> str:
    """Return how many there are of a thing: ``1 window``, ``2 windows``, ``2 policies``."""
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
        Ends of the interval; an infinite `high` lets infinity in.
    above, below : bool
        Whether `low`, and `high`, are themselves outside.
    whole : bool
        Whether only whole numbers are inside.
    """

    low: float
    high: float = math.inf
    above: bool = False
    below: bool = False
    whole: bool = False

    def holds(self, value: object) -> bool:
        """Whether `value` is a number inside; a truth value is no number, and NaN is in none."""
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
        """Return ``a number from 0 to 1e9``, or what the bound is."""
        kind = "a whole number" if self.whole else "a number"
        low, high = short(self.low), short(self.high)
        if self.high == math.inf:
            return f"{kind} above {low}" if self.above else f"{kind} of at least {low}"
        if not self.above and not self.below:
            return f"{kind} from {low} to {high}"
        first = f"above {low}" if self.above else f"of at least {low}"
        last = f"below {high}" if self.below else f"at most {high}"
        return f"{kind} {first} and {last}"


def short(value: float) -> str:
    """Return a number as people write it: 1e9 and 1000000, not 1e+09."""
    if abs(value) <= MAX_COUNT and value == int(value):
        return str(int(value))
    return f"{value:g}".replace("e+0", "e").replace("e+", "e").replace("e-0", "e-")


# Values of processes: milliseconds, or bare factors.
VALUE = Bound(0, LARGEST)
MEAN = Bound(0, LARGEST, above=True)
REAL = Bound(-LARGEST, LARGEST)
CV = Bound(0, 100)
GAMMA_CV = Bound(1e-6, 100)
RHO = Bound(-1, 1, above=True, below=True)
BURST_MEAN = Bound(0.01, LARGEST)

# Pipeline.
PERIOD_MS = Bound(1e-3, LARGEST)
EVERY_MS = Bound(0, LARGEST, above=True)
DEADLINE_MS = Bound(1e-6, LARGEST)
TIME_MS = Bound(0, LARGEST)
THREADS = Bound(1, MAX_COUNT, whole=True)
WORKERS = Bound(1, MAX_COUNT, whole=True)
DEPTH = Bound(0, MAX_COUNT, whole=True)
PRIORITY = Bound(-1000, 1000, whole=True)
BYTES = Bound(0, 1e12, whole=True)
STATE_BYTES = Bound(0, 1e15, whole=True)

# Fabric. The quota's period is the kernel's own bound.
CORES = Bound(1, 4096, whole=True)
ACCELERATORS = Bound(1, 4096, whole=True)
FOREIGN_THREADS = Bound(0, MAX_COUNT, whole=True)
QUOTA_CPU = Bound(1e-3, 4096)
QUOTA_PERIOD_MS = Bound(1, 1000)
QUOTA_SLACK_MS = Bound(0, 1000)
QUOTA_TICK_MS = Bound(0, 1000)
BACKGROUND = Bound(0, 4096)
BACKGROUND_HZ = Bound(0, 100_000)
INTERFERENCE = Bound(1, 100)
CONTENTION = Bound(0, 0.9)
RATE_MBPS = Bound(1e-4)
LOSS = Bound(0, 1, below=True)
RETRANSMIT_MS = Bound(1e-3, LARGEST)

# Scenario.
AT_S = Bound(0, LARGEST, below=True)
FOR_S = Bound(0, above=True)
RAMP_S = Bound(0, LARGEST)
EPISODE_MEAN_S = Bound(1e-5, LARGEST)
ADDED_LOSS = Bound(0, 1)

# Objective: bounded so that J is finite whatever a window shows.
WEIGHT = Bound(0, LARGEST)
TARGET = Bound(1e-9, LARGEST)
CAP = Bound(0, above=True)

# Servo.
SERVO_GAIN = Bound(0, MAX_COUNT, above=True)
DAMPING = Bound(0, MAX_COUNT)
AMPLITUDE_MM = Bound(1e-6, MAX_COUNT)
TARGET_PERIOD_S = Bound(1e-5, LARGEST)

# Live runtime. Each process of a node takes three ports.
PORT = Bound(1024, 65_000, whole=True)
AGE_MS = Bound(0, LARGEST, above=True)
CHECKPOINT_CYCLES = Bound(0, MAX_COUNT, whole=True)
DEGRADED_AT = Bound(0, 1)
STANDBY = Bound(0, 1, whole=True)
HANDED_MS = Bound(0, 1e6)

# Length of a run: the cycles that an event of the simulator counts, and the seconds that 64 bits of
# nanoseconds hold.
CYCLES = Bound(1, 2**32 - 1, whole=True)
LENGTH_S = Bound(0, 9.2e9)

# Seeds of a study are 1 to N.
SEEDS = Bound(1, 100_000, whole=True)

# Controller and windows.
WINDOW_CYCLES = Bound(1, MAX_COUNT, whole=True)
WARMUP_WINDOWS = Bound(0, MAX_COUNT, whole=True)
MIN_DWELL = Bound(0, MAX_COUNT, whole=True)
MIN_IMPROVEMENT = Bound(0, LARGEST)
GUARD_CYCLES = Bound(2, MAX_COUNT, whole=True)
PROBE_CYCLES = Bound(1, MAX_COUNT, whole=True)
LEAD_CYCLES = Bound(0, MAX_COUNT, whole=True)
SHADOW_FRACTION = Bound(0, 1)
HALF_LIFE_WINDOWS = Bound(0, MAX_COUNT, above=True)
CUSUM_MEMORY = Bound(0, 1, above=True)
