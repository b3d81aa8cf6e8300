"""Runs of cells with several rates, against values derived by hand."""

from __future__ import annotations

from typing import Any

import pytest

from dwell import draw, simulate
from dwell.cellfile.cell import from_document
from dwell.kernels.advance import play
from dwell.kernels.arrays import CellArrays, flow_rows, lay_out
from dwell.model import Problem
from dwell.model.number_arrays import Ints
from dwell.record import Run
from dwell.study.summary import summarise

CAMERA = 10


def document(**changes: Any) -> dict[str, Any]:
    """A control loop at 100 Hz that samples the detections of a camera at 10 Hz."""

    def on(node: str, exec_ms: object) -> dict[str, Any]:
        return {"on": {node: {"exec_ms": exec_ms}}}

    return {
        "dwell": 1,
        "name": "inner-loop",
        "period_ms": 10,
        "window_cycles": 20,
        "nodes": {"R": {"tier": "robot", "cores": 4}, "E": {"tier": "edge", "cores": 4}},
        "links": [{"from": "R", "to": "E", "both_ways": True, "delay_ms": 2}],
        "tasks": {
            "camera": {**on("R", 3), "every": CAMERA, "offset_ms": 2},
            "imu": on("R", 1),
            "detect": on("E", 36),
            "control": on("R", 2),
        },
        "flows": [
            {"from": "camera", "to": "detect", "bytes": 1000},
            {"from": "imu", "to": "control"},
            {"from": "detect", "to": "control", "sampled": True},
        ],
        "candidates": {"LOC": {}},
        "objective": {
            "weights": {"latency": 1, "violations": 1, "robot": 1, "edge": 1, "switching": 1},
            "targets": {"latency_ms": 5, "robot": 0.5, "edge": 0.5},
        },
        "controller": {"policy": "LOC"},
    } | changes


def waited(**changes: Any) -> Problem:
    """The same loop, whose control waits for the detections and runs in every tenth cycle."""
    cell = document(**changes)
    cell["flows"][2]["sampled"] = False
    cell["tasks"]["control"]["every"] = CAMERA
    return from_document(cell | {"deadline_ms": 10})


def played(problem: Problem, windows: int = 2) -> Run:
    return simulate(problem, seed=1, windows=windows, jobs=True)


def latencies_ms(run: Run) -> list[float | None]:
    return [None if ns is None else ns / 1e6 for ns in run.cycles["latency_ns"]]


def jobs_of(run: Run, task: str) -> list[tuple[int, float, float]]:
    """Return cycle, readiness and completion (ms) of each job of a task."""
    rows = run.jobs.filter(run.jobs["task"] == task)
    return [
        (cycle, ready / 1e6, end / 1e6)
        for cycle, ready, end in zip(rows["cycle"], rows["ready_ns"], rows["end_ns"], strict=True)
    ]


def test_control_does_not_wait_for_a_sampled_camera() -> None:
    run = played(from_document(document()))
    assert latencies_ms(run) == [3.0] * 40
    assert run.cycles["outcome"].to_list() == ["done"] * 40
    assert run.windows["l95_ms"].to_list() == run.windows["seen_l95_ms"].to_list() == [3.0, 3.0]


def test_a_camera_runs_in_every_tenth_cycle_after_its_offset() -> None:
    run = played(from_document(document()))
    assert jobs_of(run, "camera") == [(c, 10.0 * c + 2, 10.0 * c + 5) for c in (0, 10, 20, 30)]
    # Two milliseconds on the link, then 36 of work.
    assert jobs_of(run, "detect") == [(c, 10.0 * c + 7, 10.0 * c + 43) for c in (0, 10, 20, 30)]


def test_all_time_counts_for_utilisation() -> None:
    run = played(from_document(document()))
    # 36 ms of one in four cores in each 100 ms.
    assert run.windows["u_E"].to_list() == pytest.approx([0.09, 0.09])


def test_a_job_takes_the_newest_value_that_has_arrived() -> None:
    problem = from_document(document())
    arrays = lay_out([(problem, draw(problem, seed=1, windows=2))], log_jobs=True)
    play(arrays)
    taken = CellArrays(arrays).logs().taken[0][:, flow_rows(problem.pipeline)][:, 2]
    # Detections arrive at 45 ms, 145 ms, ...; control takes its jobs at 1 ms after each release.
    expected = [-1] * 5 + [0] * 10 + [10] * 10 + [20] * 10 + [30] * 5
    assert taken.tolist() == expected


def test_cycles_without_a_sink_are_idle() -> None:
    run = played(waited())
    outcomes, latencies = run.cycles["outcome"].to_list(), latencies_ms(run)
    for cycle in range(40):
        due = cycle % CAMERA == 0
        # camera at 2, 3 ms, link 2 ms, detect 36 ms, link 2 ms, control 2 ms
        assert (outcomes[cycle], latencies[cycle]) == (("done", 47.0) if due else ("idle", None))


def test_idle_cycles_are_in_no_metric() -> None:
    run = played(waited())
    assert run.cycles["missed"].to_list() == [c % CAMERA == 0 for c in range(40)]
    assert run.windows["violation_rate"].to_list() == [1.0, 1.0]
    assert run.windows["l95_ms"].to_list() == [47.0, 47.0]
    row = summarise(run, waited(), {}).row
    assert row["cycles"] == 4
    assert (row["violation_rate"], row["lost"], row["longest_misses"]) == (1.0, 0, 4)


def test_a_fast_source_sends_only_in_cycles_in_which_its_target_runs() -> None:
    run = played(waited())
    assert len(jobs_of(run, "imu")) == 40
    assert [cycle for cycle, *_ in jobs_of(run, "control")] == [0, 10, 20, 30]


def test_the_loss_of_a_sampled_way_loses_no_cycle() -> None:
    cell = document()
    cell["links"] = [
        {"from": "R", "to": "E", "delay_ms": 2, "loss": 0.9},
        {"from": "E", "to": "R", "delay_ms": 2},
    ]
    run = simulate(from_document(cell), seed=1, windows=20, jobs=True)
    assert run.cycles["outcome"].to_list() == ["done"] * 400
    assert len(jobs_of(run, "detect")) < len(jobs_of(run, "camera")) == 40


def test_a_node_that_is_down_on_a_sampled_way_loses_no_cycle() -> None:
    cell = document(scenarios={"dead": [{"node": "E", "at_s": 0.02, "down": True}]})
    run = simulate(from_document(cell), scenario="dead", seed=1, windows=2)
    assert run.cycles["outcome"].to_list() == ["done"] * 40


def test_a_loss_of_a_needed_task_loses_its_cycle_only() -> None:
    cell = document(scenarios={"dead": [{"node": "E", "at_s": 0.15, "for_s": 0.02, "down": True}]})
    cell["flows"][2]["sampled"] = False
    cell["tasks"]["control"]["every"] = CAMERA
    run = simulate(from_document(cell), scenario="dead", seed=1, windows=2)
    expected = ["done" if c % CAMERA == 0 else "idle" for c in range(40)]
    assert run.cycles["outcome"].to_list() == expected
    cell["scenarios"]["dead"][0]["at_s"] = 0.12
    run = simulate(from_document(cell), scenario="dead", seed=1, windows=2)
    expected[10] = "node_down"
    assert run.cycles["outcome"].to_list() == expected


def test_a_task_with_sampled_inputs_alone_runs_at_its_own_rate() -> None:
    cell = document()
    cell["flows"][1]["sampled"] = True
    cell["tasks"]["control"] |= {"every": 2, "offset_ms": 4}
    run = played(from_document(cell))
    assert jobs_of(run, "control") == [(c, 10.0 * c + 4, 10.0 * c + 6) for c in range(0, 40, 2)]
    assert latencies_ms(run) == [6.0, None] * 20


DRAWN = {"lognormal": {"mean": 5, "cv": 0.3}}


def values_of(problem: Problem, task: str) -> Ints:
    real = draw(problem, seed=3, windows=6)
    (row,) = [i for i, (name, _) in enumerate(real.sites) if name == task]
    values: Ints = real.exec_ns[row]
    return values


def test_the_k_th_run_takes_the_k_th_value_of_its_stream() -> None:
    fast, slow = document(), document()
    for cell in (fast, slow):
        cell["tasks"]["camera"]["on"]["R"]["exec_ms"] = DRAWN
        cell["tasks"]["imu"]["on"]["R"]["exec_ms"] = {"ar1": {"mean": 5, "cv": 0.3, "rho": 0.9}}
        cell["links"][0]["delay_ms"] = DRAWN
    del fast["tasks"]["camera"]["every"]
    slow["tasks"]["imu"]["every"] = slow["tasks"]["control"]["every"] = 4
    every, tenth = from_document(fast), from_document(slow)
    runs = len(range(0, 120, CAMERA))
    assert (
        values_of(tenth, "camera")[::CAMERA].tolist() == values_of(every, "camera")[:runs].tolist()
    )
    assert not values_of(tenth, "camera").reshape(-1, CAMERA)[:, 1:].any()
    assert values_of(tenth, "imu")[::4].tolist() == values_of(every, "imu")[:30].tolist()
    delays = [draw(one, seed=3, windows=6).delay_ns[0] for one in (every, tenth)]
    assert delays[1][::CAMERA].tolist() == delays[0][:runs].tolist()


def test_a_scale_goes_by_cycle() -> None:
    cell = document(scales={"scene": {"uniform": {"low": 1, "high": 2}}})
    cell["tasks"]["camera"]["scale"] = cell["tasks"]["imu"]["scale"] = "scene"
    problem = from_document(cell)
    camera, imu = values_of(problem, "camera"), values_of(problem, "imu")
    assert camera[::CAMERA] == pytest.approx(3 * imu[::CAMERA], abs=2)


def test_rates_of_one_change_nothing() -> None:
    plain = document()
    del plain["tasks"]["camera"]["every"]
    plain["flows"][2]["sampled"] = False
    stated = {**plain, "tasks": {name: {**task} for name, task in plain["tasks"].items()}}
    for name in ("camera", "imu"):
        stated["tasks"][name]["every"] = 1
    one, other = (simulate(from_document(cell), seed=1, windows=3) for cell in (plain, stated))
    assert one.cycles.equals(other.cycles)
    assert one.windows.equals(other.windows)


def moving(*, payload: int = 0, **changes: Any) -> Problem:
    """The loop with a control that may run on either node; a move takes effect at cycle 20."""
    cell = document(**changes)
    cell["tasks"]["control"]["on"] = {"R": {"exec_ms": 2}, "E": {"exec_ms": 2}}
    cell["flows"][2]["bytes"] = payload
    cell["candidates"] = {"LOC": {"control": "R"}, "FAR": {"control": "E"}}
    return from_document(cell)


def taken_by_control(problem: Problem, stamps: list[int]) -> list[int]:
    """Return the cycle of the detection that control took in each cycle."""
    arrays = lay_out([(problem, draw(problem, seed=1, windows=2))], log_jobs=True)
    arrays.tables.stamps[0] = stamps
    play(arrays)
    logs = CellArrays(arrays).logs()
    taken: list[int] = logs.taken[0][:, flow_rows(problem.pipeline)][:, 2].tolist()
    return taken


def test_a_node_forwards_its_value_when_the_target_moves() -> None:
    # Detections end at 43, 143, 243 ms on E. Control moves from E to R with cycle 20, at 200 ms:
    # the value of cycle 10 is forwarded and arrives at 202 ms; imu ends at 201 ms, before that.
    stamps = [1] * 20 + [0] * 20
    expected = [-1] * 4 + [0] * 10 + [10] * 6 + [-1] + [10] * 4 + [20] * 10 + [30] * 5
    # Control on E takes its job 1 + 2 ms after the release: at 43 ms (cycle 4) the value has come.
    assert taken_by_control(moving(), stamps) == expected


def test_what_arrives_at_an_old_node_is_forwarded_until_the_first_new_message() -> None:
    # The detection of cycle 20 is sent to E, under FAR, and ends at 243 ms; the move is at 230 ms.
    stamps = [1] * 23 + [0] * 17
    taken = taken_by_control(moving(), stamps)
    # It arrives on R at 245 ms: control takes it from cycle 25 on, at 251 ms.
    assert taken[23:] == [-1, 10, *[20] * 10, *[30] * 5]


def test_without_a_direct_link_there_is_no_value_until_the_next_message() -> None:
    cell = document()
    cell["nodes"]["C"] = {"tier": "cloud", "cores": 4}
    cell["links"].append({"from": "E", "to": "C", "both_ways": True, "delay_ms": 2})
    cell["links"].append({"from": "R", "to": "C", "delay_ms": 2})
    cell["tasks"]["control"]["on"] = {"R": {"exec_ms": 2}, "C": {"exec_ms": 2}}
    cell["candidates"] = {"LOC": {"control": "R"}, "FAR": {"control": "C"}}
    taken = taken_by_control(from_document(cell), [1] * 20 + [0] * 20)
    # No link leads from C to R; the detection of cycle 20 arrives at 245 ms.
    assert taken[18:27] == [10, 10, -1, -1, -1, -1, -1, 20, 20]


def test_a_node_that_goes_down_loses_its_values() -> None:
    cell = document(scenarios={"dip": [{"node": "R", "at_s": 0.2, "for_s": 0.005, "down": True}]})
    problem = from_document(cell)
    arrays = lay_out([(problem, draw(problem, scenario="dip", seed=1, windows=2))], log_jobs=True)
    play(arrays)
    taken = CellArrays(arrays).logs().taken[0][:, flow_rows(problem.pipeline)][:, 2].tolist()
    # The camera of cycle 20 is lost at 202 ms, so the next detection is the one of cycle 30.
    assert taken[18:36] == [10, 10, *[-1] * 15, 30]


def test_a_forward_occupies_the_link() -> None:
    # 100,000 bytes at 100 Mbit/s take 8 ms.
    link = {"delay_ms": 2, "rate_mbps": 100, "both_ways": True, "from": "R", "to": "E"}
    taken = taken_by_control(moving(payload=100_000, links=[link]), [1] * 20 + [0] * 20)
    assert taken[19:23] == [10, -1, 10, 10]
