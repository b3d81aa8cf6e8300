"""Agents and controller of cells: how they are started, and that none is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import TrustError
from dwell.live.host.security import INSECURE, Security
from dwell.live.local.processes import Processes, expected, without_keys
from dwell.live.trust import KEYS
from dwell.live.wire.wiring import Role
from dwell.model import Problem
from tests.cells.light import document, write_cell
from tests.waiting import wait_until

# Notes its words and a variable, and stays; it takes SIGTERM as it comes.
STAYS = (
    "import json, os, sys, time; "
    "print(json.dumps([sys.argv[1:], os.environ['MINE']]), flush=True); "
    "time.sleep(60)"
)

# Starts a node's agent, tells its process id, and waits to be killed.
OWNER = """
import sys, time
from pathlib import Path
import dwell
from dwell.live.local.loopback import on_this_machine
from dwell.live.local.processes import Processes

processes = Processes(on_this_machine(dwell.load(sys.argv[1])), Path(sys.argv[2]))
processes.write()
processes.start_agent("R1")
print(processes.running["agent@R1"].pid, flush=True)
time.sleep(3600)
"""


@pytest.fixture
def problem() -> Problem:
    return from_document(document())


def stays(node: str, words: Sequence[str]) -> Sequence[str]:
    """Run something else with the words."""
    return [sys.executable, "-c", STAYS, node, *words]


def logged(file: Path) -> str:
    """What a process has said, once it has."""
    until = time.monotonic() + 30
    while not (file.exists() and file.read_text().endswith("\n")) and time.monotonic() < until:
        time.sleep(0.02)
    return file.read_text()


def test_each_runs_where_it_belongs_with_what_it_needs(problem: Problem, tmp_path: Path) -> None:
    processes = Processes(problem, tmp_path, inside=stays, environment={"MINE": "yes"})
    processes.write()
    assert dwell.load(tmp_path / "cell.yaml") == problem
    try:
        processes.start_agent("R1")
        processes.start_controller(more=["--policy", "LOC"])
        assert processes.running.keys() == {"agent@R1", "controller@E"}
        agent = logged(tmp_path / "agent@R1.log")
        assert f'["R1", "{sys.executable}", "-m", "dwell", "agent", "--node", "R1"' in agent
        assert f'"--owner", "{os.getpid()}"' in agent
        assert f'"--cell", "{tmp_path}/cell.yaml"' in agent
        assert agent.rstrip().endswith('"yes"]')
        assert '"--policy", "LOC"' in logged(tmp_path / "controller@E.log")
        started = list(processes.running.values())
    finally:
        processes.stop()
    assert processes.running == {}
    assert all(one.poll() is not None for one in started)


def test_none_is_left_when_the_process_that_started_them_is_killed(tmp_path: Path) -> None:
    cell, out = write_cell(tmp_path), tmp_path / "out"
    words = [sys.executable, "-c", OWNER, str(cell), str(out)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, process_group=0) as owner:
        try:
            assert owner.stdout is not None
            agent = int(owner.stdout.readline())
            marks = [out / "R1" / f"{who}.pid" for who in ("stamper@R1", "sensing@R1")]
            wait_until(lambda: all(mark.exists() for mark in marks))
            pids = [agent, *(json.loads(mark.read_text())["pid"] for mark in marks)]
            assert all(psutil.pid_exists(pid) for pid in pids)
        finally:
            owner.send_signal(signal.SIGKILL)
    wait_until(lambda: not any(psutil.pid_exists(pid) for pid in pids))


def test_the_keys_of_another_cell_are_not_theirs(
    problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def says(node: str, words: Sequence[str]) -> Sequence[str]:
        return [sys.executable, "-c", f"import os; print(os.environ.get('{KEYS}'), flush=True)"]

    monkeypatch.setenv(KEYS, str(tmp_path / "of another cell"))
    processes = Processes(problem, tmp_path, inside=says)
    given = Processes(problem, tmp_path, inside=says, environment={KEYS: "of this cell"})
    try:
        processes.start_agent("R1")
        assert logged(tmp_path / "agent@R1.log") == "None\n"
        given.start_agent("R2")
        assert logged(tmp_path / "agent@R2.log") == "of this cell\n"
    finally:
        processes.stop()
        given.stop()
    role = Role("visitor", "R1", "visitor")
    with pytest.raises(TrustError):
        Security.of(problem, role)
    assert Security.of(problem, role, {**without_keys(), INSECURE: "1"}).keyring is None


def test_who_was_killed_with_its_node_is_forgotten(problem: Problem, tmp_path: Path) -> None:
    processes = Processes(problem, tmp_path, inside=stays, environment={"MINE": ""})
    processes.write()
    try:
        for node in ("E", "R1"):
            processes.start_agent(node)
        processes.start_controller()
        for who in ("agent@E", "controller@E"):
            processes.running[who].kill()
        processes.forget("E")
        assert processes.running.keys() == {"agent@R1"}
    finally:
        processes.stop()


def test_a_cell_that_is_written_elsewhere_still_finds_its_traces(tmp_path: Path) -> None:
    (tmp_path / "delays.csv").write_text("delay\n1.5\n2.5\n")
    links = [dict(link) for link in document()["links"]]
    links[0]["delay_ms"] = {"trace": {"file": "delays.csv", "column": "delay", "by": "row"}}
    problem = from_document(document(links=links), folder=tmp_path)
    processes = Processes(replace(problem, folder=str(tmp_path)), tmp_path / "out")
    processes.write()
    link = dwell.load(tmp_path / "out" / "cell.yaml").fabric.links["R1->E"]
    assert link.delay_ms.expectation == 2.0


def test_everybody_but_the_controller_is_expected(problem: Problem) -> None:
    found = expected(problem, "E")
    assert "agent@E" in found
    assert "perception@E" in found
    assert "controller@E" not in found
