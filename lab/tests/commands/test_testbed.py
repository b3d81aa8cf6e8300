"""`dwell testbed run` and `doctor`: what they refuse, and that nothing is left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

import dwell
from dwell.live.local.cgroups import find_cgroups
from dwell_lab.testbed.groups import group_name
from dwell_lab.testbed.hosts import namespace_name, namespace_path
from lab.tests.testbed.machine import no_groups, no_hosts, own_name
from tests.cells.light import QUOTAS, document, write_cell
from tests.cli.small_cell import assert_refused, call
from tests.processes import lives
from tests.waiting import wait_until

PATIENCE_S = 240.0
NOT_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
MACHINE = pytest.mark.skipif(
    bool(no_hosts() or no_groups() or os.cpu_count() == 1),
    reason=no_hosts() or no_groups() or "a testbed needs two CPUs",
)


def command(*words: object) -> list[str]:
    return [sys.executable, "-m", "dwell", "testbed", *map(str, words)]


def dwell_testbed(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*words), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def left(name: str) -> list[str]:
    """What a testbed of this name has left."""
    found = [
        str(path)
        for node in QUOTAS
        if (path := namespace_path(namespace_name(name, node))).exists()
    ]
    found += [str(path) for path in find_cgroups().groups(group_name(name)) if path.exists()]
    return found


@contextmanager
def running(cell: Path, out: Path, name: str) -> Iterator[subprocess.Popen[bytes]]:
    """Start a long run, and wait until its stamper is there."""
    errors = out.with_suffix(".errors")
    with errors.open("wb") as file:
        process = subprocess.Popen(
            command("run", cell, "--seconds", 600, "--out", out, "--name", name), stderr=file
        )
    try:
        stamper = out / "R1" / "stamper@R1.pid"
        wait_until(
            lambda: stamper.exists() or process.poll() is not None,
            "the stamper",
            patience_s=PATIENCE_S,
        )
        assert process.poll() is None, errors.read_text()
        yield process
    finally:
        process.kill()
        process.wait()
    assert "Traceback" not in errors.read_text()


# ------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--scenario", "impared"), "unknown scenario 'impared'"),
        (("--policy", "dpt"), "dpt"),
        (("--name", "no such/name"), "cannot be named"),
        (("--windows", "3", "--seconds", "5"), "give one of them"),
    ],
)
def test_what_is_unknown_is_an_error_before_anything_is_changed(
    options: Sequence[str], said: str, tmp_path: Path
) -> None:
    cell = write_cell(tmp_path)
    done = call("testbed", "run", cell, "--out", tmp_path / "out", *options)
    assert_refused(done, said, code=done.exit_code or 1)
    assert not (tmp_path / "out").exists()


def test_a_disturbed_link_that_is_not_in_the_cell_is_an_error(tmp_path: Path) -> None:
    cell = write_cell(tmp_path, scenarios={"some": [{"link": "R1->R9", "loss": 0.1}]})
    done = call("testbed", "run", cell, "--scenario", "some", "--out", tmp_path / "out")
    assert_refused(done, "R9")
    assert not (tmp_path / "out").exists()


def test_quotas_that_do_not_fit_are_an_error(tmp_path: Path) -> None:
    nodes = document()["nodes"]
    for node in nodes.values():
        node["cores"], node["quota"]["cpu"] = 999, 999
    cell = write_cell(tmp_path, nodes=nodes)
    done = call("testbed", "run", cell, "--out", tmp_path / "out")
    assert_refused(done, "too few for these nodes", code=1)
    assert not (tmp_path / "out").exists()


@NOT_ROOT
def test_who_is_not_root_is_told(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    # Who is nobody may not be able to read where Python is: what is needed is
    # imported before.
    code = (
        "import os, pathlib, sys, dwell, dwell_lab.testbed.run as testbed\n"
        "problem = dwell.load(sys.argv[1]); testbed.examine([problem])\n"
        "os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "try:\n"
        "    testbed.run_once(problem, scenario='baseline', policy=None, seconds=5, seed=1, "
        "out=pathlib.Path(sys.argv[2]), name='nobody')\n"
        "except dwell.errors.LiveError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(cell), str(tmp_path / "out")],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert "this machine cannot run the testbed" in done.stdout, done.stderr
    assert "root" in done.stdout
    assert not (tmp_path / "out").exists()


def test_the_doctor_says_what_there_is(tmp_path: Path) -> None:
    done = call("testbed", "doctor", write_cell(tmp_path), "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == (0 if found["ok"] else 1)
    assert {"CPUs"} <= {row["name"] for row in found["findings"]}
    assert all(row["ok"] or row["remedy"] for row in found["findings"] if row["needed"])


# ------------------------------------------------------------------------------ real runs


@MACHINE
def test_killed_it_is_cleared_away_by_the_next_which_plays_its_scenario_and_leaves_nothing(
    tmp_path: Path,
) -> None:
    name, cell = own_name(), write_cell(tmp_path)
    with running(cell, tmp_path / "first", name) as first:
        # While it lives the name is its own.
        refused = call("testbed", "run", cell, "--out", tmp_path / "other", "--name", name)
        assert_refused(refused, "runs already", code=1)
        of_it = psutil.Process(first.pid).children(recursive=True)
    options = ("--scenario", "impaired", "--windows", 4, "--name", name, "--json")
    done = dwell_testbed("run", cell, "--out", tmp_path / "second", *options)
    # 1 is what a machine that has a lot else to do ends with.
    assert done.returncode in (0, 1), done.stderr
    told = json.loads(done.stdout)
    assert told["failed"] == (done.returncode == 1)
    run = dwell.open_run(told["run"])
    assert run.meta["scenario"] == "impaired"
    assert {item.get("link", item.get("node")) for item in run.meta["played"]} == {
        "R1->E",
        "E->R1",
        "E",
    }
    assert all(item["for_s"] > 0 for item in run.meta["played"])
    assert run.windows["window"].to_list() == [0, 1, 2, 3][: max(run.windows.height, 1)]
    assert set(run.windows["placement"]) == {"SO"}
    assert len(run.meta["pressure"]["windows"]) == run.windows.height
    assert run.meta["testbed"]["nodes"]["E"]["quota"] == {"cpu": 0.8, "period_ms": 4.0}
    # It cannot have been less than the links' delay.
    assert run.cycles["latency_ns"].drop_nulls().min() > 2_000_000  # type: ignore[operator]
    assert run.meta["links"]["R1->E"]["messages"] > 0
    assert left(name) == []
    _, alive = psutil.wait_procs(of_it, timeout=PATIENCE_S)
    assert alive == []


@MACHINE
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_it_takes_everything_down(number: signal.Signals, tmp_path: Path) -> None:
    name, cell = own_name(), write_cell(tmp_path)
    with running(cell, tmp_path / "out", name) as process:
        of_it = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == 130
    assert left(name) == []
    assert not [process for process in of_it if process.is_running() and lives(process.pid)]
