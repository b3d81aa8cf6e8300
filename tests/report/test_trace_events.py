"""Traces of jobs in the Chrome trace event format."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import pytest

from dwell import Run, simulate
from dwell.errors import RunError
from dwell.report import trace_events
from dwell.report.trace_events import TraceEvent
from tests.cells.small import make_problem
from tests.report.pages import small_run


@pytest.fixture(scope="module")
def events() -> list[TraceEvent]:
    events: list[TraceEvent] = trace_events(small_run())["traceEvents"]
    return events


def of(events: list[TraceEvent], phase: str) -> list[TraceEvent]:
    return [event for event in events if event["ph"] == phase]


def test_it_is_json_without_numbers_that_json_has_not() -> None:
    document = trace_events(small_run())
    again = json.loads(json.dumps(document, allow_nan=False))
    assert again == document
    assert set(again) == {"traceEvents", "displayTimeUnit", "otherData"}


def test_nodes_are_processes_and_tasks_are_threads(events: list[TraceEvent]) -> None:
    names = {
        (event["name"], event["pid"], event["tid"]): event["args"]["name"]
        for event in of(events, "M")
    }
    processes = [name for (what, _, _), name in names.items() if what == "process_name"]
    assert processes == ["cell small", "node R1", "node E", "node R2"]
    for event in of(events, "X"):
        assert names["thread_name", event["pid"], event["tid"]] == event["name"]


def test_a_slice_is_a_job_that_started(events: list[TraceEvent]) -> None:
    jobs = small_run().jobs
    started = jobs.filter(jobs["start_ns"].is_not_null())
    slices = of(events, "X")
    assert len(slices) == started.height
    ended = started.filter(started["end_ns"].is_not_null())
    spent_us = float((ended["end_ns"] - ended["start_ns"]).sum()) / 1e3
    done = [event["dur"] for event in slices if event["args"]["outcome"] != "in_flight"]
    assert sum(done) == pytest.approx(spent_us)


def test_slices_of_a_thread_do_not_overlap(events: list[TraceEvent]) -> None:
    slices = sorted(of(events, "X"), key=lambda event: (event["pid"], event["tid"], event["ts"]))
    for before, after in itertools.pairwise(slices):
        if (before["pid"], before["tid"]) == (after["pid"], after["tid"]):
            assert after["ts"] >= before["ts"] + before["dur"] - 1e-6


def test_spans_begin_and_end_once(events: list[TraceEvent]) -> None:
    begins = {(event["cat"], event["id"]): event["ts"] for event in of(events, "b")}
    ends = {(event["cat"], event["id"]): event["ts"] for event in of(events, "e")}
    assert len(begins) == len(of(events, "b")) == len(of(events, "e"))
    assert begins.keys() == ends.keys()
    assert all(ends[key] >= begins[key] for key in begins)


def test_migrations_are_instants(events: list[TraceEvent]) -> None:
    moves = small_run().decisions.filter(small_run().decisions["migrated"])
    shown = [event["name"] for event in of(events, "i")]
    named = [f"{a} → {b}" for a, b in moves.select("incumbent", "placement").rows()]
    # The close of the last window lies beyond the last cycle.
    assert shown == named[: len(shown)]
    assert len(named) - len(shown) <= 1


def test_workers_of_a_task_have_threads_of_their_own() -> None:
    problem = make_problem()
    task = problem.pipeline.tasks["perception"]
    on = {node: replace(run, workers=3) for node, run in task.on.items()}
    tasks = {**problem.pipeline.tasks, "perception": replace(task, on=on, depth=0)}
    busy = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
    run = simulate(busy, scenario="robot-cpu-stress", policy="LOC", seed=1, windows=12, jobs=True)
    events = trace_events(run)["traceEvents"]
    threads = {event["tid"] for event in of(events, "X") if event["name"] == "perception"}
    assert len(threads) > 1
    test_slices_of_a_thread_do_not_overlap(events)


def test_a_run_without_jobs_is_refused() -> None:
    run = small_run()
    bare = Run(run.meta, {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions})
    with pytest.raises(RunError, match="kept no jobs"):
        trace_events(bare)
