"""Numbers of a chapter as they are written, by the unit of their column."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dwell.report.formatting import Measure, Written, write_interval, write_number
from dwell.study import Interval
from dwell.study.chapter import Unit

__all__ = ["factor", "labelled", "measure_of", "write", "write_over_seeds"]

#: What stands behind a heading; the numbers below it have none.
SIGNS: dict[Unit, str] = {"percent": "%", "change": "points", "ms": "ms"}
LEAST_P = 0.001
#: Decimals up to which numbers are settings, and written as they are.
EXACT = 3


def factor(unit: Unit) -> float:
    """From a column's numbers to those that are shown."""
    return 100.0 if unit in ("percent", "change") else 1.0


def labelled(name: str, unit: Unit) -> str:
    """Return a heading with its unit, once: ``V_D (%)``, its differences ``V_D (points)``."""
    sign = SIGNS.get(unit, "")
    if not sign or not name or f"({sign}" in name or f" {sign}" in name:
        return name
    return f"{name} ({sign})"


def measure_of(unit: Unit, values: Sequence[float]) -> Measure:
    """Return how numbers of a unit are written.

    Parameters
    ----------
    unit : Unit
    values : sequence of float
        All that stand together: bare numbers have the same decimals, as many as leave three digits
        of the larger ones, and no more than any of them needs.
    """
    decimals = {"percent": 1, "change": 1, "ms": 1, "cost": 2, "count": 1, "p": 3}
    if unit in decimals:
        return Measure("", "", "", factor(unit), decimals[unit], signed=unit == "change")
    finite = sorted(abs(value) for value in values if math.isfinite(value) and value)
    if not finite:
        return Measure("", "", "", 1.0, 0)
    large = finite[min(len(finite) - 1, math.floor(0.9 * len(finite)))]
    needed = max(len(f"{value:.6f}".rstrip("0").partition(".")[2]) for value in finite)
    fitting = 2 - math.floor(math.log10(large))
    # Of settings such as 0.001 to 32, each with three digits at most, none becomes nothing.
    if needed <= EXACT and finite[0] < 0.5 * 10.0**-fitting:
        fitting = needed
    return Measure("", "", "", 1.0, max(0, min(fitting, needed)))


def write(value: float, unit: Unit, measure: Measure | None = None) -> str:
    """Write a number without its unit; as `measure` says where it stands among others."""
    if unit == "p":
        small = 0 <= value < LEAST_P
        return f"<{LEAST_P:g}" if small else write_number(value, 3)
    if unit == "count" and value == round(value, 6) and float(value).is_integer():
        return write_number(value, 0)
    measure = measure or measure_of(unit, [value])
    return write_number(value * measure.factor, measure.decimals, signed=measure.signed)


def write_over_seeds(interval: Interval, unit: Unit, measure: Measure | None = None) -> Written:
    """Write a number over seeds with its interval, without the unit.

    Parameters
    ----------
    interval : Interval
    unit : Unit
    measure : Measure, optional
        How the numbers that it stands among are written.
    """
    if not interval.known:
        return Written(write(interval.value, unit, measure), "")
    return write_interval(interval, measure or measure_of(unit, interval))
