"""The instant at which a window closes."""

from __future__ import annotations

from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.model.number_arrays import Ints

if TYPE_CHECKING:
    from dwell.model.problem import Problem


def window_close_ns(
    problem: Problem, last_ns: Ints | int, beyond_ns: Ints | int
) -> NDArray[np.int64]:
    """Return the instant at which a window closes: after its grace and its last deadline.

    Releases never decrease from cycle to cycle, so the closes of consecutive windows never
    decrease, even if the windows are short.

    Parameters
    ----------
    last_ns : int, or int64 array of shape (...)
        Release of the window's last cycle.
    beyond_ns : int, or int64 array of shape (...)
        Release of the first cycle beyond it.

    Returns
    -------
    int64 array, shape (...)
        The later of `beyond_ns` + `close_grace_ms` and `last_ns` + D. If releases are P apart and D
        is at most P, the first is later, even if P is not a whole number of nanoseconds: a deadline
        between two nanoseconds has passed after the first of them.
    """
    due_ns, grace_ns = close_after_ns(problem)
    close_ns: Ints = np.maximum(beyond_ns + grace_ns, last_ns + due_ns)
    return close_ns


def close_after_ns(problem: Problem) -> tuple[int, int]:
    """Return the least time from a window's last release to its close, and from the next one."""
    # 28.6 ms are 28600000 ns, though their product in floating point may be a little less.
    due_ns = int(Decimal(str(problem.pipeline.deadline_ms)).scaleb(6))
    return due_ns, round(problem.controller.close_grace_ms * 1e6)
