"""Faults by seed: none breaks a promise, and what is planted for each promise is found."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace as replaced

from dwell.control import Guard, Probation
from dwell.live.roles import health, run_rows, stamper, worker
from dwell.live.roles.controlled_cell import ControlledCell
from dwell.live.roles.role import RolePlace
from dwell.live.roles.sink import Sink
from dwell.live.roles.stamper import Stamper
from dwell.live.roles.worker import Worker
from dwell.live.wire import channels
from dwell.live.wire.continuity import RESERVED, RunClaims
from dwell.live.wire.messages import ACTUATED, Accepted, Hop, Order, Stamped
from dwell.live.wire.routing import Routes
from dwell.record import Row, Values, row_of
from dwell_lab.chaos.faults import PlannedFault
from dwell_lab.chaos.light_cell import CANDIDATES
from tests.live.seeded_faults import (
    FaultyWorld,
    Plan,
    Touring,
    campaign,
    faults_in_memory,
    main,
    play,
    shrunk,
    table,
)

#: Seeds of a block; all blocks together bring 100 faults. `make seeds` plays 1,000.
BLOCK, BLOCKS = 25, 3
Patch = Callable[[pytest.MonkeyPatch], None]


def plan(wish: str, *names: str, lasts_s: float = 0.8) -> Plan:
    known = {fault.name: fault for fault in faults_in_memory()}
    faults = (
        PlannedFault(number, known[name], 0.3, lasts_s, 0.0) for number, name in enumerate(names, 1)
    )
    return Plan(1, wish, 0.2, tuple(faults))


@pytest.mark.parametrize("block", range(BLOCKS))
def test_no_fault_breaks_a_promise(block: int) -> None:
    wrong = {}
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        played = play(Plan.of(seed))
        if played.wrong:
            wrong[played.plan.command()] = played.wrong
    assert not wrong


def test_there_are_100_faults_of_every_kind() -> None:
    faults = [one.fault for seed in range(BLOCK * BLOCKS) for one in Plan.of(seed).faults]
    assert len(faults) >= 100
    assert {fault.kind for fault in faults} == {fault.kind for fault in faults_in_memory()}


# ---------------------------------------------------------------------------- planted faults


def around(
    patch: pytest.MonkeyPatch, owner: type, name: str, change: Callable[..., object]
) -> None:
    """Replace a method; the replacement gets the original method as its first argument."""
    original = getattr(owner, name)
    patch.setattr(owner, name, lambda *given, **named: change(original, *given, **named))


def applies_what_is_behind(patch: pytest.MonkeyPatch) -> None:
    def gate(self: Sink, header: Any, now_ns: int) -> str:
        self.newest = header.stamp.key
        return ACTUATED

    patch.setattr(Sink, "_gate", gate)


def applies_what_is_old(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Sink, "age_ns", lambda *_: 0)


def never_holds(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Sink, "wake", lambda self, now_ns: self.pulse.wake(now_ns))


def sends_the_output_before(patch: pytest.MonkeyPatch) -> None:
    run = Worker.run

    def late(self: Worker, job: Any, started_ns: int) -> Any:
        output, age = run(self, job, started_ns)
        before = vars(self).setdefault("_before", output)
        vars(self)["_before"] = output
        return before, age

    patch.setattr(Worker, "run", late)


def started_again(change: Callable[[Stamper], None]) -> Patch:
    """Have a stamper that goes on do so with something changed."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        init = Stamper.__init__

        def begun(self: Stamper, *arguments: Any) -> None:
            init(self, *arguments)
            if self.cycle:
                change(self)

        patch.setattr(Stamper, "__init__", begun)

    return plant


def begins_a_run(role: Stamper) -> None:
    role.course.run += 1


def stamps_numbers_again(role: Stamper) -> None:
    role.cycle -= RESERVED


def goes_back_a_term(role: Stamper) -> None:
    role.course.term -= 1


def moves_within_a_term(patch: pytest.MonkeyPatch) -> None:
    def moved(move: Any, self: Stamper, placement: str, *, by_guard: bool) -> None:
        move(self, placement, by_guard=by_guard)
        self.course.term -= by_guard

    around(patch, Stamper, "_move", moved)


def stamps_what_is_no_candidate(patch: pytest.MonkeyPatch) -> None:
    def stamped(**about: Any) -> Stamped:
        return Stamped(**{**about, "placement": about["placement"].lower()})

    patch.setattr(stamper, "Stamped", stamped)


def answers(**changes: Any) -> Patch:
    """Have the stamper answer orders that move the cell with something changed."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        def changed(
            answer: Any, self: Stamper, order: Order, refused: str, now_ns: int
        ) -> Accepted:
            said: Accepted = answer(self, order, refused, now_ns)
            return replaced(said, **changes) if order.placement and not refused else said

        around(patch, Stamper, "_answer", changed)

    return plant


def takes_orders_of_any_term(patch: pytest.MonkeyPatch) -> None:
    def weighed(refusal: Any, self: Stamper, order: Order, now_ns: int) -> Any:
        return refusal(self, replaced(order, term=self.term) if order.term else order, now_ns)

    def sent(send: Any, self: ControlledCell, order: Order) -> None:
        send(self, replaced(order, term=order.term - 1) if order.term > 1 else order)

    around(patch, Stamper, "_refusal", weighed)
    around(patch, ControlledCell, "_send", sent)


def sends_everywhere(patch: pytest.MonkeyPatch) -> None:
    routes = Routes.destinations

    def all_of_them(self: Routes, task: str, stamp: Any, *node: str, shadow: bool = False) -> Any:
        for name in CANDIDATES:
            yield from routes(self, task, replaced(stamp, placement=name), *node, shadow=shadow)

    patch.setattr(Routes, "destinations", all_of_them)


def says_it_ran_elsewhere(patch: pytest.MonkeyPatch) -> None:
    def hop(task: str, node: str, *about: Any) -> Hop:
        return Hop(task, "R1" if task == "perception" else node, *about)

    patch.setattr(worker, "Hop", hop)


def says_what_nobody_reads(patch: pytest.MonkeyPatch) -> None:
    def torn(sealed: Any, self: RolePlace, channel: Any, message: Any) -> bytes:
        data: bytes = sealed(self, channel, message)
        return data[:-1] if channel is channels.DONE else data

    around(patch, RolePlace, "sealed", torn)


def trusts_a_book_of_another_boot(patch: pytest.MonkeyPatch) -> None:
    init = Stamper.__init__

    def begun(self: Stamper, place: Any, book: Any, run: int, now_ns: int, boot: str = "") -> None:
        init(self, place, book, run, now_ns, book.entry.boot if book.entry else boot)

    patch.setattr(Stamper, "__init__", begun)


def hears_of_no_run(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(RunClaims, "believed", lambda *_: False)
    patch.setattr(RunClaims, "below", lambda *_: True)


def migrates_at_once(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Touring, "STAY", 0)
    init = ControlledCell.__init__

    def hasty(self: ControlledCell, place: Any, controller: Any, *more: Any) -> None:
        controller.min_dwell = 0
        init(self, place, controller, *more)

    patch.setattr(ControlledCell, "__init__", hasty)


def guard_never_fires(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Guard, "check", lambda *_: None)


def nothing_is_ever_proven(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Probation, "proven", lambda *_: False)


def stamper_fails_at_a_setback(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Stamper, "_begin_anew", lambda self, now_ns: {}[now_ns])


def guard_watches_the_actuator(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(stamper, "HANDED_OVER", (ACTUATED,))


def records_what_was_not(patch: pytest.MonkeyPatch) -> None:
    def told(types: Any, values: Values) -> Row:
        changed = {"actuated": True} if "actuated" in values else {}
        return row_of(types, {**values, **changed})

    patch.setattr(run_rows, "row_of", told)


def overlooks_the_actuator(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(health, "_uneven", lambda *_: iter(()))


PLANTED: dict[str, tuple[Patch, Plan, str]] = {
    "order": (applies_what_is_behind, plan("LOC", "freeze control@R2"), "actuated after"),
    "age": (applies_what_is_old, plan("LOC", "freeze all of R2"), "after it was stamped"),
    "safe state": (
        never_holds,
        plan("LOC", "freeze control@R2 and its standby"),
        "and no hold() within",
    ),
    "payload": (sends_the_output_before, plan("LOC", "cut R1->E"), "carries"),
    "one run": (started_again(begins_a_run), plan("LOC", "kill stamper@R1"), "is of run"),
    "numbers grow": (
        started_again(stamps_numbers_again),
        plan("LOC", "kill stamper@R1"),
        "is stamped after",
    ),
    "terms grow": (
        started_again(goes_back_a_term),
        plan("", "kill stamper@R1"),
        "after term",
    ),
    "one placement a term": (moves_within_a_term, plan("SO", "kill all of E"), "two placements"),
    "candidates": (stamps_what_is_no_candidate, plan("LOC", "cut R1->E"), "no candidate"),
    "orders of this run": (answers(run=7), plan("", "cut R1->E"), "is accepted in run 7"),
    "orders of this term": (answers(term=99), plan("", "cut R1->E"), "is accepted in term 99"),
    "orders of no old term": (takes_orders_of_any_term, plan("", "cut R1->E"), "is accepted after"),
    "orders get what they ask for": (
        answers(placement="?"),
        plan("", "cut R1->E"),
        "asks for",
    ),
    "routes": (sends_everywhere, plan("LOC", "cut R1->E"), "LOC has it on"),
    "hops": (says_it_ran_elsewhere, plan("SO", "cut R1->R2"), "not where SO has it"),
    "messages": (says_what_nobody_reads, plan("LOC", "cut R1->E"), "/done/control: "),
    "a loss of power": (
        trusts_a_book_of_another_boot,
        plan("LOC", "power R1"),
        "is stamped after",
    ),
    "an empty state": (hears_of_no_run, plan("LOC", "blank R1"), "is of run"),
    "migrations": (migrates_at_once, plan("", "cut R1->R2"), "cycles apart"),
    "bound": (guard_never_fires, plan("SO", "kill all of E"), "consecutive cycles lost by it"),
    "return": (nothing_is_ever_proven, plan("SO", "kill all of E"), "waited 60 s"),
    "no process ends": (
        stamper_fails_at_a_setback,
        plan("LOC", "jump -200 ms R1"),
        "has ended by itself",
    ),
    "actuator": (
        guard_watches_the_actuator,
        plan("LOC", "fail the actuator of sink.control@R2"),
        "the guard has moved",
    ),
    "health": (overlooks_the_actuator, plan("LOC", "camera 0.27"), "status reads ok"),
    "record": (records_what_was_not, plan("LOC", "kill planning@R2"), "actuated by the record"),
}


@pytest.mark.parametrize("promise", PLANTED)
def test_what_is_planted_for_a_promise_is_found(
    promise: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, faults, words = PLANTED[promise]
    plant(monkeypatch)
    assert words in "; ".join(play(faults).wrong)


def test_what_was_planted_breaks_nothing_when_it_is_gone() -> None:
    for faults in dict.fromkeys(faults for _, faults, _ in PLANTED.values()):
        assert not play(faults).wrong, faults.command()


# -------------------------------------------------------------------------- seeds and commands


def test_a_seed_gives_the_same_run_to_the_nanosecond() -> None:
    seed = next(seed for seed in range(100) if len(Plan.of(seed).faults) == 4)
    digest = play(Plan.of(seed)).digest
    assert play(Plan.of(seed)).digest == digest
    words = [sys.executable, "-m", "tests.live.seeded_faults", "--seed", str(seed)]
    elsewhere = subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
        env={**os.environ, "PYTHONHASHSEED": "5"},
    )
    assert json.loads(elsewhere.stdout)["digest"] == digest


def test_a_failing_seed_is_shrunk_to_a_command_that_shows_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    applies_what_is_behind(monkeypatch)
    three = plan("LOC", "cut E->R1", "freeze control@R2", "double R1->E 0.5")
    found = play(three).wrong
    assert found
    smaller = shrunk(three, found)
    (fault,) = smaller.faults
    assert fault.fault.name == "freeze control@R2"
    assert fault.lasts_s < 0.8
    command = shlex.split(smaller.command())
    assert command[:3] == ["python", "-m", "tests.live.seeded_faults"]
    assert main(command[3:]) == 1
    assert smaller.command() in capsys.readouterr().out


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    rows = campaign(tmp_path, 3)
    with (tmp_path / "runs.jsonl").open("a") as file:
        file.write('{"seed": 1')
    again = campaign(tmp_path, 6)
    assert again[: len(rows)] == rows
    assert [row["seed"] for row in again] == list(range(len(again)))
    count = sum(len(row["kinds"]) for row in again)
    assert count >= 6
    *_, last = table(again)
    assert last.startswith(f"| all | {count} |")


def test_a_cell_that_rests_is_at_home() -> None:
    world = FaultyWorld(plan("SO"))
    world.run(1_000)
    assert world.away("SO") == ""
    assert world.away("LOC") == "it is at SO"
    assert world.wrong == []
