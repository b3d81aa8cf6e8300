"""Rates of tasks: how they pass along flows, and what is refused."""

from __future__ import annotations

from typing import Any

import pytest

from dwell.cellfile.cell import from_document
from dwell.errors import ProblemError
from dwell.model import Constant, Execution, Flow, Pipeline, Problem, Task
from dwell.model.task_rates import rates_of

EXECUTION = Execution(Constant(1.0))


def tasks(**every: int | None) -> dict[str, Task]:
    return {name: Task(name, {"R": EXECUTION}, every=n) for name, n in every.items()}


def cell(**changes: Any) -> dict[str, Any]:
    """A camera at a tenth of the rate of a control loop, which samples what it detects."""
    on = {"R": {"exec_ms": 1}}
    return {
        "dwell": 1,
        "period_ms": 10,
        "window_cycles": 20,
        "nodes": {"R": {"tier": "robot", "cores": 4}},
        "tasks": {
            "camera": {"on": on, "every": 10},
            "imu": {"on": on},
            "detect": {"on": on},
            "control": {"on": on},
        },
        "flows": [
            {"from": "camera", "to": "detect"},
            {"from": "imu", "to": "control"},
            {"from": "detect", "to": "control", "sampled": True},
        ],
        "candidates": {"LOC": {}},
        "objective": {
            "weights": {"latency": 1, "violations": 1, "robot": 1, "edge": 1, "switching": 1},
            "targets": {"latency_ms": 5, "robot": 0.5, "edge": 0.5},
        },
    } | changes


def made(document: dict[str, Any], **tasks: dict[str, Any]) -> Problem:
    for name, keys in tasks.items():
        document["tasks"][name] = {"on": {"R": {"exec_ms": 1}}, **keys}
    return from_document(document)


def fault_of(document: dict[str, Any], **tasks: dict[str, Any]) -> tuple[str, str]:
    with pytest.raises(ProblemError) as caught:
        made(document, **tasks)
    (fault,) = caught.value.faults
    return fault.path, fault.message


def test_a_rate_passes_along_waited_flows_only() -> None:
    pipeline = made(cell()).pipeline
    assert pipeline.rates == {"camera": 10, "imu": 1, "detect": 10, "control": 1}
    assert pipeline.sink_rates == {"camera": (), "imu": (1,), "detect": (), "control": (1,)}
    assert (pipeline.sink_cycles, pipeline.has_idle_cycles, pipeline.has_rates) == (1, False, True)


def test_a_join_of_rates_has_the_slowest() -> None:
    named = tasks(a=2, b=6, c=6)
    assert rates_of(named, [Flow("a", "c"), Flow("b", "c")]) == {"a": 2, "b": 6, "c": 6}


def test_a_task_with_sampled_inputs_alone_has_a_rate_and_an_offset_of_its_own() -> None:
    document = cell()
    document["flows"][1]["sampled"] = True
    pipeline = made(document, control={"every": 2, "offset_ms": 3}).pipeline
    assert pipeline.rates["control"] == pipeline.sink_cycles == 2
    assert pipeline.has_idle_cycles


def test_a_waited_message_has_the_rate_of_its_target_and_a_sampled_one_of_its_source() -> None:
    named = tasks(a=None, b=4, c=4, d=None)
    flows = Flow("a", "c"), Flow("b", "c"), Flow("b", "d", sampled=True)
    pipeline = Pipeline(named, flows, 10.0, 10.0)
    assert pipeline.message_rates == {("a", "c"): 4, ("b", "c"): 4, ("b", "d"): 4}


@pytest.mark.parametrize(
    ("every", "path", "words"),
    [
        (0, "tasks.camera.every", "from 1 to 10000"),
        (-1, "tasks.camera.every", "from 1 to 10000"),
        (2.5, "tasks.camera.every", "a whole number"),
        (10_001, "tasks.camera.every", "from 1 to 10000"),
    ],
)
def test_a_rate_is_a_whole_number_of_cycles(every: object, path: str, words: str) -> None:
    where, message = fault_of(cell(), camera={"every": every})
    assert where == path
    assert words in message


def test_a_join_of_two_rates_names_both_and_the_remedy() -> None:
    document = cell()
    document["flows"][2]["sampled"] = False
    path, message = fault_of(document)
    assert path == "tasks.control.every"
    for words in ("imu (every 1)", "detect (every 10)", "sampled: true", "every: 10"):
        assert words in message
    assert made(document, control={"every": 10}).pipeline.rates["control"] == 10


def test_a_join_says_the_slowest_rate() -> None:
    document = cell()
    document["flows"][2]["sampled"] = False
    path, message = fault_of(document, control={"every": 20})
    assert path == "tasks.control.every"
    assert "20 is not allowed" in message
    path, message = fault_of(cell(), detect={"every": 5})
    assert path == "tasks.detect.every"
    assert "sampled: true" in message


def test_rates_of_a_join_are_multiples() -> None:
    document = cell()
    document["flows"][2]["sampled"] = False
    path, message = fault_of(document, imu={"every": 4}, control={"every": 10})
    assert path == "tasks.control.every"
    assert "imu (every 4)" in message
    assert "sampled: true" in message


def test_rates_coincide_within_a_bound() -> None:
    document = cell(window_cycles=10_000)
    document["flows"][1]["sampled"] = True
    path, message = fault_of(document, camera={"every": 9_999}, imu={"every": 9_998})
    assert path == "tasks.camera.every"
    assert "100000" in message


def test_a_loop_through_a_sampled_flow_is_refused() -> None:
    document = cell()
    document["flows"].append({"from": "control", "to": "detect", "sampled": True})
    path, message = fault_of(document)
    assert path == "flows"
    assert "sampled" in message


def test_a_flow_is_sampled_or_waited() -> None:
    document = cell()
    document["flows"].append({"from": "imu", "to": "control", "sampled": True})
    path, message = fault_of(document)
    assert path == "flows[3]"
    assert "declared again" in message


def test_a_sink_runs_in_each_window() -> None:
    document = cell(window_cycles=9)
    document["flows"][2]["sampled"] = False
    path, message = fault_of(document, control={"every": 10})
    assert path == "window_cycles"
    assert "control" in message
    assert "at least 10" in message


def test_the_time_between_decisions_is_a_multiple_of_the_interval_of_a_sink() -> None:
    document = cell(window_cycles=50)
    document["flows"][2]["sampled"] = False
    assert made(cell(window_cycles=50)).decide_cycles == 12
    assert made(document, control={"every": 10}).decide_cycles == 20
    assert made(document | {"window_cycles": 10}, control={"every": 10}).decide_cycles == 10


def test_frames_release_each_cycle() -> None:
    path, message = fault_of(cell(live={"release": "frames"}))
    assert path == "live.release"
    assert "every" in message


def test_fallbacks_fit_a_cell_with_idle_cycles() -> None:
    document = cell(controller={"fallbacks": ["LOC"]})
    document["flows"][2]["sampled"] = False
    problem = made(document, control={"every": 10})
    assert problem.pipeline.has_idle_cycles
    assert problem.controller.fallbacks == ("LOC",)
