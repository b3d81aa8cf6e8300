"""`dwell live up`, `down` and `log`: real agents and a real controller in the background."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import yaml

from dwell.live.host.supervision import survivor
from dwell.live.wire.local_addresses import taken_ports
from dwell.live.wire.wiring import wire
from dwell.record import open_run
from tests.cli.live_cell import MOODY, RealCell, invoke
from tests.cli.small_cell import environment
from tests.waiting import PATIENCE_S, wait_until

#: An address for documentation (RFC 5737), which no computer has.
AWAY = "192.0.2.7"


class Cell:
    """The example's cell, run in the background by the command line.

    `printed` is the output of the command that started it; `well` says that a test has left it as
    the next one needs it.
    """

    def __init__(self, folder: Path) -> None:
        self.cell = RealCell(folder)
        self.file, self.problem = self.cell.file, self.cell.problem
        self.root, self.out = folder / "background", folder / "runs"
        self.folder = self.root / self.problem.name
        self.text = self.file.read_text()
        self.printed, self.well = "", False

    @property
    def names(self) -> set[str]:
        return {*(f"agent@{node}" for node in self.problem.fabric.nodes), "controller@E"}

    def dwell(self, *words: str | Path) -> tuple[int, str, str]:
        """Run a command in this process."""
        code, stdout, stderr = invoke("live", *words, "--state", self.root)
        assert "Traceback" not in stderr
        return code, stdout, stderr

    def up(self, *more: str | Path) -> tuple[int, str, str]:
        """Start it by a process of its own: its processes are no children of the test's."""
        words = ("up", "--out", self.out, *more, self.file, "--state", self.root)
        done = subprocess.run(
            [sys.executable, "-m", "dwell", "live", *map(str, words)],
            cwd=self.cell.folder,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=2 * PATIENCE_S,
            check=False,
        )
        assert "Traceback" not in done.stderr
        return done.returncode, done.stdout, done.stderr

    def refused(self, *more: str | Path) -> tuple[int, str]:
        """Call `dwell live up` where it starts nothing; return its exit code and its errors."""
        code, _, error = self.dwell("up", "--out", self.out, *more, self.file)
        return code, error

    def down(self) -> tuple[int, str, str]:
        return self.dwell("down", self.file)

    def restore(self) -> None:
        """End it, with the files of the example."""
        self.file.write_text(self.text)
        self.cell.module.write_text(MOODY)
        self.down()

    def stand(self) -> None:
        """Be up and healthy, from the test before if that has left it so."""
        if not self.well:
            self.restore()
            code, self.printed, error = self.up()
            assert code == 0, error
        self.well = False
        self.cell.until(lambda status: status["window"] and not status["silent"])

    def running(self, pattern: str) -> dict[str, psutil.Process]:
        found = {mark.stem: survivor(mark) for mark in self.folder.glob(pattern)}
        return {who: process for who, process in found.items() if process is not None}

    def taken(self) -> str:
        entries = wire(self.problem).entries.values()
        return taken_ports(end.port for entry in entries for end in entry.listen.values())

    def cell_log(self, node: str, who: str) -> str:
        return (self.folder / node / f"{who}.log").read_text()

    def assert_nothing_is_there(self) -> None:
        assert self.taken() == ""
        assert not self.root.exists()
        assert not self.out.exists()

    def change(self, **live: object) -> None:
        document = yaml.safe_load(self.file.read_text())
        document["live"] |= live
        self.file.write_text(yaml.safe_dump(document, sort_keys=False))


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    made = Cell(tmp_path)
    yield made
    made.restore()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    made = Cell(tmp_path_factory.mktemp("shared"))
    yield made
    made.restore()


@pytest.fixture
def standing(shared: Cell) -> Cell:
    """Return a cell that is up; to start one takes 7 s of a CPU, so tests pass it on."""
    shared.stand()
    return shared


def test_a_cell_comes_up_and_is_looked_at(standing: Cell) -> None:
    cell = standing
    assert all(name in cell.printed for name in cell.names)
    running = cell.running("*.pid")
    assert running.keys() == cell.names
    # A session of their own: what ends the terminal does not reach them.
    assert all(os.getsid(process.pid) == process.pid for process in running.values())

    code, error = cell.refused()
    assert code == 1
    assert "is up already" in error
    assert cell.running("*.pid") == running

    code, told, _ = cell.dwell("log", cell.file)
    assert code == 0
    assert {"agent@E", "controller@E", "sink.control@R2"} <= set(told.split())
    code, _, error = cell.dwell("log", cell.file, "nobody@E")
    assert code == 2
    assert "no process 'nobody@E' of " in error
    assert "sink.control@R2" in error
    code, told, _ = cell.dwell("log", "controller@E", "--cell", cell.file)
    assert code == 0
    assert "the run is kept in" in told
    follows_until_interrupted(cell, "sink.control@R2")
    cell.well = True


def follows_until_interrupted(cell: Cell, who: str) -> None:
    words = [sys.executable, "-m", "dwell", "live", "log", str(cell.file), who, "-f"]
    words += ["--state", str(cell.root)]
    with subprocess.Popen(
        words, env=environment(), stdout=subprocess.PIPE, text=True, bufsize=1
    ) as following:
        assert following.stdout is not None
        assert len([following.stdout.readline() for _ in range(3)]) == 3
        before = (cell.folder / "R2" / f"{who}.log").read_text()
        # More comes than there was when it began.
        while following.stdout.readline().strip() in before:
            pass
        following.send_signal(signal.SIGINT)
        following.stdout.read()
    assert following.returncode == 130


def test_other_code_is_taken_over_node_by_node(standing: Cell) -> None:
    cell = standing
    # Perception is on E; R1 and R2 have what every candidate needs.
    assert invoke("live", "pin", cell.file, "SO")[0] == 0
    assert invoke("live", "pin", cell.file, "--off")[0] == 0
    before = cell.running("**/*.pid")
    cell.cell.module.write_text(MOODY.replace("the old code", "the new code"))
    code, told, error = cell.up("--again")
    assert (code, error) == (0, "")
    assert told.splitlines()[:1] == ["E runs the new code"]
    assert "code is taken over by " in told
    after = cell.running("**/*.pid")
    assert after.keys() == before.keys()
    same = {who for who in before if before[who] == after[who]}
    assert same == {"agent@E", "agent@R1", "agent@R2", "controller@E"}
    assert "the new code" in cell.cell_log("E", "perception@E")
    status = cell.cell.until(lambda status: status["health"] == "ok")
    assert status["drained"] == []
    cell.well = True


def test_other_wiring_ends_all_and_starts_it_where_that_is_allowed(standing: Cell) -> None:
    cell = standing
    before, text = cell.running("**/*.pid"), cell.file.read_text()
    cell.file.write_text(text.replace("policy: LOC", "policy: NO"))
    code, error = cell.refused("--again")
    assert (code, "unknown policy 'NO'" in error) == (2, True)
    cell.file.write_text(text.replace("probe_cycles: 5", "probe_cycles: 6"))
    code, error = cell.refused("--again")
    assert code == 1
    assert re.search(r"takes about \d+ s without commands; with --yes it is done", error)
    assert cell.running("**/*.pid") == before
    code, told, error = cell.up("--again", "--yes")
    assert (code, error) == (0, "")
    assert "s without commands" in told
    assert "light-follower is up: " in told
    assert all(who in told for who in ("agent@R1", "agent@E", "agent@R2", "controller@E"))
    cell.cell.until(lambda status: status["window"] and status["health"] == "ok")
    assert not {*before.values()} & {*cell.running("**/*.pid").values()}
    assert cell.up("--again")[1].startswith("cell.yaml: text is taken over by agent@E, ")
    cell.well = True


def test_an_edited_cell_is_taken_over_after_an_orderly_end_alone(standing: Cell) -> None:
    """Whatever dies meanwhile begins with the bytes that all others have."""
    cell = standing
    text = cell.file.read_text()
    cell.file.write_text(text.replace("guard_cycles: 40", "guard_cycles: 41"))
    cell.cell.module.write_text("broken(")
    words = "cell.yaml, moody.py on E have changed since "
    cell.cell.until(lambda status: words in cell.cell.note("agent@E")(status))
    assert words in cell.cell.until(lambda status: status["changed"])["changed"]
    # A worker, and an agent with all that is its.
    killed = {who: one for who, one in cell.running("E/*.pid").items() if who != "agent@E"}
    for process in [cell.running("*.pid")["agent@E"], *killed.values()]:
        process.send_signal(signal.SIGKILL)
    agent = [sys.executable, "-m", "dwell", "agent", "--node", "E", "--cell", str(cell.file)]
    state = str(cell.folder / "E")
    with subprocess.Popen([*agent, "--state", state], env=environment()) as started:
        cell.cell.until(
            lambda status: (
                status["health"] == "ok"
                and not {"perception@E", "agent@E"} & status["strangers"].keys()
                and status["processes"]["perception@E"]["age_ms"] < 1_000
            )
        )
        started.kill()
    # The end of the computer; its next start.
    for process in cell.running("**/*.pid").values():
        process.send_signal(signal.SIGKILL)
    wait_until(lambda: not cell.running("**/*.pid"))
    code, _, error = cell.up()
    assert code == 0, error
    assert "cell.yaml, moody.py on R1, E, R2 have changed since " in error
    cell.cell.until(lambda status: status["window"] and not status["silent"])
    assert "guard_cycles: 40" in (cell.folder / "R1" / "cell" / "cell.yaml").read_text()

    assert cell.down()[0] == 0
    cell.cell.module.write_text(MOODY)
    code, _, error = cell.up()
    assert (code, error) == (0, "")
    cell.well = True
    assert "guard_cycles: 41" in (cell.folder / "R1" / "cell" / "cell.yaml").read_text()


def test_other_decisions_are_taken_over_while_every_process_runs_on_until_it_goes_down(
    standing: Cell,
) -> None:
    cell = standing
    assert invoke("live", "pin", "SO", "--cell", cell.file)[0] == 0
    running = cell.running("**/*.pid")
    earlier = {*cell.out.glob("light-follower-*")}
    (first,) = (one for one in earlier if not (one / "run.json").exists())
    text = cell.file.read_text()
    cell.file.write_text(text.replace("min_improvement: 0.05", "min_improvement: 0.5"))
    code, told, error = cell.up("--again")
    assert (code, error) == (0, "")
    assert "decision is taken over by agent@E, agent@R1, agent@R2, controller@E" in told
    # The same processes, of the same numbers, since the same instants.
    assert cell.running("**/*.pid") == running
    status = cell.cell.until(lambda status: status["window"] and not status["silent"])
    assert (status["pinned"], status["placement"], status["changed"]) == ("SO", "SO", None)
    assert not any("changed" in process["note"] for process in status["processes"].values())
    assert (first / "run.json").exists()
    code, told, _ = cell.down()
    assert code == 0
    assert all(name in told for name in cell.names)
    assert cell.running("**/*.pid") == {}
    assert cell.taken() == ""
    # The controller ends with the others, so its run is complete.
    (second,) = {one.parent for one in cell.out.glob("*/run.json")} - earlier
    before, after = open_run(first), open_run(second)
    assert "continues" not in before.meta
    assert after.meta["continues"] == first.name
    found = [run.problem.controller.min_improvement for run in (before, after)]
    assert found == [0.05, 0.5]
    code, told, _ = cell.down()
    assert (code, "does not run here" in told) == (0, True)
    code, error = cell.refused("--again")
    assert (code, "does not run here; this starts it: dwell live up " in error) == (1, True)


def test_what_dead_agents_have_left_is_named_and_ended(standing: Cell) -> None:
    cell = standing
    for process in cell.running("*.pid").values():
        process.send_signal(signal.SIGKILL)
    wait_until(lambda: not cell.running("*.pid"))
    left = cell.running("*/*.pid")
    assert "sink.control@R2" in left
    code, error = cell.refused()
    assert code == 1
    assert "an agent of light-follower has died, and its processes still run" in error
    assert "sink.control@R2" in error
    assert cell.running("*.pid") == {}
    assert cell.running("*/*.pid") == left
    code, told, _ = cell.down()
    assert code == 0
    assert "sink.control@R2" in told
    assert cell.running("**/*.pid") == {}
    assert cell.taken() == ""


def test_a_taken_port_is_named_and_nothing_is_started(cell: Cell) -> None:
    port = wire(cell.problem).entry("perception@E").listen["control"].port
    with socket.create_server(("127.0.0.1", port)):
        code, error = cell.refused()
        assert code == 1
        assert f"of the ports of light-follower are taken: {port} by " in error
    cell.assert_nothing_is_there()


@pytest.mark.parametrize(
    ("live", "options", "code", "words"),
    [
        ({"silence": "shout"}, (), 2, "live.silence"),
        ({"actuators": {"control": "nowhere:Drive"}}, (), 1, "no module 'nowhere'"),
        ({}, ("--node", "R9"), 2, "no node 'R9' in cell 'light-follower'; there are R1, E, R2"),
        ({"hosts": "away"}, (), 2, "no node of cell 'light-follower' is this computer"),
        ({"hosts": "away"}, ("--node", "E"), 1, "is beyond this computer, and without keys"),
        (
            {"hosts": "away"},
            ("--node", "E", "--insecure"),
            1,
            f"live.hosts.E: {AWAY} is no address of this computer",
        ),
    ],
)
def test_what_cannot_run_is_said_and_nothing_is_started(
    cell: Cell, live: dict[str, object], options: tuple[str, ...], code: int, words: str
) -> None:
    if "hosts" in live:
        places = {"R1": 7450, "E": 7500, "R2": 7550}
        live = {"hosts": {node: {"address": AWAY, "port": port} for node, port in places.items()}}
    cell.change(**live)
    found, error = cell.refused(*options)
    assert (found, words in error) == (code, True), error
    cell.assert_nothing_is_there()


def test_what_has_been_started_is_ended_where_something_does_not_start(cell: Cell) -> None:
    cell.out.write_text("no folder")
    code, _, error = cell.up("--out", cell.out / "runs")
    assert code == 1
    assert "controller@E has ended with exit code 1" in error
    assert "cannot be made" in error
    cell.out.unlink()
    cell.assert_nothing_is_there()
