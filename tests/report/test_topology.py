"""The topology of a cell, as a figure's data and as a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.report.figure import Figure, svg
from dwell.report.topology import WIDTHS, topology

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize("name", ["canonical", "fan-in", "cloud"])
def test_every_node_has_its_tasks_and_every_pair_one_line(name: str) -> None:
    problem = dwell.load(EXAMPLES / f"{name}.yaml")
    frames = topology(problem).frames
    lines: dict[str, list[str]] = {}
    for node, text in frames["boxes"].sort("line").select("node", "text").rows():
        lines.setdefault(node, []).append(text)
    assert lines.keys() == problem.fabric.nodes.keys()
    for node, (head, *tasks) in lines.items():
        assert head.startswith(f"{node}: {problem.fabric.nodes[node].tier}, ")
        assert tasks == [
            f"({task.name})" if len(task.on) == 1 else task.name
            for task in problem.pipeline.tasks.values()
            if node in task.on
        ]
    pairs = {frozenset((link.source, link.target)) for link in problem.fabric.links.values()}
    assert frames["links"].height == len(pairs)
    picture = svg(topology(problem))
    assert all(f">{node}: " in picture for node in lines)


def boxes(figure: Figure, width: float) -> dict[str, tuple[float, float]]:
    """Return the middle of the first line of each node."""
    heads = figure.spec(width)["layer"][4]["data"]["values"]
    return {row["text"].partition(":")[0]: (row["x"], row["y"]) for row in heads}


def many(robots: int) -> dwell.model.Problem:
    """Return the canonical cell with further robots, whose names are long."""
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    fabric = problem.fabric
    more = {
        name: replace(fabric.nodes["R1"], name=name)
        for name in (f"robot-with-a-name-of-forty-letters-計算機{i:02}" for i in range(robots))
    }
    links = {
        link.name: link for name in more for link in (replace(fabric.links["R1->E"], source=name),)
    }
    return replace(
        problem,
        fabric=replace(fabric, nodes={**fabric.nodes, **more}, links={**fabric.links, **links}),
        objective=replace(
            problem.objective, tiers={**problem.objective.tiers, **dict.fromkeys(more, "robot")}
        ),
    )


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", ["canonical", "fan-in"])
def test_robots_are_below_the_edge_in_the_order_of_the_cell(name: str, width: float) -> None:
    places = boxes(topology(dwell.load(EXAMPLES / f"{name}.yaml")), width)
    assert places["R1"][0] < places["R2"][0]
    assert places["R1"][1] == places["R2"][1] > places["E"][1]


@pytest.mark.parametrize("width", WIDTHS)
def test_thirty_nodes_do_not_overlap(width: float) -> None:
    figure = topology(many(27))
    places = list(boxes(figure, width).values())
    assert len(places) == 30
    for i, (x, y) in enumerate(places):
        assert 0 <= x <= width
        for other_x, other_y in places[:i]:
            assert abs(x - other_x) >= 150 or abs(y - other_y) >= 40
    svg(figure, width)


def test_links_that_are_alike_are_in_the_caption() -> None:
    alike = topology(dwell.load(EXAMPLES / "canonical.yaml"))
    assert "Each link: 0.70 ms, 940 Mbit/s." in alike.caption
    assert "Mbit/s" not in svg(alike)
    cloud = topology(dwell.load(EXAMPLES / "cloud.yaml"))
    assert "Each link" not in cloud.caption
    assert all(text in svg(cloud) for text in cloud.frames["links"]["text"])


def test_a_cell_of_one_node_has_no_lines() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    alone = {"R1": problem.fabric.nodes["R1"]}
    on = problem.pipeline.tasks["perception"].on["R1"]
    tasks = {name: replace(one, on={"R1": on}) for name, one in problem.pipeline.tasks.items()}
    cell = replace(
        problem,
        fabric=replace(problem.fabric, nodes=alone, links={}),
        pipeline=replace(problem.pipeline, tasks=tasks),
        candidates={"LOC": dwell.model.Placement(dict.fromkeys(tasks, "R1"))},
        objective=replace(problem.objective, tiers={"R1": "robot"}),
        scenarios={},
        controller=replace(problem.controller, on="R1", policy="LOC", fallbacks=()),
    )
    figure = topology(cell)
    assert figure.frames["links"].is_empty()
    assert "R1: robot" in svg(figure)
