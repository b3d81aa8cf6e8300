"""Signed messages: what is forged, replayed or made up on the way changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import TrustError
from dwell.live.host.agent import Agent
from dwell.live.roles.role import RolePlace
from dwell.live.trust import signing
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.signing import Seals
from dwell.live.wire import channels
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.live.wire.messages import (
    SIGNATURE_BYTES,
    Accepted,
    Beat,
    Beats,
    Carried,
    Completion,
    Header,
    Load,
    Order,
    Restored,
    Snapshot,
    Stamp,
    decode,
    encode,
)
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from dwell.model.document import digests
from tests.live.memory_transport import MemoryTransport
from tests.live.small_world import Counting, World, canonical, on, stateful

NODES = ("R1", "E", "R2")


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(20, min_dwell=1, estimator="profile", fallbacks=("LOC",))


def issue(folder: Path, cell: str) -> dict[str, Seals]:
    authority = Authority.create(folder, cell)
    for node in NODES:
        authority.issue(node, "node")
    authority.issue(CONTROLLER, "controller")
    return {name: Seals(Keyring.open(folder / name)) for name in (*NODES, CONTROLLER)}


@pytest.fixture(scope="module")
def seals(problem: Problem, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Seals]:
    return issue(tmp_path_factory.mktemp("keys") / "a", problem.name)


@pytest.fixture
def world(problem: Problem, seals: dict[str, Seals]) -> World:
    made = World(on(problem, "SO"), policy="SO", seals=seals)
    made.run(1_000)
    assert made.stamper.placement == "SO"
    return made


def test_a_stamper_without_book_and_clock_follows_what_is_signed(world: World) -> None:
    before = world.stamper.run
    world.kill("stamper@R1")
    world.book.entry, world.run_id, world.boot = None, 0, "another"
    world.start("stamper@R1")
    applied = len(world.cycles)
    world.run(1_000)
    assert world.stamper.run == before + 1
    assert len(world.cycles) > applied + 10


@pytest.mark.parametrize(("signs", "believed"), [("R2", True), ("E", False)])
def test_one_signed_claim_of_a_run_is_believed(
    world: World, seals: dict[str, Seals], signs: str, believed: bool
) -> None:
    world.kill("stamper@R1")
    world.book.entry, world.boot = None, "another"
    world.start("stamper@R1")
    stamper, who = world.stamper, "sink.control@R2"
    now_ns = world.network.now_ns
    digest = digests(world.problem)["wiring"]
    beat = Beat(who, "R2", 10**9, now_ns, True, cell=digest, run=stamper.run + 5)
    key = world.keys.detour(world.keys.of(channels.BEAT, "R2", who))
    data = seals[signs].seal(world.keys.word(key), encode(beat))
    before = stamper.run
    stamper.receive(Arrival(key, data), now_ns)
    assert stamper.run == (before + 6 if believed else before)


def ordered(world: World, order: Order, seals: Seals | None, word: str = "order") -> Arrival:
    data = encode(order)
    key = world.keys.of(channels.ORDER)
    return Arrival(key, data if seals is None else seals.seal(word, data))


def order_of(world: World, placement: str, number: int = 1 << 60, **more: object) -> Order:
    stamper = world.stamper
    order = Order(number, "me", stamper.run, stamper.term, placement)
    return msgspec.structs.replace(order, **more)


def give(world: World, *samples: Arrival) -> int:
    """Hand messages to the stamper alone; returns how many it complains of."""
    before = world.stamper.place.complained
    # Whoever is in charge has fallen silent.
    world.stamper._charge = ""
    for sample in samples:
        world.stamper.receive(sample, world.network.now_ns)
    return world.stamper.place.complained - before


# ------------------------------------------------------------------------- nothing is lost


def test_a_cell_with_keys_runs_as_one_without(problem: Problem, seals: dict[str, Seals]) -> None:
    runs = []
    for used in (seals, None):
        world = World(problem, policy="LOC", seals=used)
        world.run(2_000)
        world.pin("HYB")
        world.run(1_000)
        assert world.stamper.placement == "HYB"
        runs.append((world.cycles, world.stamper.moves))
        for role in world.roles.values():
            place = getattr(role, "place", None) or role.worker.place  # type: ignore[attr-defined]
            assert not place.complaints
    assert runs[0] == runs[1]


def test_agents_hear_which_roster_each_agent_and_the_controller_use(
    world: World, seals: dict[str, Seals]
) -> None:
    number = seals["R1"].keyring.roster.number
    known = [role for role in roles(world.problem) if role.kind in ("agent", "controller")]
    for node in NODES:
        agent = world.roles[f"agent@{node}"]
        assert isinstance(agent, Agent)
        beats = [agent.pulse.detector.last(one.who) for one in known if one.who != agent.place.who]
        assert [beat and beat.roster for beat in beats] == [number] * 3


def test_every_small_message_that_matters_is_signed(
    problem: Problem, seals: dict[str, Seals]
) -> None:
    said: dict[str, bytes] = {}
    put = MemoryTransport.put

    def note(
        self: MemoryTransport, key: str, payload: bytes, *rest: object, **more: object
    ) -> None:
        said[key.split("/")[2]] = bytes(payload)
        put(self, key, payload, *rest, **more)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MemoryTransport, "put", note)
        world = World(problem, policy="LOC", seals=seals)
        world.run(1_000)
    kinds: dict[str, type[msgspec.Struct]] = {
        "order": Order,
        "accepted": Accepted,
        "done": Completion,
        "beat": Beat,
        "beats": Beats,
        "load": Load,
    }
    for word, kind in kinds.items():
        assert isinstance(decode(said[word][SIGNATURE_BYTES:], kind), kind)
        assert len(said[word]) > SIGNATURE_BYTES


def test_the_detour_carries_what_is_signed(world: World) -> None:
    """Rule 4, with keys: what the direct link loses comes round by E."""
    world.network.cut("R2", "R1")
    before = len(world.stamper.moves)
    world.run(2_000)
    assert len(world.stamper.moves) == before
    assert not world.stamper.place.complaints


# -------------------------------------------------------------------------------- orders


def test_an_order_has_to_be_the_controllers(world: World, seals: dict[str, Seals]) -> None:
    order = order_of(world, "LOC")
    for signed in (
        ordered(world, order, None),
        ordered(world, order, seals["R2"]),
        ordered(world, order, seals["E"]),
        # A good signature, but of a message of another kind.
        ordered(world, order, seals[CONTROLLER], word="accepted"),
    ):
        assert give(world, signed) == 1
        assert world.stamper.placement == "SO"
    assert give(world, ordered(world, order, seals[CONTROLLER])) == 0
    assert world.stamper.placement == "LOC"


def test_another_authoritys_controller_is_nobody(world: World, tmp_path: Path) -> None:
    strangers = issue(tmp_path / "keys", world.problem.name)
    assert give(world, ordered(world, order_of(world, "LOC"), strangers[CONTROLLER])) == 1
    assert world.stamper.placement == "SO"


def test_a_signature_is_for_one_cell(
    problem: Problem, seals: dict[str, Seals], tmp_path: Path
) -> None:
    """Even where two cells' controllers have the same key."""
    sealed = seals[CONTROLLER].seal("order", b"data")
    seals["R1"].require("order", CONTROLLER, sealed)
    other = issue(tmp_path / "keys", "another")["R1"]
    own = seals["R1"].keyring.roster.subjects
    other._keys = {name: [subject.key] for name, subject in own.items()}
    with pytest.raises(TrustError, match="order: not signed by controller"):
        other.require("order", CONTROLLER, sealed)


@given(st.data())
def test_a_changed_order_is_none(
    problem: Problem, seals: dict[str, Seals], data: st.DataObject
) -> None:
    sealed = bytearray(seals[CONTROLLER].seal("order", encode(Order(1, "me", 1, 1, "LOC"))))
    place = data.draw(st.integers(0, len(sealed) - 1))
    sealed[place] ^= 1 << data.draw(st.integers(0, 7))
    cut = data.draw(st.integers(0, len(sealed)))
    for changed in (bytes(sealed), bytes(sealed[:cut]), b"", bytes(sealed) + b"\0"):
        with pytest.raises(TrustError):
            seals["R1"].require("order", CONTROLLER, changed)


def test_a_replayed_order_moves_nothing(world: World, seals: dict[str, Seals]) -> None:
    there = ordered(world, order_of(world, "LOC", 1 << 60), seals[CONTROLLER])
    assert give(world, there) == 0
    back = ordered(world, order_of(world, "SO", (1 << 60) + 1), seals[CONTROLLER])
    assert give(world, back) == 0
    term, moves = world.stamper.term, list(world.stamper.moves)
    assert world.stamper.placement == "SO"
    for replayed in (there, back, there, there, back):
        assert give(world, replayed) == 0
    assert (world.stamper.term, world.stamper.moves) == (term, moves)


def test_replayed_settings_do_not_come_back(world: World, seals: dict[str, Seals]) -> None:
    """Within one term, too: numbers grow."""
    number = 1 << 60
    forks = (("planning", "R2"),)
    old = order_of(world, "", number, shadow_fraction=0.5, forks=forks)
    new = order_of(world, "", number + 1, shadow_fraction=0.25)
    assert give(world, ordered(world, old, seals[CONTROLLER])) == 0
    assert (world.stamper.shadow_fraction, world.stamper.forks) == (0.5, forks)
    assert give(world, ordered(world, new, seals[CONTROLLER])) == 0
    assert give(world, ordered(world, old, seals[CONTROLLER])) == 0
    assert (world.stamper.shadow_fraction, world.stamper.forks) == (0.25, ())


def test_a_controller_whose_clock_is_behind_learns_the_numbers(
    problem: Problem, seals: dict[str, Seals]
) -> None:
    world = World(problem, policy="SO", seals=seals)
    world.run(1_000)
    far = order_of(world, "", 1 << 61, shadow_fraction=0.5)
    assert give(world, ordered(world, far, seals[CONTROLLER])) == 0
    world.run(3_000)
    cell = world.cell
    assert cell.order_number > 1 << 61
    assert world.stamper.newest_order > 1 << 61
    assert world.stamper.shadow_fraction == cell.controller.shadow_fractions["SO"]


def test_orders_in_any_order_end_where_the_last_says(
    problem: Problem, seals: dict[str, Seals]
) -> None:
    world = World(problem, seals=seals)
    world.run(1_000)
    fractions = [0.1, 0.2, 0.3, 0.4]
    sealed = [
        ordered(world, order_of(world, "", n, shadow_fraction=f), seals[CONTROLLER])
        for n, f in enumerate(fractions, 1)
    ]
    give(world, *[sealed[i] for i in (2, 0, 3, 1, 2, 0)])
    assert world.stamper.shadow_fraction == 0.4


# --------------------------------------------------------------------------- completions


def done_now(world: World, cycle: int, node: str = "R2", sink: str = "control") -> Completion:
    stamper = world.stamper
    stamp = Stamp(stamper.run, cycle, stamper.term, stamper.placement, world.network.now_ns)
    return Completion(stamp, sink, world.network.now_ns, "actuated", (), node)


def carried(world: World, *messages: tuple[str, bytes]) -> Arrival:
    return Arrival(world.keys.of(channels.CARRIED), encode(Carried(messages)))


@pytest.fixture
def forge(world: World, seals: dict[str, Seals]) -> Callable[..., bytes]:
    """What E's relay can make of a completion of the sink on R2."""

    def made(cycle: int, by: str = "E", word: str = "done", **more: str) -> bytes:
        return seals[by].seal(word, encode(done_now(world, cycle, **more)))

    return made


def test_a_relay_cannot_make_completions_up(world: World, forge: Callable[..., bytes]) -> None:
    keys = world.keys
    # What has been released last never arrives.
    world.kill("sink.control@R2")
    world.run(2 * world.problem.pipeline.period_ms)
    guard, cycle = world.stamper.guard, world.stamper.cycle - 1
    newest = guard.newest
    for key, data in (
        (keys.of(channels.DONE, "control"), forge(cycle)),
        (keys.of(channels.DONE, "control"), forge(cycle, node="E")),
        (keys.of(channels.DONE, "control"), encode(done_now(world, cycle))),
        (keys.of(channels.ENDED), forge(cycle, word="ended")),
        (keys.of(channels.DONE, "planning"), forge(cycle, by="R2")),
        # A good one, in another key's place.
        (keys.of(channels.DONE, "control"), forge(cycle, by="R2", word="ended")),
    ):
        assert give(world, carried(world, (key, data))) == 1
        assert guard.newest == newest
    # The sink's node itself is believed, whoever carries it.
    assert (
        give(world, carried(world, (keys.of(channels.DONE, "control"), forge(cycle, by="R2")))) == 0
    )
    assert guard.newest == cycle


def test_no_other_task_speaks_for_a_sink(world: World, seals: dict[str, Seals]) -> None:
    """What E may sign, of its own task, keeps no cycle from counting as complete."""
    world.kill("sink.control@R2")
    world.run(2 * world.problem.pipeline.period_ms)
    keys, cycle = world.keys, world.stamper.cycle - 1
    others = encode(done_now(world, cycle, node="E", sink="planning"))
    give(world, Arrival(keys.of(channels.ENDED), seals["E"].seal("ended", others)))
    assert world.stamper.guard.newest < cycle
    own = encode(done_now(world, cycle))
    assert (
        give(world, Arrival(keys.of(channels.DONE, "control"), seals["R2"].seal("done", own))) == 0
    )
    assert world.stamper.guard.newest == cycle


def test_a_relay_that_repeats_itself_does_not_hide_a_fault(world: World) -> None:
    """Nothing comes from R2 any more, but what it has said before is told again and again."""
    heard: list[Arrival] = []
    receive = world.stamper.receive

    def listen(sample: Arrival, now_ns: int) -> None:
        if sample.key == world.keys.of(channels.CARRIED):
            heard.append(sample)
        receive(sample, now_ns)

    world.stamper.receive = listen  # type: ignore[method-assign]
    world.run(500)
    assert heard
    old = heard[-20:]
    for who in ("sink.control@R2", "control@R2"):
        world.kill(who)
    before = world.stamper.guard.newest
    for _ in range(10):
        world.run(world.problem.pipeline.period_ms)
        for sample in old:
            receive(sample, world.network.now_ns)
    # No cycle after the last one counts as done, and the sink's node is known to be silent.
    assert world.stamper.guard.newest <= before + 2
    assert "control@R2" in world.stamper.guard.presence.missing("SO", world.network.now_ns)


def test_orders_take_no_detour(world: World, seals: dict[str, Seals]) -> None:
    """Not even good ones: whoever sends one that way holds it back as long as he likes."""
    keys = world.keys
    sealed = ordered(world, order_of(world, "LOC"), seals[CONTROLLER]).payload
    root = keys.root
    for key in (
        keys.of(channels.ORDER), keys.of(channels.FRAME), keys.of(channels.STAMPED),
        keys.detour(keys.of(channels.ORDER)), f"order/{root}/done", "order",
        f"{root}/detour/detour/order", f"{'x' * len(root)}/done/order",
    ):  # fmt: skip
        give(world, carried(world, (key, sealed)))
    assert world.stamper.placement == "SO"


# --------------------------------------------------------------------------------- beats


def beat_of(world: World, who: str, node: str, **more: object) -> Beat:
    last = world.stamper.pulse.detector.last(who)
    assert last is not None
    return msgspec.structs.replace(last, sent_ns=world.network.now_ns + 10**9, **more)


def test_a_relay_cannot_make_beats_up(world: World, seals: dict[str, Seals]) -> None:
    keys, who = world.keys, "control@R2"
    beat = beat_of(world, who, "R2", ready=False)
    key = keys.of(channels.BEAT, "R2", who)
    before = world.stamper.pulse.detector.last(who)
    for data in (encode(beat), seals["E"].seal("beat", encode(beat))):
        assert give(world, carried(world, (key, data))) == 1
        assert world.stamper.pulse.detector.last(who) == before
    assert give(world, carried(world, (key, seals["R2"].seal("beat", encode(beat))))) == 0
    assert world.stamper.pulse.detector.last(who) == beat


def test_a_beat_is_about_who_its_key_names(world: World, seals: dict[str, Seals]) -> None:
    """The key is what a certificate is let through for."""
    keys, who = world.keys, "control@R2"
    beat = beat_of(world, who, "R2", ready=False)
    before = world.stamper.pulse.detector.last(who)
    data = seals["E"].seal("beat", encode(beat))
    assert give(world, Arrival(keys.of(channels.BEAT, "E", "perception@E"), data)) == 1
    later = encode(msgspec.structs.replace(beat, sent_ns=beat.sent_ns + 1))
    for sealed in (seals["E"].seal("beat", later), seals["R2"].seal("beat", later)):
        assert (
            give(world, carried(world, (keys.of(channels.BEAT, "E", "perception@E"), sealed))) == 1
        )
    assert world.stamper.pulse.detector.last(who) == before


def beats_of(world: World, node: str, *names: str, **more: object) -> Arrival:
    """Beats of some processes, as the agent of a node sends them."""
    nodes = {role.who: role.node for role in roles(world.problem)}
    beats = tuple(beat_of(world, who, nodes[who], **more) for who in names)
    return Arrival(world.keys.of(channels.BEATS, node), encode(Beats(beats)))


def sealed(arrival: Arrival, seals: Seals) -> Arrival:
    return Arrival(arrival.key, seals.seal("beats", arrival.payload))


@pytest.mark.parametrize(
    "names",
    [
        ("agent@R2", "perception@E"),  # a process of another node
        ("agent@E", "perception@E"),  # another node
        ("control@R2",),  # not from its agent
        ("agent@R2", "controller@E"),
    ],
)
def test_an_agent_speaks_for_its_own_node_alone(
    world: World, seals: dict[str, Seals], names: tuple[str, ...]
) -> None:
    """Its key can claim what the processes of its node together could claim."""
    last = world.stamper.pulse.detector.last
    before = {who: last(who) for who in names}
    forged = sealed(beats_of(world, "R2", *names, ready=False), seals["R2"])
    for sample in (carried(world, (forged.key, forged.payload)), forged):
        assert give(world, sample) == 1
    assert {who: last(who) for who in names} == before
    good = sealed(beats_of(world, "R2", "agent@R2", "control@R2", ready=False), seals["R2"])
    assert give(world, good) == 0
    assert last("control@R2") != before.get("control@R2", last("agent@R2"))


def test_an_agent_does_not_speak_for_the_controller_on_its_node(
    world: World, seals: dict[str, Seals]
) -> None:
    """They share a computer, and no key."""
    last = world.stamper.pulse.detector.last
    before = last("controller@E")
    forged = sealed(beats_of(world, "E", "agent@E", "controller@E", ready=False), seals["E"])
    assert give(world, forged) == 1
    assert last("controller@E") == before


def test_a_relay_cannot_make_the_beats_of_a_node_up(world: World, seals: dict[str, Seals]) -> None:
    last = world.stamper.pulse.detector.last
    before = last("control@R2")
    beats = beats_of(world, "R2", "agent@R2", "control@R2", ready=False)
    for forged in (beats, sealed(beats, seals["E"])):
        assert give(world, carried(world, (forged.key, forged.payload))) == 1
    assert last("control@R2") == before
    true = sealed(beats, seals["R2"])
    assert give(world, carried(world, (true.key, true.payload))) == 0
    assert last("control@R2") != before


# ----------------------------------------------------------------------- the controller's


def test_the_controller_believes_the_stamper_alone(world: World, seals: dict[str, Seals]) -> None:
    keys, cell, stamper = world.keys, world.cell, world.stamper
    answer = Accepted(0, cell.name, "", stamper.run, stamper.term + 5, "LOC", stamper.cycle)
    for name in ("E", "R2", CONTROLLER):
        assert (
            world.tell(keys.of(channels.ACCEPTED), seals[name].seal("accepted", encode(answer)))
            == 1
        )
    assert world.tell(keys.of(channels.ACCEPTED), encode(answer)) == 1
    gathered = encode(
        Carried(((keys.of(channels.ACCEPTED), seals["E"].seal("accepted", encode(answer))),))
    )
    assert world.tell(keys.of(channels.GATHERED), gathered) == 1
    assert cell.course.placement == "SO"
    stamped = encode(Carried(((keys.of(channels.STAMPED), b"anything"),)))
    assert world.tell(keys.of(channels.GATHERED), stamped) == 1


def test_loads_and_states_are_told_by_their_node(world: World, seals: dict[str, Seals]) -> None:
    keys = world.keys
    load = Load("R1", 1, world.network.now_ns, 1, 1, 1)
    assert world.tell(keys.of(channels.LOAD, "R1"), seals["E"].seal("load", encode(load))) == 1
    assert world.tell(keys.of(channels.LOAD, "E"), seals["R1"].seal("load", encode(load))) == 1
    assert world.tell(keys.of(channels.LOAD, "R1"), seals["R1"].seal("load", encode(load))) == 0
    restored = Restored(1, "planning", "R2", 1, 1)
    assert (
        world.tell(keys.of(channels.RESTORED), seals["E"].seal("restored", encode(restored))) == 1
    )


def test_states_are_asked_for_by_the_controller(problem: Problem, seals: dict[str, Seals]) -> None:
    moving = stateful(problem, "planning", 100)
    world = World(moving, policy="LOC", seals=seals, stages={"planning": Counting})
    world.run(1_500)
    worker, key = (
        world.worker("planning@R2"),
        Keys(problem.name).of(channels.SNAPSHOT, "planning", "R2"),
    )
    asked = encode(Snapshot(9, "planning", "R2", "E", 1, 1))
    for data in (asked, seals["E"].seal("snapshot", asked)):
        worker.receive(Arrival(key, data), world.network.now_ns)
        assert not worker.transfer.asked
    # And by orders the state moves as ever.
    world.pin("SO")
    world.run(1_500)
    assert world.stamper.placement == "SO"
    counts = world.arm.counts
    assert counts[-1][1] > counts[0][1]


# --------------------------------------------------------------------------------- costs


def test_copies_cost_no_second_look(
    problem: Problem, seals: dict[str, Seals], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[tuple[str, str]] = []
    verifies = Seals._verifies

    def count(self: Seals, word: str, name: str, sealed: bytes) -> bool:
        found.append((self.keyring.own.name, word))
        return verifies(self, word, name, sealed)

    monkeypatch.setattr(Seals, "_verifies", count)
    fresh = {name: Seals(one.keyring) for name, one in seals.items()}
    world = World(problem, policy="LOC", seals=fresh)
    world.run(2_000)
    cycles = len(world.cycles)
    for name in ("R1", CONTROLLER):
        assert cycles - 4 <= found.count((name, "done")) <= cycles + 4
    # Beats come to the stamper directly, and need no look at their signatures.
    assert found.count(("R1", "beat")) < cycles / 10


def test_what_is_remembered_is_bounded(seals: dict[str, Seals]) -> None:
    fresh = Seals(seals["R1"].keyring)
    for number in range(signing.REMEMBERED + 50):
        fresh.require("done", "R2", seals["R2"].seal("done", str(number).encode()))
    assert len(fresh._good) == signing.REMEMBERED


# -------------------------------------------------------------------------------- stamps


def command_of(world: World, cycle: int, seal: bytes, *, term: int = 1) -> Arrival:
    """What planning on E may send to the control task: a cycle that nobody has released."""
    stamper = world.stamper
    stamp = Stamp(stamper.run, cycle, term, stamper.placement, world.network.now_ns)
    header = Header(stamp, "planning", "E", "bytes", seal=seal)
    return Arrival(world.keys.of(channels.INPUT, "control", "R2", "main"), b"-", encode(header))


def test_a_cycle_that_nobody_has_stamped_stops_no_arm(
    world: World, seals: dict[str, Seals]
) -> None:
    """A number far beyond all others would make every later command an old one, for good."""
    far, worker = 1 << 50, world.worker("control@R2")
    stamp = decode(command_of(world, far, b"").header, Header).stamp
    for term in (1, 0):
        forged = msgspec.structs.replace(stamp, term=term)
        for seal in (b"", bytes(64), *(seals[n].seal("stamp", encode(forged))[:64] for n in "E")):
            worker.receive(command_of(world, far, seal, term=term), world.network.now_ns)
    before = len(world.cycles)
    world.run(1_000)
    assert len(world.cycles) > before + 20
    assert far not in world.cycles
    assert worker.place.complained == 6


def test_a_stamp_is_for_one_cycle(world: World, seals: dict[str, Seals]) -> None:
    far, worker = 1 << 50, world.worker("control@R2")
    near = decode(command_of(world, 5, b"").header, Header).stamp
    seal = seals["R1"].seal("stamp", encode(near))[:SIGNATURE_BYTES]
    worker.receive(command_of(world, far, seal), world.network.now_ns)
    assert worker.place.complained == 1


def test_a_sources_guess_is_its_own(problem: Problem, seals: dict[str, Seals]) -> None:
    """Term 0 may be said by nodes that a source runs on, and by the stamper's for no term 0."""
    tasks = dict(problem.pipeline.tasks)
    source = tasks["sensing"]
    place = RolePlace(
        replace(problem, pipeline=replace(problem.pipeline, tasks={
            **tasks, "sensing": replace(source, on={**source.on, "R2": source.on["R1"]}),
        })),
        "control@R2", "R2", None, seals=seals["R2"],  # type: ignore[arg-type]
    )  # fmt: skip

    def read(by: str, term: int) -> Header | None:
        stamp = Stamp(1, 7, term, "LOC", 0)
        seal = seals[by].seal("stamp", encode(stamp))[:SIGNATURE_BYTES]
        return place.header(
            Arrival("k", b"", encode(Header(stamp, "planning", "E", "x", seal=seal)))
        )

    assert read("R2", 0)
    assert read("R1", 1)
    for by, term in (("R1", 0), ("E", 0), ("R2", 1), ("E", 1), (CONTROLLER, 1)):
        assert read(by, term) is None
