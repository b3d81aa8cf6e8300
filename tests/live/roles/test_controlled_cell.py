"""A live cell's controller on the in-memory network: windows, orders, people, its absence."""

from __future__ import annotations

import gc
import itertools
from dataclasses import replace

import pytest
from msgspec.structs import replace as replaced

from dwell.estimators import Corrected
from dwell.live.roles.run_rows import Rows
from dwell.live.wire import channels
from dwell.live.wire.messages import Answer, Ask, Order, Stamped, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from dwell.model.shadow_plan import shadow_stamps
from tests.live.memory_transport import Clock
from tests.live.small_world import MS, Alternating, World, canonical, columns

CONTROLLER = "controller@E"


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(20, min_dwell=1, estimator="profile")


class Uneven(Corrected):
    """An estimator that wants other shares of shadows under each placement."""

    @classmethod
    def from_problem(cls, problem: Problem) -> Uneven:
        made = cls(problem)
        made.shadow_fraction = {"LOC": 0.1, "SO": 0.4}
        return made


def alternating(problem: Problem) -> World:
    return World(problem, policy=Alternating("LOC", "SO"))


def ask(world: World, what: str, about: str = "") -> str:
    """Ask the controller as a person does; returns why it refuses, or nothing."""
    keys, heard = world.keys, list[str]()
    visitor = world.network.transport(f"visitor{world.network.now_ns}", "R1")
    visitor.subscribe(
        keys.of(channels.ANSWER, "me"), lambda s: heard.append(decode(s.payload, Answer).refused)
    )
    sample = Arrival(keys.of(channels.ASK), encode(Ask("me", what, about)))
    # It has no wire of the cell's: it talks to the controller alone.
    reach, world.network.reach = world.network.reach, None
    world.cell.receive(sample, world.network.now_ns)
    world.run(5)
    world.network.reach = reach
    visitor.close()
    return heard[-1]


def test_a_controller_that_is_not_in_charge_refuses_and_names_the_one_that_is(
    problem: Problem,
) -> None:
    world = World(problem, policy="LOC")
    world.run(3_000)
    world.network.freeze(CONTROLLER)
    world.run(1_200)
    assert world.order("LOC", controller="laptop") == ""
    world.network.thaw(CONTROLLER)
    world.run(600)
    for what, about in (("pin", "SO"), ("drain", "E"), ("unpin", "")):
        assert ask(world, what, about) == "another controller: laptop is in charge"
    assert ask(world, "status") == ""
    world.run(3_000)
    wishes = world.cell.wishes
    assert (wishes.pinned, wishes.drained, world.stamper.placement) == ("", set(), "LOC")
    # It takes charge again when the other one is silent.
    assert ask(world, "pin", "SO") == ""


def test_every_order_takes_effect_and_no_cycle_is_lost(problem: Problem) -> None:
    world = alternating(problem)
    world.run(12_000)
    moves = world.stamper.moves
    assert len(moves) >= 12
    assert {why for _, _, why in moves} == {"order"}
    assert world.cycles == list(range(world.cycles[0], world.cycles[-1] + 1))
    decided = [
        to
        for _, to, moved in columns(world, "decisions", "window", "placement", "migrated")
        if moved
    ]
    assert [to for _, to, _ in moves] == decided[: len(moves)]


def test_windows_begin_with_the_first_cycle_of_a_new_placement(problem: Problem) -> None:
    world = alternating(problem)
    world.run(8_000)
    windows = columns(world, "windows", "window", "first_cycle", "placement", "mixed", "lead")
    assert len(windows) >= 8
    assert not any(mixed for *_, mixed, _ in windows)
    for (_, first, before, _, _), (_, following, after, _, lead) in itertools.pairwise(windows):
        assert following == first + problem.window_cycles + lead
        assert before != after
        # The order travels: the close is at the release of a cycle that has the old stamp.
        assert lead >= 1


def listen(world: World) -> list[Stamped]:
    """Return the list to which every stamp is added from now on."""
    stamps: list[Stamped] = []
    visitor = world.network.transport("visitor", "R1")
    visitor.subscribe(
        world.keys.of(channels.STAMPED),
        lambda sample: stamps.append(decode(sample.payload, Stamped)),
    )
    # It has no wire of the cell's.
    world.network.reach = None
    return stamps


def test_each_placement_has_its_own_share_of_shadows_from_its_first_cycle(
    problem: Problem,
) -> None:
    """The order that leads to a placement carries its share."""
    settings = replace(problem.controller, estimator=f"{__name__}:Uneven")
    world = alternating(replace(problem, controller=settings))
    world.run(2_000)
    stamps = listen(world)
    world.run(8_000)
    names = list(problem.candidates)
    for name, fraction in (("LOC", 0.1), ("SO", 0.4)):
        mine = [stamp for stamp in stamps if stamp.placement == name]
        assert len(mine) >= 60
        for stamp in mine:
            first, others = stamp.cycle, [i for i in range(len(names)) if names[i] != name]
            (other,) = shadow_stamps(first, first + 1, others, fraction)
            assert stamp.shadow == ("" if other < 0 else names[other])


def test_the_stamper_sends_no_shadows_after_its_own_move_until_it_knows_the_share(
    problem: Problem,
) -> None:
    settings = replace(
        problem.controller, estimator=f"{__name__}:Uneven", fallbacks=("LOC",), initial="SO"
    )
    world = World(replace(problem, controller=settings), policy="SO")
    world.run(2_000)
    stamps = listen(world)
    world.run(1_000)
    assert {stamp.shadow for stamp in stamps} > {""}
    for who in ("controller@E", "perception@E", "planning@E"):
        world.kill(who)
    world.run(500)
    assert world.stamper.placement == "LOC"
    stamps.clear()
    world.run(2_000)
    assert {stamp.shadow for stamp in stamps} == {""}


def test_what_is_not_moved_has_no_lead(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    world.run(8_000)
    assert {lead for (lead,) in columns(world, "windows", "lead")} == {0}


def test_what_else_is_due_comes_between_an_order_and_its_record(problem: Problem) -> None:
    world, events = alternating(problem), list[str]()
    cell, recorder = world.cell, world.recorder
    wake, append = cell.wake, recorder.append

    def woken(now_ns: int) -> int:
        events.append("wake")
        return wake(now_ns)

    def hear(sample: Arrival) -> None:
        if sample.key == world.keys.of(channels.ORDER) and decode(sample.payload, Order).placement:
            events.append("order")

    def appended(rows: Rows, **meta: object) -> None:
        events.extend(["record"] if rows["windows"] else [])
        append(rows, **meta)

    cell.wake = woken  # type: ignore[method-assign]
    world.network.taps.append(hear)
    recorder.append = appended  # type: ignore[method-assign]
    world.run(8_000)
    orders = [place for place, event in enumerate(events) if event == "order"]
    assert len(orders) >= 8
    for place in orders[:-1]:
        assert events[place - 1 : place + 3] == ["wake", "order", "wake", "record"]


def test_what_is_remembered_is_none_of_the_garbage_collectors_business(problem: Problem) -> None:
    world = alternating(problem)
    world.run(8_000)
    windows = world.cell.windows
    assert windows is not None
    remembered = windows.record._recorded
    assert len(remembered) > 100
    for cycle in remembered:
        held = (cycle, cycle.reports, cycle.heard_ns, cycle.replaced, cycle.shifts)
        assert not any(map(gc.is_tracked, held))
        assert cycle.reports
        assert cycle.shifts


def test_decisions_that_are_recorded_are_not_kept(problem: Problem) -> None:
    world = alternating(problem)
    world.run(8_000)
    assert world.cell.controller.looked.window > 8
    assert len(world.cell.controller.decisions) < 2


def test_an_order_that_was_asked_for_anew_before_its_answer_came_is_no_move_of_the_guard(
    problem: Problem,
) -> None:
    world = alternating(problem)
    cell = world.cell
    send = cell._send

    def sent(order: Order) -> None:
        send(order)
        if order.placement and cell._move is not None:
            # As after a refusal for now: the answer to the first is still on its way.
            cell._move.order = replaced(order, number=cell._next_number())
            send(cell._move.order)

    cell._send = sent  # type: ignore[method-assign]
    world.run(12_000)
    assert len(world.stamper.moves) >= 12
    assert {why for _, _, why in world.stamper.moves} == {"order"}
    assert cell.moves["guard"] == 0
    assert not cell.course.by_guard
    assert "guard" not in {why for (why,) in columns(world, "decisions", "reason")}


def test_an_order_that_is_refused_for_now_is_asked_for_anew(problem: Problem) -> None:
    world = alternating(problem)
    world.run(3_000)
    numbers = list[int]()

    def hear(sample: Arrival) -> None:
        if sample.key == world.keys.of(channels.ORDER):
            order = decode(sample.payload, Order)
            numbers.extend([order.number] if order.placement else [])

    world.network.taps.append(hear)
    world.kill("perception@E")
    world.run(2_000)
    # The stamper answers an order that it has answered as it did before.
    assert len(set(numbers)) == len(numbers) > 10


def test_whom_the_stamper_tells_that_no_guard_moved_needs_no_proof(problem: Problem) -> None:
    world = alternating(problem)
    world.run(4_000)
    cell = world.cell
    # An order that was given up, and accepted after all; only its stamp was heard.
    cell.course.by_guard, cell.course.wanted = True, "SO"
    before = len(world.stamper.moves)
    world.run(6_000)
    assert not cell.course.by_guard
    assert len(world.stamper.moves) >= before + 6


def test_an_order_that_comes_after_the_guards_move_has_not_brought_it_about(
    problem: Problem,
) -> None:
    """Only stamps are heard, and the placement is the one that is ordered a little later."""
    twin, ordered_ns = alternating(problem), list[int]()

    def hear(sample: Arrival) -> None:
        if (
            sample.key == twin.keys.of(channels.ORDER)
            and decode(sample.payload, Order).placement == "LOC"
        ):
            ordered_ns.append(twin.network.now_ns)

    twin.network.taps.append(hear)
    twin.run(6_000)
    world = alternating(problem)
    world.network.advance(ordered_ns[0] - world.stamper.place.period_ns // 2)
    assert world.stamper.placement == "SO"
    world.network.cut("stamper@R1", "*", key="dwell/*/accepted")
    world.network.cut("agent@E", "*", key="dwell/*/gathered")
    world.move_by_guard("LOC")
    world.run(400)
    cell = world.cell
    assert (cell.course.term, cell.course.placement) == (world.stamper.term, "LOC")
    assert cell.course.by_guard
    assert cell.moves["guard"] == 1


def test_what_nobody_wants_any_more_is_probed_no_longer(problem: Problem) -> None:
    world = alternating(problem)
    world.run(2_000)
    stamper = world.stamper
    stamper.guard.adopt(stamper.placement, fallback=True)
    for number, want in enumerate(
        ("SO", "SO", "", "HYB", "no candidate"), stamper.newest_order + 1
    ):
        world.answer(Order(number, world.cell.name, stamper.run, stamper.term, want=want))
        assert stamper.guard.probation.wanted == (want if want in problem.candidates else None)


def test_a_lost_order_is_sent_again(problem: Problem) -> None:
    world = alternating(problem)
    world.network.impair(world.losing(0.6), CONTROLLER, "stamper@R1")
    world.run(12_000)
    assert len(world.stamper.moves) >= 6
    assert world.cycles == list(range(world.cycles[0], world.cycles[-1] + 1))


def test_without_answers_the_controller_knows_where_the_cell_is(problem: Problem) -> None:
    world = alternating(problem)
    world.run(3_000)
    world.network.cut("stamper@R1", "*", key="dwell/*/accepted")
    world.network.cut("agent@E", "*", key="dwell/*/gathered")
    world.run(6_000)
    cell = world.cell
    assert cell.course.placement == world.stamper.placement


def test_the_loop_runs_without_a_controller_and_one_that_returns_goes_on(problem: Problem) -> None:
    world = alternating(problem)
    world.run(5_000)
    placement, term = world.stamper.placement, world.stamper.term
    world.kill(CONTROLLER)
    world.run(3_000)
    assert (world.stamper.placement, world.stamper.term) == (placement, term)
    before = len(columns(world, "windows", "window"))
    world.start(CONTROLLER)
    world.run(5_000)
    assert world.stamper.term > term
    windows = [number for (number,) in columns(world, "windows", "window")]
    assert windows == list(range(len(windows)))
    assert len(windows) > before
    assert world.cycles == list(range(world.cycles[0], world.cycles[-1] + 1))


def test_a_controller_cut_off_holds(problem: Problem) -> None:
    world = alternating(problem)
    world.run(3_000)
    cuts = [world.network.cut(CONTROLLER, "*"), world.network.cut("*", CONTROLLER)]
    placement = world.stamper.placement
    world.run(4_000)
    assert world.stamper.placement == placement
    for cut in cuts:
        world.network.heal(cut)
    world.run(4_000)
    assert world.stamper.term > 3
    assert world.cycles == list(range(world.cycles[0], world.cycles[-1] + 1))


def test_a_controller_that_hears_no_sink_goes_by_what_the_stamper_hears(problem: Problem) -> None:
    world = World(problem, policy="dtp", delay_ms=0.2)
    world.run(6_000)
    term, placement = world.stamper.term, world.stamper.placement
    before = len(columns(world, "cycles", "cycle"))
    world.network.cut("R2", "E")
    world.run(6_000)
    # Nothing is wrong with the cycles, and nothing is done about them.
    assert (world.stamper.term, world.stamper.placement) == (term, placement)
    during = columns(world, "cycles", "outcome", "latency_ns", "missed")[before:-5]
    assert len(during) > 80
    assert {(outcome, missed) for outcome, _, missed in during} == {("done", False)}
    earlier = [ns for (ns,) in columns(world, "cycles", "latency_ns")[before - 50 : before]]
    assert max(ns for _, ns, _ in during) == pytest.approx(max(earlier), abs=1_000_000)


def test_a_pinned_cell_stays_and_an_unpinned_one_goes_on(problem: Problem) -> None:
    world = alternating(problem)
    world.run(2_000)
    assert not ask(world, "pin", "HYB")
    world.run(300)
    assert world.stamper.placement == "HYB"
    term = world.stamper.term
    world.run(4_000)
    assert (world.stamper.placement, world.stamper.term) == ("HYB", term)
    assert world.cell.course.placement == "HYB"
    assert not ask(world, "unpin")
    world.run(4_000)
    assert world.stamper.term > term


def test_what_was_decided_and_not_done_is_no_migration(problem: Problem) -> None:
    world = alternating(problem)
    world.run(3_000)
    world.kill("perception@E")
    world.run(6_000)
    rows = columns(world, "decisions", "incumbent", "placement", "migrated", "refused")
    refused = [row for row in rows if row[3] is not None]
    assert len(refused) >= 2
    for incumbent, placement, migrated, why in refused:
        assert (placement, migrated) == (incumbent, False)
        assert why.startswith("SO: not ready: perception@E")
    # What is told of as done has been done.
    done = [placement for _, placement, migrated, _ in rows if migrated]
    assert done == [to for _, to, _ in world.stamper.moves][: len(done)]
    assert len(done) >= len(world.stamper.moves) - 1
    assert len(rows) >= len(columns(world, "windows", "window")) - 1


def test_what_a_person_does_not_allow_is_no_migration(problem: Problem) -> None:
    world = alternating(problem)
    world.run(2_000)
    assert not ask(world, "pin", "HYB")
    world.run(5_000)
    rows = columns(world, "decisions", "window", "migrated", "refused")[-4:]
    assert {migrated for _, migrated, _ in rows} == {False}
    assert {why.partition(": ")[2] for _, _, why in rows if why} == {"pinned to HYB"}


def test_an_order_that_nobody_answers_is_no_migration(problem: Problem) -> None:
    world = alternating(problem)
    world.run(2_000)
    moves = len(world.stamper.moves)
    world.network.cut(CONTROLLER, "stamper@R1", key="dwell/*/order")
    world.run(6_000)
    assert len(world.stamper.moves) == moves
    rows = columns(world, "decisions", "migrated", "refused")
    assert sum(migrated for migrated, _ in rows) == moves
    assert {why.partition(": ")[2] for _, why in rows if why} == {"no answer"}


def test_a_drained_node_is_left_and_not_returned_to(problem: Problem) -> None:
    world = World(problem, policy=Alternating("SO", "HYB"))
    world.run(2_000)
    assert not ask(world, "drain", "E")
    world.run(300)
    assert world.stamper.placement == "LOC"
    term = world.stamper.term
    world.run(4_000)
    assert (world.stamper.placement, world.stamper.term) == ("LOC", term)
    assert not ask(world, "undrain", "E")
    world.run(3_000)
    assert world.stamper.placement in ("SO", "HYB")


@pytest.mark.parametrize(
    ("what", "about", "said"),
    [
        ("pin", "NOWHERE", "no candidate 'NOWHERE'; there are LOC, SO, HYB"),
        ("drain", "R9", "no node 'R9'; there are R1, E, R2"),
        ("drain", "R2", "every candidate needs R2"),
        ("dance", "", "unknown question 'dance'"),
    ],
)
def test_what_cannot_be_done_is_refused(problem: Problem, what: str, about: str, said: str) -> None:
    world = World(problem, policy="LOC")
    world.run(1_000)
    assert ask(world, what, about).startswith(said)


def test_advice_orders_nothing(problem: Problem) -> None:
    advised = replace(problem, live=replace(problem.live, mode="advise"))
    world = alternating(advised)
    world.run(5_000)
    assert world.stamper.moves == []
    decided = columns(world, "decisions", "incumbent", "placement", "migrated")
    assert {incumbent for incumbent, _, _ in decided} == {"LOC"}
    assert any(moved for _, _, moved in decided)


def test_moves_of_the_guard_are_told_to_the_policy_and_recorded(problem: Problem) -> None:
    settings = replace(problem.controller, initial="SO")
    world = World(replace(problem, controller=settings), policy="dtp")
    world.run(3_000)
    world.network.freeze("perception@E")
    world.run(2_000)
    assert world.stamper.placement == "LOC"
    cell = world.cell
    assert cell.course.placement == "LOC"
    rows = columns(world, "decisions", "incumbent", "placement", "migrated", "reason")
    assert ("SO", "LOC", True, "guard") in rows
    assert cell.moves["guard"] == 1


def test_it_says_how_long_the_guard_rests_after_its_own_move(problem: Problem) -> None:
    settings = replace(problem.controller, initial="SO")
    world = World(replace(problem, controller=settings), policy="SO")
    world.run(1_000)
    cell = world.cell
    seen = [cell.status(world.network.now_ns)["resting"]]
    world.network.freeze("perception@E")
    for _ in range(60):
        world.run(problem.pipeline.period_ms)
        said = cell.status(world.network.now_ns)["resting"]
        # It knows by answers, one every quarter of a second.
        if said != seen[-1]:
            seen.append(said)
    assert seen == [False, True, False]
    assert world.stamper.guard.on_fallback


#: Every two of an estimator, a node and a jump occur together.
SET_CLOCKS = [
    (("profile", "corrected")[(i + k) % 2], node, jump_s)
    for i, node in enumerate(("R1", "E", "R2"))
    for k, jump_s in enumerate((-3_600.0, -5.0, -0.2, 5.0))
]


@pytest.mark.parametrize(("estimator", "node", "jump_s"), SET_CLOCKS)
def test_a_clock_that_is_set_ends_no_controller(estimator: str, node: str, jump_s: float) -> None:
    """Windows whose intervals cannot be are unproven; then the clock is known again."""
    cell = canonical(20, fallbacks=("LOC", "HYB", "SO"), estimator=estimator)
    world = World(cell, policy="dtp")
    world.run(2_000)
    before = len(columns(world, "windows", "window"))
    world.network.set_clock(node, Clock(round(jump_s * 1e3) * MS))
    world.run(8_000)
    decided = columns(world, "windows", "cost", "unproven", "seen_l95_ms")[before:]
    assert len(decided) > 10
    assert [unproven for _, unproven, _ in decided[-5:]] == [False] * 5
    assert all(cost is not None for cost, _, _ in decided[-5:])
    # No latency is what the clock was set by, and none is negative. By the stamper's all are stale
    # at first.
    longest_ms = cell.censor_ms if node == "R1" else 2 * cell.pipeline.period_ms
    assert all(l95_ms is None or 0 < l95_ms <= longest_ms for _, _, l95_ms in decided)
    status = world.cell.status(world.network.now_ns + round(jump_s * 1e3) * MS * (node == "E"))
    assert not [who for who, one in status["processes"].items() if not one["heard"]]
    assert status["health"] in ("ok", "degraded")


def test_cycles_that_ended_while_the_controller_was_deaf_are_not_missed(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    world.run(4_000)
    before = len(columns(world, "windows", "window"))
    cuts = [world.network.cut("*", CONTROLLER), world.network.cut("*", "agent@E")]
    world.run(7 * problem.pipeline.period_ms)
    for cut in cuts:
        world.network.heal(cut)
    world.run(3_000)
    assert world.cycles == list(range(world.cycles[0], world.cycles[-1] + 1))
    names = "heard", "violation_rate", "seen_violation_rate", "unproven", "l95_ms"
    windows = columns(world, "windows", *names)[before - 1 :]
    deaf = [window for window in windows if window[0] < problem.window_cycles]
    assert deaf
    assert all(unproven for *_, unproven, _ in deaf)
    assert {(rate, seen) for _, rate, seen, _, _ in windows} == {(0.0, 0.0)}
    assert all(l95_ms < problem.pipeline.deadline_ms for *_, l95_ms in windows)
    assert not any(missed for (missed,) in columns(world, "cycles", "missed"))
