"""The search for placements: its size and time, and the placements that schedulers find."""

from __future__ import annotations

import itertools
import json
import math
import os
import random
import subprocess
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

from benchmarks.figures import Figure, Goal, Section
from dwell.cellfile import from_document
from dwell.cost import cost
from dwell.estimators.any_placement import AnyPlacement
from dwell.estimators.placement_search import rank
from dwell.model import Placement, Problem
from tests.cells.random_dags import random_dag

#: Variable with a Python that has the package anrg-saga.
SAGA = "SAGA_PYTHON"
PEER = Path(__file__).parent / "peers" / "saga_schedules.py"
SCHEDULERS = ("Heft", "Cpop", "MinMin", "MaxMin", "ETF", "MCT", "FCP", "Duplex", "FastestNode")
LEAST = 1_000
SIMULATED, SECONDS = Goal(high=20), Goal(high=2)


def measure(quick: bool) -> Section:
    """Share of placements that are simulated, and CPU time of a search."""
    cells = list(_large_cells(5 if quick else 30))
    shares, took = [], []
    for problem in cells:
        begun = process_time()
        ranking = rank(problem, top=1)
        took.append(process_time() - begun)
        shares.append(100 * ranking.simulated / ranking.placements)
    figures = [
        Figure("random cells: placements simulated", shares, "%", SIMULATED),
        Figure("random cells: CPU time", took, "s"),
    ]
    for nodes in (3, 4):
        begun = process_time()
        ranking = rank(autoware_graph(nodes), top=1)
        figures += [
            Figure(f"Autoware on {nodes} nodes: CPU time", [process_time() - begun], "s", SECONDS),
            Figure(f"Autoware on {nodes} nodes: gap", [100 * ranking.gap], "%", Goal(high=2)),
        ]
    notes = (
        f"random cells of {LEAST} to 300000 placements; the best placement, 1000 cycles each",
        "Autoware: the 16 movable tasks of the reference system, at one rate",
    )
    return Section("Search for the best placement", figures, notes)


def schedulers(quick: bool) -> Section:
    """J of the placements of the schedulers of anrg-saga over the best J, by our kernel."""
    python = os.environ.get(SAGA)
    title = "Placements of schedulers, latency above the best"
    if python is None:
        return Section(title, [], (f"{SAGA} names no Python with anrg-saga: left out",))
    graphs = [_graph(seed) for seed in range(5 if quick else 30)]
    given = "\n".join(map(json.dumps, graphs))
    done = subprocess.run(
        [python, PEER, ",".join(SCHEDULERS)],
        input=given,
        capture_output=True,
        text=True,
        check=True,
    )
    above, took = defaultdict(list), defaultdict(list)
    for graph, line in zip(graphs, done.stdout.splitlines(), strict=True):
        problem = _cell(graph)
        begun = process_time()
        best = rank(problem, cycles=1, top=1).best[0].cost
        took["exact search"].append(1e3 * (process_time() - begun))
        sample = AnyPlacement(problem, "baseline", seed=0, windows=1)
        for name, found in json.loads(line).items():
            placement = Placement(found["nodes"])
            J = cost(sample.measure(placement.first).qos, placement, placement, problem.objective)
            above[name].append(100 * (J / best - 1))
            took[name].append(1e3 * found["cpu_s"])
    figures = [Figure(name, values, "%") for name, values in above.items()]
    figures += [Figure(f"{name}, CPU time", values, "ms") for name, values in took.items()]
    exact = ", ".join(
        f"{name} {sum(value < 1e-6 for value in values)}" for name, values in above.items()
    )
    notes = (
        "10 tasks on 3 nodes of one core, one job after another; links send one message at a time",
        f"of {len(graphs)} graphs the best placement is found by: {exact}",
    )
    return Section(title, figures, notes)


def _large_cells(count: int) -> Iterator[Problem]:
    """Yield random cells with many placements."""
    cells = map(random_dag, itertools.count())
    large = (
        problem
        for problem in cells
        if LEAST < math.prod(len(task.on) for task in problem.pipeline.tasks.values()) < 300_000
    )
    return itertools.islice(large, count)


def _graph(seed: int) -> dict[str, Any]:
    """Return a random task graph: execution time is cost over speed."""
    rng = random.Random(seed)
    tasks = [f"T{number}" for number in range(10)]
    data = [
        (source, task, rng.randint(5, 30))
        for place, task in enumerate(tasks[1:], 1)
        for source in rng.sample(
            tasks[max(0, place - 4) : place], min(place, rng.choice([1, 1, 2]))
        )
    ]
    ends = [task for task in tasks[:-1] if all(task != source for source, _, _ in data)]
    data += [(task, tasks[-1], rng.randint(5, 30)) for task in ends]
    nodes = ("P1", "P2", "P3")
    return {
        "costs": {task: rng.randint(8, 30) for task in tasks},
        "speeds": {node: rng.choice([0.7, 1.0, 1.5, 2.0]) for node in nodes},
        "data": data,
        "rates": [
            (one, other, rng.choice([1.0, 2.0, 4.0]))
            for place, one in enumerate(nodes)
            for other in nodes[place + 1 :]
        ],
    }


def _cell(graph: dict[str, Any]) -> Problem:
    """Return a graph as a cell whose J is its latency, ms."""
    speeds = graph["speeds"]
    return from_document(
        {
            "dwell": 1,
            "name": "graph",
            "period_ms": 1000,
            "nodes": {node: {"tier": "edge", "scheduler": "fifo"} for node in speeds},
            "links": [
                {"from": one, "to": other, "both_ways": True, "delay_ms": 0, "rate_mbps": 8 * rate}
                for one, other, rate in graph["rates"]
            ],
            "tasks": {
                task: {"on": {node: {"exec_ms": work / speed} for node, speed in speeds.items()}}
                for task, work in graph["costs"].items()
            },
            "flows": [
                {"from": source, "to": target, "bytes": 1000 * units}
                for source, target, units in graph["data"]
            ],
            "candidates": {"ONE": dict.fromkeys(graph["costs"], "P1")},
            "window_cycles": 1,
            "objective": {
                "weights": {
                    "latency": 1,
                    **dict.fromkeys(("violations", "robot", "edge", "switching"), 0),
                },
                "targets": {"latency_ms": 1},
            },
        }
    )


#: Inputs and mean execution time on R1, ms, of the movable tasks of Autoware's reference system.
AUTOWARE = {
    "transform_front": (("front_lidar",), 12),
    "transform_rear": (("rear_lidar",), 12),
    "fusion": (("transform_front", "transform_rear"), 9),
    "voxel_grid": (("fusion",), 7),
    "map_loader": (("cloud_map",), 3),
    "localizer": (("voxel_grid", "map_loader"), 16),
    "ground_filter": (("fusion",), 10),
    "cluster": (("ground_filter", "settings"), 14),
    "collision": (("cluster",), 5),
    "global_planner": (("goal", "localizer"), 4),
    "lanelet_loader": (("lanelet_map", "global_planner"), 3),
    "parking": (("lanelet_loader",), 5),
    "lane": (("lanelet_loader",), 5),
    "behaviour": (
        ("collision", "localizer", "global_planner", "lanelet_loader", "parking", "lane"),
        8,
    ),
    "mpc": (("behaviour",), 6),
    "interface": (("mpc", "behaviour"), 2),
}
SOURCES = {
    **dict.fromkeys(("front_lidar", "settings", "goal"), "R1"),
    **dict.fromkeys(("rear_lidar", "cloud_map", "lanelet_map"), "R2"),
}
BYTES = {"transform_front": 200_000, "transform_rear": 200_000, "fusion": 400_000}


class Graph(NamedTuple):
    """A graph of movable tasks between sources and a last task, whose nodes are given.

    Parameters
    ----------
    movable : mapping of str to tuple
        Inputs of each task, and its mean execution time on R1, ms.
    sources : mapping of str to str
        Nodes of the sources.
    last : tuple of str
        Input of the last task, and its node.
    sizes : mapping of str to int
        Bytes of the messages of tasks; 5,000 for the others.
    """

    name: str
    movable: Mapping[str, tuple[tuple[str, ...], float]]
    sources: Mapping[str, str]
    last: tuple[str, str]
    sizes: Mapping[str, int]


def autoware_graph(nodes: int) -> Problem:
    """Return the graph on two robots, an edge and, with four nodes, a cloud."""
    return graph_cell(Graph("autoware-graph", AUTOWARE, SOURCES, ("interface", "R1"), BYTES), nodes)


def graph_cell(graph: Graph, nodes: int) -> Problem:
    """Return a graph as a cell; the last task is `drive`."""
    speed = dict(tuple({"R1": 1.0, "R2": 0.9, "E": 0.6, "C": 0.5}.items())[:nodes])
    cores = {"R1": 2, "R2": 2, "E": 2, "C": 8}
    tier = {"R1": "robot", "R2": "robot", "E": "edge", "C": "cloud"}
    delay_ms = {"R1": 0.5, "R2": 0.5, "E": 1.5, "C": 8.0}
    tasks: dict[str, Any] = {
        name: {"on": {node: {"exec_ms": 0.2}}} for name, node in graph.sources.items()
    }
    tasks |= {
        name: {
            "on": {
                node: {"exec_ms": {"lognormal": {"mean": ms * share, "cv": 0.2}}}
                for node, share in speed.items()
            }
        }
        for name, (_, ms) in graph.movable.items()
    }
    before, where = graph.last
    tasks["drive"] = {"on": {where: {"exec_ms": 0.2}}}
    flows = [
        {"from": source, "to": name, "bytes": graph.sizes.get(source, 5_000)}
        for name, (sources, _) in graph.movable.items()
        for source in sources
    ]
    return from_document(
        {
            "dwell": 1,
            "name": graph.name,
            "period_ms": 100,
            "nodes": {name: {"tier": tier[name], "cores": cores[name]} for name in speed},
            "links": [
                {
                    "from": one,
                    "to": other,
                    "delay_ms": {"exponential": {"mean": max(delay_ms[one], delay_ms[other])}},
                    "rate_mbps": 200,
                }
                for one in speed
                for other in speed
                if one != other
            ],
            "tasks": tasks,
            "flows": [*flows, {"from": before, "to": "drive", "bytes": 100}],
            "candidates": {node: dict.fromkeys(graph.movable, node) for node in ("R1", "E")},
            "window_cycles": 100,
        }
    )
