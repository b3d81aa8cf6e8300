"""Problems made in Python: what a constructor refuses, and where it says the fault is."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings

from dwell.errors import Fault, ProblemError
from dwell.model import (
    Bursts,
    Constant,
    ControllerSettings,
    Episodes,
    Execution,
    Fabric,
    Flow,
    FrozenDict,
    Link,
    LinkDisturbance,
    LiveSettings,
    MovingTarget,
    Node,
    NodeDisturbance,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Servo,
    Targets,
    Task,
    Weights,
    evolve,
)
from tests.cells.many import many
from tests.cells.strategies import problems

EXECUTION = Execution(Constant(1.0))
EPISODES = Episodes("storm", Constant(30.0), Constant(10.0))


def _problem() -> Problem:
    """Return two tasks on two nodes: the first anchored, the second relocatable."""
    tasks = {
        "a": Task("a", {"R": EXECUTION}),
        "b": Task("b", {"R": EXECUTION, "E": EXECUTION}),
    }
    nodes = {"R": Node("R", "robot"), "E": Node("E", "edge")}
    links = {"R->E": Link("R", "E", Constant(1.0))}
    return Problem(
        name="cell",
        pipeline=Pipeline(tasks, (Flow("a", "b"),), 10.0, 10.0),
        fabric=Fabric(nodes, links),
        candidates={
            "LOC": Placement({"a": "R", "b": "R"}),
            "SO": Placement({"a": "R", "b": "E"}),
        },
        objective=Objective(Weights(), Targets(10.0), tiers={"R": "robot", "E": "edge"}),
    )


def _faults(make: Callable[[], object]) -> list[Fault]:
    with pytest.raises(ProblemError) as caught:
        make()
    return list(caught.value.faults)


BURSTS = Bursts(Constant(1.0), Constant(1.0), threads=1, add_delay_ms=Constant(1.0))
TARGET = MovingTarget(1.0, 1.0)
PLACED = {"a": "R", "b": "R"}


@pytest.mark.parametrize(
    ("make", "path", "words"),
    [
        (lambda: NodeDisturbance("R", for_s=0), "for_s", "above 0"),
        (lambda: LinkDisturbance("R", "E", loss=2), "loss", "from 0 to 1"),
        (lambda: NodeDisturbance("R", ramp_s=-1), "ramp_s", "from 0 to 1e9"),
        (lambda: NodeDisturbance("R", for_s=3, ramp_s=2), "ramp_s", "at most half of for_s = 3"),
        (lambda: NodeDisturbance("R", down=True, ramp_s=2), "ramp_s", "left out with `down`"),
        (
            lambda: LinkDisturbance("R", "E", ramp_s=2, episodes=EPISODES),
            "ramp_s",
            "left out with `episodes`",
        ),
        (lambda: Episodes("x", Constant(1), Constant(0)), "episodes.for_s", "mean is a number"),
        (
            lambda: replace(
                _problem(),
                scenarios={"s": (NodeDisturbance("R", episodes=replace(EPISODES, name="a/b")),)},
            ),
            "scenarios.s[0].episodes.name",
            "is not a name",
        ),
        (
            lambda: replace(
                _problem(),
                scenarios={
                    "s": (
                        NodeDisturbance("R", at_s=1, episodes=EPISODES),
                        NodeDisturbance("E", episodes=replace(EPISODES, name="wind")),
                        NodeDisturbance("E", episodes=EPISODES),
                    )
                },
            ),
            "scenarios.s[2].episodes",
            "'storm' is declared otherwise at scenarios.s[0]",
        ),
        (lambda: Weights(0, 0, 0, 0, 0), "weights", "all weights are 0"),
        (lambda: Weights(latency=1e300), "weights.latency", "from 0 to 1e9"),
        (lambda: Targets(0), "targets.latency_ms", "from 1e-9"),
        (lambda: Objective(Weights(cloud=1), Targets(1)), "targets.cloud", "missing"),
        (lambda: ControllerSettings(guard_cycles=1), "guard_cycles", "from 2"),
        (lambda: ControllerSettings(probe_cycles=0), "probe_cycles", "from 1"),
        (lambda: ControllerSettings(migration="hot"), "migration", "warm, cold"),  # type: ignore[arg-type]
        (lambda: ControllerSettings(shadow_fraction=-0.1), "shadow_fraction", "from 0 to 1"),
        (lambda: ControllerSettings(shadow_fraction=1.1), "shadow_fraction", "from 0 to 1"),
        (
            lambda: ControllerSettings(shadow_fraction="Auto"),  # type: ignore[arg-type]
            "shadow_fraction",
            "auto or a number from 0 to 1",
        ),
        (lambda: ControllerSettings(half_life_windows=0), "half_life_windows", "above 0"),
        (lambda: ControllerSettings(half_life_windows=math.nan), "half_life_windows", "above 0"),
        (lambda: Servo("arm", 1.0, TARGET), "plant", "double-integrator"),  # type: ignore[arg-type]
        (lambda: Servo("integrator", 0.0, TARGET), "gain", "above 0"),
        (lambda: Servo("integrator", 1.0, TARGET, 1.0), "damping", "left out"),
        (lambda: Servo("double-integrator", 1.0, TARGET), "damping", "above 0"),
        (lambda: MovingTarget(0.0, 1.0), "target.amplitude_mm", "from 1e-6"),
        (lambda: MovingTarget(1.0, 0.0), "target.period_s", "from 1e-5"),
        (
            lambda: replace(_problem(), servo=Servo("integrator", 1.0, MovingTarget(1.0, 0.019))),
            "servo.target.period_s",
            "at least 0.02",
        ),
        (
            lambda: evolve(
                replace(_problem(), servo=Servo("integrator", 1.0, MovingTarget(1.0, 0.05))),
                {"tasks.a.every": 3, "tasks.b.every": 3},
            ),
            "servo.target.period_s",
            "at least 0.06, two frames of the camera",
        ),
        (
            lambda: replace(_problem(), live=LiveSettings(max_age_ms=9.9)),
            "live.max_age_ms",
            "at least deadline_ms = 10",
        ),
        (lambda: replace(_problem(), window_cycles=0), "window_cycles", "from 1"),
        (lambda: replace(_problem(), warmup_windows=-1), "warmup_windows", "from 0"),
        (
            lambda: replace(_problem(), candidates={"LOC": Placement({"b": "R"})}),
            "candidates.LOC.a",
            "put it on R",
        ),
        (
            lambda: replace(_problem(), candidates={"a/b": Placement(PLACED)}),
            "candidates.a/b",
            "is not a name",
        ),
        (
            lambda: replace(_problem(), candidates={"a" * 65: Placement(PLACED)}),
            f"candidates.{'a' * 65}",
            "at most 64 characters",
        ),
        (lambda: replace(_problem(), candidates={}), "candidates", "none is declared"),
        (
            lambda: replace(_problem(), scenarios={"s": (LinkDisturbance("E", "R"),)}),
            "scenarios.s[0].link",
            "unknown link 'E->R'",
        ),
        (
            lambda: replace(
                _problem(), objective=Objective(Weights(), Targets(1), tiers={"X": "edge"})
            ),
            "objective.tiers.X",
            "unknown node 'X'",
        ),
        (
            lambda: replace(
                _problem(),
                objective=replace(_problem().objective, accelerators={"E.gpu": "edge"}),
            ),
            "objective.accelerators",
            "name the accelerators of all nodes in tiers, nothing",
        ),
        (lambda: _problem().scenario("baselin"), "", "did you mean 'baseline'?"),
    ],
)
def test_what_a_constructor_refuses(make: Callable[[], object], path: str, words: str) -> None:
    (fault,) = _faults(make)
    assert fault.path == path
    assert words in fault.message


def test_every_fault_of_meaning_is_reported_at_once() -> None:
    good = _problem()
    loop = replace(good.pipeline, flows=(Flow("a", "b"), Flow("b", "a"), Flow("a", "x")))
    faults = _faults(
        lambda: replace(
            good,
            pipeline=loop,
            candidates={"C": Placement({"a": "E", "b": "R"})},
            controller=ControllerSettings(on="X", initial="Y", fallbacks=("Z",)),
        )
    )
    assert [fault.path for fault in faults] == [
        "flows[2].to",
        "flows",
        "candidates.C.a",
        "controller.on",
        "controller.initial",
        "controller.fallbacks[0]",
    ]


def test_a_cold_migration_needs_links_for_its_state() -> None:
    good, cold = _problem(), ControllerSettings(migration="cold")
    # Without state there is nothing to carry.
    assert replace(good, controller=cold)
    heavy = replace(good.pipeline.tasks["b"], state_bytes=1000)
    tasks = {**good.pipeline.tasks, "b": heavy}
    stateful = replace(good, pipeline=replace(good.pipeline, tasks=tasks))
    (fault,) = _faults(lambda: replace(stateful, controller=cold))
    assert fault.path == "tasks.b.state_bytes"
    for words in ("without the link E->R;", "declare it", "migration: warm"):
        assert words in fault.message
    links = {**good.fabric.links, "E->R": Link("E", "R", Constant(1.0))}
    linked = replace(stateful, fabric=replace(good.fabric, links=links))
    assert replace(linked, controller=cold)
    # A task that every candidate has on one node never moves.
    staying = {"LOC": good.candidates["LOC"]}
    assert replace(stateful, candidates=staying, controller=cold)


def test_the_baseline_exists_always_and_first() -> None:
    problem = replace(_problem(), scenarios={"crash": (NodeDisturbance("E", down=True),)})
    assert list(problem.scenarios) == ["baseline", "crash"]
    assert problem.scenario("baseline") == ()


def test_the_controller_sits_on_the_first_edge_node() -> None:
    problem = _problem()
    assert problem.controller_node == "E"
    assert replace(problem, controller=ControllerSettings(on="R")).controller_node == "R"
    assert problem.initial == "LOC"


@settings(max_examples=12, suppress_health_check=list(HealthCheck))
@given(problems())
def test_problems_can_be_copied_pickled_and_hashed(problem: Problem) -> None:
    assert pickle.loads(pickle.dumps(problem)) == problem
    assert copy.deepcopy(problem) == problem
    assert hash(copy.copy(problem)) == hash(problem)


def test_what_a_problem_holds_cannot_be_changed() -> None:
    problem = _problem()
    with pytest.raises(TypeError, match="cannot be changed"):
        problem.candidates["X"] = Placement(PLACED)  # type: ignore[index]
    with pytest.raises(TypeError, match="cannot be changed"):
        FrozenDict({"a": 1}).update(b=2)


def test_faults_are_printed_with_their_lines() -> None:
    error = ProblemError([Fault("a.b", "wrong", 3), Fault("", "worse")], "cell.yaml")
    assert str(error) == "cell.yaml:3: a.b: wrong\ncell.yaml: worse"
    assert str(ProblemError([Fault("a", "wrong", 3)])) == "line 3: a: wrong"
    assert str(ProblemError("no")) == "no"
    again = pickle.loads(pickle.dumps(error))
    assert (again.faults, again.source) == (error.faults, error.source)


@given(problem=problems())
def test_a_placement_that_never_moves_begins_on_itself(problem: Problem) -> None:
    for name in problem.candidates:
        assert problem.under(name).initial == name
        assert problem.under(name).controller.policy == name
    assert problem.under("atp").initial == problem.initial


@pytest.mark.parametrize(
    ("candidates", "fraction"), [(2, 0.05), (21, 0.05), (22, 1 / 21), (100, 1 / 99)]
)
def test_all_alternatives_together_are_sent_every_cycle_at_most(
    candidates: int, fraction: float
) -> None:
    problem = many(candidates)
    assert problem.controller.shadow_fraction == "auto"
    assert problem.shadow_fraction == fraction
    given = replace(problem, controller=replace(problem.controller, shadow_fraction=0.001))
    assert given.shadow_fraction == 0.001


def test_a_lone_candidate_has_a_shadow_fraction_too() -> None:
    assert many(1).shadow_fraction == 0.05


@pytest.mark.parametrize(
    ("deadline_ms", "max_age_ms", "open_cycles", "patience_ms"),
    [(4.0, 20.0, 1, 30.0), (10.0, 20.0, 1, 30.0), (11.0, 21.0, 2, 31.0), (640.0, 650.0, 64, 660.0)],
)
def test_what_follows_from_a_deadline(
    deadline_ms: float, max_age_ms: float, open_cycles: int, patience_ms: float
) -> None:
    problem = _problem()
    problem = replace(problem, pipeline=replace(problem.pipeline, deadline_ms=deadline_ms))
    assert problem.max_age_ms(next(iter(problem.pipeline.tasks))) == max_age_ms
    assert problem.pipeline.open_cycles == open_cycles
    # g is 3.
    assert problem.guard_patience_ns == patience_ms * 1e6
