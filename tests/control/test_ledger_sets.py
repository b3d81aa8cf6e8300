"""Sets of moves: the end does not depend on the order of the file."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from dwell.cellfile import from_document
from dwell.control.ledger import FleetLedger, Seat
from dwell.estimators.fleet_prices import FleetPrice, Placements, PricedCell
from dwell.model import Decision, FrozenDict, Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.sim.fleet import simulate_fleet
from tests.cells.random_fleets import (
    close,
    every_phi,
    priced_cells,
    random_fleet,
    reordered,
    settle,
)


def robot(name: str, here_ms: float, initial: str = "LOC", window_cycles: int = 20) -> Problem:
    """Return a cell with a job of 11 ms on the edge, and of another length on its robot."""
    return from_document(
        {
            "dwell": 1,
            "name": name,
            "period_ms": 20,
            "window_cycles": window_cycles,
            "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
            "links": [{"from": "R", "to": "E", "delay_ms": 0, "both_ways": True}],
            "tasks": {
                "s": {"on": {"R": {"exec_ms": 0}}},
                "t": {"on": {"R": {"exec_ms": here_ms}, "E": {"exec_ms": 11}}},
                "k": {"on": {"R": {"exec_ms": 0}}},
            },
            "flows": [{"from": "s", "to": "t"}, {"from": "t", "to": "k"}],
            "candidates": {"LOC": {"t": "R"}, "SO": {"t": "E"}},
            "objective": {
                "weights": {
                    "latency": 1, "violations": 3, "robot": 0.5, "edge": 0.3, "switching": 0.2,
                },
                "targets": {"latency_ms": 20, "robot": 0.7, "edge": 0.7},
            },
            "controller": {
                "policy": "dtp", "initial": initial, "estimator": "corrected", "shadow_fraction": 0,
            },
        }
    )  # fmt: skip


def fleet_of(*cells: Problem) -> Fleet:
    return Fleet("pair", tuple(map(FleetEntry, cells)), ("E",), "sync")


QUICK, SLOW = robot("qa", 12), robot("qb", 19)


def crowded(*more: Problem) -> FleetLedger:
    """Return a ledger of a fleet where the wrong cell has the edge: two cells must swap."""
    return FleetLedger(priced_cells(fleet_of(robot("qa", 12, "SO"), SLOW, *more)), ["E"])


@pytest.mark.parametrize("cells", [(QUICK, SLOW), (SLOW, QUICK)])
def test_the_cell_that_gains_most_has_the_edge_in_any_order(cells: tuple[Problem, ...]) -> None:
    run = simulate_fleet(fleet_of(*cells), windows=12)
    ends = {name: str(one.decisions["placement"][-1]) for name, one in run.cells.items()}
    assert ends == {"qa-01": "LOC", "qb-01": "SO"}


@pytest.mark.parametrize(("quick", "slow"), [(20, 20), (20, 50), (20, 35), (35, 20)])
def test_two_cells_swap_as_a_set_whatever_their_windows(quick: int, slow: int) -> None:
    cells = robot("qa", 12, "SO", quick), robot("qb", 19, "LOC", slow)
    run = simulate_fleet(fleet_of(*cells), windows=12)
    moved = run.decisions.filter("migrated")
    assert dict(moved.select("cell", "placement").rows()) == {"qa-01": "LOC", "qb-01": "SO"}
    assert moved.height == 2
    for column in ("round", "phi_before", "phi_after"):
        assert moved[column].n_unique() == 1


def test_members_of_a_set_move_at_their_next_closes_with_the_same_row() -> None:
    ledger = crowded()
    verdicts = []
    for i in (1, 0, 1, 0):
        here = ledger.placements[i]
        verdict = close(ledger, i)
        if verdict.name != here:
            verdicts.append((i, verdict))
    (_, one), (_, other) = verdicts
    assert sorted(i for i, _ in verdicts) == [0, 1]
    assert one.asked == other.asked
    assert ledger.placements == ["LOC", "SO"]
    first, last, _ = one.asked
    assert first is not None
    assert last is not None
    owed = sum(ledger.owed(i, name) for i, name in enumerate(("SO", "LOC")))
    assert first - last > owed


def with_set() -> tuple[FleetLedger, int]:
    """Return a ledger of three cells with a set under way, and a member that has not moved."""
    ledger = crowded(robot("qc", 12))
    for i in itertools.islice(itertools.cycle((1, 2, 0)), 9):
        here = ledger.placements[i]
        if close(ledger, i).name != here:
            return ledger, 1 - i
    raise AssertionError("no set")


def test_nothing_else_is_played_while_a_set_is_under_way() -> None:
    ledger, _ = with_set()
    rounds = ledger.round
    problem = ledger.cells[2].problem
    decision = Decision(problem.candidates["SO"], "SO", True, "migrate")
    verdict = ledger.consider(2, decision, by_price=False)
    assert (verdict.name, verdict.why) == ("LOC", "ledger: Φ would change, a set is under way")
    assert ledger.round == rounds


def test_a_move_of_the_guard_drops_the_set_and_the_others_are_asked_again() -> None:
    ledger, waits = with_set()
    Seat(ledger, waits).place({"LOC": "SO", "SO": "LOC"}[ledger.placements[waits]])
    problem = ledger.cells[2].problem
    decision = Decision(problem.candidates["SO"], "SO", True, "migrate")
    assert ledger.consider(2, decision, by_price=False).asked[0] is not None


def test_a_cell_that_dwells_is_no_member_of_a_set() -> None:
    ledger = crowded()
    for _ in range(4):
        close(ledger, 1)
        close(ledger, 0, "dwell")
    assert ledger.placements == ["SO", "LOC"]
    settle(ledger, (0, 1))
    assert ledger.placements == ["LOC", "SO"]


@pytest.mark.parametrize("count", [3, 8])
def test_a_change_takes_at_most_twelve_plays_of_the_fleet(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = [replace(SLOW, name=f"q{i}") for i in range(count)]
    ledger = FleetLedger(priced_cells(fleet_of(*cells)), ["E"])
    plays: list[Placements] = []
    price = ledger.prices._price

    def counted(placements: Placements) -> FleetPrice:
        plays.append(placements)
        return price(placements)

    monkeypatch.setattr(ledger.prices, "_price", counted)
    settle(ledger, range(count))
    assert plays
    assert len(plays) <= 12


def test_a_cell_on_its_guards_fallback_is_no_member_of_a_set() -> None:
    ledger = crowded()
    problem = ledger.cells[1].problem
    costs = FrozenDict(dict.fromkeys(problem.candidates, 0.0))
    stays = Decision(problem.candidates["LOC"], "LOC", False, "hold", costs)
    for _ in range(4):
        close(ledger, 0)
        ledger.consider(1, stays, by_price=True, on_fallback=True)
    assert ledger.placements == ["SO", "LOC"]
    settle(ledger, (0, 1))
    assert ledger.placements == ["LOC", "SO"]


@pytest.mark.parametrize("seed", range(8))
def test_the_end_is_near_the_best_of_all_placements(seed: int) -> None:
    """In the order of the file, and with every second fleet in the reverse order."""
    fleet = random_fleet(seed, most=4)
    order = range(len(fleet.cells))
    cells: list[PricedCell] = priced_cells(reordered(fleet, order[::-1] if seed % 2 else order))
    ledger = FleetLedger(cells, fleet.shared)
    settle(ledger, order)
    phi = every_phi(ledger)
    best = min(phi, key=phi.__getitem__)
    owed = sum(ledger.owed(i, name) for i, name in enumerate(best))
    assert phi[tuple(ledger.placements)] <= max(1.01 * phi[best], phi[best] + owed)
