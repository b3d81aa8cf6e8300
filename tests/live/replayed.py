"""A simulated run, told to a live cell's windows by the messages of its processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl
import pytest

import dwell
from dwell.control import ClosedWindow, Controller, Evidence, overtaken_cycles
from dwell.estimators import Profile
from dwell.live.roles.live_windows import LiveWindows
from dwell.live.roles.offsets import Offsets
from dwell.live.roles.run_rows import Rows, columns_of
from dwell.live.wire.messages import (
    ACTUATED,
    BEHIND,
    Completion,
    Hop,
    Load,
    Origin,
    RatedHop,
    Stamp,
)
from dwell.model import FrozenDict, Problem, QoS
from dwell.record import Journal, Run, seal_run
from dwell.sim import engine

UNKNOWN = -1
#: Number of the first stamp.
FIRST = 5000


@dataclass(slots=True)
class Seen:
    """What the simulator's controller was given."""

    controller: Controller
    windows: list[ClosedWindow] = field(default_factory=list)
    evidence: list[Evidence] = field(default_factory=list)
    #: First cycle of each evidence.
    firsts: list[int] = field(default_factory=list)
    #: What the resources have worked, of all, of its own jobs and of its shadows, at instants.
    work: list[tuple[int, Any]] = field(default_factory=list)


class Dated(Profile):
    """A profile that is off by what it has learnt: when its last evidence began, and how long."""

    def learn(self, evidence: Evidence) -> None:
        """Remember an instant, and a number of cycles."""
        self.off = int(evidence.release_ns[0] // 1000 % 70 + len(evidence.release_ns)) / 500

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Return the profile's estimates, those of alternatives a little off."""
        known = super().estimate(observed=observed, incumbent=incumbent, own=own)
        return {
            name: qos if name == incumbent else replace(qos, l95_ms=qos.l95_ms * (1 - self.off))
            for name, qos in known.items()
        }


@dataclass(slots=True)
class Played:
    problem: Problem
    run: Run
    seen: Seen


def simulate(
    problem: Problem, scenario: str, windows: int = 25, seed: int = 5, *, guard: bool = False
) -> Played:
    """Simulate a run and keep what its controller was given."""
    kept: list[tuple[Seen, engine.SimulatedStamper]] = []
    consult, every = engine.SimulatedStamper.consult, problem.decide_cycles
    often = every < problem.window_cycles

    def spy(self: engine.SimulatedStamper, index: int, boundary: int, close_ns: int) -> None:
        if not kept:
            kept.append((Seen(self.controller), self))
        seen, tables, release_ns = kept[0][0], self.arrays.tables, self.release_ns
        first, cycles = boundary - every, int(self.seen[1][0, index])
        if often:
            opened, closed = tables.look_opened[0, index, 0], tables.look_closed[0, index]
            if cycles == problem.window_cycles:
                at_ns = int(release_ns[boundary - cycles])
                seen.work.append((at_ns, tables.look_opened[0, index, 1, :3].copy()))
        else:
            opened, closed = tables.opened[0, index], tables.closed[0, index]
        window = ClosedWindow(
            latency_ns=tables.latency_ns[0, first:boundary],
            release_ns=release_ns[first:boundary],
            close_ns=close_ns,
            open_ns=int(release_ns[first]),
            core_ns=(closed - opened)[:3],
            looked=self.controller.looked,
        )
        seen.work += [(window.open_ns, opened[:3].copy()), (close_ns, closed[:3].copy())]
        seen.windows.append(window)
        assert self.evidence is not None
        seen.evidence.append(self.evidence(first, boundary, close_ns))
        seen.firsts.append(first)
        consult(self, index, boundary, close_ns)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine.SimulatedStamper, "consult", spy)
        run = dwell.simulate(
            problem, scenario=scenario, seed=seed, windows=windows, jobs=True, guard=guard
        )
    seen, stamper = kept[0]
    if often:
        tables = stamper.arrays.tables
        for index, first in enumerate(run.windows["first_cycle"]):
            beyond = first + problem.window_cycles
            at_ns = int(stamper.release_ns[first]), stamper.close_ns(beyond)
            work = tables.opened[0, index, :3], tables.closed[0, index, :3]
            seen.work += zip(at_ns, work, strict=True)
    return Played(problem, run, seen)


Event = tuple[int, int, Callable[[LiveWindows, int], None]]


@dataclass(slots=True)
class Clocks:
    """What nodes' clocks show; the reference's shows simulated time."""

    ahead_ns: Mapping[str, int] = field(default_factory=dict)

    def at(self, node: str, t_ns: int) -> int:
        return t_ns + self.ahead_ns.get(node, 0)


#: Core time of jobs by cycle, whether of its shadow, and task.
Work = Mapping[tuple[int, bool, str], int]
NO_WORK: Work = FrozenDict()


def work_of(played: Played) -> Work:
    """Core time of the jobs that had completed when their windows closed."""
    work_ns = {}
    tasks = list(played.problem.pipeline.tasks)
    for first, evidence in zip(played.seen.firsts, played.seen.evidence, strict=True):
        for shadow, instants in ((False, evidence.cycles), (True, evidence.shadows)):
            assert instants is not None
            assert instants.work_ns is not None
            for (row, column), ns in np.ndenumerate(instants.work_ns):
                work_ns[first + row, shadow, tasks[column]] = int(ns)
    return work_ns


def messages_of(played: Played, clocks: Clocks, work_ns: Work = NO_WORK) -> list[Event]:
    """Return what the processes of a live cell would have said in a simulated run.

    Processes tell the core time of jobs of which `work_ns` has it.
    """
    problem, run = played.problem, played.run
    flows = problem.pipeline.flows
    into = {flow.target: flow.source for flow in flows}
    through: dict[int, str] = {}
    discarded: dict[int, int] = {}
    names = list(problem.candidates)
    for first, evidence in zip(played.seen.firsts, played.seen.evidence, strict=True):
        for row, code in enumerate(evidence.shadow_placement.tolist()):
            if code >= 0:
                assert evidence.shadows is not None
                through[first + row] = names[code]
                discarded[first + row] = int(evidence.shadows.arrived_ns[row, -1])
    hops: dict[tuple[int, bool], list[Hop]] = {}
    sensing, release_ns = next(iter(problem.pipeline.tasks)), run.arrays("cycles")["release_ns"]
    jobs = run.jobs.filter(pl.col("end_ns").is_not_null(), pl.col("outcome") == "done")
    for job in jobs.sort("cycle", "ready_ns", "end_ns").iter_rows(named=True):
        task, node = job["task"], job["node"]
        ready_ns = clocks.at(node, job["ready_ns"])
        inputs = ((into[task], ready_ns),) if task in into else ()
        start_ns, end_ns = (clocks.at(node, job[name]) for name in ("start_ns", "end_ns"))
        whose = job["cycle"], bool(job.get("shadow"))
        cpu_ns = work_ns.get((*whose, task), UNKNOWN)
        hop = Hop(task, node, ready_ns, start_ns, end_ns, inputs, cpu_ns=cpu_ns)
        if problem.pipeline.chains:
            number, released_ns = FIRST + job["cycle"], int(release_ns[job["cycle"]])
            origins = (Origin(sensing, number, released_ns, number),)
            hop = RatedHop(**msgspec.structs.asdict(hop), origins=origins)
        hops.setdefault(whose, []).append(hop)
    events: list[Event] = []
    term, before = 1, None
    table = run.arrays("cycles")
    overtaken = overtaken_cycles(table["release_ns"], table["latency_ns"])
    for entry in run.cycles.iter_rows(named=True):
        cycle, placement, released_ns = entry["cycle"], entry["placement"], entry["release_ns"]
        term += before is not None and placement != before
        before = placement
        stamp = Stamp(7, FIRST + cycle, term, placement, released_ns, through.get(cycle, ""))
        events.append((released_ns, 3, stamping(stamp)))
        if entry["latency_ns"] is not None:
            done_ns = released_ns + entry["latency_ns"]
            mine = tuple(hops[cycle, False])
            shown_ns = clocks.at("R2", done_ns)
            outcome = BEHIND if overtaken[cycle] else ACTUATED
            done = Completion(stamp, "control", shown_ns, outcome, mine, "R2")
            events.append((done_ns, 1, completing(done)))
        stop_ns = discarded.get(cycle, -1)
        if stop_ns >= 0:
            shown_ns = clocks.at("R2", stop_ns)
            arrived = Hop("control", "R2", shown_ns, -1, -1, (("planning", shown_ns),))
            own = [hop for hop in hops.get((cycle, True), ()) if hop.task != "control"]
            ran = {hop.task for hop in own}
            shared = [hop for hop in hops.get((cycle, False), ()) if hop.task not in ran]
            shared = [hop for hop in shared if hop.task != "control"]
            all_hops = (*shared, *own, arrived)
            stopped = Completion(stamp, "control", shown_ns, "shadow", all_hops, "R2")
            events.append((stop_ns, 1, completing(stopped)))
    return events + loads_of(played, clocks)


def stamping(stamp: Stamp) -> Callable[[LiveWindows, int], None]:
    return lambda windows, at_ns: windows.stamped(stamp, at_ns)


def completing(done: Completion) -> Callable[[LiveWindows, int], None]:
    return lambda windows, at_ns: windows.completed(done, at_ns)


def loading(load: Load) -> Callable[[LiveWindows, int], None]:
    return lambda windows, at_ns: windows.loaded(load)


def loads_of(played: Played, clocks: Clocks) -> list[Event]:
    events: list[Event] = []
    nodes = list(played.problem.fabric.nodes)
    for at_ns, work in played.seen.work:
        for column, node in enumerate(nodes):
            used = [round(value) for value in work[:, column].tolist()]
            load = Load(node, 1, clocks.at(node, at_ns), *used)
            events.append((at_ns, 0, loading(load)))
    return events


def replay(
    played: Played,
    offsets: Offsets,
    events: Iterable[Event],
    *,
    late: Callable[[Event], int] = lambda event: 0,
    now: Callable[[int], int] = lambda t_ns: t_ns,
    on_close: Callable[[LiveWindows, ClosedWindow, Rows], None] = lambda *_: None,
) -> tuple[LiveWindows, Controller, list[ClosedWindow], list[Evidence], list[Rows]]:
    """Play messages in the order of their arrival; close windows when they are due."""
    controller = Controller(played.problem)
    windows = LiveWindows(played.problem, offsets, controller)
    course = controller.course
    course.enter(7, 1)
    closed: list[ClosedWindow] = []
    evidence: list[Evidence] = []
    rows: list[Rows] = []
    timed = sorted(((event[0] + late(event), *event[1:]) for event in events), key=lambda e: e[:2])
    for number, (t_ns, _, hear) in enumerate(timed):
        hear(windows, now(t_ns))
        following_ns, kind = timed[number + 1][:2] if number + 1 < len(timed) else (t_ns, 3)
        # At one instant loads (0) and completions (1) precede a close, and stamps (3) follow it.
        following = now(following_ns), kind
        while (due_ns := windows.due_ns(now(t_ns))) is not None and (due_ns, 2) < following:
            window = windows.close()
            of = (window.recent or window).evidence
            assert of is not None
            evidence.append(of())
            closed.append(window)
            left = course.placement
            settle(windows, controller, window)
            if course.placement != left:
                course.enter(7, course.term + 1)
            rows.append(windows.record.rows())
            on_close(windows, window, rows[-1])
    windows.finish()
    rows.append(windows.record.rows())
    return windows, controller, closed, evidence, rows


def settle(windows: LiveWindows, controller: Controller, window: ClosedWindow) -> None:
    """Have a closed window decided on; without a due sink in it the decision is missed."""
    if not len(window.latency_ns):
        controller.miss()
        return
    proposal = controller.propose(window)
    assert windows.looked is not None
    windows.looked.seen = proposal.seen
    controller.settle(proposal)


def recorded(tmp_path: Path, controller: Controller, rows: Sequence[Rows]) -> Run:
    """Bring rows to tables, through the journal."""
    meta = {"kind": "live", "cell": "canonical"}
    journal = Journal(tmp_path / "run", run="7", meta=meta, columns=columns_of(controller))
    for some in rows:
        journal.append(some)
    journal.close()
    return seal_run(tmp_path / "run")


SYNCHRONOUS = Offsets("E", "R1", system_bound_ns=0)
