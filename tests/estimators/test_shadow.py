"""Shadow against cells whose alternatives have a latency that is known exactly."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from random import Random

import numpy as np
import pytest

import dwell
from dwell.control import shadow_stamps
from dwell.errors import ProblemError
from dwell.estimators import Evidence, Profile, Shadow
from dwell.estimators.shadow import ENOUGH, FORGOTTEN, LARGEST
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
from tests.cells.deterministic import MOVES, cell, truth
from tests.cells.generated import make_problem
from tests.estimators.windows import Row, window

SEEN = QoS(1.0, 0.0, {"R": 0.0, "E": 0.0})
NO_WORK = {"R": 0.0, "E": 0.0}


def estimate(shadow: Shadow) -> dict[str, QoS]:
    return shadow.estimate(observed=SEEN, incumbent="LOC", own=NO_WORK)


# --------------------------------------------------------------------------- constructed truth


def test_the_estimate_is_the_truth_once_there_is_enough_and_the_profile_before() -> None:
    problem = cell()
    profile = Profile(problem)
    decisions = dwell.simulate(
        problem, scenario="disturbed", policy="LOC", seed=1, windows=10
    ).decisions
    for name in ("OFF", "FAR", "TWIN"):
        l95_ms, missed = truth(problem, name)
        known = (profile.l95_ms[name], profile.violation_rate[name])
        if name != "TWIN":
            assert known != (l95_ms, missed)
        shown = decisions.select(f"est_l95_ms_{name}", f"est_violation_rate_{name}").rows()
        enough = [samples >= ENOUGH for samples in decisions[f"est_samples_{name}"]]
        assert shown == [(l95_ms, missed) if there else known for there in enough]
        assert enough[-1]
    assert [samples >= ENOUGH for samples in decisions["est_samples_OFF"]][:3] == [
        False,
        False,
        True,
    ]
    assert set(decisions["est_age_windows_OFF"]) == {0.0}


def test_a_sink_that_no_shadow_may_run_is_taken_from_the_profile() -> None:
    # Its message does cross the disturbed link; its job would take 0.5 ms, were E not stressed.
    problem = cell()
    decisions = dwell.simulate(
        problem, scenario="disturbed", policy="LOC", seed=1, windows=6
    ).decisions
    assert decisions["est_l95_ms_SINK"][-1] == 2 + 8 + 6 + 1 + 7 + 0.5
    assert truth(problem, "SINK")[0] == 2 + 8 + 6 + 1 + 7 + 0.75


def test_the_support_is_the_weight_of_the_samples() -> None:
    problem = cell(half_life_windows=3.0)
    decisions = dwell.simulate(
        problem, scenario="disturbed", policy="LOC", seed=1, windows=12
    ).decisions
    stamps = shadow_stamps(0, 12 * 50, 0, 5, 0.1).reshape(12, 50)
    weight = dict.fromkeys(MOVES, 0.0)
    for k, row in enumerate(stamps):
        for code, name in enumerate(MOVES):
            count = 50 if name in ("LOC", "TWIN") else int((row == code).sum())
            weight[name] = weight[name] * 0.5 ** (1 / 3) + count
            assert decisions[f"est_samples_{name}"][k] == pytest.approx(weight[name], rel=1e-3)


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
        assert decisions[f"est_samples_{name}"][-1] >= ENOUGH


def test_a_single_task_has_no_shadows_and_is_the_profiles() -> None:
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
    assert set(run.decisions["est_l95_ms_OFF"]) == {2.0}
    assert set(run.decisions["est_samples_OFF"]) == {0.0}
    assert run.decisions["est_age_windows_OFF"].to_list() == [1.0, 2.0, 3.0]


# -------------------------------------------------------------------------------- made by hand


def local(begin_ms: float, stretch: float = 1.0) -> Row:
    """A cycle under LOC that takes 17 ms, or `stretch` times that."""
    ends = begin_ms + stretch * np.array([2.0, 10.0, 16.0, 17.0])
    return [begin_ms, *ends[:3]], [*ends], [*ends[:3]]


def off(begin_ms: float, total_ms: float) -> Row:
    """The shadow through OFF of such a cycle: its last message arrives after `total_ms` - 1."""
    at = begin_ms + total_ms - 1.0
    return [None, at - 12, at - 6, None], [None, at - 8, at, None], [at - 12, at - 6, at]


GONE: Row = ([None] * 4, [None] * 4, [None] * 3)


def one_window(
    shadows: Mapping[int, Row], cycles: int = 50, close_ms: float | None = None
) -> Evidence:
    release = [40.0 * i for i in range(cycles)]
    return window(
        [local(t) for t in release],
        close_ms=40.0 * cycles if close_ms is None else close_ms,
        release_ms=release,
        shadows=[shadows.get(i) for i in range(cycles)],
    )


def test_weights_halve_every_half_life_until_the_profile_is_back() -> None:
    shadow = Shadow(cell(half_life_windows=4.0), shadow_fraction=0.5)
    shadow.learn(one_window({i: off(40.0 * i, 30.0) for i in range(0, 50, 2)}))
    assert shadow.support()["OFF"] == (25.0, 0)
    assert estimate(shadow)["OFF"].l95_ms == 30.0
    for k in range(1, 60):
        shadow.learn(one_window({}))
        samples, age = shadow.support()["OFF"]
        expected = 25.0 * 0.5 ** (k / 4)
        assert age == k
        assert samples == pytest.approx(expected if expected > 25 * FORGOTTEN else 0.0)
        l95_ms = 30.0 if samples >= ENOUGH else shadow.profile.l95_ms["OFF"]
        assert estimate(shadow)["OFF"].l95_ms == l95_ms
    assert shadow.support()["OFF"].samples == 0.0


def test_newer_samples_weigh_more() -> None:
    shadow = Shadow(cell(half_life_windows=1.0, deadline_ms=35.0))
    shadow.learn(one_window({i: off(40.0 * i, 30.0) for i in range(10)}))
    shadow.learn(one_window({i: off(40.0 * i, 36.0) for i in range(10)}))
    # 5 of 15 by weight met the deadline.
    assert estimate(shadow)["OFF"].violation_rate == pytest.approx(2 / 3)
    assert estimate(shadow)["OFF"].l95_ms == 36.0
    for _ in range(2):
        shadow.learn(one_window({i: off(40.0 * i, 30.0) for i in range(10)}))
    # 2.5 of 18.75 are more than 5 %, after three windows more no longer.
    assert estimate(shadow)["OFF"].l95_ms == 36.0
    for _ in range(2):
        shadow.learn(one_window({i: off(40.0 * i, 30.0) for i in range(10)}))
    assert estimate(shadow)["OFF"].l95_ms == 30.0


def test_lost_shadows_count_as_ages_and_as_missed() -> None:
    problem = cell()
    shadow = Shadow(problem)
    # Every fifth of 20 is lost; the oldest loss is 50 windows of 40 ms old.
    lost = (0, 10, 20, 30)
    rows = {i: GONE if i in lost else off(40.0 * i, 20.0) for i in range(0, 40, 2)}
    shadow.learn(one_window(rows))
    shown = estimate(shadow)["OFF"]
    assert shown.violation_rate == 0.2
    # The 19th of 20: the second oldest loss.
    assert (shown.l95_ms, shown.uncut_l95_ms) == (problem.censor_ms, math.inf)
    assert shadow.support()["OFF"].samples == 20


def test_what_is_under_way_counts_with_its_age() -> None:
    shadow = Shadow(cell(deadline_ms=39.0))
    rows = {i: off(40.0 * i, 20.0) for i in range(30, 50)}
    rows[49] = GONE
    shadow.learn(one_window(rows))
    shown = estimate(shadow)["OFF"]
    assert (shown.violation_rate, shown.l95_ms) == (0.05, 20.0)
    # A last message that came so late that the sink would have ended after the close.
    rows[49] = off(40.0 * 49, 40.5)
    rows[48] = off(40.0 * 48, 60.0)
    shadow.start(cell(deadline_ms=39.0))
    shadow.learn(one_window(rows))
    shown = estimate(shadow)["OFF"]
    assert (shown.violation_rate, shown.l95_ms) == (0.1, 40.0)


def test_what_would_end_after_the_close_has_missed_whatever_the_deadline() -> None:
    # Released late: the last cycle is 10 ms old at the close. Its shadow would take 10.5.
    shadow = Shadow(cell())
    rows = {i: off(40.0 * i, 10.5) for i in range(20, 40)}
    shadow.learn(one_window(rows, cycles=40, close_ms=39 * 40.0 + 10.0))
    assert estimate(shadow)["OFF"].violation_rate == 0.05


def test_a_shadow_outlives_the_sink_of_its_cycle() -> None:
    """Where the cycle was lost behind what they share, the sink's time is the profile's."""
    rows = [local(40.0 * i) for i in range(20)]
    broken: list[Row] = [
        ([r[0], r[1], None, None], [e[0], None, None, None], [a[0], None, None])
        for r, e, a in ((list(x), list(y), list(z)) for x, y, z in rows)
    ]
    evidence = window(
        broken,
        close_ms=800.0,
        release_ms=[40.0 * i for i in range(20)],
        shadows=[off(40.0 * i, 20.0) for i in range(20)],
    )
    shadow = Shadow(cell())
    shadow.learn(evidence)
    assert (estimate(shadow)["OFF"].l95_ms, estimate(shadow)["OFF"].violation_rate) == (20.0, 0.0)
    assert estimate(shadow)["LOC"].violation_rate == 1.0


def test_a_slow_sink_slows_its_shadow() -> None:
    rows = [(r, [*e[:3], 40.0 * i + 26.0], a) for i, (r, e, a) in enumerate(map(local, RELEASES))]
    evidence = window(
        rows,
        close_ms=800.0,
        release_ms=RELEASES,
        shadows=[off(40.0 * i, 20.0) for i in range(20)],
    )
    shadow = Shadow(cell())
    shadow.learn(evidence)
    # control took 10 ms, not 1.
    assert estimate(shadow)["OFF"].l95_ms == 29.0


RELEASES = [40.0 * i for i in range(20)]


def test_twins_share_what_is_seen_of_either() -> None:
    shadow = Shadow(cell())
    shadow.learn(one_window({}))
    shown = estimate(shadow)
    assert shown["TWIN"] == shown["LOC"]
    assert shadow.support()["TWIN"] == shadow.support()["LOC"] == (50.0, 0)
    # A shadow through a twin runs nothing, and counts nothing twice.
    shadow.start(cell())
    rows = [local(t) for t in RELEASES]
    shadow.learn(
        window(rows, close_ms=800.0, release_ms=RELEASES, shadows=[GONE] * 20, through=[4] * 20)
    )
    assert shadow.support()["TWIN"] == (20.0, 0)


def test_a_window_of_two_placements_counts_for_both() -> None:
    rows = [local(t, 1.0 if i < 12 else 1.5) for i, t in enumerate(RELEASES)]
    shadow = Shadow(cell())
    shadow.learn(window(rows, close_ms=800.0, release_ms=RELEASES, placement=[0] * 8 + [2] * 12))
    assert (shadow.support()["LOC"].samples, shadow.support()["FAR"].samples) == (8.0, 12.0)
    assert estimate(shadow)["FAR"].l95_ms == 1.5 * 17.0


def test_samples_are_bounded() -> None:
    shadow = Shadow(cell(half_life_windows=1e6))
    for cycles in (LARGEST // 2 + 9, LARGEST // 2 + 9, LARGEST + 9):
        shadow.learn(one_window({}, cycles=cycles))
    assert 1000 < shadow.support()["LOC"].samples <= LARGEST
    assert estimate(shadow)["LOC"].l95_ms == 17.0


def test_the_estimate_is_censored() -> None:
    problem = cell(window_cycles=1, deadline_ms=4.0)
    shadow = Shadow(problem)
    shadow.learn(one_window(dict.fromkeys(range(40), GONE)))
    shown = estimate(shadow)["OFF"]
    assert (shown.l95_ms, shown.violation_rate) == (problem.censor_ms, 1.0)
    assert shown.uncut_l95_ms == math.inf


def test_a_start_forgets_and_another_problem_has_its_own_profile() -> None:
    shadow = Shadow(cell())
    shadow.learn(one_window({}))
    slower = replace(cell(candidates=("LOC", "OFF")), window_cycles=20)
    shadow.start(slower)
    assert shadow.support() == {"LOC": (0.0, 0), "OFF": (0.0, 0)}
    assert estimate(shadow).keys() == {"LOC", "OFF"}


@pytest.mark.parametrize("half_life", [0.0, -1.0, math.nan, math.inf, True])
def test_a_half_life_is_a_number_above_0(half_life: float) -> None:
    with pytest.raises(ProblemError, match=r"half_life_windows: .* is not allowed; it must be"):
        Shadow(cell(), half_life_windows=half_life)


def test_a_tiny_half_life_knows_the_last_window_only() -> None:
    shadow = Shadow(cell(), half_life_windows=1e-9)
    shadow.learn(one_window({i: off(40.0 * i, 30.0) for i in range(20)}))
    assert estimate(shadow)["OFF"].l95_ms == 30.0
    shadow.learn(one_window({i: off(40.0 * i, 20.0) for i in range(20)}))
    assert estimate(shadow)["OFF"].l95_ms == 20.0
