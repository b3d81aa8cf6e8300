"""Fleets against the second, slow simulator, which plays one cell with the pipelines of all.

The environment variable DWELL_EXAMPLES sets how many fleets are tried.
"""

from __future__ import annotations

import os
from dataclasses import replace
from random import Random
from typing import get_args

import pytest

import dwell
from dwell.kernels.arrays import flow_rows
from dwell.kernels.realisation import NodeChanges, Realisation
from dwell.model import (
    Bursts,
    Execution,
    Exponential,
    Fabric,
    Flow,
    Link,
    Node,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Targets,
    Task,
    Weights,
)
from dwell.model.fabric import Scheduler
from dwell.model.fleet import Fleet, FleetEntry
from dwell.sim.fleet import drawn, phased, play_fleet
from tests.reference.simulator import NEAR_NS, simulate

EXAMPLES = int(os.environ.get("DWELL_EXAMPLES", "16"))
#: Fleets of cells with several rates.
RATED = max(EXAMPLES // 3, 1)
#: Where jobs share a core, events within a microsecond may come in either order.
MOST_EXCLUDED = 0.3
STAGES = (("sense", "R"), ("work", "E"), ("act", "R"))


def random_cell(random: Random) -> Problem:
    """Return a cell that goes over the edge; of one stage the length is drawn, too."""
    period_ms = random.choice([5.0, 10.0])
    means = {"sense": 0.4, "work": random.uniform(0.5, 4.0), "act": 0.3}
    tasks = {
        name: Task(
            name,
            {node: Execution(Exponential(means[name]), threads=random.randint(1, 2))},
            priority=random.randint(0, 2),
        )
        for name, node in STAGES
    }
    bursts = Bursts(Exponential(20.0), Exponential(5.0), threads=random.randint(1, 3))
    edge = Node(
        "E",
        "edge",
        random.randint(1, 3),
        random.choice(get_args(Scheduler)),
        bursts=random.choice([None, bursts]),
    )
    rate_mbps, loss = random.choice([float("inf"), 10.0]), random.choice([0.0, 0.2])
    usual = Link("R", "E", Exponential(0.2), rate_mbps=rate_mbps, loss=loss, retransmit_ms=12.0)
    usual = replace(usual, in_order=random.random() < 0.5)
    links = {f"{a}->{b}": replace(usual, source=a, target=b) for a, b in (("R", "E"), ("E", "R"))}
    flows = Flow("sense", "work", 2_000), Flow("work", "act", 100)
    return Problem(
        name="cell",
        pipeline=Pipeline(tasks, flows, period_ms, period_ms),
        fabric=Fabric({"R": Node("R", "robot", 2), "E": edge}, links),
        candidates={"ONLY": Placement(dict(STAGES))},
        objective=Objective(Weights(), Targets(period_ms)),
        window_cycles=10,
    )


def with_rates(cell: Problem, random: Random) -> Problem:
    """Return the cell with rates: it senses in some cycles, and mostly acts without waiting."""
    pipeline, samples = cell.pipeline, random.random() < 0.7
    every = random.choice([2, 3, 5])
    tasks = {**pipeline.tasks, "sense": replace(pipeline.tasks["sense"], every=every)}
    if samples:
        tasks["act"] = replace(tasks["act"], every=random.choice([1, 2, 5]))
    first, second = pipeline.flows
    flows = first, replace(second, sampled=samples)
    return replace(cell, pipeline=replace(pipeline, tasks=tasks, flows=flows))


def all_in_one(cell: Problem, phases_ms: list[float]) -> Problem:
    """Return one cell that has the pipelines, robots and links of several, side by side."""
    tasks: dict[str, Task] = {}
    nodes, links = {"E": cell.fabric.nodes["E"]}, {}
    flows: list[Flow] = []
    placed: dict[str, str] = {}

    def node_of(name: str, i: int) -> str:
        return name if name == "E" else f"{name}{i}"

    for i, phase_ms in enumerate(phases_ms):
        nodes[f"R{i}"] = replace(cell.fabric.nodes["R"], name=f"R{i}")
        for name, task in cell.pipeline.tasks.items():
            ((on, execution),) = task.on.items()
            new = f"{name}{i}"
            begins = phase_ms if not cell.pipeline.waited(name) else 0.0
            tasks[new] = replace(task, name=new, on={node_of(on, i): execution}, offset_ms=begins)
            placed[new] = node_of(on, i)
        flows += [
            replace(flow, source=f"{flow.source}{i}", target=f"{flow.target}{i}")
            for flow in cell.pipeline.flows
        ]
        for link in cell.fabric.links.values():
            one = replace(link, source=node_of(link.source, i), target=node_of(link.target, i))
            links[one.name] = one
    pipeline = replace(cell.pipeline, tasks=tasks, flows=tuple(flows))
    return replace(
        cell,
        pipeline=pipeline,
        fabric=Fabric(nodes, links),
        candidates={"ONLY": Placement(placed)},
    )


def with_draws(whole: Realisation, parts: list[Realisation]) -> Realisation:
    """Return the realisation of the one cell with what the others have drawn."""
    exec_ns, delay_ns = whole.exec_ns.copy(), whole.delay_ns.copy()
    loss_keys = whole.loss_keys.copy()
    for row, (task, node) in enumerate(whole.sites):
        i = int(task[-1])
        exec_ns[row] = parts[i].exec_ns[parts[i].sites.index((task[:-1], node.rstrip(str(i))))]
    for row, (source, target, link) in enumerate(whole.hops):
        i = int(source[-1])
        own = (source[:-1], target[:-1], link.replace(f"R{i}", "R"))
        delay_ns[row] = parts[i].delay_ns[parts[i].hops.index(own)]
        loss_keys[row] = parts[i].loss_keys[parts[i].hops.index(own)]
    changes = [one for one in NodeChanges.of(parts[0].node_changes) if one.node == "E"]
    return replace(
        whole, exec_ns=exec_ns, delay_ns=delay_ns, loss_keys=loss_keys, node_changes=changes
    )


def values_taken(fleet: Fleet, seed: int, windows: int) -> list[list[int]]:
    """Return by cell the cycle of the value that the job of act took in each cycle."""
    duration_ns = fleet.duration_ns(windows)
    fleet = fleet.changed(policy="ONLY", estimator="profile")
    played = play_fleet(fleet, seed=seed, duration_ns=duration_ns, jobs=True).values()
    column = int(flow_rows(fleet.entries[0].cell.pipeline)[1])
    return [one.arrays.logs().taken[0, :, column].tolist() for one in played]


@pytest.mark.parametrize(
    ("rates", "examples"),
    [(False, EXAMPLES), (True, RATED)],
    ids=["one rate", "several rates"],
)
def test_fleets_are_one_cell_with_the_pipelines_of_all(rates: bool, examples: int) -> None:
    compared = 0
    for seed in range(examples):
        random = Random(seed)
        cell = random_cell(random)
        if rates:
            cell = with_rates(cell, Random(f"{seed} rates"))
        count = 2 if rates else random.randint(2, 4)
        period_ms = cell.pipeline.period_ms
        phases = [round(random.uniform(0, period_ms / 2), 6) for _ in range(count)]
        deadline_ms = period_ms * random.choice([1.0, 1.0, random.uniform(1, 8)])
        cell = replace(cell, pipeline=replace(cell.pipeline, deadline_ms=deadline_ms))
        fleet = Fleet(
            "all", (FleetEntry(cell, count),), ("E",), phases=tuple(phases), coordination="none"
        )
        windows = 4
        run = dwell.simulate_fleet(
            fleet, seed=seed, windows=windows, policy="ONLY", estimator="profile", jobs=True
        )
        taken = values_taken(fleet, seed, windows) if rates else []
        problems = dict(zip(run.cells, phased(fleet, seed), strict=True))
        parts = [*drawn(fleet, problems, seed, fleet.duration_ns(windows)).values()]
        whole = all_in_one(cell, phases)
        real = with_draws(dwell.draw(whole, seed=seed, windows=windows), parts)
        expected = simulate(whole, real, ["ONLY"] * real.cycles)
        samples = {flow.target for flow in cell.pipeline.flows if flow.sampled}
        nearest = expected.closest_ns
        if cell.fabric.nodes["E"].scheduler == "fair" and nearest is not None:
            continue
        compared += 1
        allowed = NEAR_NS if cell.fabric.nodes["E"].scheduler == "fair" else 0
        for i, one in enumerate(run.cells.values()):
            # The one cell is played to the close of its last window, and no further.
            ended = one.jobs.filter(one.jobs["end_ns"] < expected.windows[-1].close_ns - allowed)
            assert ended.height > (10 if rates else 20)
            for row in ended.iter_rows(named=True):
                known = expected.jobs[row["cycle"], f"{row['task']}{i}"]
                assert known.end_ns is not None
                for name in ("ready_ns", "end_ns"):
                    assert abs(getattr(known, name) - row[name]) <= allowed, (seed, i, row)
                if row["task"] in samples:
                    value = known.taken.get(f"work{i}", -1)
                    assert taken[i][row["cycle"]] == value, (seed, i, row)
    assert compared >= (1 - MOST_EXCLUDED) * examples
