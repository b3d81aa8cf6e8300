"""What a fleet comes to: as the simulator plays it, whoever plays alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, product
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.estimators.fleet_prices import CellPrice, FleetPrice, FleetPrices, PricedCell
from dwell.estimators.load_table import LoadTable, load_table
from dwell.estimators.present import Present
from dwell.estimators.prices import SEED, prices_of
from dwell.model import FrozenDict
from dwell.model.fleet import Fleet, FleetEntry
from dwell.sim.fleet import phased, priced_cells, simulate_fleet
from tests.cells.once import with_windows

EXAMPLES = Path(__file__).parents[2] / "examples"
CANONICAL = dwell.load(EXAMPLES / "canonical.yaml")
FAN_IN = dwell.load(EXAMPLES / "fan-in.yaml")
LINKS = {name: replace(link, price_per_gb=0.5) for name, link in CANONICAL.fabric.links.items()}
WITH_PRICES = replace(CANONICAL, fabric=replace(CANONICAL.fabric, links=LINKS))


def fleet_of(*entries: FleetEntry, shared: tuple[str, ...] = ("E",)) -> Fleet:
    return Fleet("hall", entries, shared, phases="even", coordination="none")


def priced(fleet: Fleet, cycles: int = 1000) -> FleetPrices:
    problems = phased(fleet, 1)
    cells = [
        PricedCell(cell.name, problem, cell.streams, cell.entry.scenario)
        for cell, problem in zip(fleet.cells, problems, strict=True)
    ]
    return FleetPrices(cells, fleet.shared, cycles)


def cell_of(price: FleetPrice, index: int) -> CellPrice:
    cell = price.cells[index]
    assert cell is not None
    return cell


def test_a_fleet_is_priced_as_the_simulator_plays_it() -> None:
    entries = [FleetEntry(WITH_PRICES, 2, policy="SO"), FleetEntry(WITH_PRICES, 1, policy="HYB")]
    fleet = fleet_of(*entries)
    price = priced(fleet).price(("SO", "SO", "HYB"))
    run = simulate_fleet(fleet, seed=SEED, windows=9)
    for i, one in enumerate(run.cells.values()):
        windows = one.windows[1:]
        seen = cell_of(price, i).qos
        assert seen.l95_ms == pytest.approx(windows["seen_l95_ms"].mean(), rel=1e-12)
        assert seen.violation_rate == pytest.approx(windows["seen_violation_rate"].mean())
        assert seen.utilisation["R1"] == pytest.approx(windows["u_R1"].mean())
        assert seen.price_per_hour == pytest.approx(windows["seen_price_per_hour"].mean())
    first = next(iter(run.cells.values())).windows[1:]
    assert price.used == {"E": pytest.approx(first["u_E"].mean())}


def test_phi_is_j_without_switching_and_the_shared_node_once() -> None:
    fleet = fleet_of(FleetEntry(CANONICAL, 2))
    price = priced(fleet).price(("SO", "LOC"))
    weights, targets = CANONICAL.objective.weights, CANONICAL.objective.targets
    expected = 0.0
    for i in range(2):
        seen = cell_of(price, i).qos
        robot = max(seen.utilisation["R1"], seen.utilisation["R2"])
        expected += seen.l95_ms / targets.latency_ms + weights.violations * seen.violation_rate
        expected += weights.robot * robot / targets.robot
    expected += weights.edge * price.used["E"] / targets.edge
    assert price.phi == pytest.approx(expected)


def test_phi_does_not_depend_on_what_was_played_before() -> None:
    asked = list(product(("LOC", "SO", "HYB"), repeat=2))
    one, other = (
        priced(fleet_of(FleetEntry(CANONICAL, 2))),
        priced(fleet_of(FleetEntry(CANONICAL, 2))),
    )
    forth = [one.price(placements) for placements in asked]
    back = [other.price(placements) for placements in reversed(asked)]
    assert [price.phi for price in forth] == [price.phi for price in reversed(back)]
    qos = forth[0].qos(0)
    assert qos is not None
    assert qos.utilisation.keys() == CANONICAL.fabric.resources.keys()


def test_presents_that_are_the_same_are_not_played_again() -> None:
    prices = priced(fleet_of(FleetEntry(CANONICAL, 2)))
    said = [Present(threads=FrozenDict({"E": 3.0})), Present(threads=FrozenDict({"R1": 1.0}))]
    prices.begin(said)
    before = prices.price(("SO", "LOC"))
    prices.begin(list(said))
    assert prices.price(("SO", "LOC")) is before


def test_a_cell_that_meets_nobody_is_played_once_and_alike() -> None:
    prices = priced(fleet_of(FleetEntry(CANONICAL, 3)))
    together = prices.price(("LOC", "SO", "SO"))
    beside = prices.price(("LOC", "HYB", "LOC"))
    assert cell_of(together, 0) is cell_of(beside, 0)
    alone = priced(fleet_of(FleetEntry(CANONICAL, 3))).price(("LOC", None, None))
    assert cell_of(alone, 0).qos.l95_ms == cell_of(together, 0).qos.l95_ms
    assert alone.cells[1:] == (None, None)


def test_cells_of_several_kinds_are_played_for_about_as_long() -> None:
    prices = priced(fleet_of(FleetEntry(CANONICAL, 1), FleetEntry(FAN_IN, 1), shared=()))
    price = prices.price(tuple(next(iter(cell.problem.candidates)) for cell in prices.cells))
    assert all(cell_of(price, i).cost > 0 for i in range(2))


def test_of_a_shared_node_the_middle_of_what_cells_say_holds() -> None:
    prices = priced(fleet_of(FleetEntry(CANONICAL, 3)))
    declared = prices.price(("SO", "LOC", "LOC"))
    said = [Present(threads=FrozenDict({"E": threads})) for threads in (0.0, 16.0, 40.0)]
    prices.begin(said)
    stressed = prices.price(("SO", "LOC", "LOC"))
    assert cell_of(stressed, 0).cost > cell_of(declared, 0).cost + 0.1
    prices.begin([Present(), Present(), said[2]])
    assert prices.price(("SO", "LOC", "LOC")).phi == declared.phi


def test_a_table_has_a_level_for_every_cell_and_grows() -> None:
    fleet = fleet_of(FleetEntry(CANONICAL, 4))
    cells = [
        PricedCell(c.name, p, c.streams) for c, p in zip(fleet.cells, phased(fleet, 1), strict=True)
    ]
    told: list[tuple[int, int]] = []
    table = LoadTable(cells, ["E"], cycles=2_000, progress=lambda *done: told.append(done))
    assert set(table.columns) == {(0, "SO"), (0, "HYB")}
    assert told == [(i, 8) for i in range(1, 9)]
    for (_, name), column in table.columns.items():
        cores = table.work[0][name][1]
        assert column.level == pytest.approx(cores * np.arange(1, 5))
        assert (np.diff(column.l95_ms) > 0).all()
        # A cell alone is as its price says; what more cells come to is known less well.
        price = prices_of(cells[0].problem)[name]
        assert column.l95_ms[0] == pytest.approx(price.l95_ms)
        assert column.violation_rate[0] == pytest.approx(price.violation_rate)
        assert column.l95_error_ms[0] == pytest.approx(price.l95_error_ms)
        assert (column.l95_error_ms[1:] > price.l95_error_ms).all()
    assert load_table(cells, ["E"]) is load_table(list(cells), ("E",))


def test_a_table_of_many_cells_skips_levels_between_one_and_all() -> None:
    fleet = fleet_of(FleetEntry(CANONICAL, 40))
    cells = priced_cells(fleet, phased(fleet, 1))
    table = LoadTable(cells, ["E"], cycles=1)
    for (_, name), column in table.columns.items():
        counts = column.level / table.work[0][name][1]
        assert len(counts) == 14
        assert (counts[0], counts[-1]) == (pytest.approx(1), pytest.approx(40))
        assert np.diff(counts).max() < 3 + 1e-9


def test_others_of_another_kind_are_beside_those_of_one() -> None:
    big = replace(with_windows(CANONICAL, 50), name="big")
    fleet = fleet_of(FleetEntry(CANONICAL, 2), FleetEntry(big, 1))
    cells = [
        PricedCell(c.name, p, c.streams) for c, p in zip(fleet.cells, phased(fleet, 1), strict=True)
    ]
    table = LoadTable(cells, ["E"], cycles=200)
    assert [group for group, _ in islice(table.columns.items(), 4)] == [
        (0, "SO"),
        (0, "HYB"),
        (2, "SO"),
        (2, "HYB"),
    ]
    heaviest = max(cores for _, cores in table.work[2].values())
    mine = table.work[0]["HYB"][1]
    assert table.columns[0, "HYB"].level == pytest.approx([mine, 2 * mine, 2 * mine + heaviest])
