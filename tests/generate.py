"""Problems and realisations for tests: made by hand, or at random."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from random import Random
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dwell.model import (
    AR1,
    Bursts,
    Constant,
    ControllerSettings,
    Disturbance,
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
    Targets,
    Task,
    Uniform,
    Weights,
)
from dwell.sim.realisation import LinkSegment, NodeChange, Realisation

__all__ = ["make_problem", "make_realisation", "random_problem", "random_stamps"]

MS = 1_000_000
Scheduler = Literal["fair", "fifo", "priority"]


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
        controller=controller or ControllerSettings(),
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
    hops = tuple(
        (flow.source, flow.target, link)
        for flow in pipeline.flows
        for link in fabric.links
        if any(
            f"{placement[flow.source]}->{placement[flow.target]}" == link
            for placement in problem.candidates.values()
        )
    )
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


def _nanoseconds(rows: Sequence[Sequence[float]], columns: int) -> NDArray[np.int64]:
    values = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    return np.rint(values * MS).astype(np.int64)


# ---------------------------------------------------------------------------------- at random


def random_problem(
    rng: Random, *, schedulers: Sequence[Scheduler] = ("fair", "fifo", "priority")
) -> Problem:
    """Make a valid Problem with a scenario ``disturbed``.

    Periods are long (0.1 to 1 s), so that events seldom come within a microsecond by chance.
    """
    period = rng.uniform(100, 1000)
    windows_hint_s = 30 * period / 1e3
    nodes = [
        _random_node(rng, name, period, schedulers)
        for name in ("N0", "N1", "N2", "N3", "N4")[: rng.randint(1, 5)]
    ]
    scales: dict[str, Process] = {}
    if rng.random() < 0.4:
        scales["scene"] = AR1(mean=1, cv=rng.uniform(0.05, 0.3), rho=rng.uniform(-0.3, 0.9))
    order = [f"T{i}" for i in range(rng.randint(1, 7))]
    rng.shuffle(order)
    flows = [
        Flow(source, target, rng.choice([0, 1000, 20_000, 200_000]))
        for source, target in itertools.combinations(order, 2)
        if rng.random() < rng.choice([0.3, 0.6])
    ]
    rng.shuffle(flows)
    targets = {flow.target for flow in flows}
    tasks = [
        _random_task(rng, name, nodes, period, len(order), name not in targets, scales)
        for name in sorted(order)
    ]
    links = [
        _random_link(rng, source.name, target.name, period)
        for source, target in itertools.permutations(nodes, 2)
    ]
    candidates = {
        name: {task.name: rng.choice(list(task.on)) for task in tasks}
        for name in ("A", "B", "C", "D")[: rng.randint(1, 4)]
    }
    return make_problem(
        nodes,
        tasks,
        flows,
        links=links,
        candidates=candidates,
        period_ms=period,
        deadline_ms=period * rng.uniform(0.3, 1),
        scenario=[
            _random_disturbance(rng, nodes, links, windows_hint_s)
            for _ in range(rng.choice([0, 0, 1, 2, 4, 8]))
        ],
        scales=scales,
        window_cycles=rng.randint(1, 5),
        controller=ControllerSettings(on=rng.choice(nodes).name),
    )


def _random_process(rng: Random, mean: float) -> Process:
    processes: list[Process] = [
        LogNormal(mean, rng.uniform(0.05, 1)),
        Gamma(mean, rng.uniform(0.2, 1)),
        Exponential(mean),
        Uniform(0.5 * mean, 1.5 * mean),
        Normal(mean, 0.2 * mean, min=0.01 * mean),
        AR1(mean, 0.3, rng.uniform(0, 0.9)),
    ]
    return rng.choice(processes)


def _random_node(rng: Random, name: str, period: float, schedulers: Sequence[Scheduler]) -> Node:
    bursts = None
    if rng.random() < 0.2:
        bursts = Bursts(
            every_ms=Exponential(rng.uniform(0.5, 5) * period),
            for_ms=_random_process(rng, rng.uniform(0.1, 2) * period),
            threads=rng.randint(1, 4),
        )
    return Node(
        name,
        rng.choice(["robot", "edge", "cloud"]),
        cores=rng.choice([1, 1, 2, 2, 3, 4]),
        scheduler=rng.choice(list(schedulers)),
        accelerators={"gpu": rng.randint(1, 2)} if rng.random() < 0.3 else {},
        bursts=bursts,
    )


def _random_task(
    rng: Random,
    name: str,
    nodes: Sequence[Node],
    period: float,
    tasks: int,
    source: bool,
    scales: Mapping[str, Process],
) -> Task:
    feasible = rng.sample(list(nodes), min(len(nodes), rng.choice([1, 2, 2, 3])))
    load = rng.choice([0.2, 0.5, 0.9, 1.5]) / tasks * len(nodes)
    on = {
        node.name: Execution(
            _random_process(rng, period * load * rng.uniform(0.3, 1.5)),
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
        scale=rng.choice([None, *scales]),
        offset_ms=rng.uniform(0, 1.5) * period if source and rng.random() < 0.4 else 0.0,
        start_ms=rng.choice([0.0, rng.uniform(0, 2) * period]),
    )


def _random_link(rng: Random, source: str, target: str, period: float) -> Link:
    # 200 kB take from a hundredth of a period to one and a half.
    full = 200_000 * 8e-3 / period
    bursts = None
    if rng.random() < 0.2:
        bursts = Bursts(
            every_ms=Exponential(rng.uniform(0.5, 5) * period),
            for_ms=_random_process(rng, rng.uniform(0.1, 2) * period),
            add_delay_ms=_random_process(rng, rng.uniform(0.01, 1) * period),
        )
    return Link(
        source,
        target,
        _random_process(rng, period * rng.choice([0.01, 0.1, 1])),
        rate_mbps=rng.choice([float("inf"), full * 10, full * 100, full / 1.5]),
        loss=rng.choice([0.0, 0.0, rng.uniform(0.01, 0.3)]),
        retransmit_ms=rng.choice([None, rng.uniform(0.05, 2) * period]),
        in_order=rng.random() < 0.4,
        bursts=bursts,
    )


def _random_disturbance(
    rng: Random, nodes: Sequence[Node], links: Sequence[Link], run_s: float
) -> Disturbance:
    at_s = rng.choice([0.0, rng.uniform(0, 0.8) * run_s, rng.uniform(0, 0.8) * run_s])
    for_s = rng.choice([float("inf"), *(rng.uniform(0, 0.3) * run_s for _ in range(5))])
    if not links or rng.random() < 0.5:
        down = rng.random() < 0.4
        return NodeDisturbance(
            rng.choice(list(nodes)).name,
            at_s,
            for_s,
            stress_threads=0 if down and rng.random() < 0.5 else rng.randint(1, 6),
            down=down,
        )
    link = rng.choice(list(links))
    extra = Constant(rng.uniform(1, 50)) if rng.random() < 0.1 else Exponential(rng.uniform(1, 500))
    return LinkDisturbance(
        link.source,
        link.target,
        at_s,
        for_s,
        add_delay_ms=rng.choice([None, extra]),
        loss=rng.choice([0.0, rng.uniform(0, 0.8), 1.0]),
        rate_mbps=rng.choice([float("inf"), rng.uniform(0.5, 20)]),
        down=rng.random() < 0.3,
    )


def random_stamps(rng: Random, problem: Problem, windows: int) -> list[str]:
    """Return a candidate for every window; the first window has the initial one."""
    names = list(problem.candidates)
    return [problem.initial, *(rng.choice(names) for _ in range(windows - 1))]
