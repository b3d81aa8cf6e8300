"""The longest run that recorded traces allow."""

from __future__ import annotations

from bisect import bisect_left

from dwell.errors import TraceError
from dwell.model import Problem


def longest_run(problem: Problem, windows: int) -> int:
    """Return `windows`, or the number of windows in the problem's traces if that is smaller.

    Raises
    ------
    TraceError
        If the traces are too short for a window after the warm-up.
    """
    from dwell.sim import draw

    def too_many(length: int) -> bool:
        try:
            for scenario in problem.scenarios:
                draw(problem, scenario=scenario, seed=0, windows=length)
        except TraceError:
            # The shortest run is too long for the traces.
            if length == lengths[0]:
                raise
            return True
        return False

    lengths = range(problem.warmup_windows + 1, windows + 1)
    enough = len(lengths)
    if lengths and too_many(windows):
        enough = bisect_left(lengths, True, key=too_many)
    return problem.warmup_windows + enough
