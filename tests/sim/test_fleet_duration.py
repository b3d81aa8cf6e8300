"""How long a fleet is played, and what happens to its shared nodes meanwhile."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import dwell
from dwell.cellfile import from_document
from dwell.errors import ProblemError
from dwell.model import Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.study import capacity_of
from dwell.study.drawn_disturbances import disturbances_of


def cell(name: str, period_ms: float, work_ms: float, **more: Any) -> Problem:
    """Return a cell whose only work is on one core, E."""
    scheduler = more.pop("scheduler", "priority")
    rank = {"priority": more.pop("rank", 0)} if scheduler == "priority" else {}
    return from_document(
        {
            "dwell": 1,
            "name": name,
            "period_ms": period_ms,
            "tasks": {
                "s": {"on": {"R": {"exec_ms": 0}}},
                "t": {**rank, "on": {"E": {"exec_ms": work_ms}}},
            },
            "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge", "scheduler": scheduler}},
            "links": [{"from": "R", "to": "E", "delay_ms": 0}],
            "flows": [{"from": "s", "to": "t"}],
            "candidates": {"SO": {}},
            "controller": {"policy": "SO", "estimator": "profile"},
            **more,
        }
    )


def fleet_of(*cells: Problem, **settings: Any) -> Fleet:
    entries = tuple(FleetEntry(one) for one in cells)
    given = {"phases": "even", "coordination": "none", **settings}
    return Fleet("hall", entries, ("E",), **given)


def latencies_ms(run: dwell.Run) -> NDArray[np.float64]:
    return run.cycles["latency_ns"].to_numpy() / 1e6


SLOW = cell("slow", 1000, 275, deadline_ms=800, window_cycles=20)


@pytest.mark.parametrize("window_cycles", [20, 2000])
def test_capacity_does_not_depend_on_how_long_another_cells_window_is(window_cycles: int) -> None:
    """Two slow cells and the fast one need 105 % of the core."""
    fast = cell("fast", 10, 5, window_cycles=window_cycles, rank=1)
    found = capacity_of(fleet_of(SLOW, fast), seeds=(1, 2), cycles=100, most=4, processes=1)
    assert found.robots == 1


def test_every_cell_is_released_to_the_end() -> None:
    fast = cell("fast", 10, 5, window_cycles=30, warmup_windows=5, rank=1)
    run = dwell.simulate_fleet(fleet_of(SLOW, fast), seed=1, windows=3)
    assert run.seconds == 60.0
    assert {name: len(one.cycles) for name, one in run.cells.items()} == {
        "slow-01": 60,
        "fast-01": 6000,
    }
    # 275 ms of work on half a core, in each cycle.
    latency_ms = latencies_ms(run.cells["slow-01"])
    assert latency_ms.min() > 500


def test_all_cells_are_counted_from_the_longest_warm_up_on() -> None:
    slow = cell("slow", 1000, 275, window_cycles=20, warmup_windows=1)
    fast = cell("fast", 10, 5, window_cycles=30, warmup_windows=5)
    run = dwell.simulate_fleet(fleet_of(slow, fast), seed=1, windows=3)
    windows = run.cells["fast-01"].windows
    first = int(windows.filter(~windows["warmup"])["first_cycle"][0])
    # 20 s of the slow cell are 66.7 windows of the fast one.
    assert first == 67 * 30


def test_an_incomplete_window_is_in_no_window_but_in_the_cycles() -> None:
    fast = cell("fast", 10, 5, window_cycles=30)
    run = dwell.simulate_fleet(fleet_of(SLOW, fast), seed=1, seconds=20.5)
    slow = run.cells["slow-01"]
    assert (slow.windows.height, slow.cycles.height) == (1, 21)
    assert slow.cycles["lead"].to_list() == [False] * 20 + [True]
    assert run.cells["fast-01"].cycles.height == 2050
    # What is released before the end has its whole deadline.
    assert latencies_ms(slow)[-1] == pytest.approx(latencies_ms(slow)[0], abs=10)


def test_the_load_of_shared_nodes_has_windows_whichever_cell_is_first() -> None:
    fast = cell("fast", 10, 5, window_cycles=100)
    for cells in ((SLOW, fast), (fast, SLOW)):
        load = dwell.simulate_fleet(fleet_of(*cells), seed=1, windows=2).load
        assert load.height >= 39
        np.testing.assert_allclose(load["u_E"].to_numpy()[20:], 0.775, atol=0.25)


@pytest.mark.parametrize("seconds", [0.0, 19.9, float("nan"), float("inf")])
def test_a_duration_holds_a_window_of_each_cell(seconds: float) -> None:
    with pytest.raises(ProblemError, match="at least the longest window, 20"):
        dwell.simulate_fleet(fleet_of(SLOW), seconds=seconds)


# ------------------------------------------------------------------------ disturbances of shared


BUSY = {"busy": [{"node": "E", "at_s": 1, "stress_threads": 1}]}
GUSTS = {
    "gusts": [
        {
            "node": "E",
            "stress_threads": 2,
            "episodes": {"name": "g", "every_s": {"exponential": {"mean": 2}}, "for_s": 1},
        }
    ]
}


def test_what_happens_to_a_shared_node_happens_to_all_cells() -> None:
    """Each takes 2 ms alone, and 4 with one foreign thread on the core."""
    one = cell("one", 20, 2, window_cycles=10, scheduler="fifo", scenarios=BUSY)
    entries = (FleetEntry(one, 2), FleetEntry(one, scenario="busy"))
    fleet = Fleet("hall", entries, ("E",), phases="even", coordination="none")
    for of in dwell.simulate_fleet(fleet, seed=1, windows=20).cells.values():
        latency_ms = latencies_ms(of)
        late = of.cycles["release_ns"].to_numpy() > 1_000_000_000
        np.testing.assert_allclose(latency_ms[~late][:-1], 2)
        np.testing.assert_allclose(latency_ms[late], 4)
        assert [item.at_s for item in disturbances_of(of)] == [1.0]


def test_draw_repeats_the_draws_of_each_cell() -> None:
    one = cell("one", 20, 2, window_cycles=10, scheduler="fifo", scenarios=GUSTS)
    entries = (FleetEntry(one, 2), FleetEntry(one, scenario="gusts"))
    fleet = Fleet("hall", entries, ("E",), phases="sync", coordination="none")
    run = dwell.simulate_fleet(fleet, seed=4, windows=200)
    found = []
    for of in run.cells.values():
        again = dwell.draw(
            of.problem,
            scenario=of.meta["scenario"],
            seed=4,
            windows=of.meta["windows"],
            streams=of.meta.get("streams", ""),
            shared=of.meta["shared"],
            disturbances=of.shared_disturbances,
        )
        found.append([*again.node_changes])
        threads = {change.threads for change in again.node_changes}
        assert threads == {0, 2}
        begins = {change.at_ns for change in again.node_changes}
        assert {round(item.at_s * 1e9) for item in disturbances_of(of)} <= begins
    assert found[0] == found[1] == found[2]


def test_episodes_of_one_name_are_the_same_in_all_cells_of_a_fleet() -> None:
    one = cell("one", 20, 2, scenarios=GUSTS)
    item = {**GUSTS["gusts"][0], "episodes": {"name": "g", "every_s": 5, "for_s": 1}}
    other = cell("other", 20, 2, scenarios={"gusts": [item]})
    entries = (FleetEntry(one, scenario="gusts"), FleetEntry(other, scenario="gusts"))
    with pytest.raises(ProblemError, match=r"cells\[1\].scenario.*'g' is declared otherwise"):
        Fleet("hall", entries, ("E",))
