"""What is estimated of a node that is full: of what others take of it, only the least is seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.cost import SATURATED
from dwell.estimators import Corrected, Evidence, Profile
from dwell.model import (
    Constant,
    Disturbance,
    Execution,
    Flow,
    Link,
    Node,
    NodeDisturbance,
    Problem,
    QoS,
    Task,
)
from tests.cells.generated import make_problem
from tests.estimators.windows import MS, Row, window

ESTIMATORS = ("profile", "shadow", "scaling", "corrected")


def shared(*scenario: Disturbance, period_ms: float = 10.0) -> Problem:
    """A cell whose second task, on E, takes 4 of 10 cores for 10 ms; on R it takes little."""
    return make_problem(
        [Node("R", "robot", 8), Node("E", "edge", 10)],
        [
            Task("sense", {"R": Execution(Constant(1.0))}),
            Task(
                "act",
                {
                    "R": Execution(Constant(2.0)),
                    "E": Execution(Constant(10.0), threads=4),
                },
                depth=1,
            ),
        ],
        [Flow("sense", "act")],
        links=[Link("R", "E", Constant(0.1))],
        candidates={"LOC": {}, "SO": {"act": "E"}},
        period_ms=period_ms,
        scenario=scenario,
        window_cycles=50,
    )


class Script:
    """Places window after window as it is told, and keeps what it was shown."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names, self.initial = list(names), names[0]
        self.observed: list[float] = []
        self.estimated: list[dict[str, float]] = []

    def __deepcopy__(self, memo: object) -> Script:
        return self

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Note U of E, and follow the script."""
        self.observed.append(observed.utilisation["E"])
        self.estimated.append({name: qos.utilisation["E"] for name, qos in estimates.items()})
        return self.names[min(len(self.observed), len(self.names) - 1)]


def play(problem: Problem, names: Sequence[str], estimator: str) -> Script:
    script = Script(names)
    dwell.simulate(
        problem,
        scenario="disturbed",
        policy=script,
        estimator=estimator,
        seed=1,
        windows=len(names),
    )
    assert len(script.observed) >= len(names) - 1
    return script


# --------------------------------------------------------------------------------- three cases


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_stress_beyond_the_node_fills_it_under_every_candidate(estimator: str) -> None:
    problem = shared(NodeDisturbance("E", stress_threads=20))
    script = play(problem, ["SO", "SO", "LOC", "LOC", "SO", "SO"], estimator)
    assert min(script.observed) >= SATURATED
    for estimated in script.estimated:
        assert estimated["LOC"] == pytest.approx(1.0) == estimated["SO"]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_what_a_candidate_showed_holds_while_the_cell_itself_fills_the_node(estimator: str) -> None:
    problem = shared(NodeDisturbance("E", stress_threads=7))
    script = play(problem, ["SO", "SO", "LOC", "SO", "SO", "SO"], estimator)
    # 7 of 10 cores; with 4 threads more the node is full.
    shown = dict(zip(["SO", "SO", "LOC", "SO", "SO", "SO"], script.observed, strict=False))
    assert shown["LOC"] == pytest.approx(0.7, abs=0.03)
    assert shown["SO"] >= SATURATED
    assert [estimated["LOC"] for estimated in script.estimated[:2]] == [1.0, 1.0]
    for estimated in script.estimated[2:]:
        assert estimated["LOC"] == pytest.approx(0.7, abs=0.03)
        assert estimated["SO"] >= SATURATED


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_what_a_candidate_showed_before_the_stress_is_not_used(estimator: str) -> None:
    # The node is full from the fourth window on, seen under SO before and after.
    problem = shared(NodeDisturbance("E", at_s=1.5, stress_threads=20))
    script = play(problem, ["LOC", "SO", "SO", "SO", "SO"], estimator)
    assert script.observed[2] < 0.5
    assert script.estimated[2]["LOC"] < 0.2
    for used, estimated in zip(script.observed[3:], script.estimated[3:], strict=True):
        assert used >= SATURATED
        assert estimated["LOC"] == 1.0


# --------------------------------------------------------------------------------- by windows


def estimated(
    estimator: Profile, incumbent: str, used: float, own: float, name: str = "LOC"
) -> float:
    estimates = estimator.estimate(
        observed=QoS(1.0, 0.0, {"R": 0.1, "E": used}),
        incumbent=incumbent,
        own={"R": 0.1, "E": own},
    )
    return estimates[name].utilisation["E"]


def test_a_node_is_full_from_the_bound_on() -> None:
    profile = Profile(shared(), samples=10)
    assert estimated(profile, "SO", 0.994, 0.4) == pytest.approx(0.594)
    assert estimated(profile, "SO", SATURATED, 0.4) == 1.0


def test_own_work_and_shadows_that_fill_a_node_hide_nothing() -> None:
    profile = Profile(shared(), samples=10)
    assert estimated(profile, "SO", 1.0, 1.0) == 0.0
    assert estimated(profile, "SO", 1.0, 0.997) == pytest.approx(0.003)


def test_one_close_without_saturation_ends_what_was_known() -> None:
    profile = Profile(shared(), samples=10)
    assert estimated(profile, "LOC", 0.7, 0.0) == pytest.approx(0.7)
    assert estimated(profile, "SO", 1.0, 0.3) == pytest.approx(0.7)
    assert estimated(profile, "SO", 0.9, 0.3) == pytest.approx(0.6)
    assert estimated(profile, "SO", 1.0, 0.3) == 1.0


def test_a_full_window_of_a_candidate_takes_the_place_of_its_earlier_one() -> None:
    profile = Profile(shared(), samples=10)
    estimated(profile, "LOC", 0.7, 0.0)
    estimated(profile, "LOC", 1.0, 0.0)
    assert estimated(profile, "SO", 1.0, 0.3) == 1.0


def test_a_start_forgets_the_windows() -> None:
    problem = shared()
    profile = Profile(problem, samples=10)
    estimated(profile, "LOC", 0.7, 0.0)
    profile.start(problem)
    assert estimated(profile, "SO", 1.0, 0.3) == 1.0


def test_runs_of_one_estimator_do_not_know_of_each_other() -> None:
    problem = shared(NodeDisturbance("E", stress_threads=7))
    profile = Profile(problem)
    for _ in range(2):
        script = Script(["SO", "LOC", "SO"])
        dwell.simulate(
            problem, scenario="disturbed", policy=script, estimator=profile, seed=1, windows=3
        )
        assert script.estimated[0]["LOC"] == 1.0


# ------------------------------------------------------------------------- corrected: by load


def slow() -> Corrected:
    """An estimator of the cell with a period in which nothing waits."""
    return Corrected(shared(period_ms=40.0), shadow_fraction=0.0)


def local(corrected: Corrected, used: float) -> float:
    """Close a window under LOC, in which nothing of E is measured; L95 of SO."""
    corrected.learn(cycles(0, 1.0, 3.0, work_ms=2.0))
    seen = QoS(3.0, 0.0, {"R": 0.1, "E": used})
    shown = corrected.estimate(observed=seen, incumbent="LOC", own={"R": 0.1, "E": 0.0})
    return shown["SO"].l95_ms


def away(corrected: Corrected, used: float, own: float, took_ms: float) -> float:
    """Close a window under SO, whose jobs on E took so long; L95 of SO."""
    corrected.learn(cycles(1, 1.1, 1.1 + took_ms, work_ms=40.0))
    seen = QoS(3.0, 0.0, {"R": 0.1, "E": used})
    shown = corrected.estimate(observed=seen, incumbent="SO", own={"R": 0.1, "E": own})
    return shown["SO"].l95_ms


def cycles(placement: int, begun_ms: float, ended_ms: float, work_ms: float) -> Evidence:
    """Ten cycles whose second job begins and ends so long after the release."""
    starts = [40.0 * i for i in range(10)]
    rows: list[Row] = [
        ([at, at + begun_ms], [at + 1.0, at + ended_ms], [at + begun_ms]) for at in starts
    ]
    shown = window(rows, close_ms=400.0, release_ms=starts, placement=[placement] * 10)
    work_ns = np.full_like(shown.cycles.end_ns, [MS, round(work_ms * MS)])
    known = replace(shown.cycles, start_ns=shown.cycles.ready_ns, work_ns=work_ns)
    return shown.with_instants(known, shown.shadows)


def test_load_that_is_seen_once_the_cell_has_left_is_no_change() -> None:
    """The threads that jobs on a full node told stay, as long as it is full."""
    corrected = slow()
    measured_ms = away(corrected, 1.0, 0.3, 25.0)
    assert measured_ms == pytest.approx(26.1, rel=0.01)
    # Seen were 0.7 of others; they take all of it now.
    assert local(corrected, 1.0) == pytest.approx(measured_ms, rel=0.01)
    assert away(corrected, 1.0, 0.3, 25.0) == pytest.approx(measured_ms, rel=0.01)


def test_load_below_the_least_that_was_seen_is_a_change() -> None:
    corrected = slow()
    away(corrected, 1.0, 0.3, 25.0)
    assert local(corrected, 0.1) == pytest.approx(11.1, rel=0.1)


@pytest.mark.parametrize("own", [0.0, 0.2])
def test_a_full_node_of_which_nothing_is_measured_has_a_thread_a_core(own: float) -> None:
    """However much of it the cell's own unfinished jobs took."""
    corrected = slow()
    local(corrected, 0.0)
    rows: list[Row] = [([0.0, 1.1], [1.0, None], [1.1])] * 20
    corrected.learn(window(rows, close_ms=10.0, placement=[1] * 20))
    seen = QoS(10.0, 1.0, {"R": 0.1, "E": 1.0})
    shown = corrected.estimate(observed=seen, incumbent="SO", own={"R": 0.1, "E": own})
    # 4 threads beside 10 on 10 cores: 1.4 times as long.
    assert shown["SO"].l95_ms == pytest.approx(1.1 + 14.0, rel=0.1)
