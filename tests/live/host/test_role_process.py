"""The end of a sink's process, and of its agent: the actuator is brought to rest."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from dwell.live.host.role_process import bring_to_rest
from dwell.live.local.processes import without_keys
from dwell.live.roles.sink import Sink
from tests.cli.live_cell import RealCell
from tests.live.small_world import Arm, World, canonical
from tests.waiting import PATIENCE_S, wait_until

SINK = "sink.control@R2"
#: An actuator that writes down how it is called, and raises as often as a file beside it says.
ARM = """
from pathlib import Path

HERE = Path(__file__).parent
HERE.joinpath("calls").touch()

def called(what):
    with HERE.joinpath("calls").open("a") as calls:
        calls.write(what + "\\n")
    fails = HERE / f"{what}-fails"
    left = int(fails.read_text()) if fails.exists() else 0
    if left:
        fails.write_text(str(left - 1))
        raise RuntimeError(f"{what}: the bus is off")

class Arm:
    def apply(self, command): called("apply")
    def hold(self): called("hold")
    def zero(self): called("zero")
    def stop(self): called("stop")
"""


class Ending:
    """A cell file with that actuator, and processes of it."""

    def __init__(self, folder: Path) -> None:
        made = RealCell(folder)
        document = made.document
        document["live"] |= {"actuators": {"control": "arm:Arm"}, "silence": "hold"}
        document["live"]["max_age_ms"] = 200
        made.file.write_text(yaml.safe_dump(document, sort_keys=False))
        made.file.with_name("arm.py").write_text(ARM)
        self.folder, self.file, self.state = folder, made.file, made.state("R2")
        self.running: list[subprocess.Popen[bytes]] = []

    def start(self, *words: str | Path) -> subprocess.Popen[bytes]:
        """Start a module, and wait until the actuator is there."""
        owner = "--owner", str(os.getpid())
        with (self.folder / "log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", *map(str, words), "--cell", str(self.file), *owner],
                stdout=log,
                stderr=log,
                env=without_keys(),
            )
        self.running.append(process)
        wait_until(self._listens)
        return process

    def _listens(self) -> bool:
        """Whether the sink has made its actuator, and what it remembers by."""
        return self.file.with_name("calls").exists() and any(self.state.glob(f"{SINK}.highest"))

    def sink(self) -> subprocess.Popen[bytes]:
        return self.start("dwell.live.host.role_command", "--who", SINK, "--state", self.state)

    def agent(self) -> subprocess.Popen[bytes]:
        return self.start("dwell", "agent", "--node", "R2", "--state", self.state)

    def fail(self, what: str, times: int) -> None:
        self.file.with_name(f"{what}-fails").write_text(str(times))

    @property
    def calls(self) -> list[str]:
        return self.file.with_name("calls").read_text().split()

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text()

    def close(self) -> None:
        for process in self.running:
            process.kill()
            process.wait()


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Ending]:
    made = Ending(tmp_path)
    yield made
    made.close()


def end(process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> int:
    process.send_signal(number)
    return process.wait(PATIENCE_S)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_sink_that_is_told_to_end_stops_its_actuator(cell: Ending, number: int) -> None:
    assert end(cell.sink(), number) == 0
    assert cell.calls == ["zero", "stop"]


def test_a_stop_that_raises_at_the_end_is_repeated(cell: Ending) -> None:
    cell.fail("zero", 2)
    cell.fail("stop", 1)
    assert end(cell.sink()) == 0
    assert cell.calls == ["zero"] * 3 + ["stop"] * 2


def test_a_stop_that_raises_to_the_last_is_told_by_the_exit_code(cell: Ending) -> None:
    cell.fail("zero", 1_000)
    assert end(cell.sink()) == 1
    assert cell.calls.count("zero") > 2
    assert cell.calls[-1] == "stop"
    assert "zero() raised RuntimeError: zero: the bus is off" in cell.log


def test_a_second_signal_ends_a_sink_at_once(cell: Ending) -> None:
    cell.fail("zero", 1_000)
    process = cell.sink()
    process.terminate()
    wait_until(lambda: "zero" in cell.calls)
    # The end of a terminal brings several of these.
    process.send_signal(signal.SIGHUP)
    assert end(process) == 1
    assert "stop" not in cell.calls


def test_the_end_of_an_agents_terminal_ends_its_processes_in_order(cell: Ending) -> None:
    process = cell.agent()
    assert end(process, signal.SIGHUP) == 0
    assert cell.calls[-2:] == ["zero", "stop"]
    assert not list(cell.state.glob("*.pid"))


def test_an_agent_says_that_an_actuator_may_not_have_stopped(cell: Ending) -> None:
    cell.fail("zero", 1_000)
    process = cell.agent()
    assert end(process) == 1
    last = cell.log.strip().splitlines()[-1]
    assert last.startswith(f"error: {SINK} ended with exit code 1: ")
    assert "the bus is off" in last


def test_a_second_signal_has_an_agent_end_all_at_once(cell: Ending) -> None:
    cell.fail("zero", 1_000)
    process = cell.agent()
    process.terminate()
    wait_until(lambda: "zero" in cell.calls)
    assert end(process) == 1
    assert not list(cell.state.glob("*.pid"))
    assert "stop" not in cell.calls


class Stuck(Arm):
    """An actuator without `stop` that raises as often as it is told."""

    def __init__(self, fails: int) -> None:
        super().__init__()
        self.fails, self.zeros = fails, 0

    def zero(self) -> None:
        self.zeros += 1
        if self.zeros <= self.fails:
            raise OSError("no answer")


@pytest.mark.parametrize(("fails", "rests"), [(0, True), (1, True), (10_000, False)])
def test_an_actuator_without_stop_is_told_zero(fails: int, rests: bool) -> None:
    sink = World(canonical()).roles["sink.control@R2"]
    assert isinstance(sink, Sink)
    sink.actuator = arm = Stuck(fails)
    assert bring_to_rest(sink, 0.5) is rests
    assert arm.zeros > min(fails, 1)
