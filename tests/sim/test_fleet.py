"""Several cells in one simulation: they meet on the nodes they share, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.kernels.codes import CycleOutcome, Status
from dwell.kernels.realisation import Realisation
from dwell.kernels.rows import Tables
from dwell.model import (
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

EXAMPLES = Path(__file__).parents[2] / "examples"


def problem_of(chains: tuple[str, ...], scheduler: str = "fair") -> Problem:
    """Chains robot -> E -> robot side by side in one cell; each has a robot of its own."""
    nodes = {"E": Node("E", "edge", 2, scheduler)}  # type: ignore[arg-type]
    tasks: dict[str, Task] = {}
    flows: list[Flow] = []
    links: dict[str, Link] = {}
    for chain in chains:
        robot = f"R{chain}"
        nodes[robot] = Node(robot, "robot", 1)
        for name, node, mean in (("a", robot, 3.0), ("b", "E", 14.0), ("c", robot, 2.0)):
            task = f"{name}{chain}"
            tasks[task] = Task(task, {node: Execution(Exponential(mean))})
        flows += [Flow(f"a{chain}", f"b{chain}", 50_000), Flow(f"b{chain}", f"c{chain}", 1000)]
        for source, target in ((robot, "E"), ("E", robot)):
            link = Link(source, target, Exponential(1.0), rate_mbps=100)
            links[link.name] = link
    placed = {task: next(iter(tasks[task].on)) for task in tasks}
    return Problem(
        name="chains",
        pipeline=Pipeline(tasks, tuple(flows), 20, 20),
        fabric=Fabric(nodes, links),
        candidates={"ONLY": Placement(placed)},
        objective=Objective(Weights(), Targets(20)),
        window_cycles=20,
    )


def played(cells: list[tuple[Problem, Realisation]], shared: set[str]) -> Tables:
    arrays = lay_out(cells, shared=shared)
    assert play(arrays) == Status.FINISHED
    return arrays.tables


@pytest.mark.parametrize("scheduler", ["fair", "fifo", "priority"])
def test_cells_that_share_a_node_are_one_cell_with_both_pipelines(scheduler: str) -> None:
    both = problem_of(("1", "2", "3"), scheduler)
    whole = dwell.draw(both, seed=3, windows=30)
    together = played([(both, whole)], set()).latency_ns[0]
    cells = []
    for chain in ("1", "2", "3"):
        one = problem_of((chain,), scheduler)
        # Streams have names, so the part of the whole realisation is the realisation of the part.
        cells.append((one, dwell.draw(one, seed=3, windows=30)))
    apart = played(cells, {"E"}).latency_ns
    assert np.array_equal(together, apart.max(axis=0))
    alone = [played([cell], set()).latency_ns[0] for cell in cells]
    assert (apart >= np.array(alone)).mean() > 0.9
    assert (apart > np.array(alone)).any()


def test_cells_that_share_nothing_do_not_notice_each_other() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    faster = replace(problem, pipeline=replace(problem.pipeline, period_ms=25.0, deadline_ms=25.0))
    cells = [
        (problem, dwell.draw(problem, seed=1, windows=8, scenario="robot-cpu-stress")),
        (faster, dwell.draw(faster, seed=2, windows=5, scenario="network-impairment")),
    ]
    together = played(cells, set())
    for i, cell in enumerate(cells):
        alone = played([cell], set())
        cycles = cell[1].cycles
        # The cell that ends first still sees its last cycles through while the other goes on.
        settled = alone.outcome[0] != CycleOutcome.IN_FLIGHT
        assert settled.mean() > 0.99
        for table in ("latency_ns", "compute_ns", "network_ns", "outcome"):
            found, expected = getattr(together, table)[i, :cycles], getattr(alone, table)[0]
            assert np.array_equal(found[settled], expected[settled]), table


def test_own_work_of_a_cell_is_its_own() -> None:
    """Busy time of the shared node is the sum of what the cells call their own."""
    cells = []
    for chain in ("1", "2"):
        one = problem_of((chain,), "fifo")
        cells.append((one, dwell.draw(one, seed=5, windows=10)))
    arrays = lay_out(cells, shared={"E"})
    play(arrays)
    e = list(cells[0][0].fabric.resources).index("E")
    busy, own = arrays.tables.closed[:, -1, 0, e], arrays.tables.closed[:, -1, 1, e]
    assert busy[0] == busy[1]
    assert own.sum() == pytest.approx(busy[0], rel=1e-12)
    assert (own > 0).all()
