from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import (
    Accepted,
    Completion,
    Header,
    Hop,
    Order,
    Stamp,
    Stamped,
    encode,
)
from dwell.model import Problem
from dwell_lab.chaos.actuations import Seen
from dwell_lab.chaos.invariants import Judge
from dwell_lab.chaos.light_cell import MIN_DWELL, WINDOW_CYCLES, document
from dwell_lab.chaos.stages import APPLY, HOLD

RUN = 7


@dataclass
class Wire:
    judge: Judge
    now_ns: int = 0
    number: int = 0

    def say(self, key: str, payload: bytes = b"", header: bytes = b"") -> list[str]:
        self.now_ns += 1_000
        return list(self.judge.hear(self.now_ns, key, payload, header))

    @property
    def keys(self) -> Keys:
        return Keys(self.judge.problem.name)

    def stamp(self, cycle: int, term: int, placement: str, run: int = RUN) -> list[str]:
        return self.say(
            self.keys.of(channels.STAMPED), encode(Stamped(run, cycle, term, placement, 0))
        )

    def order(self, term: int, placement: str) -> Order:
        self.number += 1
        order = Order(self.number, "controller-1", RUN, term, placement)
        assert self.say(self.keys.of(channels.ORDER), encode(order)) == []
        return order

    def accept(
        self, order: Order, term: int, placement: str, cycle: int, *, fallback: bool = False
    ) -> list[str]:
        answer = Accepted(
            *(order.number, order.controller, "", RUN, term, placement, cycle), fallback=fallback
        )
        return self.say(self.keys.of(channels.ACCEPTED), encode(answer))

    def route(self, task: str, node: str, stamp: Stamp, kind: str = "main") -> list[str]:
        header = encode(Header(stamp, "stamper", "R1", "none"))
        return self.say(self.keys.of(channels.INPUT, task, node, kind), header=header)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return from_document(document("SO"))


@pytest.fixture
def wire(problem: Problem) -> Wire:
    return Wire(Judge(problem))


def test_what_is_right_is_not_found_wrong(wire: Wire) -> None:
    assert wire.stamp(0, 1, "SO") == []
    order = wire.order(1, "LOC")
    assert wire.accept(order, 2, "LOC", 1) == []
    assert wire.stamp(1, 2, "LOC") == []
    assert wire.route("perception", "R1", Stamp(RUN, 1, 2, "LOC", 0)) == []
    assert wire.route("perception", "E", Stamp(RUN, 1, 2, "LOC", 0, "SO"), "shadow") == []
    assert (
        wire.route("perception", "E", Stamp(RUN, 1, 2, "LOC", 0, "", (("perception", "E"),))) == []
    )
    assert wire.judge.migrations() == []


@pytest.mark.parametrize(
    ("later", "wrong"),
    [
        ((5, 1, "SO"), "stamped after"),
        ((4, 1, "SO"), "stamped after"),
        ((6, 0, "SO"), "after term 1"),
        ((6, 2, "NOWHERE"), "no candidate"),
        ((6, 1, "LOC"), "two placements"),
        ((6, 1, "SO", RUN + 1), "of run"),
    ],
)
def test_stamps(wire: Wire, later: tuple[int, int, str], wrong: str) -> None:
    wire.stamp(5, 1, "SO")
    assert wrong in "; ".join(wire.stamp(*later))


def test_an_order_of_an_old_term_is_not_accepted(wire: Wire) -> None:
    wire.stamp(0, 1, "SO")
    order = wire.order(1, "HYB")
    wire.stamp(1, 2, "LOC")  # the guard was faster
    assert "after cycle 1 of term 2" in "; ".join(wire.accept(order, 3, "HYB", 2))


def test_an_answer_that_is_heard_before_its_order_is_held_against_it(wire: Wire) -> None:
    wire.stamp(0, 1, "SO")
    order = Order(1, "controller-1", RUN, 1, "HYB")
    assert wire.accept(order, 3, "HYB", 1) == []
    assert "accepted in term 3" in "; ".join(wire.say(wire.keys.of(channels.ORDER), encode(order)))


def test_an_order_that_was_accepted_before_the_guard_moved_may_be_answered_again(
    wire: Wire,
) -> None:
    wire.stamp(0, 1, "SO")
    order = wire.order(1, "HYB")
    assert wire.accept(order, 2, "HYB", 1) == []
    wire.stamp(1, 2, "HYB")
    wire.stamp(5, 3, "LOC")
    assert wire.accept(order, 2, "HYB", 1) == []


def test_an_order_gets_what_it_asks_for(wire: Wire) -> None:
    wire.stamp(0, 1, "SO")
    order = wire.order(1, "HYB")
    assert "asks for HYB and gets LOC" in "; ".join(wire.accept(order, 2, "LOC", 1))


@pytest.mark.parametrize(
    ("task", "node", "stamp", "kind", "wrong"),
    [
        ("sensing", "E", Stamp(RUN, 1, 1, "SO", 0), "main", "infeasible"),
        ("perception", "R2", Stamp(RUN, 1, 0, "SO", 0), "main", "infeasible"),
        ("perception", "R1", Stamp(RUN, 1, 1, "SO", 0), "main", "SO has it on E"),
        ("perception", "E", Stamp(RUN, 1, 1, "SO", 0, "LOC"), "shadow", "LOC has it on R1"),
        ("perception", "E", Stamp(RUN, 1, 1, "SO", 0), "shadow", "no candidate"),
        ("perception", "R1", Stamp(RUN, 1, 1, "OSO", 0), "main", "no candidate"),
    ],
)
def test_routes(wire: Wire, task: str, node: str, stamp: Stamp, kind: str, wrong: str) -> None:
    assert wrong in "; ".join(wire.route(task, node, stamp, kind))


def test_jobs_run_where_the_stamp_says(wire: Wire) -> None:
    hops = (Hop("perception", "R1", 0, 0, 0),)
    done = Completion(Stamp(RUN, 1, 1, "SO", 0), "control", 0, "actuated", hops, "R2")
    assert "ran on R1" in "; ".join(wire.say(wire.keys.of(channels.DONE, "control"), encode(done)))


@pytest.mark.parametrize(
    ("cycles", "held_before", "bad"),
    [
        (range(9), {}, False),
        (range(9), {4}, False),
        (range(9), {1, 4}, True),
        ([0, 1, 3, 4, 5, 6, 7, 8], {}, False),
        ([0, 1, 3, 5, 6, 7, 8], {}, True),
        ([0, 1, 3, 4, 5, 6, 7, 8], {7}, True),
    ],
)
def test_no_status_is_ok_while_the_actuator_lacks_commands(
    wire: Wire, cycles: Iterable[int], held_before: Container[int], bad: bool
) -> None:
    for cycle in range(9):
        wire.stamp(cycle, 1, "SO")
    seen = []
    for cycle in cycles:
        if cycle in held_before:
            seen.append(Seen(HOLD, "SO", 1, 0, 0, 0, 0))
        seen.append(Seen(APPLY, "SO", 1, cycle, cycle, 0, 0))
    recent = {"cycles": [(0, 2), (3, 5), (6, 8)]}
    found = wire.judge.looked({"health": "ok", "recent": recent}, seen)
    assert [wrong.partition(":")[0] for wrong in found] == ["status reads ok"] * bad
    assert not wire.judge.looked({"health": "degraded", "recent": recent}, seen)


def test_what_cannot_be_decoded_is_wrong(wire: Wire) -> None:
    assert wire.say(wire.keys.of(channels.STAMPED), b"\xff")


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize(
    ("settings", "apart"),
    [
        ({"decide_cycles": WINDOW_CYCLES}, (MIN_DWELL + 1) * WINDOW_CYCLES),
        # By the interval of decisions: max(N_min W, min_dwell_cycles) + d cycles.
        ({"decide_cycles": 1}, MIN_DWELL * WINDOW_CYCLES + 1),
        ({"decide_cycles": 2, "min_dwell": 0}, 2),
        ({"decide_cycles": 1, "min_dwell": 0, "min_dwell_cycles": 5}, 6),
    ],
)
def test_migrations_keep_their_distance(
    problem: Problem, settings: dict[str, Any], apart: int, early: bool
) -> None:
    controller = replace(problem.controller, **settings)
    wire = Wire(Judge(replace(problem, controller=controller)))
    later = 10 + apart - early
    wire.stamp(0, 1, "SO")
    first = wire.order(1, "LOC")
    wire.accept(first, 2, "LOC", 10)
    wire.stamp(10, 2, "LOC")
    second = wire.order(2, "SO")
    wire.accept(second, 3, "SO", later)
    wire.stamp(later, 3, "SO")
    assert len(wire.judge.migrations()) == early
    assert wire.judge.migrations() == []


def test_moves_of_the_guard_may_come_at_any_time(wire: Wire) -> None:
    wire.stamp(0, 1, "SO")
    wire.accept(wire.order(1, "LOC"), 2, "LOC", 10)
    wire.stamp(10, 2, "LOC")
    wire.stamp(12, 3, "HYB")
    wire.accept(wire.order(3, ""), 3, "HYB", 13, fallback=True)
    assert wire.judge.migrations() == []


def test_recovery_is_a_cycle_that_an_order_stands_behind(wire: Wire) -> None:
    wire.stamp(0, 1, "SO")
    wire.stamp(1, 2, "LOC")
    wire.accept(wire.order(2, ""), 2, "LOC", 2, fallback=True)
    since_ns = wire.now_ns
    wire.stamp(2, 2, "LOC")
    assert wire.judge.ordered_since(since_ns) is None
    wire.accept(wire.order(2, "SO"), 3, "SO", 3)
    wire.stamp(3, 3, "SO")
    assert wire.judge.ordered_since(since_ns) == wire.now_ns
