"""`dwell candidates`: the cheapest of all placements of a cell."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import dwell
from tests.cli.small_cell import SMALL, assert_refused, call, read_json


def test_it_shows_the_best_placements_and_how_they_differ(cell: Path) -> None:
    result = call("candidates", cell)
    assert (result.exit_code, result.stderr) == (0, "")
    rows = [line.split() for line in result.stdout.splitlines()]
    assert rows[0] == ["small:", "2", "placements,", "baseline,", "1000", "cycles", "each"]
    assert [row[0] for row in rows if row and row[0] in ("OFF", "LOC")] == ["OFF", "LOC"]
    assert "OFF: plan on E" in result.stdout
    assert "LOC: as OFF, with plan on R" in result.stdout


def test_as_json(cell: Path) -> None:
    found = read_json(call("candidates", cell, "--json"))
    assert list(found["candidates"]) == ["OFF", "LOC"]
    assert found["candidates"]["OFF"]["l95_ms"] == 4.0
    assert (found["exact"], found["gap"], found["placements"]) == (True, 0.0, 2)
    assert found["simulated"] == 2


NAMED = SMALL[SMALL.index("candidates:") : SMALL.index("scenarios:")]


def test_the_block_can_be_pasted(cell: Path) -> None:
    block = call("candidates", cell, "--yaml").stdout
    assert yaml.safe_load(block) == {"candidates": {"OFF": {"plan": "E"}, "LOC": {"plan": "R"}}}
    cell.write_text(SMALL.replace(NAMED, block), encoding="utf-8")
    assert list(dwell.load(cell).candidates) == ["OFF", "LOC"]


def test_a_placement_without_a_name_gets_one(cell: Path) -> None:
    block = "candidates:\n  LOC: {plan: R}\n"
    cell.write_text(SMALL.replace(NAMED, block), encoding="utf-8")
    assert list(read_json(call("candidates", cell, "--json"))["candidates"]) == ["A1", "LOC"]


def test_several_scenarios(cell: Path) -> None:
    found = read_json(call("candidates", cell, "--scenarios", "baseline,stress", "--json"))
    alone = read_json(call("candidates", cell, "--scenario", "stress", "--json"))
    costs = {name: one["cost"] for name, one in found["candidates"].items()}
    assert all(costs[name] >= one["cost"] for name, one in alone["candidates"].items())


@pytest.mark.parametrize("option", ["--scenario", "--scenarios"])
def test_an_unknown_scenario_is_refused(cell: Path, option: str) -> None:
    assert_refused(call("candidates", cell, option, "rain"), "unknown scenario 'rain'")
