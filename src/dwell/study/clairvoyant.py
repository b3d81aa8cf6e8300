"""The cheapest sequence of placements when all costs are known: dynamic programming over windows.

The objective is the sum of J over windows, each with the switching term of the move before it::

    sum over k of  costs[k, m_k] + switching[m_{k-1}, m_k]

The minimum is over every sequence m that Algorithm 1 could produce for any input. Window 0 has the
initial placement, because placements are decided one window late. n_d, the number of windows since
the last migration, begins at 0, and a migration needs n_d >= N_min. The first migration therefore
takes effect in window N_min + 1 or later, and migrations are at least N_min + 1 windows apart. J
alone decides, without Delta_min and caps.

Method
    Let G_k(m) be the least cost of windows k to K - 1 if m is the placement before them and the
    dwell is over. Let f(k) be the first window that can migrate again after a migration into window
    k: k + N_min + 1. Staying costs window k under m; a migration to x also determines the windows
    up to f(k)::

        G_k(m) = min( costs[k, m] + G_{k+1}(m),
                      min over x of switching[m, x] + sum of costs[k:f(k), x] + G_{f(k)}(x) )

    With P_k(m) the costs of m summed over the windows before k, H_k = G_k + P_k needs no sums::

        H_k(m) = min( H_{k+1}(m), min over x of D_k(m, x) + H_{f(k)}(x) )
        D_k(m, x) = switching[m, x] + P_k(m) - P_k(x)

    D takes a few array operations for all windows together. Each window, last to first, then needs
    three NumPy calls: O(K M^2) operations for any dwell.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dwell.errors import MetricError, PolicyError
from dwell.model.bounds import MIN_DWELL
from dwell.model.number_arrays import Floats, Ints, Mask

#: Totals that differ by at most this share of the largest are a tie, because of rounding.
TIE_TOLERANCE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """A placement for every window, and the total cost.

    Parameters
    ----------
    choice : int64 array, shape (K,)
        Index of the candidate of each window.
    total : float
        Sum of J over the windows, including switching terms.
    """

    choice: Ints
    total: float


def clairvoyant(
    costs: ArrayLike,
    switching: ArrayLike,
    *,
    initial: int,
    min_dwell: int = 0,
    counts: ArrayLike | None = None,
    decides: ArrayLike | None = None,
) -> Sequence:
    """Find the sequence with the lowest total.

    In a tie the current placement wins, then the first candidate in order.

    Parameters
    ----------
    costs : array of float, shape (K, M)
        J of window k under candidate m, without its switching term.
    switching : array of float, shape (M, M)
        Price of a move from the row's candidate to the column's, in units of J; 0 on the
        diagonal.
    initial : int
        Candidate of window 0.
    min_dwell : int
        N_min, windows.
    counts : array of float, shape (K,), optional
        Weight of each window's J, with its switching term, in the total. Default: 1.
    decides : array of bool, shape (K,), optional
        Whether a decision follows the end of each window. Without a decision the placement stays
        and n_d does not grow. Default: all True.

    Raises
    ------
    MetricError
        If an array has the wrong shape, a value is not finite, or a price or count is negative.
    PolicyError
        If `initial` is no candidate, or `min_dwell` is out of its range.
    """
    costs, switching = _checked(costs, switching)
    windows, candidates = costs.shape
    if not 0 <= initial < candidates:
        raise PolicyError(f"initial is {initial!r}; it must be from 0 to {candidates - 1}")
    if not MIN_DWELL.holds(min_dwell):
        raise PolicyError(f"min_dwell is {min_dwell!r}; it must be {MIN_DWELL}")
    count = _one_a_window("counts", counts, windows)
    decided = _one_a_window("decides", decides, windows).astype(bool)
    free_at = _free_at(decided, min_dwell)
    relative = costs * count[:, None]
    # A cost common to all candidates decides nothing; without it the sums are more accurate.
    relative -= relative.min(axis=1, keepdims=True)
    before = np.zeros((windows + 1, candidates))
    np.cumsum(relative, axis=0, out=before[1:])
    price = count[:, None, None] * switching + before[:-1, :, None] - before[:-1, None, :]
    price[1:][~decided[:-1]] = np.inf
    least = _least(price, before[-1], free_at)
    tie = TIE_TOLERANCE * float(before[-1].max() + (count.max() * switching).max())
    choice = _follow(least, price, free_at, initial, tie)
    return Sequence(choice, math.fsum(count * priced(choice, costs, switching)))


def priced(choice: Ints, costs: Floats, switching: Floats) -> Floats:
    """J of every window of a sequence, shape (K,), with the switching term of the move before it.

    Shapes: `choice` (K,), `costs` (K, M), `switching` (M, M).
    """
    values: Floats = costs[np.arange(len(choice)), choice]
    values[1:] += switching[choice[:-1], choice[1:]]
    return values


def _checked(costs: ArrayLike, switching: ArrayLike) -> tuple[Floats, Floats]:
    """Return both arrays as float64; refuse wrong shapes and values."""
    costs = np.asarray(costs, np.float64)
    switching = np.asarray(switching, np.float64)
    if costs.ndim != 2 or 0 in costs.shape:
        raise MetricError(
            f"costs has the shape {costs.shape}; it must be (windows, candidates), each at least 1"
        )
    square = (costs.shape[1],) * 2
    if switching.shape != square:
        raise MetricError(f"switching has the shape {switching.shape}; it must be {square}")
    for what, wrong, values, bound in (
        ("costs", ~np.isfinite(costs), costs, "finite"),
        ("switching", ~(switching >= 0) | np.isinf(switching), switching, "finite, at least 0"),
        ("switching", (switching != 0) & np.eye(*square, dtype=bool), switching, "0"),
    ):
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            value = values[row, column]
            raise MetricError(f"{what}[{row}, {column}] is {value}; it must be {bound}")
    return costs, switching


def _one_a_window(what: str, values: ArrayLike | None, windows: int) -> Floats:
    """Return one number per window, 1 by default."""
    row = np.ones(windows) if values is None else np.asarray(values, np.float64)
    if row.shape != (windows,):
        raise MetricError(f"{what} has the shape {row.shape}; it must be ({windows},)")
    if not (np.isfinite(row) & (row >= 0)).all():
        raise MetricError(f"{what} must be finite and at least 0")
    return row


def _free_at(decided: Mask, min_dwell: int) -> Ints:
    """Return f, shape (K,): the first window that can migrate again after a migration into each.

    The dwell blocks N_min decisions after a migration. Values are at most K.
    """
    windows = len(decided)
    closes = np.flatnonzero(decided)
    free = np.searchsorted(closes, np.arange(windows)) + min(min_dwell, windows)
    following = np.append(closes + 1, windows)
    entered: Ints = following[np.minimum(free, len(closes))]
    return np.minimum(entered, windows)


def _least(price: Floats, end: Floats, free_at: Ints) -> Floats:
    """Return H, last window to first.

    Parameters
    ----------
    price : float64 array, shape (K, M, M)
        D; infinite for a window that nothing can move into.
    end : float64 array, shape (M,)
        H_K.
    free_at : int64 array, shape (K,)

    Returns
    -------
    float64 array, shape (K + 1, M)
        From window 1 on; window 0 is not decided.
    """
    windows, candidates, _ = price.shape
    least = np.empty((windows + 1, candidates))
    least[windows] = end
    rows = list(least)
    totals, moved = np.empty((candidates, candidates)), np.empty(candidates)
    add, smallest, smaller = np.add, np.minimum.reduce, np.minimum
    # Names and arrays are looked up outside of the loop for speed.
    for k, at, there in zip(
        range(windows - 1, 0, -1), free_at[:0:-1].tolist(), price[:0:-1], strict=True
    ):
        add(there, rows[at], totals)
        smallest(totals, 1, out=moved)
        smaller(moved, rows[k + 1], out=rows[k])
    return least


def _follow(least: Floats, price: Floats, free_at: Ints, initial: int, tie: float) -> Ints:
    """Return the choice of every window, shape (K,): move whenever a move lowers the total."""
    windows, candidates, _ = price.shape
    choice = np.empty(windows, np.int64)
    gains = least[2:] - least[1:-1] > tie
    moments, targets = [], []
    for m in range(candidates):
        at = np.flatnonzero(gains[:, m]) + 1
        totals = price[at, m] + least[free_at[at]]
        best = totals <= totals.min(axis=1, keepdims=True) + tie
        moments.append(at.tolist())
        targets.append(best.argmax(axis=1).tolist())
    free = free_at.tolist()
    now, since, k = initial, 0, free[0]
    while (i := bisect_left(moments[now], k)) < len(moments[now]):
        k = moments[now][i]
        choice[since:k] = now
        now, since, k = targets[now][i], k, free[k]
    choice[since:] = now
    return choice
