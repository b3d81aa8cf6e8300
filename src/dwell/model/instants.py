"""Limits of time: the last instant of a run, and an instant after all others."""

from __future__ import annotations

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import CYCLES, LENGTH_S, counted, short

#: Later than every real instant and longer than every latency; its sum with either fits 64 bits.
NEVER_NS = 1 << 62
#: Age beyond which failures of calls, cycles and shadows are ignored.
EVIDENCE_NS = 10_000_000_000
#: Last instant at which a run may release a cycle, since its first (291 years). The sum with
#: twenty times of a cell file (1e9 ms each) fits 64 bits.
HORIZON_NS = 9_200_000_000_000_000_000


def require_length(
    windows: int, window_cycles: int, period_ms: float, asked: str = "windows"
) -> int:
    """Return the number of cycles of a run.

    Raises a ProblemError about the option `asked` if the cycles are too many or last too long.
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
    """Return the largest number of cycles of a run."""
    return int(min(CYCLES.high, LENGTH_S.high / (period_ms / 1e3)))
