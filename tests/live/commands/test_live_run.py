"""`dwell live run`: what it shows meanwhile, what it writes into its run, how it ends."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import psutil
import pytest
import yaml

import dwell
from dwell.errors import OPTIONAL, LiveError, installing
from dwell.live.commands.live_run import MARK, ObservedRun
from dwell.live.local.playing import crowded, make_folder
from dwell.live.local.timeline import timeline_of
from dwell.live.trust import KEYS
from dwell.model import Problem
from dwell.model.document import to_document
from tests.cli.small_cell import ROOT, call
from tests.processes import lives
from tests.report.live_runs import PERIOD_NS, live_run

CELL = ROOT / "examples" / "visual_servoing" / "cell.yaml"
#: Its stages are light: less of the machine is needed to start and end it.
LIGHT = ROOT / "examples" / "live" / "cell.yaml"
#: Far more than any of it takes, on a machine that has a lot else to do.
PATIENCE_S = 240.0
#: The command, which gives a cell of twenty processes as long to start.
PATIENT = f"""
import sys
from dwell.cli import main
from dwell.live.local.loopback import Loopback
Loopback.start_s = {PATIENCE_S}
main(sys.argv[1:])
"""
LIVE_RUN = (sys.executable, "-c", PATIENT, "live", "run")
TWO_CPUS = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2, reason="robots and edge need a CPU each"
)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return dwell.load(CELL)


def test_a_run_is_told_what_was_played_and_when(problem: Problem, tmp_path: Path) -> None:
    folder = live_run(origin_ns=10 * PERIOD_NS).save(tmp_path / "run")
    timeline = timeline_of(problem, "demo", seed=5, seconds=100)
    told = ObservedRun(problem, "demo", 5, timeline)
    told.changed(timeline.changes[0], 20 * PERIOD_NS)
    run = told.note(folder, **told.observed(None))
    assert (run.meta["scenario"], run.meta["seed"]) == ("demo", 5)
    # Interrupted: it was on until the end.
    (played,) = run.meta["played"]
    assert played["node"] == "R1"
    assert played["at_s"] == pytest.approx(10 * PERIOD_NS / 1e9, abs=1e-3)
    assert played["for_s"] == pytest.approx(51 * PERIOD_NS / 1e9, abs=1e-3)
    assert "tracking" not in run.meta


@pytest.mark.parametrize("full", [("R1",), ("R1", "R2"), ()])
def test_a_machine_that_was_full_while_nothing_disturbed_it_is_warned_of(
    problem: Problem, full: tuple[str, ...]
) -> None:
    run = live_run(played=[{"node": "E", "at_s": 0.5, "for_s": 0.4}])
    # E is full only while it is stressed: in the windows that begin at 0.33 and 0.73 s.
    used = {
        "u_R1": [1.0 if "R1" in full else 0.9] * 6,
        "u_E": [0.3, 0.99, 0.99, 0.3, 0.3, 0.3],
        "u_R2": [1.0 if "R2" in full else 0.9] * 6,
    }
    windows = run.windows.with_columns(**{name: pl.Series(of) for name, of in used.items()})
    small = replace(problem, window_cycles=10)
    tables = {"cycles": run.cycles, "windows": windows, "decisions": run.decisions}
    warnings = crowded(dwell.Run(run.meta, tables), small)
    assert [warning.partition(" ")[0] for warning in warnings] == list(full)


def test_what_is_on_is_what_began_and_has_not_ended(problem: Problem) -> None:
    timeline = timeline_of(problem, "demo", seed=1, seconds=1_000)
    told = ObservedRun(problem, "demo", 1, timeline)
    seen = []
    for change in timeline.changes:
        told.changed(change)
        seen.append(tuple(one.kind for one in told.on()))
    assert list(dict.fromkeys(seen)) == [
        ("robot stress",), (), ("network impairment",), ("edge stress",),
    ]  # fmt: skip
    assert told.on() == []


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(LiveError, match="is not a live run's"):
        make_folder(tmp_path, MARK, "a live run's")
    make_folder(tmp_path / "out", MARK, "a live run's")
    (tmp_path / "out" / "runs").mkdir()
    make_folder(tmp_path / "out", MARK, "a live run's")
    assert not (tmp_path / "out" / "runs").exists()


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A cell that has begun to be played on."""
    one = subprocess.Popen(
        [*LIVE_RUN, str(LIGHT), "--scenario", "baseline", "--out", str(tmp_path / "out"), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # It makes a cell of its own: keys of another one are not for it.
        env={**os.environ, KEYS: str(tmp_path / "of another cell")},
    )
    assert one.stderr is not None
    try:
        assert "nothing disturbs it" in one.stderr.readline()
        yield one
    finally:
        one.kill()
        one.communicate()


def shared_by(processes: list[psutil.Process]) -> set[str]:
    """Files of Zenoh's in shared memory that processes have mapped."""
    found: set[str] = set()
    for process in processes:
        maps = Path(f"/proc/{process.pid}/maps").read_text()
        found.update(line.split()[-1] for line in maps.splitlines() if line.endswith(".zenoh"))
    return found


@TWO_CPUS
def test_interrupted_it_seals_its_run_and_ends_everything(
    demo: subprocess.Popen[str], tmp_path: Path
) -> None:
    of_it = psutil.Process(demo.pid).children(recursive=True)
    assert len(of_it) > 10
    demo.send_signal(signal.SIGINT)
    told, said = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode == 130
    assert "Traceback" not in said
    found = json.loads(told)
    assert found["interrupted"]
    run = dwell.open_run(found["run"])
    assert run.meta["recovered"]["sealed"]
    assert run.meta["scenario"] == "baseline"
    # No window may have closed.
    assert run.meta.get("played", []) == []
    # Everything had ended before it told so.
    assert not [process for process in of_it if process.is_running() and lives(process.pid)]


@TWO_CPUS
def test_killed_it_leaves_no_process_port_or_shared_memory(demo: subprocess.Popen[str]) -> None:
    of_it = psutil.Process(demo.pid).children(recursive=True)
    shared = shared_by(of_it)
    ports = {
        entry.laddr.port
        for process in of_it
        for entry in process.net_connections("tcp")
        if entry.status == psutil.CONN_LISTEN
    }
    assert shared
    assert ports
    demo.kill()
    _, alive = psutil.wait_procs(of_it, timeout=PATIENCE_S)
    assert alive == []
    assert not [name for name in shared if Path(name).exists()]
    for port in ports:
        with socket.socket() as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.bind(("127.0.0.1", port))


@TWO_CPUS
def test_any_cell_with_stages_runs_and_its_observer_looks_on(tmp_path: Path) -> None:
    """The tutorial's cell under other names, with a delay on a link, and an observer beside it."""
    beside = LIGHT.parent
    text = re.sub(r"\bplanning\b", "plan it", (beside / "cell.yaml").read_text())
    (tmp_path / "cell.yaml").write_text(text.replace("name: light-follower", "name: S\u00fcd x"))
    document = to_document(dwell.load(tmp_path / "cell.yaml"))
    delay = {"link": "R1->E", "both_ways": True, "at_s": 2, "for_s": 60, "add_delay_ms": 400}
    document["scenarios"] = {"calm": [], "far": [delay]}
    document["live"] = {**document.get("live", {}), "observer": "looking:Looking"}
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(document))
    stages = (beside / "stages.py").read_text().replace('"planning"', '"plan it"')
    (tmp_path / "stages.py").write_text(stages)
    (tmp_path / "looking.py").write_text(OBSERVER)
    words = ["--scenario", "far", "--seconds", "6", "--policy", "SO", "--seed", "3"]
    done = subprocess.run(
        [*LIVE_RUN, str(tmp_path / "cell.yaml"), *words, "--out", str(tmp_path / "out"), "--json"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    run = dwell.open_run(told["run"])
    assert (run.meta["scenario"], run.meta["seed"]) == ("far", 3)
    assert run.meta["looked"] > 3
    assert len(run.meta["played"]) == 2
    assert Path(told["report"]).is_file()
    # From then on nothing that goes over the edge is there in time, by the link alone.
    begun_ns = run.disturbances[0].at_s * 1e9
    before = run.cycles.filter(pl.col("release_ns") < begun_ns)
    after = run.cycles.filter(pl.col("release_ns") > begun_ns + 1e9)
    on_edge = after.filter(pl.col("placement").cast(pl.String) == "SO")
    # A busy machine makes cycles late, but not all of them.
    assert before["latency_ns"].drop_nulls().min() < 400e6  # type: ignore[operator]
    if on_edge.height:
        assert on_edge["missed"].all()
        assert on_edge["latency_ns"].drop_nulls().min() > 400e6  # type: ignore[operator]


#: Hides packages from a process and those that it starts.
BARE = """
import sys
for module in {hidden!r}:
    sys.modules[module] = None
"""


@TWO_CPUS
@pytest.mark.parametrize("extra", ["live", "sim"])
def test_it_needs_no_more_than_the_extra_live(extra: str, tmp_path: Path) -> None:
    cell, site = tmp_path / "cell" / "cell.yaml", tmp_path / "site"
    shutil.copytree(LIGHT.parent, cell.parent)
    text = cell.read_text()
    assert "at_s: 8, for_s: 10" in text
    cell.write_text(text.replace("at_s: 8, for_s: 10", "at_s: 2, for_s: 2"))
    site.mkdir()
    hidden = [module for module, (_, of) in OPTIONAL.items() if of not in ("live", extra)]
    (site / "sitecustomize.py").write_text(BARE.format(hidden=hidden))
    path = os.pathsep.join((str(site), str(ROOT / "src")))
    words = ["--scenario", "slow-link", "--seconds", "6", "--out", str(tmp_path / "out"), "--json"]
    done = subprocess.run(
        [*LIVE_RUN, str(cell), *words],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    # What will be missing is said before anything is started, with what brings it.
    assert done.stderr.startswith("note: there will be no report")
    assert installing("report") in done.stderr.splitlines()[0]
    told = json.loads(done.stdout)
    assert told["cycles"] > 0
    assert told["report"] is None
    run = dwell.open_run(told["run"])
    assert len(run.cycles) == told["cycles"]
    assert run.meta["scenario"] == "slow-link"
    assert len(run.meta["played"]) == 2
    assert Path(told["run"], "run.json").exists() == (extra == "sim")
    # Where everything is installed there is a report on it.
    assert call("report", told["run"]).exit_code == 0


OBSERVER = """
class Looking:
    def __init__(self, folder, begin_ns):
        self.looks = 0
    def look(self, now_ns):
        self.looks += 1
        return {}
    def told(self, origin_ns):
        return {"looked": self.looks}
    def close(self):
        pass
"""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"without": ["camera"]}, "nothing to run for camera"),
        ({"live": {"observer": "looking"}}, "live.observer: 'looking' is not allowed"),
        ({"scenario": "storm"}, "storm"),
        (
            {"run": "nowhere:Camera"},
            "tasks.camera.run (nowhere:Camera): no module 'nowhere'",
        ),
        (
            {"controller": {"policy": "nowhere:Mine"}},
            "controller.policy: policy 'nowhere:Mine': no module 'nowhere'",
        ),
        (
            {"controller": {"estimator": "nowhere:Mine"}},
            "controller.estimator: estimator 'nowhere:Mine': no module 'nowhere'",
        ),
    ],
)
def test_what_cannot_be_run_is_said(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    document = to_document(dwell.load(LIGHT))
    for task in change.get("without", ()):
        del document["tasks"][task]["run"]
    if "run" in change:
        document["tasks"]["camera"]["run"] = change["run"]
    for section in ("live", "controller"):
        document[section] = {**document.get(section, {}), **change.get(section, {})}
    cell = tmp_path / "cell.yaml"
    cell.write_text(yaml.safe_dump(document))
    scenario = ["--scenario", change["scenario"]] if "scenario" in change else []
    done = call("live", "run", cell, "--out", tmp_path / "out", *scenario)
    assert done.exit_code in (1, 2)
    assert said in done.stderr
    assert not (tmp_path / "out").exists()
