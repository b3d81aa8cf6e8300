"""The topology of a cell, as a figure's data and as a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.report.figure import svg
from dwell.report.topology import topology

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
