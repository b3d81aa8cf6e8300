"""Processes that are forked from one that has done their imports, and how they end."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from dwell.live.host.launcher import UNKNOWN_CODE, ForkServer, Running
from dwell.live.host.supervision import SupervisedProcess, Supervisor
from tests.waiting import PATIENCE_S, wait_until

#: Imports something that takes a while, then runs the words of its caller as code.
PROGRAM = """
import sys, time
from dwell.live.host.launcher import serve
time.sleep(0.2)
imported = object()
words = serve()
if words is not None:
    exec(words[0])
"""


@pytest.fixture
def server() -> Iterator[ForkServer]:
    made = ForkServer([sys.executable, "-c", PROGRAM], {**os.environ, "OF_THE_NODE": "7"})
    wait_until(made.ready)
    yield made
    made.stop()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


def start(server: ForkServer, log: Path, code: str) -> Running:
    with log.open("ab") as file:
        return server.start([code], file)


def test_a_forked_process_has_imports_environment_and_a_log(server: ForkServer, log: Path) -> None:
    code = "import os; print(type(imported).__name__, os.environ['OF_THE_NODE'], sys.stdin.read())"
    process = start(server, log, code)
    assert process.wait() == 0
    assert log.read_text() == "object 7 \n"


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("raise SystemExit(3)", 3),
        ("raise ValueError('no camera')", 1),
        ("import os; os.kill(os.getpid(), 9)", -signal.SIGKILL),
    ],
)
def test_how_a_forked_process_ended(
    server: ForkServer, log: Path, code: str, expected: int
) -> None:
    process = start(server, log, code)
    assert process.wait() == expected
    assert process.poll() == expected


def test_forked_processes_share_nothing_that_is_random(server: ForkServer, log: Path) -> None:
    code = "import random, numpy as np; print(random.random(), np.random.random())"
    for _ in range(2):
        assert start(server, log, code).wait() == 0
    numbers = log.read_text().split()
    assert len(set(numbers)) == len(numbers) == 4


def test_ctrl_c_for_the_agent_is_not_for_them(server: ForkServer, log: Path) -> None:
    process = start(server, log, "time.sleep(1000)")
    assert os.getpgid(process.pid) == process.pid
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


def test_what_was_forked_outlives_its_server_and_another_one_starts(
    server: ForkServer, log: Path
) -> None:
    process = start(server, log, "time.sleep(1000)")
    (parent,) = [psutil.Process(process.pid).parent()]
    assert parent is not None
    parent.kill()
    wait_until(lambda: not server.ready())
    assert process.poll() is None
    wait_until(server.ready)
    assert start(server, log, "raise SystemExit(4)").wait() == 4
    assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    wait_until(lambda: process.poll() is not None)
    assert process.poll() == UNKNOWN_CODE


def test_a_server_ends_with_its_agent_and_leaves_what_it_has_forked(tmp_path: Path) -> None:
    agent = (
        "import os, sys, time\n"
        "from dwell.live.host.launcher import ForkServer\n"
        f"server = ForkServer([sys.executable, '-c', {PROGRAM!r}])\n"
        "while not server.ready():\n"
        "    time.sleep(0.01)\n"
        f"with open({str(tmp_path / 'log')!r}, 'ab') as log:\n"
        "    print(server.start(['time.sleep(1000)'], log).pid, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    with psutil.Popen([sys.executable, "-c", agent], stdout=-1) as ended:
        told, _ = ended.communicate(timeout=PATIENCE_S)
    process = psutil.Process(int(told))
    try:
        server = process.parent()
        wait_until(lambda: process.parent() != server or server is None or server.pid == 1)
        assert process.is_running()
    finally:
        process.kill()


def test_a_killed_worker_is_forked_again(server: ForkServer, tmp_path: Path) -> None:
    said: list[str] = []
    supervisor = Supervisor(tmp_path, said.append, server)
    child: SupervisedProcess = supervisor.keep("worker@E", ["time.sleep(1000)"])

    def started(count: int) -> bool:
        supervisor.step()
        return child.starts == count

    wait_until(lambda: started(1))
    first = child.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: started(2))
    assert said == ["worker@E was killed by SIGKILL"]
    assert child.pid not in (None, first)
    supervisor.stop()
    assert not psutil.pid_exists(first)
