"""Agents and controller that one process starts: their commands, logs and end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from dwell.live.host.node_processes import NodeProcesses, end_all
from tests.waiting import wait_until

# Prints its words, and stays.
STAYS = "import sys, time; print(sys.argv[1:], flush=True); time.sleep(60)"
# Ignores SIGTERM.
STUBBORN = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1, flush=True)"


def start_script(command: Sequence[str], **options: object) -> subprocess.Popen[bytes]:
    """Start a script with the words of the command."""
    return subprocess.Popen([sys.executable, "-c", STAYS, *command[1:]], **options)  # type: ignore[call-overload,no-any-return]


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[NodeProcesses]:
    made = NodeProcesses(
        *(tmp_path / "cell.yaml", tmp_path / "logs"),
        root=tmp_path / "state",
        environment=os.environ,
        popen=start_script,
        start_new_session=True,
    )
    made.folder.mkdir()
    yield made
    made.end("", 5.0)


def printed(processes: NodeProcesses, who: str) -> str:
    wait_until(lambda: processes.log(who).read_text().endswith("\n"))
    return processes.log(who).read_text()


def test_each_process_has_its_command_its_log_and_its_session(
    processes: NodeProcesses, tmp_path: Path
) -> None:
    processes.start_agent("R1")
    processes.start_controller_on("E", tmp_path / "runs", ["--policy", "LOC"])
    file, state = tmp_path / "cell.yaml", tmp_path / "logs" / "R1"
    agent = ["-m", "dwell", "agent", "--node", "R1", "--cell", str(file), "--state", str(state)]
    assert printed(processes, "agent@R1") == f"{agent}\n"
    assert "'--policy', 'LOC'" in printed(processes, "controller@E")
    assert all(os.getsid(one.pid) == one.pid for one in processes.running.values())


def test_the_controller_can_end_before_the_agents(processes: NodeProcesses, tmp_path: Path) -> None:
    processes.start_agent("R1")
    processes.start_controller_on("E", tmp_path / "runs")
    controller = processes.running["controller@E"]
    processes.end("controller@", 5.0)
    assert controller.poll() == -signal.SIGTERM
    assert processes.running.keys() == {"agent@R1"}


def test_a_process_that_ignores_sigterm_is_killed() -> None:
    words = [sys.executable, "-c", f"{STUBBORN}; time.sleep(60)"]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        end_all([process], 0.1)
        assert process.poll() == -signal.SIGKILL
