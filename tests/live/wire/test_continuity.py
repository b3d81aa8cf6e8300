"""One message that is damaged or made up neither ends nor freezes what a cell decides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import pytest

from dwell.live.roles.failure_detector import FailureDetector
from dwell.live.roles.latencies import Intervals
from dwell.live.roles.loads import NodeLoad
from dwell.live.roles.offsets import Offsets
from dwell.live.wire import channels
from dwell.live.wire.continuity import CONFIRMATIONS, RESERVED, Continuity, OvershootDetector
from dwell.live.wire.messages import (
    Accepted,
    Beat,
    Completion,
    Heard,
    Load,
    Stamp,
    Stamped,
    encode,
)
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from tests.live.small_world import Staying, World, canonical

MS, S = 1_000_000, 1_000_000_000
PERIOD_NS = 33 * MS
HUGE = 1 << 40


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(10, min_dwell=1, estimator="profile")


@pytest.fixture
def world(problem: Problem) -> World:
    made = World(problem, policy=Staying())
    made.run(1_500)
    assert windows(made) >= 2
    return made


def windows(world: World) -> int:
    found = world.status["windows"]
    assert isinstance(found, int)
    return found


def hear(world: World, key: str, message: msgspec.Struct) -> None:
    world.cell.receive(Arrival(key, encode(message)), world.network.now_ns)


def stamped(world: World, **false: object) -> None:
    """The controller hears one stamp that is as the next would be, but for what is false."""
    stamper = world.stamper
    true = Stamped(
        stamper.run, stamper.cycle, stamper.term, stamper.placement, world.network.now_ns
    )
    hear(world, world.keys.of(channels.STAMPED), msgspec.structs.replace(true, **false))


def completed(world: World, outcome: str = "actuated", **false: object) -> None:
    stamper = world.stamper
    true = Stamped(
        stamper.run, stamper.cycle, stamper.term, stamper.placement, world.network.now_ns
    )
    stamp = msgspec.structs.replace(true, **false)
    done = Completion(
        Stamp(*msgspec.structs.astuple(stamp)[:7]),
        "control",
        world.network.now_ns,
        outcome,
        (),
        "R2",
    )
    keys = world.keys
    hear(
        world,
        keys.of(channels.DONE, "control") if outcome == "actuated" else keys.of(channels.ENDED),
        done,
    )


def answered(world: World, **false: object) -> None:
    """The controller hears one answer that is as the next would be, but for what is false."""
    stamper, cell = world.stamper, world.cell
    number, name = cell.order_number, cell.name
    true = Accepted(number, name, "", stamper.run, stamper.term, stamper.placement, stamper.cycle)
    hear(world, world.keys.of(channels.ACCEPTED), msgspec.structs.replace(true, **false))


def windows_go_on(world: World) -> None:
    """For two seconds, but for what one message may cost."""
    before = windows(world)
    world.run(2_000)
    per_s = 1e3 / (world.problem.window_cycles * world.problem.pipeline.period_ms)
    assert windows(world) - before >= 2 * per_s - 3


def goes_on(world: World) -> None:
    """Windows close at their pace, and what a person asks for is done."""
    guard_moves = len(world.stamper.moves)
    windows_go_on(world)
    target = "SO" if world.stamper.placement != "SO" else "LOC"
    world.pin(target)
    world.run(1_000)
    assert world.stamper.placement == target
    assert [why for _, _, why in world.stamper.moves[guard_moves:]] == ["order"]
    found = world.status
    assert found["placement"] == target
    assert (found["run"], found["term"]) == (world.stamper.run, world.stamper.term)
    assert world.cell.course.placement == target
    windows_go_on(world)
    assert world.cycles == list(range(world.cycles[0], world.cycles[-1] + 1))


FALSE: dict[str, Callable[[World], dict[str, object]]] = {
    "cycle + 2^40": lambda w: {"cycle": w.stamper.cycle + HUGE},
    "cycle + 20,000": lambda w: {"cycle": w.stamper.cycle + 20_000},
    "cycle + 1,000": lambda w: {"cycle": w.stamper.cycle + 1_000},
    "cycle + 64": lambda w: {"cycle": w.stamper.cycle + 64},
    "cycle + 1": lambda w: {"cycle": w.stamper.cycle + 1},
    "the last cycle": lambda _: {"cycle": (1 << 62) - 1},
    "cycle 0": lambda _: {"cycle": 0},
    "term + 2^20": lambda w: {"term": w.stamper.term + (1 << 20)},
    "term + 2^40": lambda w: {"term": w.stamper.term + HUGE},
    "term + 100": lambda w: {"term": w.stamper.term + 100},
    "term + 1": lambda w: {"term": w.stamper.term + 1},
    "term + 1 elsewhere": lambda w: {"term": w.stamper.term + 1, "placement": "LOC"},
    "run + 1": lambda w: {"run": w.stamper.run + 1},
    "run + 2^40": lambda w: {"run": w.stamper.run + HUGE},
    "run and cycle": lambda w: {"run": w.stamper.run + HUGE, "cycle": 0},
    "released 50 s later": lambda w: {"released_ns": w.network.now_ns + 50 * S},
    "released an hour later": lambda w: {"released_ns": w.network.now_ns + 3_600 * S},
    "released at the end of time": lambda _: {"released_ns": (1 << 62) - 1},
    "released at the beginning of time": lambda _: {"released_ns": -(1 << 62)},
    "placement": lambda _: {"placement": "SO"},
    "shadow": lambda _: {"shadow": "SO"},
}


@pytest.mark.parametrize("what", FALSE)
def test_one_false_stamp_or_completion_ends_no_decisions(world: World, what: str) -> None:
    """One of every kind, with time between them."""
    stamped(world, **FALSE[what](world))
    for outcome in ("actuated", "shadow", "replaced"):
        world.run(700)
        completed(world, outcome, **FALSE[what](world))
    goes_on(world)
    assert world.cell.moves["guard"] == 0


@pytest.mark.parametrize(
    "false",
    [
        *({"run": 1 + HUGE}, {"term": 1 << 40}, {"term": 0}, {"run": 0, "term": 0}),
        *({"cycle": 1 << 40}, {"cycle": 0}, {"cycle": 1_000}, {"newest": (1 << 61) - 1}),
        *({"newest": (1 << 62) - 1}, {"number": (1 << 62) - 1}, {"placement": "SO"}),
        *({"term": 2, "placement": "SO"}, {"fallback": True}, {"term": 7, "fallback": True}),
        *({"proven": "SO"}, {"refused": "stale term: 1, now 1"}, {"resting": True}),
    ],
    ids=str,
)
def test_one_false_answer_ends_no_decisions(world: World, false: dict[str, object]) -> None:
    answered(world, **false)
    goes_on(world)


def test_what_is_not_believed_is_counted_and_said_once(world: World) -> None:
    said: list[str] = []
    world.cell.place.say = said.append
    before = world.status["disbelieved"]
    for more in range(40):
        stamped(world, cycle=world.stamper.cycle + HUGE + 1_000_000 * more * more)
        world.run(50)
    assert world.status["disbelieved"] == before + 40
    assert len(said) == 1
    assert "stamper@R1" in said[0]
    goes_on(world)


def test_a_stamper_that_left_numbers_out_is_believed_at_once(world: World) -> None:
    world.kill("stamper@R1")
    world.start("stamper@R1")
    assert world.stamper.cycle >= RESERVED
    world.run(200)
    assert world.status["disbelieved"] == 0
    before = windows(world)
    world.run(2_000)
    assert windows(world) >= before + 3


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> int:
    """Numbers that a stamper reserves, so few that a short time away has more cycles."""
    reserved = 32
    for module in ("wire.continuity", "roles.stamper"):
        monkeypatch.setattr(f"dwell.live.{module}.RESERVED", reserved)
    return reserved


def test_a_controller_that_was_cut_off_believes_the_next_stamp_at_once(
    few: int, world: World
) -> None:
    first = world.stamper.cycle
    cut = world.network.cut("*", "controller@E")
    world.run(5_000)
    assert world.stamper.cycle > first + 4 * few
    world.network.heal(cut)
    world.run(400)
    assert world.status["disbelieved"] == 0
    goes_on(world)


def test_a_stamper_that_was_away_for_long_is_believed_at_once(few: int, problem: Problem) -> None:
    # More cycles than a restart leaves out, which comes on top.
    pipeline = replace(problem.pipeline, period_ms=2_000.0)
    slow = replace(problem, pipeline=pipeline, servo=None)
    world = World(slow, policy=Staying())
    world.run(60_000)
    first = world.stamper.cycle
    cut = world.network.cut("*", "controller@E")
    world.run(4 * few * 2_000)
    world.kill("stamper@R1")
    world.start("stamper@R1")
    assert world.stamper.cycle > first + 4 * few
    unanswered = world.network.cut("stamper@R1", "*", key="dwell/*/accepted")
    world.network.heal(cut)
    world.run(20_000)
    assert world.status["disbelieved"] == 0
    world.network.heal(unanswered)
    before = windows(world)
    world.run(100_000)
    assert windows(world) >= before + 2
    target = "SO" if world.stamper.placement != "SO" else "LOC"
    world.pin(target)
    world.run(60_000)
    assert world.status["placement"] == world.stamper.placement == target


@pytest.mark.parametrize("answers", [True, False])
@pytest.mark.parametrize("more", [{"run": 1}, {"reserved": 1 << 40}])
def test_a_stamper_that_is_really_beyond_is_followed(
    world: World, more: dict[str, int], answers: bool
) -> None:
    if not answers:
        world.network.cut("controller@E", "stamper@R1", key="dwell/*/order")
    world.kill("stamper@R1")
    entry = world.book.entry
    assert entry is not None
    fields = {name: getattr(entry, name) + much for name, much in more.items()}
    world.book.entry = replace(entry, **fields)
    for memory in world.highest.values():
        memory.store(entry.run, world.cycles[-1])
    world.start("stamper@R1")
    world.run(1_000)
    before = windows(world)
    world.run(3_000)
    assert windows(world) >= before + 6
    assert world.status["run"] == world.stamper.run


def test_a_guards_move_is_told_by_stamps_where_no_answer_comes(world: World) -> None:
    world.network.cut("stamper@R1", "*", key="dwell/*/accepted")
    world.network.cut("agent@E", "*", key="dwell/*/gathered")
    stamper = world.stamper
    other = next(name for name in world.problem.candidates if name != stamper.placement)
    world.move_by_guard(other)
    world.run(400)
    assert world.status["placement"] == other
    assert world.status["guard_moves"] == 1


# --------------------------------------------------------------------------- the rule itself


def test_a_cycle_may_be_as_far_ahead_as_time_and_a_restart_explain() -> None:
    continuity = Continuity(PERIOD_NS)
    assert continuity.takes((1, 5), 0)
    assert continuity.takes((1, 6), PERIOD_NS)
    assert continuity.takes((1, 6 + RESERVED), 2 * PERIOD_NS)
    hour_ns = 3_600 * S
    assert continuity.takes((1, 6 + RESERVED + hour_ns // PERIOD_NS), hour_ns)
    assert not continuity.takes((1, 1 << 40), hour_ns)
    assert not continuity.takes((2, 0), hour_ns)
    assert continuity.leaps == 2
    assert continuity.takes((1, 6), hour_ns)


def test_what_leaps_is_believed_in_company() -> None:
    continuity = Continuity(PERIOD_NS)
    continuity.takes((1, 5), 0)
    taken = [continuity.takes((2, n), n * PERIOD_NS) for n in range(1, 8)]
    assert taken == [False] * (CONFIRMATIONS - 1) + [True] * (8 - CONFIRMATIONS)


def test_what_leaps_among_what_goes_on_is_never_believed() -> None:
    continuity = Continuity(PERIOD_NS)
    for n in range(1, 200):
        assert continuity.takes((1, n), n * PERIOD_NS)
        for more in range(20):
            assert not continuity.takes((1, HUGE + 20 * n + more), n * PERIOD_NS + more)


def test_copies_and_late_ones_are_no_company() -> None:
    overshoot = OvershootDetector()
    assert not any(overshoot.behind(7) for _ in range(100))
    for n in range(20):
        assert not overshoot.behind(n)
        overshoot.advanced()
    assert [overshoot.behind(1, n) for n in range(CONFIRMATIONS)] == [False] * (
        CONFIRMATIONS - 1
    ) + [True]


# ------------------------------------------------------------- other numbers that only grow


@pytest.mark.parametrize("false", [(1, HUGE * S), (HUGE, 0), (HUGE, HUGE * S)])
def test_one_false_load_leaves_no_node_idle_for_ever(false: tuple[int, int]) -> None:
    load = NodeLoad()
    for n in range(1, 40):
        load.report(Load("E", 1, n * S, n * S // 2, 0, 0))
        if n == 20:
            load.report(Load("E", *false, n * S // 2, 0, 0))
    assert load.at(38 * S)[0] - load.at(30 * S)[0] == pytest.approx(4 * S)


def beat(life: int, sent_ns: int, *heard: Heard) -> Beat:
    return Beat("perception@E", "E", life, sent_ns, True, heard)


@pytest.mark.parametrize("false", [(1, HUGE * S), (HUGE, 0), (HUGE, HUGE * S)])
@pytest.mark.parametrize("direct", [True, False])
def test_one_false_beat_silences_nobody_for_ever(false: tuple[int, int], direct: bool) -> None:
    detector = FailureDetector("controller@R1", S)
    detector.hear(beat(1, 0), 0)
    detector.hear(beat(*false), 1, direct=direct)
    for n in range(1, 10):
        detector.hear(beat(1, n * S), n * S)
    assert detector.age_ns("perception@E", 9 * S) == 0
    last = detector.last("perception@E")
    assert last is not None
    assert (last.life, last.sent_ns) == (1, 9 * S)


def test_late_beats_over_the_detour_are_no_news() -> None:
    detector = FailureDetector("controller@R1", S)
    detector.hear(beat(1, 100), 100)
    assert not any(detector.hear(beat(1, n), 100 + n, direct=False) for n in range(50))


def test_a_false_completion_stops_no_intervals() -> None:
    intervals = Intervals("R1", lambda _: frozenset({"arm"}))
    intervals.hear(
        Beat("sink.arm@R2", "R2", 1, 20 * MS, True, (Heard("stamper@R1", "R1", 0, 10 * MS),)),
        14 * MS,
    )
    for cycle in (3, HUGE, 4):
        done = Completion(Stamp(1, cycle, 1, "LOC", 0), "arm", 0, "actuated", (), "R2")
        intervals.completed(done, 40 * MS, newest=5, direct=True)
    assert [cycle for cycle, _, _ in intervals.take_unreported()] == [3, 4]


def test_one_false_instant_does_not_widen_the_clocks_bounds_for_ever() -> None:
    offsets = Offsets("R1", "R1")

    def exchange(n: int) -> None:
        sent_ns = n * S
        offsets.sample("E", "R1", sent_ns, sent_ns + MS)
        offsets.sample("R1", "E", sent_ns, sent_ns + MS)

    for n in range(1, 200):
        exchange(n)
        if n == 100:
            offsets.sample("E", "R1", HUGE * S, n * S)
            offsets.sample("R1", "E", n * S, HUGE * S)
    assert offsets.from_reference("E", 199 * S).bound_ns < 3 * MS
