"""Small random fleets on a tight edge, their ledger, and the price of all their placements."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import dwell
from dwell.control.coordination import Verdict
from dwell.control.ledger import FleetLedger
from dwell.estimators.fleet_prices import PricedCell
from dwell.model import Decision, FrozenDict, Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.model.process import Constant
from dwell.model.qos import Reason
from dwell.sim.fleet import phased

CANONICAL = Path(__file__).parents[2] / "examples" / "canonical.yaml"


def random_fleet(seed: int, most: int = 7) -> Fleet:
    """Return 3 or more canonical cells of two kinds, with 2 to 4 cores for all."""
    rng = np.random.default_rng(seed)
    count, cores = int(rng.integers(3, most + 1)), int(rng.integers(2, 5))
    cell = dwell.load(CANONICAL)
    edge = replace(cell.fabric.nodes["E"], cores=cores, bursts=None)
    cell = replace(cell, fabric=replace(cell.fabric, nodes={**cell.fabric.nodes, "E": edge}))
    kinds = [_kind(cell, rng), _kind(replace(cell, name="other"), rng)]
    phasing = int(rng.integers(3))
    entries, phases_ms = [], []
    for i in range(count):
        kind = kinds[int(rng.integers(2))]
        share = (0.0, i / count, float(rng.random()))[phasing]
        entries.append(FleetEntry(kind))
        phases_ms.append(share * kind.pipeline.period_ms)
    return Fleet("random", tuple(entries), ("E",), tuple(phases_ms))


def _kind(cell: Problem, rng: np.random.Generator) -> Problem:
    """Return a cell with its own period and speed of perception on the robot."""
    tasks = dict(cell.pipeline.tasks)
    perception = tasks["perception"]
    if rng.random() < 0.75:
        slow = replace(perception.on["R1"], exec_ms=Constant(float(rng.uniform(20, 34))))
        tasks["perception"] = replace(perception, on={**perception.on, "R1": slow})
    period_ms = 40.0 if cell.name == "other" and rng.random() < 0.5 else cell.pipeline.period_ms
    pipeline = replace(cell.pipeline, tasks=tasks, period_ms=period_ms)
    return replace(cell, pipeline=pipeline)


def priced_cells(fleet: Fleet) -> list[PricedCell]:
    """Return the cells of a fleet as its ledger prices them."""
    problems = phased(fleet, 1)
    return [
        PricedCell(cell.name, problem, cell.streams)
        for cell, problem in zip(fleet.cells, problems, strict=True)
    ]


def reordered(fleet: Fleet, order: Sequence[int]) -> Fleet:
    """Return a fleet with its entries and phases in another order."""
    entries = tuple(fleet.entries[i] for i in order)
    assert not isinstance(fleet.phases, str)
    return replace(fleet, entries=entries, phases=tuple(fleet.phases[i] for i in order))


def every_phi(ledger: FleetLedger) -> dict[tuple[str, ...], float]:
    """Return the Φ of all placements, as the ledger plays them."""
    every = itertools.product(*(list(cell.problem.candidates) for cell in ledger.cells))
    return {placements: ledger.prices.price(placements).phi for placements in every}


def close(ledger: FleetLedger, index: int, reason: Reason = "hold") -> Verdict:
    """Let a cell decide that would stay where it is."""
    problem, here = ledger.cells[index].problem, ledger.placements[index]
    costs = FrozenDict(dict.fromkeys(problem.candidates, 0.0))
    decision = Decision(problem.candidates[here], here, False, reason, costs)
    return ledger.consider(index, decision, by_price=True)


def settle(ledger: FleetLedger, order: Sequence[int]) -> None:
    """Let all cells decide until none has moved for three rounds."""
    quiet = 0
    while quiet < 3:
        before = list(ledger.placements)
        for i in order:
            close(ledger, i)
        quiet = quiet + 1 if ledger.placements == before else 0
