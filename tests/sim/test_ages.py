"""Data ages and mean ages in J: by hand, and in the record of a run."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.cost import price
from dwell.errors import ProblemError
from dwell.model import (
    Caps,
    Chain,
    Constant,
    Execution,
    Flow,
    Link,
    MissCap,
    MovingTarget,
    Node,
    Placement,
    Problem,
    Servo,
    Targets,
    Task,
    Weights,
)
from dwell.study.reference import references
from tests.cells.deterministic import cell
from tests.cells.generated import make_problem
from tests.cells.once import with_windows

PERIOD_MS = 40.0


def weighing(problem: Problem, latency: str | None = None, cap_ms: float = 1e9) -> Problem:
    """Let a cell weigh its mean age, with a bound of ages that none reaches."""
    objective = replace(
        problem.objective,
        weights=Weights(age=2.0),
        targets=Targets(latency_ms=problem.pipeline.deadline_ms, age_ms=50.0),
        caps=Caps(latency_ms=cap_ms),
        latency=latency,
    )
    return replace(problem, objective=objective)


def lossy(loss: float) -> Problem:
    """Return a cell in which each cycle takes 9 ms, or is lost."""
    return make_problem(
        [Node("R", "robot", 2), Node("E", "edge", 2)],
        [
            Task("sense", {"R": Execution(Constant(1.0))}),
            Task("act", {"E": Execution(Constant(3.0))}),
        ],
        [Flow("sense", "act")],
        links=[Link("R", "E", Constant(5.0), loss=loss)],
        period_ms=PERIOD_MS,
        window_cycles=100,
    )


def test_with_a_constant_latency_the_mean_age_is_the_latency_and_half_a_period() -> None:
    ages = dwell.simulate(weighing(cell()), seed=1, windows=3, policy="LOC").windows["seen_age_ms"]
    assert ages[1:].to_list() == pytest.approx([17 + PERIOD_MS / 2] * 2)
    # Until the first actuation of a run its age counts from the first release: 17 ms, not 57.
    assert ages[0] == pytest.approx(17 + PERIOD_MS / 2 - PERIOD_MS * 17 / (50 * PERIOD_MS))


@pytest.mark.parametrize("loss", [0.1, 0.4])
def test_with_independent_losses_the_mean_age_grows_by_their_gaps(loss: float) -> None:
    run = dwell.simulate(weighing(lossy(loss)), seed=1, windows=300, policy="LOC")
    expected_ms = 9 + PERIOD_MS * (1 + loss) / (2 * (1 - loss))
    assert run.windows["seen_age_ms"].mean() == pytest.approx(expected_ms, rel=0.02)


def test_ages_count_for_no_more_than_the_bound() -> None:
    problem = weighing(lossy(0.999999), cap_ms=200.0)
    assert problem.censor_ms == 200.0
    run = dwell.simulate(problem, seed=1, windows=2, policy="LOC")
    # 200 of 4,000 ms grow to the bound.
    assert run.windows["seen_age_ms"].to_list() == pytest.approx([200 - 200 * 100 / 4_000, 200])


def test_a_weighed_age_is_in_the_cost_of_windows_and_in_decisions() -> None:
    problem = weighing(cell(estimator="profile"))
    run = dwell.simulate(problem, scenario="disturbed", seed=1, windows=4, policy="dtp")
    for row in run.windows.filter(~run.windows["mixed"]).iter_rows(named=True):
        used = max(row["u_R"], 0.0), max(row["u_E"], 0.0), 0.0
        seen = row["seen_l95_ms"], row["seen_violation_rate"]
        without = price(*seen, *used, 0.0, replace(problem.objective, weights=Weights()))
        assert row["cost"] >= without + 2.0 * row["seen_age_ms"] / 50.0 - 1e-12
    assert {"seen_age_ms", "est_age_ms_LOC"} <= {*run.decisions.columns}
    known = run.decisions.filter(run.decisions["est_age_ms_OFF"].is_not_null())
    # OFF takes 2 + 1 + 3 + 1 + 6 + 1 ms.
    assert known["est_age_ms_OFF"][0] == pytest.approx(14 + PERIOD_MS / 2)


def chained(latency: str | None = "see-act") -> Problem:
    """Return the example with a camera at 10 Hz and a controller at 100 Hz."""
    problem = dwell.load("examples/inner-loop.yaml")
    objective = replace(problem.objective, latency=latency)
    return replace(problem, objective=objective)


def test_a_chain_takes_the_place_of_the_latency_in_what_the_controller_sees() -> None:
    runs = [
        dwell.simulate(one, scenario="wifi-outage", seed=1, windows=40, policy="EDGE")
        for one in (chained(), chained(None))
    ]
    windows, plain = (run.arrays("windows") for run in runs)
    age_ms, seen_ms = windows["age_l95_see-act"], windows["seen_l95_ms"]
    lost = age_ms > 720
    assert chained().censor_ms == 4 * 180
    assert 0 < lost.sum() < len(lost)
    assert set(seen_ms[lost]) == {720.0}
    assert (seen_ms <= age_ms).all()
    assert (seen_ms[~lost] == age_ms[~lost]).mean() > 0.9
    # The column of the cycle is the same as without a chain.
    assert windows["l95_ms"].tolist() == plain["l95_ms"].tolist()
    assert plain["seen_l95_ms"].max() < 10


def test_the_mean_age_of_a_chain_counts_commands_of_cycles_that_waited_for_long() -> None:
    # A command every 15 ms in cycles of 10 ms: cycles wait, up to D, and take ever newer pictures.
    on = {name: {"R": Execution(Constant(ms))} for name, ms in (("camera", 1), ("act", 15))}
    problem = make_problem(
        [Node("R", "robot", 4)],
        [Task("camera", on["camera"]), Task("act", on["act"], every=1)],
        [Flow("camera", "act", sampled=True)],
        period_ms=10,
        deadline_ms=640,
        window_cycles=20,
    )
    chains = {"see-act": Chain("camera", "act", 20)}
    problem = replace(problem, pipeline=replace(problem.pipeline, chains=chains))
    objective = replace(
        problem.objective,
        weights=Weights(age=1.0),
        targets=Targets(latency_ms=20, age_ms=20.0),
        latency="see-act",
    )
    run = dwell.simulate(replace(problem, objective=objective), seed=1, windows=10, policy="LOC")
    assert run.cycles["latency_ns"][100] > 4 * 20e6
    # At a command its picture is 20 or 25 ms old, in turn; then it ages for 15 ms.
    assert run.windows["seen_age_ms"][1:6].to_list() == pytest.approx([30.0] * 5, abs=0.5)


def test_a_policy_leaves_a_placement_whose_data_are_old() -> None:
    # Without a bound on the age and the chain in J, the policy sees latencies alone.
    problem = chained(None)
    unbounded = {"see-act": Chain("camera", "control")}
    latencies = replace(problem, pipeline=replace(problem.pipeline, chains=unbounded))
    runs = [
        dwell.simulate(one, scenario="wifi-outage", seed=1, windows=40, policy="dtp")
        for one in (chained(), latencies)
    ]
    ages = [run.arrays("windows")["age_l95_see-act"].mean() for run in runs]
    assert ages[0] < 0.8 * ages[1]


def test_a_servo_takes_the_error_at_the_release_of_the_chains_origin() -> None:
    # A chain of waited flows alone descends from the release of its cycle: nothing changes.
    problem = replace(
        dwell.load("examples/canonical.yaml"),
        servo=Servo("integrator", 2.0, MovingTarget(amplitude_mm=10.0, period_s=2.0)),
    )
    chain = {"see": Chain("sensing", "control")}
    named = replace(
        problem,
        pipeline=replace(problem.pipeline, chains=chain),
        objective=replace(problem.objective, latency="see"),
    )
    rows = [errors_of(one) for one in (problem, named)]
    assert rows[0] == rows[1]
    # With pictures of each tenth cycle, the errors that a command uses are older.
    sampled = replace(chained(), servo=problem.servo)
    assert errors_of(sampled) > errors_of(replace(chained(None), servo=problem.servo))


def errors_of(problem: Problem) -> float:
    from dwell.study.summary import summarise

    run = dwell.simulate(problem, seed=1, windows=12, policy=next(iter(problem.candidates)))
    return float(summarise(run, problem, {}).row["tracking_rms_mm"])


def test_a_run_has_the_ages_of_its_chains_in_its_summary() -> None:
    from dwell.study.summary import summarise

    problem = chained()
    run = dwell.simulate(problem, seed=1, windows=5, policy="EDGE")
    row, counted = summarise(run, problem, {}).row, run.windows.filter(~run.windows["warmup"])
    assert row["age_l95_see-act"] == pytest.approx(counted["age_l95_see-act"].mean())
    for column in ("age_missed_see-act", "reaction_l95_see-act"):
        assert row[column] == pytest.approx(counted[column].mean())


def sampling(every: int, exec_ms: float, **tasks: object) -> Problem:
    """Return a cell whose control samples its inputs in each cycle of 10 ms, on one node."""
    document = {
        "dwell": 1,
        "period_ms": 10,
        "window_cycles": 2 * every,
        "nodes": {"R": {"tier": "robot", "cores": 8}},
        "tasks": {
            "camera": {"every": every, "on": {"R": {"exec_ms": exec_ms}}},
            "control": {"on": {"R": {"exec_ms": 1}}},
            **tasks,
        },
        "flows": [
            {"from": "camera", "to": "control", "sampled": True},
            *({"from": "camera", "to": name} for name in tasks),
            *({"from": name, "to": "control", "sampled": True} for name in tasks),
        ],
        "chains": {"see": {"from": "camera", "to": "control"}},
        "candidates": {"LOC": {}},
        "objective": {"weights": {}},
    }
    return from_document(document)


def test_an_event_waits_for_the_next_release_and_its_actuation() -> None:
    # The value of each fifth cycle is there after 12 ms: the run two cycles later uses it.
    problem = sampling(5, 12.0)
    windows = dwell.simulate(problem, seed=1, windows=3, policy="LOC").windows
    assert windows["reaction_l95_see"].to_list() == [71.0] * 3
    assert windows["age_l95_see"].to_list()[1:] == [61.0] * 2
    # Windows in which no release's wait ends.
    short = with_windows(problem, 2)
    known = dwell.simulate(short, seed=1, windows=8, policy="LOC").windows["reaction_l95_see"]
    assert [value < math.inf for value in known] == [False] * 3 + [True, False, False, True, False]
    # Each cycle takes 17 ms.
    pipeline = replace(cell().pipeline, chains={"see": Chain("sense", "control")})
    plain = dwell.simulate(replace(cell(), pipeline=pipeline), seed=1, windows=2, policy="LOC")
    assert plain.windows["reaction_l95_see"].to_list() == [17 + PERIOD_MS] * 2


def test_an_event_is_known_as_soon_as_one_way_has_brought_it() -> None:
    # A run of control knows the camera's cycle before it, and the detection of the one before that.
    detect = {"workers": 2, "on": {"R": {"exec_ms": 15}}}
    windows = dwell.simulate(sampling(1, 1.0, detect=detect), seed=1, windows=5).windows
    assert windows["age_l95_see"].to_list()[2:] == [21.0] * 3
    assert windows["reaction_l95_see"].to_list()[2:] == [21.0] * 3


@pytest.mark.parametrize("key", ["latency", "weights.age", "caps.misses"])
def test_references_refuse_what_they_cannot_price(key: str) -> None:
    problem = cell()
    pipeline = replace(problem.pipeline, chains={"see": Chain("sense", "control")})
    problem = replace(problem, pipeline=pipeline)
    objective = {
        "latency": replace(problem.objective, latency="see"),
        "weights.age": weighing(problem).objective,
        "caps.misses": replace(problem.objective, caps=Caps(misses=MissCap(1, 20))),
    }[key]
    problem = replace(problem, objective=objective)
    with pytest.raises(ProblemError, match=f"objective.{key}"):
        references(problem, dwell.draw(problem, seed=1, windows=2))
    with pytest.raises(ProblemError, match=f"objective.{key}"):
        dwell.search(problem)


def test_an_objective_names_a_chain_that_is_frequent_enough() -> None:
    problem = dwell.load("examples/inner-loop.yaml")
    with pytest.raises(ProblemError, match=r"objective\.latency.*see-act"):
        replace(problem, objective=replace(problem.objective, latency="see-atc"))
    tasks = dict(problem.pipeline.tasks)
    tasks["log"] = Task("log", {"R": Execution(Constant(0.1))})
    pipeline = replace(
        problem.pipeline,
        tasks=tasks,
        flows=(*problem.pipeline.flows, Flow("detect", "log")),
        chains={"slow": Chain("camera", "log")},
    )
    controller = replace(problem.controller, decide_cycles=5)
    placed = {name: Placement({**one, "log": "R"}) for name, one in problem.candidates.items()}
    slow = replace(problem, pipeline=pipeline, controller=controller, candidates=placed)
    with pytest.raises(ProblemError, match=r"decide_cycles.*at least 10"):
        replace(slow, objective=replace(problem.objective, latency="slow"))


def test_weights_and_caps_check_their_numbers() -> None:
    objective = cell().objective
    with pytest.raises(ProblemError, match=r"targets\.age_ms"):
        replace(objective, weights=Weights(age=1.0))
    with pytest.raises(ProblemError, match=r"misses\.m"):
        MissCap(20, 20)
    assert MissCap(2, 20).least_cycles == 400
