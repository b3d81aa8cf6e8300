"""The task graph of Topcuoglu, Hariri and Wu (2002), figure 2, on three processors.

Processors are nodes with one core, and run jobs one after another. A link sends one message after
another, in one millisecond per unit of data.
"""

from __future__ import annotations

from collections.abc import Sequence

from dwell.model import (
    Constant,
    Execution,
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

#: Execution time of each task on P1, P2 and P3, ms.
EXEC_MS = (
    (14, 16, 9),
    (13, 19, 18),
    (11, 13, 19),
    (13, 8, 17),
    (12, 13, 10),
    (13, 16, 9),
    (7, 15, 11),
    (5, 11, 14),
    (18, 12, 20),
    (21, 7, 16),
)
#: Units of data between tasks: sender, receiver, units.
DATA = (
    *((1, 2, 18), (1, 3, 12), (1, 4, 9), (1, 5, 11), (1, 6, 14), (2, 8, 19), (2, 9, 16)),
    *((3, 7, 23), (4, 8, 27), (4, 9, 23), (5, 9, 13), (6, 8, 15), (7, 10, 17), (8, 10, 11)),
    (9, 10, 13),
)
NODES = ("P1", "P2", "P3")


def heft_graph(start_ms: Sequence[float] = (0, 0, 0)) -> Problem:
    """Return the graph as a cell whose J is its latency, ms.

    `start_ms` is the start-up cost of a message by its sender.
    """
    tasks = {
        f"T{number}": Task(
            f"T{number}",
            {node: Execution(Constant(float(ms))) for node, ms in zip(NODES, row, strict=True)},
        )
        for number, row in enumerate(EXEC_MS, 1)
    }
    flows = tuple(Flow(f"T{a}", f"T{b}", 1000 * units) for a, b, units in DATA)
    links = [
        Link(source, target, Constant(float(ms)), rate_mbps=8.0)
        for source, ms in zip(NODES, start_ms, strict=True)
        for target in NODES
        if source != target
    ]
    return Problem(
        name="heft",
        pipeline=Pipeline(tasks, flows, period_ms=500.0, deadline_ms=500.0),
        fabric=Fabric(
            nodes={name: Node(name, "edge", scheduler="fifo") for name in NODES},
            links={link.name: link for link in links},
        ),
        candidates={node: Placement(dict.fromkeys(tasks, node)) for node in NODES[:2]},
        objective=Objective(
            weights=Weights(latency=1.0, violations=0.0, robot=0.0, edge=0.0, switching=0.0),
            targets=Targets(latency_ms=1.0),
        ),
        window_cycles=5,
    )
