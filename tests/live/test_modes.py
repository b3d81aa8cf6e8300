"""Rule 13 on the in-memory network: advice, and what people ask of a controller."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

import dwell
from dwell.dash.recorded_cell import RecordedCell
from dwell.live.wire import channels
from dwell.live.wire.messages import Ask, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from dwell.record import moves
from dwell.report.run_page import run_page
from tests.live.small_world import EXEC_MS, Recorded, World, canonical
from tests.report.pages import table_of


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC",), initial="SO")


def ask(world: World, what: str, about: str = "") -> str:
    """Ask as a person does; returns the refusal."""
    cell = world.cell
    sample = Arrival(world.keys.of(channels.ASK), encode(Ask("me", what, about)))
    before = cell._do(Ask("me", what, about), world.network.now_ns)
    cell.receive(sample, world.network.now_ns)
    return before


def require_unbroken(cycles: Iterable[int], world: World) -> None:
    """No cycle is missing, twice, or out of order."""
    assert all(later == earlier + 1 for earlier, later in pairwise(cycles))
    assert world.cycles[-1] >= world.stamper.cycle - 2


def test_advice_is_recorded_and_not_followed(problem: Problem) -> None:
    # LOC is slower than the cell file says of SO, and how busy this machine is does not count.
    weights = replace(problem.objective.weights, robot=0.0, edge=0.0)
    moving = replace(
        problem,
        controller=replace(problem.controller, initial="LOC"),
        objective=replace(problem.objective, weights=weights),
    )
    advised = replace(moving, live=replace(problem.live, mode="advise"))
    exec_ms = {**EXEC_MS, "perception": 28.0}
    moved, stayed = (World(cell, exec_ms=exec_ms, policy="dtp") for cell in (moving, advised))
    for world in (moved, stayed):
        world.run(15_000)
    assert moved.stamper.moves
    assert not stayed.stamper.moves
    rows = stayed.recorder.rows["decisions"]
    assert len(rows) >= 3
    names = stayed.cell.controller.decision_columns
    assert {dict(zip(names, row, strict=False))["placement"] for row in rows} - {"LOC"}


def test_a_pin_holds_against_the_policy_even_where_it_only_advises(problem: Problem) -> None:
    advised = replace(problem, live=replace(problem.live, mode="advise"))
    world = World(advised, policy="dtp")
    world.run(2_000)
    assert not ask(world, "pin", "HYB")
    world.run(8_000)
    assert world.stamper.placement == "HYB"
    assert world.status["pinned"] == "HYB"
    require_unbroken(world.cycles, world)


@pytest.mark.parametrize("every", [5, 20])
def test_moves_of_an_operator_are_rows_of_decisions(
    problem: Problem, tmp_path: Path, every: int
) -> None:
    decides = replace(problem.controller, decide_cycles=every, min_dwell_cycles=0)
    frequent = replace(problem, window_cycles=20, warmup_windows=0, controller=decides)
    world = Recorded(frequent, tmp_path, policy="SO")
    for what, about in (("pin", "HYB"), ("pin", "LOC"), ("unpin", ""), ("drain", "E")):
        world.run(2_500)
        assert not ask(world, what, about)
    world.run(2_500)
    folder = world.finish()
    run = dwell.open_run(folder)
    found = moves(run)
    assert [(move.source, move.target, move.reason) for move in found] == [
        ("SO", "HYB", "pinned"),
        ("HYB", "LOC", "pinned"),
        ("LOC", "SO", "migrate"),
        ("SO", "LOC", "drained"),
    ]
    assert [move.is_decided for move in found] == [False, False, True, False]
    placed, firsts = run.cycles["placement"].cast(str).to_list(), run.windows["first_cycle"]
    for move in found:
        if not move.is_decided:
            assert placed[move.cycle - 1 : move.cycle + 1] == [move.source, move.target]
            assert firsts[move.window] < move.cycle <= firsts[move.window + 1] + 20
            assert run.decisions["dwell"][move.row] == 0
    # The pages have the moves, too.
    rows = table_of(run_page(run), "migrations").rows
    assert [row["reason"] for row in rows] == ["pinned", "pinned", "migrate", "drained"]
    shown = RecordedCell(folder)
    assert shown.described()["about"]["policy"] == "Static"
    assert shown.described()["moves"] == {"migrations": 4, "returns": 1, "guard_moves": 0}
    texts = [event["text"] for event in shown.view(0.0, 20.0, 100)["events"]]
    assert {"SO → HYB: pinned", "HYB → LOC: pinned", "SO → LOC: drained"} <= {*texts}


def test_code_is_changed_by_draining_at_no_cycle_lost(problem: Problem) -> None:
    world = World(problem, policy="SO")
    world.run(2_000)
    assert world.stamper.placement == "SO"
    assert not ask(world, "drain", "E")
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    workers = [role.who for role in roles(world.problem) if role.node == "E" and role.works]
    assert workers
    for who in workers:
        world.kill(who)
    world.run(3_000)
    for who in workers:
        world.start(who)
    world.run(1_000)
    assert not ask(world, "undrain", "E")
    assert not ask(world, "pin", "SO")
    world.run(2_000)
    assert world.stamper.placement == "SO"
    assert not any(reason == "guard" for _, _, reason in world.stamper.moves)
    require_unbroken(world.cycles, world)


@pytest.mark.parametrize(
    ("questions", "refused"),
    [
        ([("pin", "NO")], "no candidate 'NO'; there are LOC, SO, HYB"),
        ([("drain", "X")], "no node 'X'; there are R1, E, R2"),
        ([("undrain", "X")], "no node 'X'; there are R1, E, R2"),
        ([("drain", "R1")], "every candidate needs R1; nothing could run"),
        (
            [("pin", "SO"), ("drain", "E")],
            "the cell is pinned to SO, which needs E; unpin it first",
        ),
        ([("drain", "E"), ("pin", "SO")], "SO needs E, which is drained"),
        ([("dance", "")], "unknown question 'dance'"),
    ],
)
def test_what_cannot_be_is_refused(
    problem: Problem, questions: list[tuple[str, str]], refused: str
) -> None:
    world = World(problem, policy="SO")
    world.run(1_000)
    *before, last = questions
    for question in before:
        assert not ask(world, *question)
    assert ask(world, *last) == refused
    world.run(1_000)
    require_unbroken(world.cycles, world)
