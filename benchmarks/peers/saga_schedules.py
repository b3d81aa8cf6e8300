"""Schedules of task graphs by the package `anrg-saga`.

`python saga_schedules.py NAME,NAME < GRAPHS` prints one line of JSON per graph: for each scheduler
the node of every task, and the CPU time of its call, s. Input is one line of JSON per graph: cost
of each task, speed of each node, data between tasks, rate between nodes.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import Any

from saga import Network, TaskGraph, schedulers

logging.disable(logging.WARNING)


def schedule(graph: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the nodes that a scheduler chooses, and its CPU time."""
    rates = graph["rates"]
    network = Network.create(
        graph["speeds"].items(), [(one, other, rate) for one, other, rate in rates]
    )
    tasks = TaskGraph.create(graph["costs"].items(), [tuple(flow) for flow in graph["data"]])
    scheduler = getattr(schedulers, f"{name}Scheduler")()
    begun = time.process_time()
    found = scheduler.schedule(network, tasks)
    taken_s = time.process_time() - begun
    nodes = {task.name: node for node, jobs in found.mapping.items() for task in jobs}
    return {"nodes": {task: nodes[task] for task in graph["costs"]}, "cpu_s": taken_s}


if __name__ == "__main__":
    names = sys.argv[1].split(",")
    for line in sys.stdin:
        graph = json.loads(line)
        print(json.dumps({name: schedule(graph, name) for name in names}), flush=True)
