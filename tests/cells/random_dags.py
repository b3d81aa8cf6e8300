"""Random cells that nothing disturbs: DAGs on shared nodes, accelerators and links."""

from __future__ import annotations

from random import Random

from dwell.model import (
    Caps,
    Constant,
    ControllerSettings,
    Execution,
    Fabric,
    Flow,
    Link,
    LogNormal,
    Node,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Targets,
    Task,
    Weights,
)
from dwell.model.fabric import Scheduler
from tests.cells.once import once

WINDOW_CYCLES = 50


def random_dag(seed: int, settings: ControllerSettings | None = None) -> Problem:
    """Make a cell of 3 to 20 tasks: the first and the last are anchored, the others may move.

    Work is 20 to 90 % of the robot's cores, if all of it is there, and the period 0.8 to 2 times as
    long as the longest path, so that branches contend and cycles may overlap.
    """
    rng = Random(seed)
    count = rng.randint(3, 20)
    names = [f"T{i}" for i in range(count)]
    robot, edge = _nodes(rng)
    kind = "gpu" if robot.accelerators else None
    tasks = {}
    for i, name in enumerate(names):
        ms = rng.uniform(1.0, 10.0)
        moves = 0 < i < count - 1 and rng.random() < 0.8
        on_gpu = kind if moves and rng.random() < 0.3 else None
        on = {"R": Execution(_time(rng, ms), accelerator=on_gpu)}
        if moves:
            on["E"] = Execution(_time(rng, ms * rng.uniform(0.3, 1.0)))
        tasks[name] = Task(name, on)
    flows = [
        Flow(source, name, rng.choice([0, 1_000, 50_000]))
        for i, name in enumerate(names[1:], 1)
        for source in rng.sample(names[:i], min(i, rng.choice([1, 1, 2, 3])))
    ]
    path_ms = _longest_ms(tasks, flows)
    work_ms = sum(task.on["R"].exec_ms.expectation for task in tasks.values())
    load = rng.uniform(0.2, 0.9)
    period_ms = round(max(work_ms / (robot.cores * load), path_ms * rng.uniform(0.8, 2.0)), 3)
    mobile = [name for name in names if len(tasks[name].on) > 1]
    home = dict.fromkeys(names, "R")
    candidates = {"LOC": Placement(home)}
    for number in range(rng.randint(1, 4)):
        moved = {name: "E" for name in mobile if rng.random() < rng.choice([0.3, 0.6, 1.0])}
        if moved and Placement(home | moved) not in candidates.values():
            candidates[f"C{number}"] = Placement(home | moved)
    links = [
        Link(a, b, _delay(rng), rate_mbps=rng.choice([float("inf"), 100.0, 400.0]))
        for a, b in (("R", "E"), ("E", "R"))
    ]
    deadline_ms = round(min(path_ms * rng.uniform(1.0, 2.5), period_ms), 3)
    return Problem(
        name=f"dag-{seed}",
        pipeline=Pipeline(tasks, tuple(flows), period_ms=period_ms, deadline_ms=deadline_ms),
        fabric=Fabric(nodes={"R": robot, "E": edge}, links={link.name: link for link in links}),
        candidates=candidates,
        objective=Objective(
            weights=Weights(),
            targets=Targets(latency_ms=deadline_ms),
            caps=Caps(),
            tiers={"R": "robot", "E": "edge"},
        ),
        controller=once(settings or ControllerSettings(), WINDOW_CYCLES),
        window_cycles=WINDOW_CYCLES,
    )


def _nodes(rng: Random) -> tuple[Node, Node]:
    gpu = {"gpu": 1} if rng.random() < 0.4 else {}
    schedulers: tuple[Scheduler, ...] = "fair", "fair", "fifo", "priority"
    scheduler = rng.choice(schedulers)
    robot = Node("R", "robot", rng.randint(1, 4), scheduler, accelerators=gpu)
    return robot, Node("E", "edge", rng.randint(2, 8))


def _time(rng: Random, ms: float) -> Process:
    cv = rng.choice([0.0, 0.1, 0.2, 0.4])
    return LogNormal(ms, cv) if cv else Constant(ms)


def _delay(rng: Random) -> Process:
    return LogNormal(rng.uniform(0.3, 3.0), rng.choice([0.2, 0.5, 1.0]))


def _longest_ms(tasks: dict[str, Task], flows: list[Flow]) -> float:
    """Mean time of the longest path, all of it on the robot."""
    finish_ms: dict[str, float] = {}
    for name, task in tasks.items():
        before = [finish_ms[flow.source] for flow in flows if flow.target == name]
        finish_ms[name] = max(before, default=0.0) + task.on["R"].exec_ms.expectation
    return max(finish_ms.values())
