"""The ends of time: the last instant of a run, and the instant that never comes."""

from __future__ import annotations

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import CYCLES, LENGTH_S, counted, short

#: Later than every instant of people, longer than every latency; the sum with any of them fits 64
#: bits.
NEVER_NS = 1 << 62
#: Age beyond which failures of calls, cycles and shadows say nothing any more.
EVIDENCE_NS = 10_000_000_000
#: Last instant at which a run may release a cycle, since its first (291 years). Twenty times of a
#: cell file (1e9 ms each) can be added to it, and 64 bits hold the sum.
HORIZON_NS = 9_200_000_000_000_000_000


def require_length(
    windows: int, window_cycles: int, period_ms: float, asked: str = "windows"
) -> int:
    """Return the number of cycles of a run, which 64 bits must hold with their instants.

    Parameters
    ----------
    asked : str
        Name of what asks for the windows, as messages have it.

    Raises
    ------
    ProblemError
        If they are too many, or last too long.
    """
    cycles = windows * window_cycles
    product = f"{counted(windows, 'window')} of window_cycles = {window_cycles}"
    if not CYCLES.holds(cycles):
        message = f"{product} are {cycles} cycles; a run has at most {CYCLES.high}: ask for less"
        raise ProblemError([Fault(asked, message)])
    length_s = cycles * (period_ms / 1e3)
    if not LENGTH_S.holds(length_s):
        message = (
            f"{product} and period_ms = {short(period_ms)} last {short(length_s)} s; a run lasts "
            f"at most {short(LENGTH_S.high)} s (291 years), in nanoseconds of 64 bits: ask for "
            "less, or lower window_cycles or period_ms"
        )
        raise ProblemError([Fault(asked, message)])
    return cycles


def longest_run(period_ms: float) -> int:
    """Return how many cycles a run has at most."""
    return int(min(CYCLES.high, LENGTH_S.high / (period_ms / 1e3)))
