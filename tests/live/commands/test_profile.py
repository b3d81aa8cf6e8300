"""`dwell profile`: what it prints and writes, and how it fails."""

from __future__ import annotations

import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from typer.testing import Result

import dwell
from dwell.calibration.profile_file import read_profile
from dwell.calibration.round_trips import listen
from dwell.estimators import Profile
from tests.cli.small_cell import ROOT, assert_refused, read_json
from tests.cli.small_cell import call as call_dwell
from tests.waiting import PATIENCE_S

STAGES = """\
import os
CORES = []

def perceive():
    CORES.append(os.sched_getaffinity(0))
    print("printed by the stage")
    return sum(range(2000))

def plan(number):
    assert number == 10
    return number

def inputs(run):
    return 10

class Stage:
    def process(self, inputs):
        return inputs

stage = Stage()

def fail():
    if len(CORES) == 12:
        raise ValueError("no camera")
    CORES.append(None)
"""

CELL = """\
dwell: 1
name: measured
period_ms: 1000
window_cycles: 10
nodes:
  R1: {tier: robot}
  E: {tier: edge}
candidates:
  LOC: {perception: R1}
  OFF: {perception: E}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a folder with stages, which is the current one."""
    monkeypatch.chdir(tmp_path)
    Path("profiled_stages.py").write_text(STAGES, encoding="utf-8")
    yield tmp_path
    sys.modules.pop("profiled_stages", None)


def call(*arguments: str | Path) -> Result:
    """Run `dwell profile`."""
    return call_dwell("profile", *arguments)


def measure(node: str, *more: str | Path, runs: int = 40) -> Result:
    """Measure perception on a node, quickly."""
    task = "perception=profiled_stages:perceive"
    return call("--node", node, "--task", task, "--samples", str(runs), "--warmup", "3", *more)


@pytest.fixture
def port() -> Iterator[int]:
    """Return the port of a listener for one connection."""
    ports: queue.Queue[int] = queue.Queue()
    thread = threading.Thread(
        target=listen,
        args=("127.0.0.1", 0),
        kwargs={
            "announce": lambda _, port: ports.put(port),
            "log": lambda _: None,
            "once": True,
        },
        daemon=True,
    )
    thread.start()
    yield ports.get(timeout=PATIENCE_S)
    thread.join(timeout=PATIENCE_S)


def refused(result: Result, code: int, *words: str) -> None:
    """Assert that a command failed with an error of one line, and has written nothing."""
    assert_refused(result, *words, code=code)
    lines = [line for line in result.stderr.splitlines() if line != "printed by the stage"]
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    assert [path.name for path in Path().rglob("*.parquet")] == []


# --------------------------------------------------------------------------------------- tasks


def test_measuring_prints_a_table_and_what_to_paste(folder: Path) -> None:
    core = max(os.sched_getaffinity(0))
    result = measure("R1")
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.splitlines() if line]
    assert " ".join(rows[0]) == "ms n mean median p95 p99 max cv lag 1 cores used"
    assert rows[1][:2] == ["perception@R1", "40"]
    assert f"profiled_stages:perceive on core {core} of" in result.stdout
    assert "after 3 (warm-up) left out" in result.stdout
    assert "not subtracted" in result.stdout
    assert (
        "      R1: {exec_ms: {trace: {file: profiles/R1.parquet, column: perception@R1, by: row, "
        "wrap: true}}" in result.stdout
    )
    # What the stage prints is no part of the results.
    assert "printed by the stage" not in result.stdout
    assert result.stderr.count("printed by the stage") == 43
    assert pl.read_parquet("profiles/R1.parquet")["perception@R1"].len() == 40


def test_every_run_is_pinned_and_the_process_is_not_afterwards(folder: Path) -> None:
    before, core = os.sched_getaffinity(0), min(os.sched_getaffinity(0))
    found = read_json(measure("R1", "--core", str(core), "--json"))
    seen = sys.modules["profiled_stages"].CORES
    assert seen == [{core}] * 43
    assert found["measurements"]["perception@R1"]["about"]["cores"] == [core]
    assert os.sched_getaffinity(0) == before


def test_json_says_what_the_file_says(folder: Path) -> None:
    found = read_json(measure("R1", "--out", "here.parquet", "--json"))
    (measured,) = read_profile(Path("here.parquet"))
    one = found["measurements"]["perception@R1"]
    assert found["profile"] == "here.parquet"
    assert one["about"] == measured.about
    assert one["columns"]["perception@R1"]["mean"] == pytest.approx(measured.samples.mean())
    assert one["columns"]["perception@R1/cpu_ms"]["n"] == 40
    assert isinstance(one["warnings"], list)
    assert found["yaml"].startswith("tasks:\n  perception:\n")


def test_several_tasks_with_inputs_of_their_own(folder: Path) -> None:
    tasks = ("plan=profiled_stages:plan", "act=profiled_stages:stage.process")
    arguments = [word for task in tasks for word in ("--task", task)]
    arguments += ["--inputs", "plan=profiled_stages:inputs", "--inputs", "act=builtins:hex"]
    result = measure("R1", *arguments)
    assert result.exit_code == 0, result.output
    assert [one.name for one in read_profile(Path("profiles/R1.parquet"))] == [
        "perception@R1",
        "plan@R1",
        "act@R1",
    ]
    assert (
        call(
            *("--node", "E", "--samples", "2", "--task", "plan=profiled_stages:plan"),
            *("--inputs", "profiled_stages:inputs", "--period-ms", "1"),
        ).stdout.count("one every 1 ms")
        == 1
    )


def test_two_nodes_become_a_cell(folder: Path) -> None:
    """Measured, merged, pasted, loaded, run."""
    assert measure("R1").exit_code == 0
    assert measure("E").exit_code == 0
    files = ("profiles/R1.parquet", "profiles/E.parquet")
    found = read_json(call("merge", *files, "--out", "all.parquet", "--json"))
    Path("cell.yaml").write_text(CELL + found["yaml"], encoding="utf-8")
    problem = dwell.load("cell.yaml")
    # The flowless pair of candidates needs no link.
    samples = {one.about["node"]: one.samples for one in read_profile(Path("all.parquet"))}
    for name, node in (("LOC", "R1"), ("OFF", "E")):
        # Every window replays all of them.
        estimated = Profile(replace(problem, window_cycles=len(samples[node]))).l95_ms[name]
        assert min(abs(samples[node] - estimated)) < 1e-6


def test_a_second_measurement_replaces_the_first_but_nothing_else(folder: Path) -> None:
    assert measure("R1").exit_code == 0
    assert measure("R1", runs=50).exit_code == 0
    assert len(read_profile(Path("profiles/R1.parquet"))[0].samples) == 50
    other = call("--node", "R1", "--task", "plan=profiled_stages:perceive", "--samples", "2")
    assert other.exit_code == 2
    assert "holds perception@R1, which would be lost" in other.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--node", "R1"), ("needs --node and at least one --task",)),
        (("--task", "a=os:getpid"), ("needs --node",)),
        (("--node", "R1", "--task", "os:getpid"), ("'os:getpid'", "TASK=MODULE:FUNCTION")),
        (("--node", "R@1", "--task", "a=os:getpid"), ("node: 'R@1' is not a name",)),
        (("--node", "R1", "--task", "=os:getpid"), ("task: '' is not a name",)),
        (("--node", "R1", "--task", "a=no_such:f"), ("--task a", "no module 'no_such'")),
        (("--node", "R1", "--task", "a=os:getpit"), ("did you mean 'getpid'?",)),
        (("--node", "R1", "--task", "a=os:name"), ("--task a", "of type str")),
        (("--node", "R1", "--task", "a=profiled_stages:Stage"), ("is a class",)),
        (("--node", "R1", *("--task", "a=os:getpid") * 2), ("'a' is given twice",)),
        (
            ("--node", "R1", "--task", "a=os:getpid", "--inputs", "b=os:getpid"),
            ("--inputs: 'b' is not measured here",),
        ),
        (
            ("--node", "R1", "--task", "a=os:abs", "--inputs", "os:getpid", "--inputs", "a=os:f"),
            ("--inputs: given twice for 'a'",),
        ),
        (("--node", "R1", "--task", "a=os:getpid", "--inputs", "os:nope"), ("--inputs", "'nope'")),
        (("--node", "R1", "--task", "a=os:getpid", "--core", "4095"), ("no core 4095", "may use")),
        (("--node", "R1", "--task", "a=os:getpid", "--core", "x"), ("'x'", "0-3")),
        (("--node", "R1", "--task", "a=os:getpid", "--period-ms", "0"), ("period_ms: 0.0",)),
        (("--node", "R1", "--task", "a=os:getpid", "--out", "a.csv"), ("a.csv", ".parquet")),
        (("--samples", "5", "merge", "a.parquet", "--out", "b.parquet"), ("--samples", "'merge'")),
        (("merge", "a.parquet", "--out", "b.parquet"), ("a.parquet: no such file",)),
        (("link", "edge", "--from", "R1", "--to", "E"), ("'edge'", "HOST:PORT")),
        (("link", "e:1", "--from", "R1", "--to", "R1"), ("to: 'R1'",)),
        (("link", "e:1", "--from", "R1", "--to", "E", "--bytes", "0"), ("bytes: 0",)),
    ],
)
def test_a_mistake_writes_nothing(
    folder: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    refused(call(*arguments), 2, *words)


@pytest.mark.parametrize(
    "arguments", [("--samples", "0"), ("--warmup", "-1"), ("nope",), ("merge",)]
)
def test_arguments_have_bounds(folder: Path, arguments: tuple[str, ...]) -> None:
    result = call(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert not Path("profiles").exists()


def test_a_task_that_raises_writes_nothing_at_all(folder: Path) -> None:
    """The task before it was measured to the end."""
    failing = "fail=profiled_stages:fail"
    result = measure("R1", "--task", failing, runs=5)
    refused(result, 1, "fail, run 1: ValueError: no camera (profiled_stages.py:")


def test_an_interrupted_measurement_writes_nothing(folder: Path) -> None:
    Path("endless.py").write_text(
        "import time\ndef f():\n    print('begun', flush=True)\n    time.sleep(60)\n",
        encoding="utf-8",
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "dwell", "profile", "--node", "R1", "--task", "a=endless:f"],
        env={"PYTHONPATH": str(ROOT / "src"), "PATH": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "begun\n"
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, stdout, stderr) == (130, "", "")
    assert not Path("profiles").exists()


def test_a_module_that_cannot_be_imported(folder: Path) -> None:
    Path("profiled_broken.py").write_text("1 / 0\n", encoding="utf-8")
    result = call("--node", "R1", "--task", "a=profiled_broken:f")
    refused(result, 2, "ZeroDivisionError", "(profiled_broken.py:1)")


def test_files_that_cannot_be_merged(folder: Path) -> None:
    measure("R1")
    measure("E", runs=41)
    files = ("profiles/R1.parquet", "profiles/E.parquet")
    differing = call("merge", *files, "--out", "all.parquet")
    assert_refused(differing, "profiles/R1.parquet 40, profiles/E.parquet 41")
    twice = call("merge", files[0], files[0], "--out", "all.parquet")
    assert_refused(twice, "perception@R1 is both in profiles/R1.parquet and in profiles/R1.parquet")
    assert not Path("all.parquet").exists()


# --------------------------------------------------------------------------------------- links


def test_a_link_is_measured_and_goes_into_a_cell(folder: Path, port: int) -> None:
    result = call(
        *("link", f"127.0.0.1:{port}", "--from", "R1", "--to", "E"),
        *("--samples", "40", "--warmup", "2", "--bytes", "100000"),
    )
    assert result.exit_code == 0, result.output
    assert "as if both ways took equally long" in result.stdout
    assert "with 100000 bytes" in result.stdout
    measure("R1")
    measure("E")
    files = [f"profiles/{name}.parquet" for name in ("R1", "E", "R1-E")]
    found = read_json(call("merge", *files, "--out", "all.parquet", "--json"))
    Path("cell.yaml").write_text(CELL + found["yaml"], encoding="utf-8")
    link = dwell.load("cell.yaml").fabric.links["R1->E"]
    samples = pl.read_parquet("all.parquet")["R1->E"]
    assert link.delay_ms.expectation == pytest.approx(samples.mean())
    rate = found["measurements"]["R1->E"]["about"]["rate_mbps"]
    assert rate is None or link.rate_mbps == pytest.approx(rate, rel=1e-3)


def test_a_peer_that_is_not_there(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    result = call("link", f"127.0.0.1:{free}", "--from", "R1", "--to", "E")
    refused(result, 1, f"127.0.0.1:{free}: no connection", "dwell profile listen")


def test_a_listener_that_cannot_listen(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = server.getsockname()[1]
        refused(call("listen", "--port", str(taken)), 1, "cannot listen there")
