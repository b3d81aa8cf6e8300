"""Diagnostics of a cell, and the unit that publishes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import dwell
from dwell import ros2
from dwell.live.commands.units import unit_texts
from dwell.live.ros2.diagnostics import ERROR, OK, STALE, TYPE, WARN, diagnostics
from tests.live.small_world import World, canonical

CELL = Path("examples/live/ros2.yaml")


def entries(world: World, status: dict[str, Any]) -> dict[str, Any]:
    fields = diagnostics(world.problem, status, 5_000_000_007)
    message = ros2.decode(ros2.encode(fields, TYPE), TYPE)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    return {entry.name: entry for entry in message.status}


def test_one_entry_for_the_cell_each_node_and_each_stage() -> None:
    world = World(canonical(20), policy="LOC")
    world.run(3_000)
    found = entries(world, world.status)
    name = world.problem.name
    assert set(found) == {
        f"dwell: {name}",
        *(f"dwell: {name}: node {node}" for node in world.problem.fabric.nodes),
        *(f"dwell: {name}: stage {task}" for task in world.problem.pipeline.tasks),
    }
    assert {entry.level for entry in found.values()} == {OK}
    values = {pair.key: pair.value for pair in found[f"dwell: {name}"].values}
    assert values["placement"] == "LOC"
    assert float(values["l95_ms"]) > 0
    assert found[f"dwell: {name}: stage perception"].hardware_id == "R1"


def test_silent_node_is_an_error() -> None:
    world = World(canonical(20), policy="LOC")
    world.run(3_000)
    for who in [who for who in world.roles if "@R2" in who]:
        world.network.freeze(who)
    world.run(3_000)
    found = entries(world, world.status)
    name = world.problem.name
    assert found[f"dwell: {name}: node R2"].level == ERROR
    assert found[f"dwell: {name}: node R1"].level == OK
    assert found[f"dwell: {name}"].level in (WARN, ERROR)


def test_absent_controller_is_stale() -> None:
    world = World(canonical(20))
    status = {"health": "absent", "headline": "no controller answers"}
    (entry,) = entries(world, status).values()
    assert (entry.level, entry.message) == (STALE, "no controller answers")


def test_unit_of_the_controllers_node() -> None:
    problem = dwell.load(CELL)
    names = {node: unit_texts(problem, node, CELL, user="robot") for node in ("R1", "E")}
    (unit,) = (text for name, text in names["E"].items() if name.startswith("dwell-diagnostics@"))
    assert f"-m dwell ros2 diagnostics {CELL}" in unit
    assert "Type=exec" in unit
    assert not any("diagnostics" in name for name in names["R1"])
    plain = dwell.load("examples/live/cell.yaml")
    assert not any("diagnostics" in name for name in unit_texts(plain, "E", CELL, user="robot"))
