"""What all processes of a cell share: complaints, beats, and what they find out by them."""

from __future__ import annotations

import pytest

import dwell
from dwell.live.roles.role import RIVAL_BEATS, Pulse, RolePlace
from dwell.live.wire import channels
from dwell.live.wire.messages import Beat, encode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from dwell.model.document import digests
from tests.live.memory_transport import Network
from tests.live.small_world import MS, World, canonical


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC",))


def test_other_cell_files_and_versions_are_named(problem: Problem) -> None:
    world = World(problem, policy="dtp")
    world.run(1_000)
    stamper = world.stamper
    digest = digests(world.problem)["wiring"]
    key = stamper.place.keys.of(channels.BEAT, "E", "agent@E")

    def beat(cell: str, version: str) -> str:
        one = Beat("agent@E", "E", 99, 1, True, cell=cell, version=version)
        stamper.receive(Arrival(key, encode(one)), world.network.now_ns)
        return stamper.place.last_complaint

    own = dwell.__version__
    assert beat("0123", own) == (
        f"agent@E has another cell file (0123) than stamper@R1 ({digest}); "
        "copy one file to all nodes"
    )
    assert beat(digest, "7.1.0") == (
        f"agent@E runs Dwell 7.1.0, and stamper@R1 {own}; install one version on all nodes"
    )
    assert stamper.pulse.strangers.keys() == {"agent@E"}
    count = stamper.place.complained
    # A patch release says the same things.
    assert beat(digest, f"{own.rpartition('.')[0]}.99") != ""
    assert stamper.place.complained == count
    assert not stamper.pulse.strangers


def test_a_process_of_another_cell_file_is_shown_by_the_controller(problem: Problem) -> None:
    world = World(problem, policy="dtp")
    world.run(1_000)
    cell = world.roles["controller@E"]
    keys, now_ns = world.stamper.place.keys, world.network.now_ns
    for who, node in (("stamper@R1", "R1"), ("agent@E", "E")):
        one = Beat(who, node, 99, 1, True, cell="other", version=dwell.__version__)
        cell.receive(Arrival(keys.of(channels.BEAT, node, who), encode(one)), now_ns)  # type: ignore[attr-defined]
    found = cell.status(now_ns)  # type: ignore[attr-defined]
    assert found["strangers"]["agent@E"].startswith("agent@E has another cell file (other)")
    # Its candidates may be others of the same names: it is ordered nothing.
    before = world.stamper.term
    world.pin("SO")
    assert cell.status(world.network.now_ns)["moving_to"] == "SO"  # type: ignore[attr-defined]
    assert world.stamper.term == before


def test_two_processes_of_one_name_are_noticed(problem: Problem) -> None:
    end = Network(delay_ns=0, start_ns=MS).transport("me", "R1")
    place = RolePlace(problem, "stamper@R1", "R1", end)
    pulse = Pulse(place, lambda: (True, ""), hears=[("*", "*")])
    key = place.keys.of(channels.BEAT, "E", "agent@E")

    def beat(life: int, sent_ns: int) -> None:
        one = Beat("agent@E", "E", life, sent_ns, True, cell=digests(problem)["wiring"])
        pulse.receive(Arrival(key, encode(one)), sent_ns)

    beat(1, 1)
    beat(2, 2)
    # One that was on its way when its sender died.
    beat(1, 3)
    assert place.complained == 0
    for sent_ns in range(4, 4 + RIVAL_BEATS):
        beat(1, sent_ns)
    assert place.last_complaint == (
        "two processes say that they are agent@E; end one: its agent runs twice?"
    )
