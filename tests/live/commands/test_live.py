"""Live cells from the command line: real processes over Zenoh, begun by a camera's own frames."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import dwell
from dwell.errors import LiveError
from dwell.live.commands import live
from dwell.live.host.operator_client import OperatorClient
from dwell.live.wire.wiring import roles
from tests.cli.live_cell import EXAMPLE, MOODY, RealCell, in_window, invoke
from tests.cli.small_cell import ROOT
from tests.waiting import PATIENCE_S

CPU = min(os.sched_getaffinity(0))


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCell]:
    made = RealCell(tmp_path_factory.mktemp("live"))
    try:
        made.controller()
        made.agent("R2")
        made.agent("E", "--accelerator", "moody:busy")
        made.agent("R1", "--cpus-of", f"perception@*={CPU}", "--realtime", "camera@R1=1")
        made.until(
            lambda status: (
                not status["silent"]
                and all(one["ready"] for one in status["processes"].values())
                and in_window("LOC")(status)
            )
        )
        yield made
    finally:
        made.close()


def test_frames_begin_the_cycles(cell: RealCell) -> None:
    """Of a camera that brings 20 a second, in a cell whose stamper has no timer."""
    before = cell.until(lambda status: status["window"])["window"]["number"]
    cell.until(lambda status: status["window"]["number"] >= before + 2)
    assert "turn" in cell.log("R2", "sink.control@R2")


def test_status_says_who_is_there(cell: RealCell) -> None:
    # Other work on this machine may make the guard move the cell between two looks.
    stdout = cell.show(lambda stdout: stdout.startswith("light-follower: LOC\n"))
    lines = stdout.splitlines()
    assert lines[1].startswith("mode control, term ")
    assert lines[2].startswith("window ")
    shown = {line.split()[0] for line in lines[3:]}
    assert shown == {role.who for role in roles(cell.problem)} - {"controller@E"}
    stdout = cell.show(lambda stdout: json.loads(stdout)["health"] == "ok", "--check", "--json")
    assert json.loads(stdout)["headline"] is None


def test_status_shows_times_of_stages_and_counts_of_flows(cell: RealCell) -> None:
    status = cell.until(lambda status: status["stages"].get("perception@R1", {}).get("jobs"))
    one = status["stages"]["perception@R1"]
    assert 0 < one["exec_median_ms"] <= one["exec_p95_ms"]
    flow = status["flows"]["camera@R1->perception@R1"]
    ends = ("taken", "replaced", "dropped", "lost", "in_flight")
    assert flow["sent"] == sum(flow[end] for end in ends) > 0
    assert flow["bytes_per_s"] > 0
    stdout = cell.show(lambda stdout: "camera@R1->" in stdout, "--stages")
    _, _, tables = stdout.partition("\nstage ")
    stages, _, flows = tables.partition("\nflow ")
    (row,) = (line for line in stages.splitlines() if line.startswith("  perception@R1 "))
    assert len(row.split()) == 6
    assert "in_flight" in flows


def test_processes_are_placed_one_by_one(cell: RealCell) -> None:
    def pid(who: str) -> int:
        return int(json.loads((cell.state("R1") / f"{who}.pid").read_text())["pid"])

    assert os.sched_getaffinity(pid("perception@R1")) == {CPU}
    assert os.sched_getaffinity(pid("stamper@R1")) == os.sched_getaffinity(0)
    real = os.sched_getscheduler(pid("camera@R1")) == os.SCHED_FIFO
    # Who may not have the priority goes on without, and says so.
    assert real or "real-time priority 1" in cell.log("R1", "camera@R1")


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="needs SCHED_IDLE")
def test_only_shadow_workers_run_on_what_is_left(cell: RealCell) -> None:
    def scheduler(who: str) -> int:
        written = json.loads((cell.state("E") / f"{who}.pid").read_text())
        return os.sched_getscheduler(int(written["pid"]))

    assert scheduler("perception@E") == os.SCHED_OTHER
    idle = scheduler("perception@E.shadow") == os.SCHED_IDLE
    # Who may not have the class goes on without, and says so.
    assert idle or "no low scheduling class" in cell.log("E", "perception@E.shadow")


def test_an_accelerator_counts_beside_the_cpu(cell: RealCell) -> None:
    status = cell.until(lambda status: status["window"]["utilisation"]["E.gpu"] == 0.875)
    assert status["window"]["utilisation"].keys() == {"R1", "E", "R2", "E.gpu"}
    assert status["processes"]["agent@E"]["note"] == ""


def test_a_stage_that_raises_is_named_and_the_loop_goes_on(cell: RealCell) -> None:
    cell.mood.write_text("raise")
    who = cell.note("perception@R1")
    found = who(cell.until(lambda status: "no light" in who(status)))
    assert found.startswith("perception on R1: cycle ")
    assert found.endswith("process() raised ValueError: no light")
    cell.mood.write_text("text")
    found = who(cell.until(lambda status: "returned" in who(status)))
    assert found.endswith("process() returned a str, not a Message")
    cell.mood.unlink()
    before = cell.until(lambda status: status["window"])["window"]["number"]
    cell.until(lambda status: status["window"]["number"] > before)
    assert "process() raised ValueError: no light" in cell.log("R1", "perception@R1")


def test_what_a_stage_says_cannot_draw_on_a_terminal(cell: RealCell) -> None:
    cell.mood.write_text("draw")
    try:
        who = cell.note("perception@R1")
        found = who(cell.until(lambda status: "no\\r\\nlight" in who(status)))
        assert found.endswith(r"process() raised ValueError: \x1b[2Jno\r\nlight")
        stdout = cell.show(lambda stdout: r"\x1b[2Jno\r\nlight" in stdout)
        log = cell.log("R1", "perception@R1")
        assert r"\x1b[2Jnone\r" + "\ntold\n" in log
        for text in (stdout, log):
            assert text.replace("\n", "").isprintable()
    finally:
        cell.mood.unlink()


def test_a_pin_and_a_drain_move_the_cell(cell: RealCell, monkeypatch: pytest.MonkeyPatch) -> None:
    # A command waits for the move for some seconds, which this machine may need.
    monkeypatch.setattr(live, "MOVES_S", PATIENCE_S)

    def told(*words: str) -> tuple[int, str]:
        code, stdout, stderr = invoke("live", *words, "--cell", cell.file)
        return code, stdout + stderr

    code, text = told("pin", "SO")
    assert code == 0
    assert "; pinned to SO" in text
    assert "moving to" not in text
    cell.until(lambda status: status["placement"] == "SO")
    assert told("drain", "E") == (
        1,
        "error: refused: the cell is pinned to SO, which needs E; unpin it first\n",
    )
    assert told("pin", "LOC")[0] == 0
    cell.until(lambda status: status["placement"] == "LOC")
    assert cell.until(lambda status: status["pinned"] == "LOC")
    assert told("unpin")[0] == 0
    cell.until(lambda status: status["pinned"] is None)
    assert told("drain", "E")[0] == 0
    assert told("pin", "SO") == (1, "error: refused: SO needs E, which is drained\n")
    assert told("drain", "R1") == (
        1,
        "error: refused: every candidate needs R1; nothing could run\n",
    )
    assert told("pin", "NO") == (
        1,
        "error: refused: no candidate 'NO'; there are LOC, SO, HYB\n",
    )
    assert told("undrain", "X") == (1, "error: refused: no node 'X'; there are R1, E, R2\n")


def test_a_drained_node_gets_other_code(cell: RealCell) -> None:
    """Goes on from the test before: E is drained."""
    assert "the old code" in cell.log("E", "perception@E")
    assert cell.end("agent-E") == 0
    cell.until(lambda status: status["processes"]["agent@E"]["age_ms"] > 1_000)
    # Windows go on without E.
    before = cell.until(lambda status: status["window"])["window"]["number"]
    cell.until(lambda status: status["window"]["number"] > before)
    cell.module.write_text(MOODY.replace("the old code", "the new code"))
    cell.agent("E")
    cell.until(lambda status: status["processes"]["agent@E"]["age_ms"] < 1_000)
    assert invoke("live", "drain", cell.file, "E", "--off")[0] == 0
    assert invoke("live", "pin", cell.file, "SO")[0] == 0
    # Its run will have such a window.
    status = cell.until(in_window("SO"))
    assert status["drained"] == []
    assert "the new code" in cell.log("E", "perception@E")
    assert "the old code" in cell.log("R1", "perception@R1")


def test_status_says_what_the_controller_does_not_hear(cell: RealCell) -> None:
    cell.until(lambda status: status["health"] == "ok")
    killed = cell.processes.pop("agent-E")
    killed.kill()
    killed.wait(timeout=PATIENCE_S)
    silent = "light-follower is silent: the controller hears nobody since "
    stdout = cell.show(lambda stdout: stdout.startswith(silent), "--check", code=1)
    lines = stdout.splitlines()
    assert "the relay, agent E, is silent" in lines[0]
    assert not any(line.split()[1:2] == ["ready"] for line in lines[1:])
    assert invoke("live", "status", "--cell", cell.file)[0] == 0
    cell.agent("E")
    cell.until(lambda status: status["health"] == "ok")


def test_status_watches_until_it_is_interrupted(cell: RealCell) -> None:
    words = [sys.executable, "-m", "dwell", "live", "status", "--watch", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    with subprocess.Popen(
        [*words, "--cell", str(cell.file)], stdout=subprocess.PIPE, env=environment
    ) as watching:
        assert watching.stdout is not None
        looks = [json.loads(watching.stdout.readline()) for _ in range(3)]
        watching.send_signal(signal.SIGINT)
        assert watching.wait(timeout=PATIENCE_S) == 130
    assert [look["cell"] for look in looks] == ["light-follower"] * 3


def test_a_second_agent_of_a_node_is_refused(cell: RealCell) -> None:
    state = cell.folder / "state" / "second"
    second = cell.start(
        "second", "agent", "--node", "R2", "--cell", cell.file, "--state", state
    )  # fmt: skip
    assert second.wait(timeout=PATIENCE_S) == 1
    told = (cell.folder / "second.log").read_text()
    assert "agent@R2 cannot open its session 'control' on tcp/127.0.0.1:" in told
    assert "is taken, by an older process, another agent of the node or another cell" in told
    assert "Traceback" not in told


def test_another_cell_file_is_named_by_status(cell: RealCell) -> None:
    other = cell.file.with_name("other.yaml")
    other.write_text(yaml.safe_dump({**cell.document, "deadline_ms": 40}, sort_keys=False))
    cell.end("agent-E")
    cell.agent("E", cell=other)
    status = cell.until(lambda status: "agent@E" in status["strangers"])
    assert "agent@E has another cell file (" in status["strangers"]["agent@E"]
    cell.show(lambda stdout: "copy one file to all nodes" in stdout)
    # Nobody hears it: the guard has moved to where E is not needed.
    cell.until(lambda status: status["placement"] == "LOC" and status["guard_moves"])
    cell.end("agent-E")


def test_the_run_is_a_run(cell: RealCell) -> None:
    assert cell.end("controller") == 0
    (folder,) = (cell.folder / "runs").iterdir()
    run = dwell.open_run(folder)
    assert run.windows.height > 5
    assert {"LOC", "SO"} <= set(run.windows["placement"])


def test_nobody_answers(tmp_path: Path) -> None:
    made = RealCell(tmp_path)
    words = "no controller of cell 'light-follower' answers; is `dwell controller` running on E?"
    with OperatorClient(made.problem) as visitor, pytest.raises(LiveError, match=re.escape(words)):
        visitor.ask("status", patience_s=0.2)
    code, stdout, stderr = invoke("live", "status", "--json", "--cell", made.file)
    found = json.loads(stdout)
    assert (code, stderr) == (1, "")
    assert (found["health"], found["headline"], found["answer_age_ms"]) == ("absent", words, None)
    code, stdout, stderr = invoke("live", "status", "--cell", made.file)
    assert (code, stdout) == (1, "")
    # A cell of this name may run here with other ports, which is said, too.
    assert stderr.startswith(f"error: {words}")


# ------------------------------------------------------------------------ before the start


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "--node", "X"), "no node 'X' in cell 'light-follower'; there are R1, E, R2"),
        (("agent", "--node", "X", "--cell"), "no node 'X' in cell 'light-follower'"),
        (
            ("agent", "--node", "R1", "--realtime", "nobody@R1=3", "--cell"),
            "--realtime: 'nobody@R1=3' is for no process of the node: agent@R1, camera@R1, ",
        ),
        (
            ("agent", "--node", "R1", "--realtime", "camera@R1=100", "--cell"),
            "--realtime: '100' is no priority from 1 to 99",
        ),
        (
            ("agent", "--node", "R1", "--cpus-of", "camera@R1=x", "--cell"),
            "--cpus-of: 'x' is no list of CPUs, as 0,2-3",
        ),
        (
            ("agent", "--node", "R1", "--accelerator", "no_such:thing", "--cell"),
            "--accelerator: importing no_such failed",
        ),
    ],
)
def test_mistakes_are_told_before_anything_starts(arguments: tuple[str, ...], words: str) -> None:
    code, _, stderr = invoke(*arguments, EXAMPLE / "cell.yaml")
    assert code in (1, 2)
    assert words in " ".join(stderr.replace("│", "").split())
