"""The watchdog of the model: cells whose windows are not what was played leave Φ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.control.watchdog import NOT_AS_PLAYED, Doubts, Expected, SeenWindow, Watchdog
from dwell.estimators.prices import prices_of
from dwell.model import Bursts, Constant, Episodes, NodeDisturbance, Problem
from dwell.model.fleet import Coordination, Fleet, FleetEntry
from dwell.record import FleetRun
from tests.cells.examples import EXAMPLES

AS_PLAYED = Expected(30.0, 0.1, 1.0, 0.01)
#: Canonical windows are 3.33 s long: from the twelfth to the thirtieth something happens.
AT_S, FOR_S = 40.0, 60.0


def seen(last_cycle: int, l95_ms: float = 30.0, rate: float = 0.1, cycles: int = 10) -> SeenWindow:
    return SeenWindow(l95_ms, rate, last_cycle, cycles)


# ----------------------------------------------------------------------------------- the windows


@pytest.mark.parametrize(
    ("l95_ms", "rate", "agrees"),
    [
        (34.0, 0.1, True),
        (34.1, 0.1, False),
        (25.9, 0.1, False),
        (30.0, 0.139, True),
        (30.0, 0.141, False),
        (30.0, 0.05, False),
    ],
)
def test_a_window_agrees_within_four_deviations(l95_ms: float, rate: float, agrees: bool) -> None:
    assert AS_PLAYED.agrees_with(seen(9, l95_ms, rate)) is agrees


def test_two_windows_that_share_no_cycle_are_needed() -> None:
    dog = Watchdog(10)
    compared = []
    for last in range(9, 60, 5):
        window = seen(last, rate=0.9)
        if dog.is_due(window, 0):
            compared.append(last)
            changed = dog.compare(window, AS_PLAYED)
            assert changed is (len(compared) == 2)
            if changed:
                break
    assert compared == [9, 19]
    assert not dog.trusts


def test_it_trusts_again_after_two_windows_that_agree() -> None:
    dog = Watchdog(10)
    rates = [0.9, 0.1, 0.9, 0.9, 0.1, 0.9, 0.1, 0.1]
    trusts = []
    for number, rate in enumerate(rates):
        window = seen(10 * number + 9, rate=rate)
        assert dog.is_due(window, 0)
        dog.compare(window, AS_PLAYED)
        trusts.append(dog.trusts)
    assert trusts == [True, True, True, False, False, False, False, True]


def test_windows_that_are_cut_or_begin_before_a_move_are_not_compared() -> None:
    dog = Watchdog(10)
    assert not dog.is_due(seen(9, cycles=9), 0)
    assert dog.is_due(seen(9), 0)
    assert not dog.is_due(seen(14), 1)
    assert not dog.is_due(seen(19), 1)
    assert dog.is_due(seen(24), 1)


def test_what_few_windows_have_not_met_is_in_the_deviation() -> None:
    """The canonical cell has bursts that eight windows need not meet."""
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    price = prices_of(problem)["SO"]
    windows = np.column_stack((np.full(8, price.l95_ms), np.zeros(8)))
    played = Expected.of(windows, price, problem.window_cycles)
    assert played.l95_deviation_ms > 0.01 * price.l95_ms
    assert played.agrees_with(seen(99, price.l95_ms, 0.01, 100))
    assert not played.agrees_with(seen(99, price.l95_ms, 0.5, 100))


def test_two_bad_windows_in_succession_may_be_declared() -> None:
    """Bursts of five windows, in one of ten: their price is that of the mean."""
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    edge = problem.fabric.nodes["E"]
    window_ms = problem.window_ms
    bursts = Bursts(Constant(45 * window_ms), Constant(5 * window_ms), threads=32)
    nodes = {**problem.fabric.nodes, "E": replace(edge, bursts=bursts)}
    problem = replace(problem, fabric=replace(problem.fabric, nodes=nodes))
    price = prices_of(problem)["SO"]
    assert price.violation_rate < 0.2
    deviations = price.l95_deviation_ms, price.violation_deviation
    played = Expected.of_estimate(price.qos, deviations, problem.window_cycles)
    assert played.agrees_with(seen(99, problem.censor_ms, 1.0, 100))


# ------------------------------------------------------------------------------------- in a fleet


def cell_of(stress_threads: int, for_s: float = FOR_S) -> Problem:
    """The canonical cell without tenants; foreign threads on E for 0.4 of each second.

    The load of such a node is that of a few threads that are always there, next to which no job
    would be late.
    """
    cell = dwell.load(EXAMPLES / "canonical.yaml")
    nodes = {**cell.fabric.nodes, "E": replace(cell.fabric.nodes["E"], bursts=None)}
    episodes = Episodes("gusts", Constant(0.6), Constant(0.4))
    item = NodeDisturbance("E", AT_S, for_s, stress_threads=stress_threads, episodes=episodes)
    fabric = replace(cell.fabric, nodes=nodes)
    return replace(cell, fabric=fabric, scenarios={"gusts": (item,)})


def played(estimator: str, rule: Coordination = "ledger", stress_threads: int = 16) -> FleetRun:
    fleet = Fleet(
        "hall", (FleetEntry(cell_of(stress_threads), 4, "gusts"),), ("E",), "random", rule
    )
    return dwell.simulate_fleet(fleet, seed=1, windows=45, estimator=estimator)


def away(run: FleetRun) -> set[int]:
    """Windows at which the record of any cell says that its windows are not what was played."""
    rows = run.decisions.filter(pl.col("refused").str.ends_with(NOT_AS_PLAYED))
    return set(rows["window"].to_list())


def test_cells_leave_phi_while_their_windows_are_not_what_was_played() -> None:
    run = played("corrected")
    found = away(run)
    assert found
    assert min(found) >= 13
    # They are back two windows after the end.
    assert 29 in found or 28 in found
    assert max(found) <= 34


def test_a_cell_that_has_left_takes_no_more_of_a_shared_node() -> None:
    run = played("corrected")
    moves = run.decisions.filter(pl.col("migrated") & (pl.col("placement") != "LOC"))
    later = moves.filter(pl.col("window").is_in(list(away(run))))
    for cell, window in later.select("cell", "window").iter_rows():
        rows = run.decisions.filter((pl.col("cell") == cell) & (pl.col("window") == window))
        assert not rows["refused"].fill_null("").str.ends_with(NOT_AS_PLAYED).any()


def test_with_the_profile_the_record_says_it_and_nothing_follows() -> None:
    run = played("profile")
    assert away(run)
    rows = run.decisions.filter(pl.col("refused").str.ends_with(NOT_AS_PLAYED))
    assert not rows["migrated"].any()
    # The cells stay in Φ: all of them are on SO, as before.
    assert run.decisions["placement"].tail(1).to_list() == ["SO"]


def test_fleets_that_nothing_happens_to_stay_in_phi() -> None:
    assert not away(played("corrected", stress_threads=0))


# ---------------------------------------------------------------------------------- a cell alone


def alone(estimator: str, windows: int = 45, for_s: float = FOR_S) -> dwell.Run:
    problem = cell_of(16, for_s)
    return dwell.simulate(
        problem, scenario="gusts", policy="dtp", estimator=estimator, seed=1, windows=windows
    )


@pytest.mark.parametrize("estimator", ["corrected", "shadow", "scaling"])
def test_an_incumbent_that_is_not_as_estimated_is_priced_by_what_was_seen(estimator: str) -> None:
    run = alone(estimator)
    rows = run.decisions.join(run.windows.select("window", "violation_rate"), on="window")
    off_so = rows.filter((pl.col("incumbent") == "SO") & pl.col("migrated"))
    assert off_so.height
    first = off_so.row(0, named=True)
    assert first["est_violation_rate_SO"] == first["violation_rate"] > 0.3
    # The others are priced as before.
    assert first["est_violation_rate_HYB"] < 0.01
    # Back at once it would be wrong again: it is doubted for some windows.
    after = rows.filter(pl.col("window").is_between(first["window"] + 1, first["window"] + 7))
    assert (after["est_violation_rate_SO"] > 0.3).all()
    assert "LOC" in after["placement"].to_list()


def test_most_windows_are_spent_where_the_price_holds() -> None:
    windows = alone("corrected", 120, 1e6).windows.filter(pl.col("window") >= 30)
    assert (windows["placement"] == "LOC").to_numpy().mean() > 0.7


def test_doubts_last_twice_as_long_each_time() -> None:
    doubts = Doubts(10)
    for span in (8, 16, 32):
        doubts.change("SO", 100, trusts=False)
        assert doubts.at(100 + 10 * span) == {"SO"}
        assert doubts.at(101 + 10 * span) == set()
    doubts.change("SO", 100, trusts=True)
    assert doubts.at(100) == set()
    assert repr(doubts) == "<Doubts of nothing>"
