"""The ledger of a fleet: moves are good for all, finite, and never over another's cap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dwell
from dwell.cellfile import from_document
from dwell.control import Controller
from dwell.control.coordination import Coordination, Verdict, Wish
from dwell.control.fleet_rank import MostServed
from dwell.control.ledger import FleetLedger, Loads, PricedCell, Seat
from dwell.estimators.load_table import LoadColumn, LoadTable
from dwell.estimators.present import Present
from dwell.model import Decision, FrozenDict, MissCap, Problem, QoS
from dwell.model.fleet import FleetObjective
from dwell.model.process import Constant
from dwell.model.qos import Reason

EXAMPLES = Path(__file__).parents[2] / "examples"
CANONICAL = dwell.load(EXAMPLES / "canonical.yaml")


def with_cores(problem: Problem, cores: int) -> Problem:
    """Return a cell with an edge of so many cores, and no tenants there."""
    nodes = dict(problem.fabric.nodes)
    nodes["E"] = replace(nodes["E"], cores=cores, bursts=None)
    return replace(problem, fabric=replace(problem.fabric, nodes=nodes))


def stressed(problem: Problem) -> Problem:
    """Return a cell whose robot cannot look at a picture in time."""
    tasks = dict(problem.pipeline.tasks)
    perception = tasks["perception"]
    slow = replace(perception.on["R1"], exec_ms=Constant(31.0))
    tasks["perception"] = replace(perception, on={**perception.on, "R1": slow})
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))


def cells_of(problem: Problem, count: int) -> list[PricedCell]:
    """Return cells of one kind, evenly spread over their period."""
    found = []
    for i in range(count):
        phase_ms = problem.pipeline.period_ms * i / count
        own = replace(problem, pipeline=replace(problem.pipeline, phase_ms=phase_ms))
        found.append(PricedCell(f"cell-{i + 1:02}", own, "" if i == 0 else f"cell-{i + 1}/"))
    return found


def priced(problem: Problem, here: str, wished: str, costs: Mapping[str, float]) -> Decision:
    """Return the decision of a policy that prices."""
    migrated = wished != here
    reason: Reason = "migrate" if migrated else "hold"
    return Decision(problem.candidates[wished], wished, migrated, reason, FrozenDict(costs))


def settle(ledger: FleetLedger, rounds: int = 50) -> list[tuple[int, str, Verdict]]:
    """Have cells look at their candidates in turns until none moves; return the moves."""
    moves: list[tuple[int, str, Verdict]] = []
    #: By round, cells served before and after it, the fall of Φ, and the sum of what is owed.
    changes: dict[int, tuple[int, int, float, float]] = {}
    for _ in range(rounds):
        before = len(moves)
        for i, cell in enumerate(ledger.cells):
            here = ledger.placements[i]
            costs = dict.fromkeys(cell.problem.candidates, 0.0)
            if isinstance(ledger.rank, MostServed):
                served = sum(ledger.rank.served(ledger.prices.price(tuple(ledger.placements))))
            owed = {name: ledger.owed(i, name) for name in costs}
            verdict = ledger.consider(i, priced(cell.problem, here, here, costs), by_price=True)
            if verdict.name != here:
                assert ledger.placements[i] == verdict.name
                first, last, number = verdict.asked
                assert first is not None
                assert last is not None
                assert number is not None
                if ledger.objective == "sum":
                    assert first - last > owed[verdict.name]
                if isinstance(ledger.rank, MostServed):
                    more = sum(ledger.rank.served(ledger.prices.price(tuple(ledger.placements))))
                    # The members of a set move one after another, in one round.
                    begin, _, _, due = changes.get(number, (served, 0, 0.0, 0.0))
                    changes[number] = begin, more, first - last, due + owed[verdict.name]
                moves.append((i, verdict.name, verdict))
        if len(moves) == before:
            assert all(
                more > served or (more == served and fall > due)
                for served, more, fall, due in changes.values()
            )
            return moves
    raise AssertionError("cells do not come to rest")


def wrong_table(cells: list[PricedCell], seed: int) -> LoadTable:
    """Return a table of loads that says anything."""
    rng = np.random.default_rng(seed)
    table = LoadTable(cells, ["E"], cycles=1)
    for group, column in table.columns.items():
        size = len(column.level)
        l95_ms, rate = rng.uniform(1, 100, size), rng.uniform(0, 1, size)
        table.columns[group] = LoadColumn(column.level, l95_ms, rate, rate, rate)
    return table


@settings(max_examples=15, deadline=None)
@given(
    count=st.integers(2, 5),
    cores=st.integers(1, 4),
    seed=st.integers(0, 1000),
    objective=st.sampled_from(["sum", "worst", "served"]),
    slow=st.lists(st.booleans(), min_size=5, max_size=5),
)
def test_moves_are_finite_and_lower_the_played_phi_whatever_the_table_says(
    count: int, cores: int, seed: int, objective: FleetObjective, slow: list[bool]
) -> None:
    plain = with_cores(CANONICAL, cores)
    cells = cells_of(plain, count)
    for i, is_slow in enumerate(slow[:count]):
        if is_slow:
            cells[i] = replace(cells[i], problem=stressed(cells[i].problem))
    ledger = FleetLedger(cells, ["E"], objective, table=wrong_table(cells, seed))
    at_first = ledger.prices.price(tuple(ledger.placements)).phi
    moves = settle(ledger)
    at_last = ledger.prices.price(tuple(ledger.placements)).phi
    least = min(cell.problem.controller.min_improvement for cell in cells)
    if objective == "sum":
        assert len(moves) * least <= at_first - at_last + 1e-9


def test_a_right_table_leads_to_where_no_single_move_is_any_better() -> None:
    cells = cells_of(stressed(with_cores(CANONICAL, 4)), 6)
    ledger = FleetLedger(cells, ["E"])
    assert settle(ledger)
    held = tuple(ledger.placements)
    phi = ledger.prices.price(held).phi
    for i, cell in enumerate(cells):
        for name in cell.problem.candidates:
            moved = (*held[:i], name, *held[i + 1 :])
            if name != held[i]:
                assert phi - ledger.prices.price(moved).phi <= ledger.owed(i, name) + 0.05 * phi


def test_the_worst_cell_counts_before_the_sum() -> None:
    cells = cells_of(stressed(with_cores(CANONICAL, 3)), 5)
    by_sum, by_worst = FleetLedger(cells, ["E"]), FleetLedger(cells, ["E"], "worst")
    settle(by_sum)
    settle(by_worst)
    sums = by_sum.prices.price(tuple(by_sum.placements))
    worst = by_worst.prices.price(tuple(by_worst.placements))
    least = cells[0].problem.controller.min_improvement
    assert max(worst.costs) <= max(sums.costs) + least


def test_at_least_as_many_cells_are_served_as_by_the_other_objectives() -> None:
    """Six robots are slow, and the edge has room for two."""
    cells = cells_of(stressed(with_cores(CANONICAL, 2)), 6)
    served: dict[FleetObjective, int] = {}
    for objective in ("sum", "worst", "served"):
        ledger = FleetLedger(cells, ["E"], objective)
        settle(ledger)
        price = ledger.prices.price(tuple(ledger.placements))
        served[objective] = sum(
            cell is not None and cell.qos.violation_rate <= 0.05 for cell in price.cells
        )
    assert served["served"] == max(served.values()) == 2


@pytest.mark.parametrize("capped", ["latency", "misses"])
def test_no_cell_is_moved_over_a_cap_of_another_one(capped: str) -> None:
    problem = stressed(with_cores(CANONICAL, 2))
    # All at once, so that two on E are in each other's way.
    cells = [replace(cell, problem=problem) for cell in cells_of(problem, 3)]
    plain = FleetLedger(cells, ["E"])
    seen = [plain.prices.price(("HYB", name, "LOC")).cells[0] for name in ("LOC", "HYB")]
    alone_ms, beside_ms = (cell.qos.l95_ms for cell in seen if cell is not None)
    between_ms = (alone_ms + beside_ms) / 2
    caps = replace(problem.objective.caps, latency_ms=between_ms)
    assert alone_ms + 1 < beside_ms
    tight = problem
    if capped == "misses":
        caps = replace(problem.objective.caps, misses=MissCap(2, 20))
        tight = replace(problem, pipeline=replace(problem.pipeline, deadline_ms=between_ms))
    tight = replace(tight, objective=replace(problem.objective, caps=caps))
    wished = priced(problem, "LOC", "HYB", dict.fromkeys(problem.candidates, 0.0))
    answers = []
    for first in (cells[0], replace(cells[0], problem=tight)):
        ledger = FleetLedger([first, *cells[1:]], ["E"], table=plain.table)
        ledger.place(0, "HYB")
        answers.append(ledger.consider(1, wished, by_price=True))
    assert answers[0].name != "LOC"
    assert (answers[1].name, answers[1].why) == ("LOC", "cap of cell-01")


def test_a_cell_that_somebody_else_has_moved_is_load_from_then_on() -> None:
    problem = stressed(with_cores(CANONICAL, 2))
    cells = cells_of(problem, 3)
    ledger, costs = FleetLedger(cells, ["E"]), dict.fromkeys(problem.candidates, 0.0)
    assert ledger.consider(0, priced(problem, "LOC", "LOC", costs), by_price=True).name != "LOC"
    crowded = FleetLedger(cells, ["E"])
    Seat(crowded, 1).place("SO")
    Seat(crowded, 2).place("SO")
    assert crowded.placements == ["LOC", "SO", "SO"]
    assert crowded.consider(0, priced(problem, "LOC", "LOC", costs), by_price=True).name == "LOC"


def test_nothing_is_played_twice_while_nothing_is_new() -> None:
    cells = cells_of(stressed(with_cores(CANONICAL, 2)), 3)
    ledger = FleetLedger(cells, ["E"])
    settle(ledger)
    rounds = ledger.round
    settle(ledger)
    assert ledger.round == rounds


def test_a_policy_without_prices_is_let_through_or_refused() -> None:
    problem = stressed(with_cores(CANONICAL, 2))
    ledger = FleetLedger(cells_of(problem, 3), ["E"])

    def wishes(name: str) -> Decision:
        return Decision(problem.candidates[name], name, True, "migrate")

    assert ledger.consider(0, wishes("SO"), by_price=False).name == "SO"
    assert ledger.consider(1, wishes("SO"), by_price=False).name in ("SO", "LOC")
    verdict = ledger.consider(2, wishes("SO"), by_price=False)
    assert verdict.name == "LOC"
    assert str(verdict.why).startswith("ledger: Φ would rise by ")
    assert ledger.consider(2, wishes("SO"), by_price=False).why == verdict.why


def of_two_latencies(here_ms: float, there_ms: float, least: float) -> Problem:
    """Return a cell whose J is L95 / 100 ms."""
    return from_document(
        {
            "dwell": 1,
            "period_ms": 200,
            "window_cycles": 2,
            "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
            "tasks": {"a": {"on": {"R": {"exec_ms": here_ms}, "E": {"exec_ms": there_ms}}}},
            "candidates": {"LOC": {"a": "R"}, "SO": {"a": "E"}},
            "objective": {
                "weights": {
                    "latency": 1, "violations": 1, "robot": 0, "edge": 0, "switching": 0,
                },
                "targets": {"latency_ms": 100},
            },
            "controller": {"min_improvement": least},
        }
    )  # fmt: skip


@pytest.mark.parametrize("here_ms", range(10, 100, 5))
def test_a_fall_of_phi_equal_to_what_is_owed_moves_nothing(here_ms: int) -> None:
    for least, name in ((0.05, "LOC"), (0.05 - 1e-8, "SO")):
        problem = of_two_latencies(here_ms, here_ms - 5, least)
        wished = Decision(problem.candidates["SO"], "SO", True, "migrate")
        ledger = FleetLedger([PricedCell("one", problem, "")], ["E"])
        assert ledger.consider(0, wished, by_price=False).name == name


@pytest.mark.parametrize("steps", [10, 12, 14, 16])
def test_rounding_does_not_lift_the_worst_cost_to_the_next_multiple(steps: int) -> None:
    """A cost of 9 steps of 0.03 is a little more than 9 steps in floats."""
    problem = of_two_latencies(3 * steps, 3 * (steps - 1), 0.03)
    wished = Decision(problem.candidates["SO"], "SO", True, "migrate")
    ledger = FleetLedger([PricedCell("one", problem, "")], ["E"], "worst")
    assert ledger.consider(0, wished, by_price=False).name == "SO"


class Says(Coordination):
    """Says what it is told to."""

    def __init__(self, *names: str) -> None:
        self.names = list(names)

    def consider(self, wish: Wish) -> Verdict:
        return Verdict(self.names.pop(0), "because", (2.0, 1.0, 7))


def observed(problem: Problem, l95_ms: float) -> tuple[QoS, dict[str, float]]:
    shares = dict.fromkeys(problem.fabric.nodes, 0.2)
    return QoS(l95_ms, float(l95_ms > 33), shares), shares


def test_a_refused_move_leaves_the_policy_as_it_was() -> None:
    problem = replace(CANONICAL, controller=replace(CANONICAL.controller, min_dwell=0))
    controller = Controller(problem, "dtp", coordination=Says("LOC", "SO", "SO"))
    for window in range(2):
        proposal = controller.propose_by(*observed(problem, 100.0))
        controller.commit(proposal)
        assert controller.course.placement == ("LOC", "SO")[window]
    columns = *controller.decision_columns, "refused"
    first, second = (dict(zip(columns, row, strict=True)) for row in controller.decisions)
    wished = str(first["refused"]).partition(":")[0]
    assert first["refused"] == f"{wished}: because"
    assert not first["migrated"]
    assert (first["phi_before"], first["phi_after"], first["round"]) == (2.0, 1.0, 7)
    assert second["migrated"]
    assert second["placement"] == "SO"
    # The window after it pays for the move that was made, not for the one that was wished.
    assert controller.course.previous == "LOC"
    after = controller.propose_by(*observed(problem, 30.0))
    assert after.decision.name == "SO"


def test_a_fleet_moves_a_cell_that_its_policy_would_let_stay() -> None:
    controller = Controller(CANONICAL, "dtp", coordination=Says("HYB", "HYB"))
    controller.commit(controller.propose_by(*observed(CANONICAL, 20.0)))
    assert controller.course.placement == "HYB"
    assert controller.policy.incumbent == "HYB"  # type: ignore[attr-defined]
    controller.commit(controller.propose_by(*observed(CANONICAL, 20.0)))
    assert [row[6 - 4 + 1] for row in controller.decisions] == [True, False]


def test_cells_take_turns_in_sending_shadows() -> None:
    cells = cells_of(CANONICAL, 3)
    ledger = FleetLedger(cells, ["E"], table=wrong_table(cells, 0))
    release_ns = np.arange(0, 40_000_000_000, 33_333_333)
    turns = np.array([Seat(ledger, i).turns(release_ns) for i in range(3)])
    assert (turns.sum(axis=0) == 1).all()
    assert turns.any(axis=1).all()


def test_a_stress_that_windows_have_shown_is_in_what_is_played() -> None:
    ledger = FleetLedger(cells_of(with_cores(CANONICAL, 8), 2), ["E"])
    before = ledger.prices.price(("LOC", "LOC")).phi
    ledger.prices.begin([Present(threads=FrozenDict({"R1": 4.0}))] * 2)
    assert ledger.prices.price(("LOC", "LOC")).phi > before + 2


def test_reprs_are_short() -> None:
    cells = cells_of(CANONICAL, 2)
    ledger = FleetLedger(cells, ["E"], table=wrong_table(cells, 0))
    for one in (ledger, Seat(ledger, 0), ledger.prices, ledger.table):
        assert len(repr(one)) < 100


@given(seed=st.integers(0, 1000), data=st.data())
def test_what_a_move_changes_is_the_difference_of_all_costs(seed: int, data: st.DataObject) -> None:
    names = st.sampled_from(list(CANONICAL.candidates))
    placements = data.draw(st.lists(names, min_size=4, max_size=4))
    index, there = data.draw(st.integers(0, 3)), data.draw(names)
    loads = Loads(wrong_table(cells_of(CANONICAL, 4), seed))
    rng = np.random.default_rng(seed)
    alone = [{name: float(rng.uniform(1, 5)) for name in CANONICAL.candidates} for _ in range(4)]
    here = placements[index]
    moved = [*placements[:index], there, *placements[index + 1 :]]
    before, after = (sum(loads.costs(one, alone)) for one in (placements, moved))
    rise = loads.rise(loads.at(placements), index, here, there)
    rise += alone[index][there] - alone[index][here]
    if here != there:
        assert rise == pytest.approx(after - before)
