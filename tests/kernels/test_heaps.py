"""The heaps of jobs: entries come out in order, whatever came between."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.kernels.rows import row_types
from tests.kernels.parts import at, ints, parts

TAKE = -1
#: Few values, so that many are equal and keys have to tell them apart.
VALUE = st.integers(0, 5)
STEPS = st.lists(st.one_of(st.just(TAKE), VALUE), max_size=64)


@given(STEPS, st.lists(st.integers(0, 64), min_size=64, max_size=64))
def test_running_jobs_may_leave_from_the_middle(steps: list[int], places: list[int]) -> None:
    heap = np.zeros(len(steps) + 1, row_types()["running"])
    added, where = ints(steps), ints(places)
    n = parts().part_running(at(added), at(where), len(steps), at(heap))
    inside: list[tuple[float, int]] = heap[:n].tolist()
    # Every entry is after the one over it, so that the first is the first to finish.
    assert all(inside[(i - 1) // 2] < inside[i] for i in range(1, n))
    assert all(finish_ns == steps[key] for finish_ns, key in inside)
    assert len({key for _, key in inside}) == n
    left = 0
    for step in steps:
        left = left + 1 if step != TAKE else max(left - 1, 0)
    assert n == left


@given(st.lists(st.tuples(VALUE, VALUE), min_size=1, max_size=64))
def test_waiting_jobs_come_by_rank_then_readiness_with_their_work(
    jobs: list[tuple[int, int]],
) -> None:
    rows = np.array(
        [(*job, key, 10.0 * key) for key, job in enumerate(jobs)], row_types()["waiting"]
    )
    heap, taken = np.zeros_like(rows), np.zeros_like(rows)
    parts().part_waiting(at(rows), len(rows), at(heap), at(taken))
    assert taken.tolist() == sorted(rows.tolist())
