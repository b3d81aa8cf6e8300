"""Messages: nothing that arrives crashes a process, fills its memory, or reaches a stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dwell.errors import LiveError
from dwell.live.roles.joins import MAX_JOINS
from dwell.live.roles.role import MAX_COMPLAINTS, MAX_STRANGERS, Pulse
from dwell.live.roles.worker import Worker
from dwell.live.stage import Message
from dwell.live.wire import channels
from dwell.live.wire.messages import (
    MAX_CONTROL_BYTES,
    MAX_HEADER_BYTES,
    Beat,
    Completion,
    Header,
    Heard,
    Order,
    Stamp,
    decode,
    encode,
)
from dwell.live.wire.routing import MAX_KNOWN
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from dwell.model.document import digests
from tests.fuzz.targets import KINDS, every_key, wholes
from tests.live.small_world import (
    EXEC_MS,
    Bench,
    Counting,
    Passing,
    World,
    canonical,
    queued,
    stateful,
)

calls: list[str] = []


class Watched(Passing):
    """A stage that tells that it was called."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        calls.append(self.name)
        return super().process(inputs)


class Stateful(Counting):
    def process(self, inputs: Mapping[str, Message]) -> Message:
        calls.append(self.name)
        return super().process(inputs)

    def restore(self, state: bytes) -> None:
        calls.append("restore")
        super().restore(state)


def problem() -> Problem:
    return stateful(canonical(fallbacks=("LOC", "HYB")), "planning", 100)


@pytest.fixture(scope="module")
def world() -> World:
    """A cell whose stamper has begun, and whose cycles are all through."""
    stages: dict[str, Callable[[str], Passing]] = dict.fromkeys(EXEC_MS, Watched)
    made = World(problem(), stages=stages | {"planning": Stateful}, policy="dtp")
    made.run(1_000)
    return made


def roles_of(world: World) -> list[tuple[str, Any]]:
    """Every role, benches unpacked."""
    return [
        (who, role.worker if isinstance(role, Bench) else role) for who, role in world.roles.items()
    ]


# ------------------------------------------------------------------------------ the codec


def values_of(kind: type[msgspec.Struct]) -> st.SearchStrategy[list[Any]]:
    """What a message of a type may be made of, mostly."""
    names = st.sampled_from(["LOC", "SO", "sensing", "E", "control@R2", "x"])
    numbers = st.integers(-1, 1 << 62)
    texts = st.text(max_size=10)
    parts = st.recursive(
        st.one_of(names, numbers, texts, st.booleans(), st.floats(allow_nan=True), st.binary()),
        lambda inner: st.lists(inner, max_size=4),
        max_leaves=12,
    )
    return st.lists(parts, max_size=len(kind.__struct_fields__) + 1)


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_any_bytes_are_decoded_or_refused(kind: type[msgspec.Struct], data: st.DataObject) -> None:
    raw = data.draw(st.one_of(st.binary(max_size=300), values_of(kind).map(msgspec.msgpack.encode)))
    with suppress(LiveError):
        found = decode(raw, kind)
        assert encode(decode(encode(found), kind)) == encode(found)


@pytest.mark.parametrize("message", wholes(), ids=lambda message: type(message).__name__)
def test_a_message_cut_short_is_refused(message: msgspec.Struct) -> None:
    whole = encode(message)
    for length in range(len(whole)):
        with pytest.raises(LiveError):
            decode(whole[:length], type(message))


def test_a_message_too_long_is_refused_unread() -> None:
    with pytest.raises(LiveError, match="a Beat of 262145 bytes; at most 262144 are read"):
        decode(bytes(MAX_CONTROL_BYTES + 1), Beat)
    with pytest.raises(LiveError, match="at most 16384"):
        decode(bytes(MAX_HEADER_BYTES + 1), Header, limit=MAX_HEADER_BYTES)


@pytest.mark.parametrize(
    "deep", [b"\x91" * 100_000, b"\xdd\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff"]
)
def test_a_message_that_claims_more_than_it_has_is_refused(deep: bytes) -> None:
    for kind in KINDS:
        with pytest.raises(LiveError):
            decode(deep, kind)


# ------------------------------------------------------------------------------ the roles


def sizes(role: Any) -> int:
    """How many things a role remembers, all that hangs on it counted, its problem left out."""
    seen: set[int] = set()

    def count(thing: Any, depth: int) -> int:
        plain = str | bytes | int | float | bool | None | Problem
        if id(thing) in seen or isinstance(thing, plain) or callable(thing) or depth > 6:
            return 0
        seen.add(id(thing))
        total = 0
        if isinstance(thing, dict):
            return len(thing) + sum(count(value, depth + 1) for value in list(thing.values()))
        if isinstance(thing, list | tuple | set | frozenset) or hasattr(thing, "popleft"):
            return len(thing) + sum(count(value, depth + 1) for value in list(thing))
        if type(thing).__module__.startswith("dwell.live"):
            names = [*getattr(thing, "__dict__", ())]
            for kind in type(thing).__mro__:
                slots = kind.__dict__.get("__slots__", ())
                names += [slots] if isinstance(slots, str) else slots
            kept = [
                getattr(thing, name, None)
                for name in names
                if name not in ("transport", "problem", "windows")
            ]
            total += sum(count(value, depth + 1) for value in kept)
        return total

    return count(role, 0)


def sample(data: st.DataObject, key: str) -> Arrival:
    """A message that nobody meant: noise, cut short, oversized, or of the wrong type."""
    whole = data.draw(st.sampled_from(wholes()))
    junk = st.one_of(
        st.binary(max_size=200),
        st.integers(0, 60).map(lambda length: encode(whole)[:length]),
        st.just(bytes(MAX_CONTROL_BYTES + 1)),
        values_of(type(whole)).map(msgspec.msgpack.encode),
        # MessagePack is read up to the end of the first value.
        st.binary(min_size=1, max_size=9).map(lambda tail: encode(whole) + tail),
    )
    header = data.draw(st.one_of(st.just(b""), junk, st.just(bytes(MAX_HEADER_BYTES + 1))))
    return Arrival(key, data.draw(junk), header)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_role_falls_over_what_nobody_meant(world: World, data: st.DataObject) -> None:
    now_ns = world.network.now_ns
    key = data.draw(st.sampled_from(every_key(world.stamper.place.problem)))
    found = sample(data, key)
    calls.clear()
    for _, role in roles_of(world):
        role.receive(found, now_ns)
    for who, role in world.roles.items():
        if isinstance(role, Bench):
            worker = role.worker
            while (chore := worker.next_chore(now_ns)) is not None:
                worker.finish_chore(chore, *worker.do_chore(chore), now_ns, now_ns)
            assert not queued(worker)[0], f"{who} would call its stage"
    assert calls == []


def test_a_flood_of_nonsense_takes_no_memory(world: World) -> None:
    now_ns = world.network.now_ns
    keys = every_key(world.stamper.place.problem)

    def flood(count: int) -> None:
        for number in range(count):
            junk = msgspec.msgpack.encode([number, "x", [number] * 3])
            for key in keys:
                for _, role in roles_of(world):
                    role.receive(Arrival(key, junk, junk), now_ns)

    flood(120)
    before = {who: sizes(role) for who, role in roles_of(world)}
    flood(60)
    assert {who: sizes(role) for who, role in roles_of(world)} == before
    for _, role in roles_of(world):
        assert len(role.place.complaints) <= MAX_COMPLAINTS


def test_a_flood_of_well_formed_messages_takes_no_memory() -> None:
    """All that the protocol lets anybody say, from somebody who says everything."""
    world = World(problem(), policy="dtp")
    world.run(500)
    now_ns = world.network.now_ns
    keys, digest = world.stamper.place.keys, digests(world.problem)["wiring"]
    tasks = world.problem.pipeline.tasks

    def say(number: int) -> list[Arrival]:
        stamp = Stamp(9, number, 1, "LOC", 0, forks=((f"t{number}", "E"),))
        heard = (Heard(f"z{number}", f"n{number}", 1, 1),)
        unknown = Beat(f"x{number}", "E", 1, 1, True, cell=digest)
        stranger = Beat(f"y{number}", "E", 1, 1, True, cell=f"{number}")
        liar = Beat("agent@E", "E", 99, number, True, heard, cell=digest)
        found = [
            *(
                Arrival(keys.of(channels.BEAT, "E", b.who), encode(b))
                for b in (unknown, stranger, liar)
            ),
            Arrival(
                keys.of(channels.DONE, "control"),
                encode(Completion(stamp, f"s{number}", 1, "actuated", (), "R2")),
            ),
            Arrival(
                keys.of(channels.ENDED),
                encode(Completion(stamp, "control", 1, f"{number}", (), "R2")),
            ),
            Arrival(
                keys.of(channels.ORDER), encode(Order(number, f"c{number}", 1, 1, f"p{number}"))
            ),
            Arrival(keys.of(channels.STAMPED), encode(stamp)),
        ]
        for task in tasks:
            for source in tasks:
                head = encode(Header(stamp, source, "R1", "bytes"))
                found += [
                    Arrival(keys.of(channels.INPUT, task, node, "main"), b"payload", head)
                    for node in ("R1", "E")
                ]
        return found

    def flood(numbers: range) -> None:
        for number in numbers:
            for one in say(number):
                for _, role in roles_of(world):
                    if "/in/" not in one.key or f"/in/{getattr(role, 'task', '')}/" in one.key:
                        role.receive(one, now_ns)

    flood(range(650))
    before = {who: sizes(role) for who, role in roles_of(world)}
    flood(range(650, 1_000))
    for who, role in roles_of(world):
        room = 2 * MAX_COMPLAINTS + 2 * MAX_STRANGERS
        assert sizes(role) <= before[who] + room, who
        windows = getattr(role, "windows", None)
        if windows is not None:
            # They remember the cycles of the last windows, and a line of open ones.
            assert len(windows._by_key) <= windows.record._kept + windows._longest
        pulse = getattr(role, "pulse", None)
        if isinstance(pulse, Pulse):
            assert len(pulse.strangers) <= MAX_STRANGERS
            known = {name for name, _, _ in pulse.detector.everybody(now_ns)}
            assert known <= set(world.roles) | {"controller@E"}
    for _, role in roles_of(world):
        if isinstance(role, Worker):
            jobs, _, joins = queued(role)
            assert jobs <= 10 * MAX_JOINS
            assert max(joins, default=0) <= MAX_JOINS
            assert len(role.routes._known) <= MAX_KNOWN


def test_a_beat_of_an_unknown_process_is_not_heard(world: World) -> None:
    stamper = world.stamper
    beat = Beat("ghost@E", "E", 1, 1, True, cell=digests(world.problem)["wiring"])
    stamper.receive(Arrival(stamper.place.keys.of(channels.BEAT, "E", "ghost@E"), encode(beat)), 0)
    assert stamper.pulse.detector.last("ghost@E") is None
    assert "ghost@E on E is no process of cell 'canonical'" in stamper.place.complaints
