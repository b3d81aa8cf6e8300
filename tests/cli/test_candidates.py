"""`dwell candidates`: the cheapest of all placements of a cell."""

from __future__ import annotations

import json
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


@pytest.mark.parametrize(
    ("objective", "key"),
    [
        ("latency: reaction", "latency"),
        ("weights: {age: 1}, targets: {age_ms: 50}", "weights.age"),
        ("caps: {misses: {m: 1, k: 20}}", "caps.misses"),
    ],
)
def test_an_objective_that_a_search_does_not_support_is_a_fault_of_the_file(
    cell: Path, objective: str, key: str
) -> None:
    chain = "chains:\n  reaction: {from: sense, to: plan}\n"
    cell.write_text(f"{SMALL}{chain}objective: {{{objective}}}\n", encoding="utf-8")
    refused = call("candidates", cell)
    assert_refused(refused, f"{cell}: objective.{key}: the search of placements does not support")


def test_too_few_cycles_for_a_run_of_each_sink_are_refused(cell: Path) -> None:
    cell.write_text(
        SMALL.replace("plan: {on", "plan: {every: 2, on").replace("plan}", "plan, sampled: true}"),
        encoding="utf-8",
    )
    refused = call("candidates", cell, "--cycles", "1")
    assert_refused(refused, "error: --cycles: 1 is not allowed; it must be at least 2, the cycles")


@pytest.mark.parametrize("option", ["--scenario", "--scenarios"])
def test_an_unknown_scenario_is_refused(cell: Path, option: str) -> None:
    assert_refused(call("candidates", cell, option, "rain"), "unknown scenario 'rain'")


def test_check_and_run_search_a_cell_with_all_placements(cell: Path) -> None:
    cell.write_text(SMALL.replace(NAMED, "candidates: {all: true, keep: 2}\n"), encoding="utf-8")
    assert list(read_json(call("check", cell, "--json"))["candidates"]) == ["A1", "A2"]
    assert call("run", cell, "--windows", "8", "--policy", "A2", "--out", "run").exit_code == 0
    found = json.loads(Path("run/run.json").read_text(encoding="utf-8"))["problem"]["candidates"]
    assert found == {"all": "found", "keep": 2, "A1": {"plan": "E"}, "A2": {"plan": "R"}}
    assert call("report", "run").exit_code == 0


def test_check_says_why_no_placement_is_feasible(cell: Path) -> None:
    text = SMALL.replace(NAMED, "candidates: all\n").replace("period_ms: 20", "period_ms: 0.1")
    cell.write_text(text, encoding="utf-8")
    assert_refused(call("check", cell), "over the capacity of R")


@pytest.mark.parametrize(
    "command",
    [["live", "run"], ["agent", "--node", "R", "--cell"], ["controller", "--out", "x", "--cell"]],
    ids=["run", "agent", "controller"],
)
def test_live_cells_refuse_all_placements(cell: Path, command: list[str]) -> None:
    cell.write_text(SMALL.replace(NAMED, "candidates: all\n"), encoding="utf-8")
    refused = call(*command, cell)
    assert refused.exit_code == 2
    assert "paste the block of `dwell candidates CELL --yaml`" in refused.stderr


def test_fleets_refuse_all_placements(cell: Path) -> None:
    cell.write_text(SMALL.replace(NAMED, "candidates: all\n"), encoding="utf-8")
    Path("fleet.yaml").write_text(
        "dwell-fleet: 1\nname: hall\nshared: [E]\ncells:\n  - {cell: small.yaml, count: 2}\n",
        encoding="utf-8",
    )
    assert_refused(call("fleet", "run", "fleet.yaml"), "`candidates: all`, which fleets do not")
