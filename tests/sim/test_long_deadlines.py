"""Deadlines beyond the period: several cycles are under way at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.model import Constant, ControllerSettings, Execution, Problem, Task, Uniform
from dwell.model.fabric import Node
from dwell.model.number_arrays import Floats
from dwell.record import Run
from dwell.study.quality import actuations, age_of_information
from tests.cells.generated import MS, make_problem
from tests.reference.test_against import Case, examine


def one_stage(
    exec_ms: float, period_ms: float, deadline_ms: float, *, workers: int = 1, cycles: int = 20
) -> Problem:
    """Return a cell of one stage; a lone worker takes the latest cycle."""
    on = {"R": Execution(Constant(exec_ms), workers=workers)}
    return make_problem(
        [Node("R", "robot", cores=workers, scheduler="fifo")],
        [Task("a", on, depth=0 if workers > 1 else 1)],
        period_ms=period_ms,
        deadline_ms=deadline_ms,
        window_cycles=cycles,
    )


def played(problem: Problem, windows: int) -> Run:
    return dwell.simulate(problem, scenario="baseline", policy="LOC", seed=1, windows=windows)


def latencies_ms(run: Run) -> Floats:
    """Latencies of the cycles in windows; NaN of lost ones."""
    inside = run.cycles.filter(~run.cycles["lead"])
    values: Floats = inside["latency_ns"].cast(float).fill_null(np.nan).to_numpy() / MS
    return values


def mean_age_ms(run: Run, begin: int, end: int) -> float:
    """Mean age at the actuator between the releases of two cycles."""
    table = run.arrays("cycles")
    release_ns = table["release_ns"]
    effective = actuations(release_ns, table["latency_ns"])
    return age_of_information(effective, int(release_ns[begin]), int(release_ns[end])).mean_ms


# Stage, period, workers; latencies of the cycles that are done in steady state, cycles and done
# cycles until they repeat, first cycle of the steady state, and mean age, by hand.
BY_HAND = {
    "86 in 20, five workers": (86, 20, 5, [86] * 43, 43, 5, 96),
    "86 in 20, one worker": (86, 20, 1, [*range(88, 107, 2)], 43, 43, 140),
    "200 in 40, one worker": (200, 40, 1, [240], 5, 5, 340),
    "200 in 40, five workers": (200, 40, 5, [200] * 5, 5, 5, 220),
    "120 in 100, one worker": (120, 100, 1, [140, 160, 180, 200, 220], 6, 6, 240),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_a_stage_longer_than_the_period(name: str) -> None:
    exec_ms, period_ms, workers, expected, cycles, first, age_ms = BY_HAND[name]
    problem = one_stage(exec_ms, period_ms, 400 - 400 % period_ms, workers=workers, cycles=cycles)
    run = played(problem, 8)
    found = latencies_ms(run)
    begin, end = first + 2 * cycles, first + 5 * cycles
    for row in found[begin:end].reshape(3, cycles):
        assert sorted(row[~np.isnan(row)]) == expected
    assert mean_age_ms(run, begin, end) == pytest.approx(age_ms)
    # A done cycle within D is not missed; a replaced one is.
    missed = run.cycles.filter(~run.cycles["lead"])["missed"].to_numpy()
    np.testing.assert_array_equal(missed, np.isnan(found))


@pytest.mark.parametrize("name", BY_HAND)
def test_the_second_simulator_agrees_on_cells_made_by_hand(name: str) -> None:
    exec_ms, period_ms, workers, _, _, _, _ = BY_HAND[name]
    problem = one_stage(exec_ms, period_ms, 240, workers=workers, cycles=4)
    real = dwell.draw(problem, scenario="baseline", seed=1, windows=20)
    assert examine(Case(problem, real, ("LOC",) * 20), 0) == []


def test_a_window_closes_with_the_last_deadline_of_its_cycles() -> None:
    # At the release of the next cycle, after 20 ms, the window's cycle is unfinished.
    for deadline_ms, seen_ms in ((100, 86.0), (85, 85.0)):
        run = played(one_stage(86, 20, deadline_ms, workers=5, cycles=1), 30)
        assert run.windows["seen_l95_ms"].to_list() == [seen_ms] * 30
        assert run.windows["seen_violation_rate"].to_list() == [float(seen_ms < 86)] * 30


@pytest.mark.parametrize(("every", "leads"), [(4, False), (10, True)])
def test_a_move_takes_effect_after_the_deadlines_of_the_cycles_it_looked_at(
    every: int, leads: bool
) -> None:
    on = {name: Execution(Constant(30.0), workers=5) for name in ("R", "E")}
    problem = make_problem(
        [Node(name, "edge", cores=5) for name in ("R", "E")],
        [Task("a", on)],
        candidates={"LOC": {}, "SO": {"a": "E"}},
        period_ms=20,
        deadline_ms=100,
        window_cycles=10,
        controller=ControllerSettings(),
    )
    problem = replace(problem, controller=replace(problem.controller, decide_cycles=every))
    run = dwell.simulate(problem, scenario="baseline", policy=_Once("SO"), seed=1, windows=4)
    # The decision looks at cycles 0 to every - 1; their last deadline is 100 ms after a release.
    first = every - 1 + 5
    placement = run.cycles["placement"].to_list()
    assert placement.index("SO") == first
    # With decisions between windows, each cycle counts in the window of its release.
    assert run.cycles["lead"][:first].to_list() == [False] * every + [leads] * (first - every)
    assert run.windows["first_cycle"].to_list()[:2] == [0, first if leads else 10]
    if not leads:
        # The next decision sees cycles under the new placement only.
        assert run.decisions["last_cycle"].to_list()[1] == first + every - 1
        assert run.decisions["cycles"].to_list()[1] == every


class _Once:
    """Moves at the first decision, and stays."""

    def __init__(self, name: str) -> None:
        self.name = name

    def decide(self, **_: object) -> str:
        """Return the candidate."""
        return self.name


def test_an_overtaken_cycle_within_its_deadline_is_not_missed() -> None:
    on = {"R": Execution(Uniform(10.0, 90.0), workers=5)}
    problem = make_problem(
        [Node("R", "robot", cores=5)],
        [Task("a", on)],
        period_ms=20,
        deadline_ms=100,
        window_cycles=50,
    )
    run = played(problem, 10)
    assert run.cycles["missed"].sum() == 0
    ends = (run.cycles["release_ns"] + run.cycles["latency_ns"]).to_numpy()
    overtaken = [bool((ends[i + 1 :] < ends[i]).any()) for i in range(500)]
    expected = np.reshape(overtaken, (10, 50)).sum(axis=1)
    assert expected.min() > 0
    assert run.windows["overtaken"].to_list() == expected.tolist()


def test_no_cycle_is_overtaken_in_one_worker() -> None:
    assert played(one_stage(86, 20, 120), 4).windows["overtaken"].to_list() == [0] * 4
