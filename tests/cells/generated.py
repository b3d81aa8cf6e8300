"""Problems and realisations for tests: made by hand, or at random."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from random import Random
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.realisation import LinkSegment, NodeChange, Realisation
from dwell.model import (
    AR1,
    Bursts,
    Constant,
    ControllerSettings,
    Disturbance,
    Episodes,
    Execution,
    Exponential,
    Fabric,
    Flow,
    Gamma,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Normal,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Quota,
    Targets,
    Task,
    Uniform,
    Weights,
)
from dwell.model.objective import Tier
from tests.cells.once import once

MS = 1_000_000
# Turns are those of threads on one core with a quota that is noticed at ticks.
Scheduler = Literal["fair", "fifo", "priority", "turns"]


# ------------------------------------------------------------------------------------ by hand


def make_problem(
    nodes: Sequence[Node],
    tasks: Sequence[Task],
    flows: Sequence[Flow] = (),
    *,
    links: Sequence[Link] = (),
    candidates: Mapping[str, Mapping[str, str]] | None = None,
    period_ms: float = 100.0,
    deadline_ms: float | None = None,
    scenario: Sequence[Disturbance] = (),
    scales: Mapping[str, Process] | None = None,
    release_jitter_ms: Process | None = None,
    window_cycles: int = 1,
    controller: ControllerSettings | None = None,
) -> Problem:
    """Make a Problem; without `candidates` every task is on its first node, in candidate LOC."""
    moves = candidates or {"LOC": {}}
    first = {task.name: next(iter(task.on)) for task in tasks}
    return Problem(
        name="test",
        pipeline=Pipeline(
            tasks={task.name: task for task in tasks},
            flows=tuple(flows),
            period_ms=period_ms,
            deadline_ms=deadline_ms or period_ms,
            release_jitter_ms=release_jitter_ms or Constant(0.0),
            scales=scales or {},
        ),
        fabric=Fabric(
            nodes={node.name: node for node in nodes},
            links={link.name: link for link in links},
        ),
        candidates={name: Placement({**first, **move}) for name, move in moves.items()},
        objective=Objective(
            weights=Weights(),
            targets=Targets(latency_ms=deadline_ms or period_ms),
            tiers={node.name: node.tier for node in nodes},
        ),
        scenarios={"disturbed": tuple(scenario)},
        controller=once(controller or ControllerSettings(), window_cycles),
        window_cycles=window_cycles,
    )


def make_realisation(
    problem: Problem,
    *,
    windows: int,
    exec_ms: Mapping[tuple[str, str], Sequence[float]] | None = None,
    delay_ms: Mapping[tuple[str, str, str], Sequence[float]] | None = None,
    extra_ms: Mapping[tuple[tuple[str, str, str], int], Sequence[float]] | None = None,
    release_ms: Sequence[float] | None = None,
    node_changes: Sequence[NodeChange] = (),
    segments: Sequence[LinkSegment] = (),
) -> Realisation:
    """Make a Realisation in which everything has its expectation, but for what is given."""
    cycles = windows * problem.window_cycles
    pipeline, fabric = problem.pipeline, problem.fabric
    if release_ms is None:
        release_ms = [k * pipeline.period_ms for k in range(cycles + 1)]
    sites = tuple((name, node) for name, task in pipeline.tasks.items() for node in task.on)
    hops = (*_flow_hops(problem), *_state_hops(problem))
    given = exec_ms or {}
    exec_rows = [
        given.get((task, node), [pipeline.tasks[task].on[node].exec_ms.expectation] * cycles)
        for task, node in sites
    ]
    delays = delay_ms or {}
    delay_rows = [
        delays.get(hop, [fabric.links[hop[2]].delay_ms.expectation] * cycles) for hop in hops
    ]
    extra = extra_ms or {}
    begun = {segment.link for segment in segments if segment.at_ns == 0}
    quiet = [
        LinkSegment(0, link.name, False, link.loss, link.rate_mbps, ())
        for link in fabric.links.values()
        if link.name not in begun
    ]
    return Realisation(
        scenario="disturbed",
        seed=None,
        windows=windows,
        release_ns=_nanoseconds([release_ms], cycles + 1)[0],
        sites=sites,
        exec_ns=_nanoseconds(exec_rows, cycles),
        hops=hops,
        delay_ns=_nanoseconds(delay_rows, cycles),
        loss_keys=np.arange(len(hops), dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15),
        layers=tuple((hops.index(hop), layer) for hop, layer in extra),
        extra_ns=_nanoseconds(list(extra.values()), cycles),
        node_changes=tuple(sorted(node_changes, key=lambda change: change.at_ns)),
        link_segments=tuple(sorted([*quiet, *segments], key=lambda s: (s.link, s.at_ns))),
    )


def _flow_hops(problem: Problem) -> Iterator[tuple[str, str, str]]:
    for flow in problem.pipeline.flows:
        placements = [copy for one in problem.candidates.values() for copy in one.copies]
        crossed = {f"{placed[flow.source]}->{placed[flow.target]}" for placed in placements}
        for link in problem.fabric.links:
            if link in crossed:
                yield flow.source, flow.target, link


def _state_hops(problem: Problem) -> Iterator[tuple[str, str, str]]:
    """State crosses the links between the nodes that some candidate has its task on."""
    if problem.controller.migration == "warm":
        return
    for name, task in problem.pipeline.tasks.items():
        nodes = {copy[name] for one in problem.candidates.values() for copy in one.copies}
        for link in problem.fabric.links.values():
            if task.state_bytes and {link.source, link.target} <= nodes:
                yield name, name, link.name


def _nanoseconds(rows: Sequence[Sequence[float]], columns: int) -> NDArray[np.int64]:
    values = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    return np.rint(values * MS).astype(np.int64)


# ---------------------------------------------------------------------------------- at random


def random_problem(
    rng: Random,
    *,
    schedulers: Sequence[Scheduler] = ("fair", "fifo", "priority"),
    whole_ms: bool = False,
    orders: bool = False,
) -> Problem:
    """Make a valid Problem with a scenario ``disturbed``.

    Parameters
    ----------
    rng : Random
    schedulers : sequence
        Which of them its nodes may have.
    whole_ms : bool
        Whether every duration is a constant number of whole milliseconds, and short, so that many
        events fall on the same instant. Otherwise periods are long (0.1 to 1 s) and durations
        continuous, so that events seldom come within a microsecond of each other by chance.
    orders : bool
        Whether there are several candidates, between which orders take time: they have a delay, a
        lead or a grace, and half of the problems migrate cold, with state that takes a while.
    """
    return _Maker(rng, schedulers, whole_ms, orders).problem()


def random_stamps(rng: Random, problem: Problem, windows: int) -> list[str]:
    """Return a candidate for every window; the first window has the initial one."""
    names = list(problem.candidates)
    return [problem.initial, *(rng.choice(names) for _ in range(windows - 1))]


class _Maker:
    """One problem in the making."""

    def __init__(
        self, rng: Random, schedulers: Sequence[Scheduler], whole_ms: bool, orders: bool
    ) -> None:
        self.rng = rng
        self.schedulers = list(schedulers)
        self.whole_ms = whole_ms
        self.orders = orders
        self.period = float(rng.randint(5, 20)) if whole_ms else rng.uniform(100, 1000)
        self.nodes: list[Node] = []
        self.links: list[Link] = []
        self.scales: dict[str, Process] = {}
        self.named = 0

    def duration(self, low: float, high: float) -> float:
        """Return a number of milliseconds between two shares of the period."""
        value = self.rng.uniform(low, high) * self.period
        return float(round(value)) if self.whole_ms else value

    def process(self, mean: float) -> Process:
        rng = self.rng
        if self.whole_ms:
            return Constant(float(max(1, round(mean))))
        processes: list[Process] = [
            LogNormal(mean, rng.uniform(0.05, 1)),
            Gamma(mean, rng.uniform(0.2, 1)),
            Exponential(mean),
            Uniform(0.5 * mean, 1.5 * mean),
            Normal(mean, 0.2 * mean, min=0.01 * mean),
            AR1(mean, 0.3, rng.uniform(0, 0.9)),
        ]
        return rng.choice(processes)

    def bursts(self, threads: int, add_delay_ms: Process | None = None) -> Bursts | None:
        if self.rng.random() > 0.2:
            return None
        return Bursts(
            every_ms=self.process(self.rng.uniform(0.5, 5) * self.period),
            for_ms=self.process(self.rng.uniform(0.1, 2) * self.period),
            threads=threads,
            add_delay_ms=add_delay_ms or Constant(0.0),
        )

    def problem(self) -> Problem:
        rng, period = self.rng, self.period
        names = ("N0", "N1", "N2", "N3", "N4")[: rng.randint(1, 5)]
        self.nodes = [self.node(name) for name in names]
        if not self.whole_ms and rng.random() < 0.4:
            self.scales["scene"] = AR1(
                mean=1, cv=rng.uniform(0.05, 0.3), rho=rng.uniform(-0.3, 0.9)
            )
        order = [f"T{i}" for i in range(rng.randint(1, 7))]
        rng.shuffle(order)
        density = rng.choice([0.2, 0.4, 0.7])
        flows = [
            Flow(source, target, rng.choice([0, 1000, 20_000, 200_000]))
            for source, target in itertools.combinations(order, 2)
            if rng.random() < density
        ]
        rng.shuffle(flows)
        targets = {flow.target for flow in flows}
        load = rng.choice([0.2, 0.5, 0.9, 1.5]) / len(order) * len(self.nodes)
        tasks = [self.task(name, load, source=name not in targets) for name in sorted(order)]
        self.links = [
            self.link(source.name, target.name)
            for source, target in itertools.permutations(self.nodes, 2)
        ]
        jitter = not self.whole_ms and rng.random() < 0.3
        candidates = {
            name: {task.name: rng.choice(list(task.on)) for task in tasks}
            for name in ("A", "B", "C", "D")[: rng.randint(2 if self.orders else 1, 4)]
        }
        return make_problem(
            self.nodes,
            tasks,
            flows,
            links=self.links,
            candidates=candidates,
            period_ms=period,
            deadline_ms=period * rng.uniform(0.3, 1),
            scenario=[self.disturbance() for _ in range(rng.choice([0, 0, 1, 2, 4, 8]))],
            scales=self.scales,
            release_jitter_ms=Exponential(0.1 * period) if jitter else None,
            window_cycles=rng.randint(1, 5),
            controller=self.controller(rng.choice(self.nodes).name),
        )

    def controller(self, node: str) -> ControllerSettings:
        rng = self.rng
        if not self.orders:
            return ControllerSettings(on=node)
        return ControllerSettings(
            on=node,
            migration=rng.choice(["warm", "cold"]),
            order_delay_ms=rng.choice([0.0, self.duration(0, 3)]),
            order_lead_cycles=rng.choice([0, 0, 1, 3]),
            close_grace_ms=rng.choice([0.0, 0.0, self.duration(0, 1), self.duration(0, 6)]),
        )

    def node(self, name: str) -> Node:
        rng = self.rng
        tiers: list[Tier] = ["robot", "edge", "cloud"]
        tier = rng.choice(tiers)
        # Fractions that floating point has exactly: the naive simulator computes with those.
        background = rng.choice([0.0, 0.0, 0.0, 0.0625, 0.125, 0.25])
        cores, scheduler = rng.choice([1, 1, 2, 2, 3, 4]), rng.choice(self.schedulers)
        turns = scheduler == "turns"
        quota = self.quota(turns)
        beside = rng.choice([None, 0.0, background / 2]) if quota is not None else None
        return Node(
            name,
            tier,
            background=background,
            background_beside=beside,
            background_hz=rng.choice([0.0, 50.0, 200.0]) if turns else 0.0,
            interference=rng.choice([1.0, 1.0, 2.0]),
            cores=1 if turns else cores,
            scheduler="fair" if scheduler == "turns" else scheduler,
            accelerators={"gpu": rng.randint(1, 2)} if rng.random() < 0.3 else {},
            bursts=self.bursts(rng.randint(1, 4)),
            quota=quota,
        )

    def quota(self, ticks: bool) -> Quota | None:
        rng = self.rng
        if not ticks and rng.random() >= 0.2:
            return None
        # Some ten of the quota's periods a cycle: the naive simulator looks at each.
        period_ms = max(1.0, min(1000.0, round(self.period * rng.choice([0.03, 0.1, 0.5]))))
        slack_ms = rng.choice([0.0, 0.0, 0.25, 1.0, 4.0])
        cpu = rng.choice([0.3, 0.5, 1, 1.7, 2.5])
        if not ticks:
            return Quota(cpu, period_ms, slack_ms)
        tick_ms = max(1.0, round(self.period * rng.choice([0.05, 0.1, 0.3])))
        return Quota(cpu, period_ms, slack_ms, tick_ms)

    def task(self, name: str, load: float, *, source: bool) -> Task:
        rng = self.rng
        feasible = rng.sample(self.nodes, min(len(self.nodes), rng.choice([1, 2, 2, 3])))
        on = {
            node.name: Execution(
                self.process(self.period * load * rng.uniform(0.3, 1.5)),
                threads=rng.choice([1, 1, 1, 2, 3, 5]),
                workers=rng.choice([1, 1, 1, 2, 3]),
                accelerator="gpu" if node.accelerators and rng.random() < 0.5 else None,
            )
            for node in feasible
        }
        return Task(
            name,
            on,
            depth=rng.choice([0, 0, 1, 1, 2, 3]),
            priority=rng.randint(0, 3),
            scale=rng.choice([None, *self.scales]),
            offset_ms=self.duration(0, 1.5) if source and rng.random() < 0.4 else 0.0,
            start_ms=rng.choice([0.0, self.duration(0, 2)]),
            state_bytes=rng.choice([0, 1000, 5000, 20_000]) if self.orders else 0,
        )

    def link(self, source: str, target: str) -> Link:
        rng = self.rng
        # At this rate 200 kB take a whole period.
        full = 200_000 * 8e-3 / self.period
        rates = [math.inf, full * 10, full * 100, full / 1.5]
        return Link(
            source,
            target,
            self.process(self.period * rng.choice([0.01, 0.1, 1])),
            rate_mbps=rng.choice([math.inf, 0.8] if self.whole_ms else rates),
            loss=rng.choice([0.0, 0.0, rng.uniform(0.01, 0.3)]),
            retransmit_ms=rng.choice([None, max(1.0, self.duration(0.05, 2))]),
            in_order=rng.random() < 0.4,
            bursts=self.bursts(0, self.process(rng.uniform(0.01, 1) * self.period)),
        )

    def disturbance(self) -> Disturbance:
        rng = self.rng
        at_s = rng.choice([0.0, self.duration(0, 25), self.duration(0, 25)]) / 1e3
        lengths = [max(1.0, self.duration(0, 8)) / 1e3 for _ in range(5)]
        for_s = rng.choice([math.inf, *lengths])
        episodes, ramp_s = self.episodes(), 0.0
        if not self.links or rng.random() < 0.5:
            down = rng.random() < 0.4
            if not down and episodes is None:
                ramp_s = self.ramp_s(for_s)
            return NodeDisturbance(
                rng.choice(self.nodes).name,
                at_s,
                for_s,
                stress_threads=0 if down and rng.random() < 0.5 else rng.randint(1, 6),
                down=down,
                episodes=episodes,
                ramp_s=ramp_s,
            )
        link = rng.choice(self.links)
        down = rng.random() < 0.3
        if not down and episodes is None:
            ramp_s = self.ramp_s(for_s)
        return LinkDisturbance(
            link.source,
            link.target,
            at_s,
            for_s,
            add_delay_ms=rng.choice([None, self.process(rng.uniform(0.01, 1) * self.period)]),
            loss=rng.choice([0.0, rng.uniform(0, 0.8), 1.0]),
            rate_mbps=rng.choice([math.inf, 0.4 if self.whole_ms else rng.uniform(0.5, 20)]),
            down=down,
            episodes=episodes,
            ramp_s=ramp_s,
        )

    def episodes(self) -> Episodes | None:
        if self.rng.random() >= 0.2:
            return None
        self.named += 1
        lengths = [self.duration(low, high) / 1e3 for low, high in ((0.5, 5), (0.3, 3))]
        every_s, for_s = (Constant(max(length, 1e-3)) for length in lengths)
        return Episodes(f"episodes {self.named}", every_s, for_s)

    def ramp_s(self, for_s: float) -> float:
        longest_s = min(for_s / 2, self.duration(1, 6) / 1e3)
        return self.rng.choice([0.0, 0.0, longest_s])
