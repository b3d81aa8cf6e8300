"""Shadow against cells whose alternatives have a latency that is known exactly."""

from __future__ import annotations

import itertools
from random import Random

import pytest

import dwell
from dwell.estimators import Corrected, Profile, Shadow
from dwell.model import (
    Constant,
    ControllerSettings,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Problem,
    QoS,
    Task,
)
from tests.cells.deterministic import cell, truth
from tests.cells.generated import make_problem
from tests.estimators.windows import local_row, off_row, window

SEEN = QoS(1.0, 0.0, {"R": 0.0, "E": 0.0})
NO_WORK = {"R": 0.0, "E": 0.0}


# --------------------------------------------------------------------------- constructed truth


def test_the_estimate_is_the_truth_from_the_first_window_on() -> None:
    problem = cell()
    profile = Profile(problem)
    decisions = dwell.simulate(
        problem, scenario="disturbed", policy="LOC", seed=1, windows=10
    ).decisions
    # The sink of SINK, that no shadow may run, is on a node of which others show the threads.
    for name in ("OFF", "FAR", "SINK", "TWIN"):
        l95_ms, missed = truth(problem, name)
        if name != "TWIN":
            assert (profile.l95_ms[name], profile.violation_rate[name]) != (l95_ms, missed)
        assert decisions[f"est_l95_ms_{name}"].to_list() == pytest.approx([l95_ms] * 10)
        assert set(decisions[f"est_violation_rate_{name}"]) == {missed}


def random_cell(rng: Random) -> Problem:
    """A DAG of constants on nodes with room for everything; links may have an extra delay."""
    nodes = [Node(name, "edge", 4096) for name in ("N0", "N1", "N2")]
    names = [f"T{i}" for i in range(rng.randint(2, 7))]
    order = rng.sample(names, len(names))
    flows = [Flow(a, b) for a, b in itertools.combinations(order, 2) if rng.random() < 0.35]
    if not flows:
        flows = [Flow(order[0], order[1])]
    targets = {flow.target for flow in flows}
    tasks = [
        Task(
            name,
            {
                node.name: Execution(Constant(rng.randint(0, 20) / 4), workers=99)
                for node in rng.sample(nodes, rng.choice([1, 2, 3]))
            },
            offset_ms=0.0 if name in targets else rng.choice([0.0, 0.0, 3.0]),
        )
        for name in names
    ]
    pairs = list(itertools.permutations((node.name for node in nodes), 2))
    placed = [{t.name: rng.choice(list(t.on)) for t in tasks} for _ in range(rng.randint(1, 4))]
    return make_problem(
        nodes,
        tasks,
        flows,
        links=[Link(a, b, Constant(rng.randint(0, 8) / 4)) for a, b in pairs],
        candidates={f"C{i}": placement for i, placement in enumerate(placed)},
        scenario=[
            LinkDisturbance(a, b, add_delay_ms=Constant(rng.randint(1, 20) / 4))
            for a, b in pairs
            if rng.random() < 0.5
        ],
        period_ms=50.0,
        deadline_ms=float(rng.randint(1, 30)),
        window_cycles=20,
        controller=ControllerSettings(
            estimator="shadow", shadow_fraction=rng.choice([0.25, 0.3]), half_life_windows=9.0
        ),
    )


@pytest.mark.parametrize("seed", range(30))
def test_the_estimate_is_the_truth_for_any_dag(seed: int) -> None:
    """Joins, several sinks, sinks that are sources, equal placements, a single candidate."""
    problem = random_cell(Random(seed))
    decisions = dwell.simulate(
        problem, scenario="disturbed", policy="C0", seed=1, windows=6
    ).decisions
    for name in problem.candidates:
        shown = decisions.select(f"est_l95_ms_{name}", f"est_violation_rate_{name}").rows()[-1]
        assert shown == pytest.approx(truth(problem, name), abs=1e-9)


def test_a_single_task_has_no_shadows_and_is_judged_by_the_load() -> None:
    """Of a full node there is a thread for each core at least."""
    on = {"R": Execution(Constant(4.0)), "E": Execution(Constant(2.0))}
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("only", on)],
        candidates={"LOC": {}, "OFF": {"only": "E"}},
        window_cycles=30,
        scenario=[NodeDisturbance("E", stress_threads=20)],
        controller=ControllerSettings(estimator="shadow", shadow_fraction=1.0),
    )
    run = dwell.simulate(problem, scenario="disturbed", policy="LOC", seed=1, windows=3)
    assert set(run.decisions["est_l95_ms_OFF"]) == {2 * 2.0}
    assert set(run.decisions["est_samples_OFF"]) == {0.0}
    assert run.decisions["est_age_windows_OFF"].to_list() == [1.0, 2.0, 3.0]


# -------------------------------------------------------------------------------- made by hand


def test_a_slow_sink_slows_its_shadow() -> None:
    """What cycles show of a part that a shadow shares with them counts for both."""
    starts = [40.0 * i for i in range(20)]
    rows = [local_row(at) for at in starts]
    rows = [(r, [*e[:3], at + 26.0], a) for at, (r, e, a) in zip(starts, rows, strict=True)]
    shadow = Shadow(cell())
    shadow.learn(
        window(rows, close_ms=800.0, release_ms=starts, shadows=[off_row(at, 6.0) for at in starts])
    )
    shown = shadow.estimate(observed=SEEN, incumbent="LOC", own=NO_WORK)
    # `control` took 10 ms, not 1.
    assert shown["OFF"].l95_ms == pytest.approx(14.0 + 6.0 + 9.0)
    assert shown["LOC"].l95_ms == pytest.approx(17.0 + 9.0)


def test_of_what_no_shadow_went_through_nothing_is_assumed() -> None:
    """The message of SINK is on the link of OFF, whose delay is measured."""
    starts = [40.0 * i for i in range(20)]
    evidence = window(
        [local_row(at) for at in starts],
        close_ms=800.0,
        release_ms=starts,
        shadows=[off_row(at, 6.0) for at in starts],
    )
    latencies = {}
    for kind in (Shadow, Corrected):
        estimator = kind(cell())
        estimator.learn(evidence)
        shown = estimator.estimate(observed=SEEN, incumbent="LOC", own=NO_WORK)
        latencies[kind] = shown["SINK"].l95_ms
    assert latencies == {Shadow: 17.5, Corrected: pytest.approx(17.5 + 6.0)}
