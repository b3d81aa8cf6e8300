"""The guard of chains with a bound on their age, by hand, in milliseconds."""

from __future__ import annotations

import math
from dataclasses import replace

from dwell.estimators.prices import prices_of
from dwell.model import (
    Chain,
    Constant,
    ControllerSettings,
    Execution,
    Flow,
    Link,
    Node,
    Problem,
    Task,
)
from tests.cells.generated import make_problem
from tests.sim.test_simulated_guard import moves, placements, play

MOVES = {"OFF": {"detect": "E"}, "ALT": {"detect": "X"}, "LOC": {"detect": "R"}}
NODES = ("R", "E", "X")


def cell(max_age_ms: float = 100.0, fallbacks: tuple[str, ...] = ("LOC",)) -> Problem:
    """Return a cell whose control at 100 Hz samples the detections of a camera at 20 Hz.

    A detection takes 20 ms; none completes on X. The patience for the chain is 150 ms.
    """
    on_x = {"X": Execution(Constant(1e6))}
    problem = make_problem(
        [Node(name, "robot" if name == "R" else "edge", 8) for name in NODES],
        [
            Task("camera", {"R": Execution(Constant(1.0))}, every=5),
            Task("imu", {"R": Execution(Constant(1.0))}),
            Task("detect", {name: Execution(Constant(20.0)) for name in "RE"} | on_x),
            Task("control", {"R": Execution(Constant(1.0))}),
        ],
        [
            Flow("camera", "detect"),
            Flow("imu", "control"),
            Flow("detect", "control", sampled=True),
        ],
        links=[Link(*ends, Constant(1.0)) for node in "EX" for ends in (("R", node), (node, "R"))],
        candidates=MOVES,
        period_ms=10.0,
        window_cycles=5,
        controller=ControllerSettings(
            on="R", initial="OFF", fallbacks=fallbacks, guard_cycles=2, probe_cycles=4
        ),
    )
    chains = {"see": Chain("camera", "control", max_age_ms)}
    return replace(problem, pipeline=replace(problem.pipeline, chains=chains))


def test_a_dead_task_behind_a_sampled_flow_moves_the_cell_while_control_goes_on() -> None:
    # The newest detection that control uses is of the camera's release at 150.
    found = play(cell(), down={"E": [(200, 2000)]}, windows=16)
    assert moves(found) == [(6, "OFF", "LOC")]
    assert placements(found) == [("OFF", 30), ("LOC", 50)]
    assert found.cycles["outcome"].unique().to_list() == ["done"]
    # Detections on R are there again before the age would have reached the patience once more.
    assert found.windows["age_missed_see"].to_list()[8:] == [0.0] * 8


def test_cycles_miss_while_their_detections_are_too_old() -> None:
    # Control ends 2 ms after a release; 100 ms after the release at 150 it misses, until it gets
    # the detection of the release at 300: it is there at 321, when the control of 320 starts.
    found = play(cell(), down={"E": [(200, 2000)]}, windows=8)
    missed = found.cycles.filter("missed")["cycle"].to_list()
    assert missed == list(range(25, 32))
    for column in ("violation_rate", "seen_violation_rate"):
        assert found.windows[column].to_list() == [0, 0, 0, 0, 0, 1.0, 0.4, 0]


def test_a_candidate_whose_detections_never_arrive_misses_all_in_its_price() -> None:
    prices = prices_of(cell(), cycles=200)
    assert {name: price.violation_rate for name, price in prices.items()} == {
        "OFF": 0.0,
        "ALT": 1.0,
        "LOC": 0.0,
    }


def test_a_chain_without_a_bound_is_not_guarded() -> None:
    found = play(cell(math.inf), down={"E": [(200, 2000)]}, windows=16)
    assert moves(found) == []
    assert not found.cycles["missed"].any()


def test_a_fallback_on_which_only_the_chain_fails_is_left_after_the_patience() -> None:
    found = play(cell(fallbacks=("ALT", "LOC")), down={"E": [(200, 2000)]}, windows=16)
    assert [move[1:] for move in moves(found)] == [("OFF", "ALT"), ("ALT", "LOC")]
    assert placements(found) == [("OFF", 30), ("ALT", 15), ("LOC", 35)]


def test_it_returns_once_probes_of_detections_have_arrived() -> None:
    # E is back at 500: probes of the camera's releases at 500, 550, 600 and 650 arrive.
    found = play(cell(), down={"E": [(200, 500)]}, windows=24)
    assert placements(found) == [("OFF", 30), ("LOC", 40), ("OFF", 50)]


def test_a_fallback_whose_node_was_down_is_tried_once_it_is_back_while_control_goes_on() -> None:
    found = play(cell(fallbacks=("ALT",)), down={"E": [(200, 2000)], "X": [(100, 600)]}, windows=16)
    assert moves(found) == [(12, "OFF", "ALT")]
    assert placements(found) == [("OFF", 60), ("ALT", 20)]
