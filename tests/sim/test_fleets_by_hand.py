"""Latencies of fleets that can be worked out by hand, on each kind of scheduler."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.model.fleet import Fleet, Phases
from tests.cells.fleets import BESIDE_MS, fleet_of, one_job


def latencies_ms(fleet: Fleet, windows: int = 2, cycles: int = 30) -> dict[str, list[float]]:
    """Return what cycles of each cell take beside sensing and acting; not the last of the run."""
    played = dwell.simulate_fleet(fleet, policy="OFF", estimator="profile", windows=windows)
    return {
        name: [value / 1e6 - 2 * BESIDE_MS for value in run.cycles["latency_ns"].drop_nulls()][
            :cycles
        ]
        for name, run in played.cells.items()
    }


@pytest.mark.parametrize("count", [1, 2, 5])
def test_one_after_another_where_all_come_at_once(count: int) -> None:
    found = latencies_ms(fleet_of((one_job(), count)))
    for place, latencies in enumerate(found.values(), 1):
        assert latencies == pytest.approx([2.0 * place] * 30)


def test_five_evenly_spread_never_wait_and_six_wait_longer_and_longer() -> None:
    """Five jobs of 2 ms fill a period of 10 ms: back to back."""
    for latencies in latencies_ms(fleet_of((one_job(), 5), phases="even")).values():
        assert latencies == pytest.approx([2.0] * 30)
    late = latencies_ms(fleet_of((one_job(), 6), phases="even"))
    # Every period 2 ms of work are left over.
    assert max(map(max, late.values())) > 30


@pytest.mark.parametrize(("count", "cores"), [(1, 1), (3, 1), (4, 1), (4, 2), (3, 4)])
def test_equal_jobs_share_a_processor_alike(count: int, cores: int) -> None:
    """n jobs of C on c cores, all at once: each takes C n / c, and no less than C."""
    cell = one_job(2.0, scheduler="fair", cores=cores)
    for latencies in latencies_ms(fleet_of((cell, count))).values():
        assert latencies == pytest.approx([2.0 * max(1, count / cores)] * 30, abs=1e-5)


def test_jobs_that_overlap_share_a_processor_while_they_do() -> None:
    """Of 2 ms, 1 ms apart: the first has 1 ms alone, then both half a core until it is done."""
    cell = one_job(2.0, scheduler="fair")
    first, second = latencies_ms(fleet_of((cell, 2), phases=(0.0, 1.0))).values()
    assert first == pytest.approx([3.0] * 30, abs=1e-5)
    assert second == pytest.approx([3.0] * 30, abs=1e-5)


def response_ms(own_ms: float, others: list[tuple[float, float]]) -> float:
    """Worst response of a preemptive task by those of a higher priority, as (C, T).

    Joseph and Pandya, 1986, DOI 10.1093/comjnl/29.5.390: R = C + sum of ceil(R / T) C.
    """
    found = own_ms
    while True:
        longer = own_ms + sum(math.ceil(round(found / t, 9)) * c for c, t in others)
        if longer == found:
            return found
        found = longer


@pytest.mark.parametrize(("fast", "slow"), [((2.0, 10.0), (5.0, 15.0)), ((4.0, 10.0), (6.0, 25.0))])
@pytest.mark.parametrize("phases", ["sync", "random"])
def test_two_periods_on_a_priority_core_keep_their_response_times(
    fast: tuple[float, float], slow: tuple[float, float], phases: Phases
) -> None:
    """The bound is reached where both begin at once, and never passed."""
    cells = [
        one_job(
            work_ms,
            name=name,
            period_ms=period_ms,
            deadline_ms=period_ms,
            scheduler="priority",
            priority=priority,
        )
        for name, (work_ms, period_ms), priority in (("fast", fast, 2), ("slow", slow, 1))
    ]
    found = latencies_ms(
        fleet_of((cells[0], 1), (cells[1], 1), phases=phases), windows=8, cycles=60
    )
    worst = response_ms(slow[0], [fast])
    assert found["fast-01"] == pytest.approx([fast[0]] * 60)
    assert max(found["slow-01"]) <= worst + 1e-6
    if phases == "sync":
        assert max(found["slow-01"]) == pytest.approx(worst)


def test_a_phase_moves_all_of_a_cell_and_nothing_else() -> None:
    fleet = fleet_of((one_job(), 2))
    sync = dwell.simulate_fleet(fleet, policy="LOC", windows=2)
    apart = dwell.simulate_fleet(replace(fleet, phases=(0.0, 3.0)), policy="LOC", windows=2)
    for name, offset_ms in (("one-01", 0), ("one-02", 3)):
        before, after = (run.cells[name].cycles["release_ns"].to_numpy() for run in (sync, apart))
        assert np.array_equal(after - before, [offset_ms * 1_000_000] * 40)
    latencies = itertools.chain(*latencies_ms(replace(fleet, shared=())).values())
    assert set(np.round([*latencies], 9)) == {2.0}
