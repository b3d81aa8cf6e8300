"""Formats of numbers and names: the same in pages, figures and on the terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from dwell.display import Measure, decimals_for, write_number, write_places
from dwell.report.palette import FAMILIES, contended
from dwell.study import Interval
from dwell.study.metric import METRICS
from dwell.study.over_seeds import RUN, UNIT

if TYPE_CHECKING:
    import polars as pl

#: Note for every page and table that shows ATP.
OURS = "ATP is our reconstruction."
#: Fewer seeds give wide intervals; pages then recommend more seeds.
FEW_SEEDS = 5
#: Reason why the windows of a run are not independent, and the consequence.
LASTING = (
    "a trace is replayed, or what comes and goes takes longer than a run; there limits of V_D rest "
    "on the number of runs alone"
)
#: A symbol with its index: V_D, N_min, α_L.
SYMBOL = re.compile(r"(?<![\w.])([A-ZΔα-ωdp])_(D|L|V|S|r|e|z|min|max|loss)(?!\w)")
#: L95 of the final latencies of cycles.
FINAL_L95 = METRICS["l95_ms"].called("L95 final")
ABBREVIATIONS = {"cpu": "CPU", "gpu": "GPU", "lan": "LAN", "wan": "WAN", "5g": "5G"}


class Written(NamedTuple):
    """A number and its interval, each as text."""

    value: str
    error: str

    def __str__(self) -> str:
        """Return ``3.4 ± 0.2``."""
        return f"{self.value} {self.error}".strip()


def write_ms(value: float) -> str:
    """Write a time in milliseconds, with its unit, as `write_number` does: ``12.3 ms``."""
    return f"{write_number(value, decimals_for(value, 1))} ms"


def write_interval(interval: Interval, measure: Measure, *, larger_half: bool = False) -> Written:
    """Write a mean over seeds with its 95 % interval.

    The interval is ``± half`` with the larger half if the halves differ by at most one unit of the
    last digit and ``±`` gives both ends the right sign; else it is ``[low, high]``. An unknown
    interval, or an interval of width 0, is left out; ``± <0.1`` means a half that rounds to 0.

    Parameters
    ----------
    larger_half : bool
        Whether to write ``±`` and the larger half for every finite interval: for narrow tables that
        explain it.
    """
    text = measure.number(interval.value)
    value, low, high = (end * measure.factor for end in interval)
    if not interval.known or low == high:
        return Written(text, "")
    half = max(high - value, value - low)
    if measure.ends or not math.isfinite(half):
        return Written(text, _between(low, high, measure))
    places = measure.places(value)
    least = 10.0**-places
    small = half < least / 2
    if not (larger_half or small or _is_even(value, low, high, least)):
        return Written(text, _between(low, high, measure))
    if small:
        return Written(text, f"± <{write_places(least, places)}")
    return Written(text, f"± {write_places(half, places)}")


def _is_even(value: float, low: float, high: float, least: float) -> bool:
    """Whether both halves are equal to the last digit, and ``±`` keeps the signs of the ends."""
    below, above = value - low, high - value
    half = max(below, above)
    # The tolerance allows for rounding when the halves differ by exactly one unit.
    alike = abs(above - below) <= least * (1 + 1e-6)
    return alike and (value - half < 0) == (low < 0) and (value + half > 0) == (high > 0)


def _between(low: float, high: float, measure: Measure) -> str:
    ends = (
        write_number(end, measure.decimals, signed=measure.signed, fixed=measure.fixed)
        for end in (low, high)
    )
    return f"[{', '.join(ends)}]"


def few_seeds(count: int) -> str:
    """Return the end of a sentence that recommends more seeds; empty for enough seeds."""
    if count >= FEW_SEEDS:
        return ""
    return f". Few seeds: give at least {FEW_SEEDS} for intervals that say something."


def independent_runs(runs: pl.DataFrame) -> str:
    """Return a sentence on scenarios whose runs, not windows, are independent; empty if none."""
    names = list(dict.fromkeys(runs.filter(unit=RUN)["scenario"])) if UNIT in runs.columns else []
    if not names:
        return ""
    listed = ", ".join(map(shown_scenario, names))
    return f" Runs, not windows, are independent in {listed}: {LASTING}."


def percent(share: float, decimals: int = 0) -> str:
    """Write a share in percent: ``5 %``."""
    return f"{write_number(100 * share, decimals)} %"


def shown_policy(name: str) -> str:
    """Return a policy's name for display: ``DTP (corrected)``; ATP gets "our reconstruction"."""
    known = contended(name)
    return _shown(name, "our reconstruction" if known and known.family == "atp" else "")


def shown_contender(name: str) -> str:
    """Return a contender's name for display: ``DTP (corrected)``; unknown names stay as they are.

    The caller adds the note on ATP (`OURS`).
    """
    return _shown(name)


def _shown(name: str, remark: str = "") -> str:
    known = contended(name)
    if known is None:
        return name
    shown = FAMILIES[known.family].label
    shown += f"-{known.variant}" if known.variant else ""
    brackets = "; ".join(filter(None, (remark, known.belief)))
    shown += f" ({brackets})" if brackets else ""
    glue = " " if known.rest.startswith("as ") else ", "
    return f"{shown}{glue}{known.rest}" if known.rest else shown


def shown_scenario(name: str) -> str:
    """Return a scenario's name for display: ``Robot CPU stress`` for ``robot-cpu-stress``."""
    words = name.replace("_", "-").split("-")
    text = " ".join(ABBREVIATIONS.get(word, word) for word in words)
    return text[:1].upper() + text[1:]


def listed(items: Iterable[str], last: str = "and") -> str:
    """Return the items as a list in words: ``a``, ``a and b``, ``a, b and c``."""
    words = list(items)
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
