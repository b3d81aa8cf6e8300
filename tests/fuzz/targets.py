"""Everything that reads bytes from the network, as functions of bytes: they return, or they fail.

Hypothesis feeds them in `tests/live/test_fuzz.py`, and atheris, guided by coverage, in
``python -m tests.fuzz``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

import dwell
from dwell.errors import LiveError, TrustError
from dwell.live.roles.controlled_cell import ControlledCell
from dwell.live.stage import Message
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.roster import Roster
from dwell.live.trust.signing import Seals
from dwell.live.wire import channels, messages
from dwell.live.wire.channels import CHANNELS, RELAYED
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import (
    MAX_HEADER_BYTES,
    Beat,
    Carried,
    Completion,
    Header,
    Order,
    encode,
)
from dwell.live.wire.payloads import read_payload
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from tests.cells.once import with_windows
from tests.live.small_world import Bench, Passing, World, forget_jobs

NODES = ("R1", "E", "R2")
DAY_NS = 86_400_000_000_000
KINDS: tuple[type[msgspec.Struct], ...] = tuple(
    kind
    for kind in vars(messages).values()
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and kind.__struct_fields__
)
STAMP = messages.Stamp(1, 5, 1, "LOC", 0)
HOP = messages.Hop("sensing", "R1", 1, 2, 3, (("stamper", 1),))
ORIGIN = messages.Origin("sensing", 5, 0, 5)
RATED_HOP = messages.RatedHop(**msgspec.structs.asdict(HOP), origins=(ORIGIN,))


class Plan(msgspec.Struct):
    """What a stage may declare."""

    name: str
    points: list[tuple[float, float]]
    more: dict[str, Any] = {}


class ReachedError(AssertionError):
    """Bytes that nobody has signed have come to a stage, or moved something."""


class _Alarm(Passing):
    def process(self, inputs: Mapping[str, Message]) -> Message:
        raise ReachedError(f"{self.name} was called with {inputs}")


# ----------------------------------------------------------------------------- the cell


@cache
def _folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="dwell-fuzz-"))


@cache
def _seals() -> dict[str, Seals]:
    cell = dwell.load("examples/canonical.yaml").name
    folder = _folder() / "keys"
    authority = Authority.create(folder, cell)
    for node in NODES:
        authority.issue(node, "node")
    authority.issue("controller", "controller")
    return {name: Seals(Keyring.open(folder / name, cell=cell)) for name in (*NODES, "controller")}


@cache
def _world(*, keys: bool) -> World:
    """A cell that has run for a while, and whose stages are not to be called any more."""
    problem = dwell.load("examples/canonical.yaml")
    stages: dict[str, Callable[[str], Passing]] = {}
    found = World(problem, policy="dtp", stages=stages, seals=_seals() if keys else None)
    found.run(300)
    for role in found.roles.values():
        if isinstance(role, Bench):
            forget_jobs(role.worker)
            role.worker.stage = _Alarm(role.worker.task)
    return found


def every_key(problem: Problem) -> tuple[str, ...]:
    """Return the keys of all messages of a cell, and of their copies on the detour."""
    keys = Keys(problem.name)
    plain = [
        keys.of(channel, *chunks)
        for channel in CHANNELS.values()
        for chunks in dict(channel.senders(problem)) or [()]
        if "*" not in chunks
    ]
    return *plain, *(keys.detour(key) for key in plain), *(keys.relay(key) for key in plain)


@cache
def _keys() -> tuple[str, ...]:
    return every_key(dwell.load("examples/canonical.yaml"))


# ---------------------------------------------------------------------------- the targets


def read_message(data: bytes) -> None:
    """The first byte chooses the kind."""
    kind = KINDS[data[0] % len(KINDS)] if data else KINDS[0]
    with suppress(LiveError):
        found = messages.decode(data[1:], kind)
        assert type(found) is kind
        again = messages.decode(encode(found), kind)
        assert encode(again) == encode(found)


def read_header(data: bytes) -> None:
    """As it comes beside a payload."""
    with suppress(LiveError):
        found = messages.decode(data, Header, limit=MAX_HEADER_BYTES)
        assert len(data) <= MAX_HEADER_BYTES
        assert len(found.hops) <= 64


def read_any_payload(data: bytes) -> None:
    """The first byte is the length of the kind, which follows."""
    length = data[0] if data else 0
    kind = data[1 : 1 + length].decode("utf-8", "replace")
    for expected in (None, Plan):
        with suppress(LiveError):
            found = read_payload(kind, data[1 + length :], expected)
            if isinstance(found, np.ndarray):
                assert found.dtype.kind in "biufc"
                assert found.nbytes == len(data[1 + length :])
                assert not found.flags.writeable


def read_bundle(data: bytes) -> None:
    """As it comes over the detour."""
    place = _world(keys=False).stamper.place
    for sample in place.around(Arrival(place.keys.of(channels.CARRIED), data)):
        assert place.channel(sample) in RELAYED
        assert len(sample.payload) <= len(data)


def check_seal(data: bytes) -> None:
    """Nobody has signed it."""
    seals = _seals()["R2"]
    for word, name in (("order", "controller"), ("done", "R2"), ("stamp", "nobody")):
        try:
            seals.require(word, name, data)
        except TrustError:
            continue
        raise ReachedError(f"taken for {name}'s {word}")


def read_roster(data: bytes) -> None:
    """A file, but one that is copied from host to host."""
    path = _folder() / "roster.json"
    path.write_bytes(data)
    try:
        Roster.read(path, _AUTHORITY.public_key())
    except TrustError:
        return
    raise ReachedError("a roster that nobody has signed")


def reach_roles(data: bytes) -> None:
    """Two bytes choose a key; two are the length of the header. No keys: nobody may fall over."""
    _hear(_world(keys=False), data)


def reach_sealed_roles(data: bytes) -> None:
    """With keys nothing may move, either."""
    world = _world(keys=True)
    before = _course(world)
    _hear(world, data)
    for role in world.roles.values():
        if isinstance(role, Bench) and forget_jobs(role.worker):
            raise ReachedError(f"{role.worker.place.who} would call its stage")
    after = _course(world)
    if after != before:
        raise ReachedError(f"{before} has become {after}")


def _course(world: World) -> tuple[int, str, int, int, int]:
    """Return what no message without a signature may change."""
    stamper, applied = world.stamper, len(world.arm.applied)
    return stamper.term, stamper.placement, stamper.cycle, stamper.newest_order, applied


def keep_deciding(data: bytes) -> None:
    """A message to the controller that is whole, but for some numbers; then true ones follow.

    A byte chooses the message; then come a byte for each field and eight for what it is to be.
    """
    world = _deciding()
    cell = world.cell
    key, true = _next_messages(world, cell)[data[0] % 3 if data else 0]
    found = msgspec.to_builtins(true)
    stamp = found[0] if isinstance(true, Completion) else found
    for at in range(1, len(data) - 8, 9):
        place = data[at] % len(stamp)
        if type(stamp[place]) is int:
            stamp[place] = int.from_bytes(data[at + 1 : at + 9], "big") >> 2
    cell.receive(Arrival(key, msgspec.msgpack.encode(found)), world.network.now_ns)
    before = cell.status(world.network.now_ns)["windows"]
    world.run(1_500)
    status = cell.status(world.network.now_ns)
    here = world.stamper.run, world.stamper.term
    # The network's clock begins at 0, and instants of years overflow sooner or later.
    far = abs(status["origin_ns"]) > DAY_NS
    if far or status["windows"] < before + 2 or (status["run"], status["term"]) != here:
        # What follows begins with one that still decides.
        _deciding.cache_clear()
        raise FrozenError(
            f"{found} ended the decisions: {status['windows'] - before} windows since, and "
            f"the run begins at {status['origin_ns']}"
        )


class FrozenError(AssertionError):
    """After a message the controller closes no window, or is in another run, term or year."""


@cache
def _deciding() -> World:
    """A cell whose controller closes a window every 10 cycles."""
    problem = dwell.load("examples/canonical.yaml")
    quick = replace(with_windows(problem, 10), warmup_windows=0)
    found = World(quick, policy="SO")
    found.run(1_000)
    return found


def _next_messages(world: World, cell: ControlledCell) -> list[tuple[str, msgspec.Struct]]:
    """What the controller may hear next: a stamp, a completion, an answer."""
    stamper, now_ns = world.stamper, world.network.now_ns
    who = stamper.run, stamper.cycle, stamper.term, stamper.placement
    keys = world.keys
    done = Completion(messages.Stamp(*who, now_ns), "control", now_ns, "actuated", (), "R2")
    told = (
        cell.order_number,
        cell.name,
        "",
        stamper.run,
        stamper.term,
        stamper.placement,
        stamper.cycle,
    )
    return [
        (keys.of(channels.STAMPED), messages.Stamped(*who, now_ns)),
        (keys.of(channels.DONE, "control"), done),
        (keys.of(channels.ACCEPTED), messages.Accepted(*told)),
    ]


def _hear(world: World, data: bytes) -> None:
    key = _keys()[int.from_bytes(data[:2], "big") % len(_keys())]
    length = int.from_bytes(data[2:4], "big")
    sample = Arrival(key, data[4 + length :], data[4 : 4 + length])
    for role in world.roles.values():
        hears = role.worker if isinstance(role, Bench) else role
        hears.receive(sample, world.network.now_ns)  # type: ignore[attr-defined]


_AUTHORITY = Ed25519PrivateKey.generate()

TARGETS: dict[str, Callable[[bytes], None]] = {
    "message": read_message,
    "header": read_header,
    "payload": read_any_payload,
    "bundle": read_bundle,
    "seal": check_seal,
    "roster": read_roster,
    "roles": reach_roles,
    "sealed": reach_sealed_roles,
    "decisions": keep_deciding,
}


# --------------------------------------------------------------------------------- seeds


def wholes() -> list[msgspec.Struct]:
    """Return a message of every kind, most of their fields filled in."""
    return [
        *(STAMP, messages.Stamped(**msgspec.structs.asdict(STAMP), intervals=((4, 9, 1),)), HOP),
        Header(STAMP, "sensing", "R1", "bytes", (HOP,)),
        Completion(STAMP, "control", 9, "actuated", (HOP,), "R2"),
        *(ORIGIN, RATED_HOP, messages.RatedHeader(STAMP, "sensing", "R1", "bytes", (RATED_HOP,))),
        messages.RatedCompletion(STAMP, "control", 9, "sampled", (RATED_HOP,), "R2"),
        messages.Heard("stamper@R1", "R1", 1, 2),
        Beat("agent@E", "E", 1, 5, True, (messages.Heard("stamper@R1", "R1", 1, 2),), cell="x"),
        messages.Beats((Beat("agent@E", "E", 1, 5, True), Beat("planning@E", "E", 1, 4, True))),
        messages.Receipt(1, 5, {"planning@E": 4}, (0, -9, 9)),
        Order(1, "me", 1, 1, "SO", 0.5, (("planning", "E"),)),
        Carried((("beat/E/agent@E", b"b"), ("done/control", b"c"))),
        messages.Ask("me", "pin", "SO"),
        messages.Answer("me", "", {"a": [1, {"b": 2.5}]}),
        messages.Load("E", 1, 2, 3, 4, 5, 0.5, (("planning@E", 7),)),
        messages.Snapshot(1, "planning", "E", "R2", 1, 5),
        messages.State(1, 5, "planning", "R2", 1),
        messages.Restored(1, "planning", "E", 1, 5),
        messages.Accepted(1, "me", "", 1, 1, "SO", 9),
    ]


def _whole_samples() -> list[bytes]:
    """Whole messages, under every key."""
    header = encode(Header(STAMP, "sensing", "R1", "bytes", (HOP,)))
    length = len(header).to_bytes(2, "big")
    return [
        index.to_bytes(2, "big") + length + header + encode(whole)
        for index in range(len(_keys()))
        for whole in wholes()[index % 5 :: 5]
    ]


def seeds(name: str) -> list[bytes]:
    """Return valid inputs of a target, to begin from."""
    complete = wholes()
    if name == "message":
        return [bytes([KINDS.index(type(one))]) + encode(one) for one in complete]
    if name == "header":
        return [encode(one) for one in complete if isinstance(one, Header)]
    if name == "bundle":
        return [encode(one) for one in complete if isinstance(one, Carried)]
    if name == "payload":
        kinds = {
            b"none": b"",
            b"bytes": b"abc",
            b"array:<f4:2x3": bytes(24),
            b"array:|u1:5": bytes(5),
            b"struct:Plan": msgspec.msgpack.encode(Plan("a", [(1.0, 2.0)])),
        }
        return [bytes([len(kind)]) + kind + data for kind, data in kinds.items()]
    if name == "decisions":
        # Each number of each message, a little and much higher than it may be.
        values = (7, 1 << 22, 1 << 42, (1 << 63) - 1, (1 << 64) - 1)
        return [
            bytes([kind, place]) + value.to_bytes(8, "big")
            for kind in range(3)
            for place in (range(7) if kind == 2 else (0, 1, 2, 4))
            for value in values
        ]
    if name == "seal":
        data = encode(Order(1, "me", 1, 1, "SO"))
        return [bytes(64) + data, _seals()["E"].seal("order", data)]
    if name == "roster":
        roster = Roster("cell", 1, {})
        return [roster.signed(Ed25519PrivateKey.generate()).encode()]
    return _whole_samples()
