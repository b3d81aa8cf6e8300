"""Agents and processes of a cell with faults around their clock and transport."""

from __future__ import annotations

import re
import time
from contextlib import closing
from pathlib import Path

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.live.host.hosting import clock_of
from dwell.live.local.clocks import ClockFile
from dwell.live.local.linked_transport import without_source
from dwell.live.local.loopback import on_this_machine
from dwell.live.local.message_links import LinkFile
from dwell.live.local.process import FaultyPlatform, main, program
from dwell.live.local.processes import Processes
from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import Beats, decode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import wire
from dwell_lab.chaos.wiretap import entry_for
from tests.cells.light import document

HOUR_NS = 3_600_000_000_000
NODES = ("R1", "E", "R2")
PROBLEM = from_document(document())
CELL = str(Path(__file__).parents[3] / "examples" / "live" / "cell.yaml")


def test_a_clock_is_right_where_no_file_says_otherwise() -> None:
    assert FaultyPlatform().clock(PROBLEM, "R1") is clock_of(PROBLEM)


def test_a_command_that_is_no_role_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["simulate"])
    assert ended.value.code == 2
    assert "invalid choice: 'simulate'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["agent", "--node", "R1"], 2, "the following arguments are required: --cell"),
        (["agent", "--node", "R1", "--cell", CELL, "--cpus", "x"], 2, "--cpus: 'x' is no list"),
        (["agent", "--node", "X", "--cell", CELL], 1, "error: no node 'X' in cell"),
        (["controller", "--cell", "none.yaml"], 2, "none.yaml"),
    ],
)
def test_a_mistake_is_told_as_by_the_command(
    words: list[str], code: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        ended: int | str | None = main(words)
    except SystemExit as error:
        ended = error.code
    assert ended == code
    assert told in capsys.readouterr().err


def test_faults_are_around_an_agent_and_what_it_starts(tmp_path: Path) -> None:
    problem = on_this_machine(PROBLEM)
    heard: dict[str, tuple[str, int]] = {}

    def hear(sample: Arrival) -> None:
        source, _ = without_source(sample.header)
        for beat in decode(sample.payload, Beats).beats:
            heard[beat.who] = source, beat.sent_ns - time.monotonic_ns()

    links, clocks = tmp_path / "links", tmp_path / "clocks"
    with (
        closing(LinkFile(links, NODES)),
        closing(ClockFile(clocks, NODES, time.monotonic_ns)) as file,
    ):
        file.set("R1", jump_ns=HOUR_NS)
        processes = Processes(problem, tmp_path, program=program(links=links, clocks=clocks))
        processes.write()
        transport = ZenohTransport(entry_for(wire(problem), ["R1"]))
        try:
            transport.subscribe(Keys(problem.name).of(channels.BEATS, "*"), hear)
            processes.start_agent("R1")
            until_s = time.monotonic() + 60
            while not {"agent@R1", "stamper@R1", "sensing@R1"} <= heard.keys():
                assert time.monotonic() < until_s
                time.sleep(0.02)
        finally:
            transport.close()
            processes.stop()
    assert {source for source, _ in heard.values()} == {"R1"}
    assert all(abs(ahead_ns - HOUR_NS) < HOUR_NS // 10 for _, ahead_ns in heard.values())


def test_the_runtime_reads_no_fault_from_its_environment() -> None:
    assert dwell.__file__ is not None
    live = Path(dwell.__file__).parent / "live"
    beside = {live / "local", live / "commands"}
    found = {
        name
        for file in live.rglob("*.py")
        if file.parent not in beside
        for name in re.findall(r"DWELL_\w+", file.read_text())
    }
    assert found == {"DWELL_KEYS", "DWELL_INSECURE"}
