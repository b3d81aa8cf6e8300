"""Commands in this process: what they print, write and answer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner, Result

import dwell
from dwell.cli.commands import app
from dwell.cli.examples import find_examples
from dwell.errors import ProblemError, RunError
from dwell.model.document import to_document
from dwell.record import Run

ROOT = Path(__file__).parents[2]
CANONICAL = ROOT / "examples" / "canonical.yaml"
REAL = ROOT.parent / "shared" / "data"

SMALL = """\
dwell: 1
name: small
period_ms: 20
window_cycles: 10
nodes:
  R: {tier: robot, cores: 1}
  E: {tier: edge, cores: 4}
links:
  - {from: R, to: E, both_ways: true, delay_ms: 1}
tasks:
  sense: {on: {R: {exec_ms: 1}}}
  plan: {on: {R: {exec_ms: 8}, E: {exec_ms: 2}}}
flows:
  - {from: sense, to: plan}
candidates:
  LOC: {plan: R}
  OFF: {plan: E}
scenarios:
  stress: [{node: R, stress_threads: 3}]
"""


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a small cell in a folder of its own, which is the current one."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return path


def call(*arguments: str | Path) -> Result:
    """Run a command."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def read_json(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


# --------------------------------------------------------------------------------- general


def test_version() -> None:
    assert call("--version").stdout == f"dwell {dwell.__version__}\n"


def test_a_wrong_command_is_named_with_its_nearest() -> None:
    result = call("chek")
    assert result.exit_code == 2
    assert "check" in result.stderr


def test_an_internal_error_is_not_dressed_up(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr("dwell.cli.check.load", broken)
    assert isinstance(call("check", cell).exception, KeyError)


def test_interrupted_work_exits_with_130(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dwell.cli.check.load", interrupted)
    result = call("check", cell)
    assert (result.exit_code, result.output) == (130, "")


# ----------------------------------------------------------------------------------- check


def test_check_sums_up_a_cell(cell: Path) -> None:
    result = call("check", cell)
    assert (result.exit_code, result.stderr) == (0, "")
    for words in ("small: no faults", "can move: plan (R, E)", "scenarios: baseline, stress"):
        assert words in result.stdout
    rows = [line.split() for line in result.stdout.splitlines()]
    assert ["LOC", "9.0", "0.0", "45", "0"] in rows
    assert ["OFF", "4.0", "0.0", "5", "2"] in rows


def test_check_as_json(cell: Path) -> None:
    found = read_json(call("check", cell, "--json"))
    assert found["valid"] is True
    assert found["warnings"] == []
    assert found["candidates"]["OFF"]["l95_ms"] == 4.0
    assert found["candidates"]["OFF"]["own_work"] == {"R": 0.05, "E": 0.025}


def test_check_prints_every_fault_with_its_line(cell: Path) -> None:
    text = SMALL.replace("tier: edge", "tier: egde").replace("{plan: E}", "{plan: X}")
    cell.write_text(text, encoding="utf-8")
    result = call("check", cell)
    assert (result.exit_code, result.stdout) == (2, "")
    places = [line.split(" ")[0] for line in result.stderr.splitlines()]
    assert places == [f"{cell}:7:", f"{cell}:17:"]
    found = call("check", cell, "--json")
    assert (found.exit_code, found.stderr) == (2, "")
    assert [fault["line"] for fault in json.loads(found.stdout)["faults"]] == [7, 17]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "exec_ms: 8",
            "exec_ms: 30",
            ("candidates.LOC: its own work takes 155% of the cores of R",),
        ),
        (
            "candidates:",
            "objective: {caps: {latency_ms: 5}}\ncandidates:",
            ("candidates.LOC: L95 is 9.0 ms undisturbed, over the cap of 5 ms",),
        ),
        (
            "E: {exec_ms: 2}}}",
            "E: {exec_ms: 37.5, workers: 2}}}\ncontroller: {guard_cycles: 3, fallbacks: [LOC]}",
            ("controller.guard_cycles: 3 is tight for OFF", "40.5 ms", "40.0 ms"),
        ),
        (
            "E: {exec_ms: 2}}}",
            "E: {exec_ms: 2}}}\ncontroller: {fallbacks: [LOC], close_grace_ms: 59}\n"
            "live: {hosts: {R: {port: 7000}}}",
            ("controller.close_grace_ms: 59 is less", "= 60 ms", "7 cycles", "instead of 4"),
        ),
        (
            "E: {exec_ms: 2}}}",
            "E: {exec_ms: 2, workers: 2}}}\nlive: {hosts: {R: {port: 7000}}}",
            ("tasks.plan.on.E.workers: 2 is for the simulator", "one job at a time"),
        ),
    ],
)
def test_check_warns(cell: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    cell.write_text(SMALL.replace(old, new), encoding="utf-8")
    result = call("check", cell)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("warning: ") == 1
    for word in words:
        assert word in result.stderr
    assert len(read_json(call("check", cell, "--json"))["warnings"]) == 1


@pytest.mark.parametrize(
    ("jitter", "warned"),
    [
        ("{exponential: {mean: 1000}}", True),
        ("{uniform: {low: 0, high: 25}}", True),
        ("{uniform: {low: 0, high: 19}}", False),
        ("2", False),
    ],
)
def test_a_jitter_of_releases_beyond_the_period_is_warned_of(
    cell: Path, jitter: str, warned: bool
) -> None:
    text = cell.read_text(encoding="utf-8")
    cell.write_text(f"{text}\nrelease_jitter_ms: {jitter}\n", encoding="utf-8")
    found = read_json(call("check", cell, "--json"))["warnings"]
    assert [one["path"] for one in found if one["path"] == "release_jitter_ms"] == (
        ["release_jitter_ms"] if warned else []
    )


def test_cycles_on_their_way_when_a_run_ends_are_told_apart_from_lost_ones(cell: Path) -> None:
    """A task that takes more than a period: the queue before it grows to the end."""
    cell.write_text(SMALL.replace("{R: {exec_ms: 8}", "{R: {exec_ms: 130}"), encoding="utf-8")
    arguments = ("run", cell, "--policy", "LOC", "--windows", "10")
    row = read_json(call(*arguments, "--out", "one", "--json"))["summary"]
    assert row["lost"] == 0
    assert row["in_flight"] > row["cycles"] / 2
    text = call(*arguments, "--out", "two").stdout
    assert f"{row['in_flight']} of {row['cycles']}" in text
    assert "unfinished at the end" in text
    assert "inf" not in text
    assert "unfinished" not in call("run", cell, "--policy", "OFF", "--out", "three").stdout


def test_no_warning_about_a_guard_that_is_off_or_has_nowhere_to_go(cell: Path) -> None:
    slow = SMALL.replace("E: {exec_ms: 2}}}", "E: {exec_ms: 37.5, workers: 2}}}")
    for controller in ("", "controller: {fallbacks: [OFF]}\n"):
        cell.write_text(slow + controller, encoding="utf-8")
        assert call("check", cell).stderr == ""


@pytest.mark.parametrize(("grace_ms", "warned"), [(59, True), (60, False)])
def test_a_cell_with_stages_is_warned_of_closing_before_its_guard_acts(
    cell: Path, grace_ms: int, warned: bool
) -> None:
    """Before it has hosts, and so before anything is started."""
    document = to_document(dwell.load(cell))
    document["controller"] = {
        **document.get("controller", {}),
        "fallbacks": ["OFF"],
        "guard_cycles": 3,
        "close_grace_ms": grace_ms,
    }
    cell.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert "close_grace_ms" not in call("check", cell).stderr
    for name, task in document["tasks"].items():
        task["run"] = f"stages:{name}"
    cell.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert ("warning: controller.close_grace_ms: 59" in call("check", cell).stderr) is warned


def test_examples_are_without_faults_and_warnings() -> None:
    for path in (CANONICAL, CANONICAL.with_name("fan-in.yaml"), CANONICAL.with_name("cloud.yaml")):
        result = call("check", path)
        assert (result.exit_code, result.stderr) == (0, "")


def test_traces_may_be_elsewhere(cell: Path, tmp_path: Path) -> None:
    text = SMALL.replace("delay_ms: 1}", "delay_ms: {trace: {file: t.csv, column: up}}}")
    cell.write_text(text, encoding="utf-8")
    missing = call("check", cell)
    assert missing.exit_code == 2
    assert "--traces" in missing.stderr
    folder = tmp_path / "measured"
    folder.mkdir()
    (folder / "t.csv").write_text("up\n" + "1.5\n" * 400, encoding="utf-8")
    assert call("check", cell, "--traces", folder).exit_code == 0
    found = read_json(call("run", cell, "--traces", folder, "--windows", "4", "--json"))
    assert found["summary"]["cycles"] == 40
    absolute = SMALL.replace(
        "delay_ms: 1}", f"delay_ms: {{trace: {{file: {folder}/t.csv, column: up}}}}}}"
    )
    cell.write_text(absolute, encoding="utf-8")
    assert call("check", cell, "--traces", tmp_path).exit_code == 0


# ------------------------------------------------------------------------------------- run


def test_run_saves_and_sums_up(cell: Path) -> None:
    result = call("run", cell, "--scenario", "stress", "--policy", "OFF", "--windows", "12")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "small, stress, OFF, seed 1: 12 windows of 10 cycles" in result.stdout
    assert "saved to runs/small-stress-OFF-1" in result.stdout
    run = dwell.open_run("runs/small-stress-OFF-1")
    assert run.windows.height == 12
    assert run.meta["scenario"] == "stress"
    assert not run.has_jobs


def test_run_as_json_says_what_the_tables_say(cell: Path) -> None:
    found = read_json(
        call("run", cell, "--seed", "7", "--windows", "12", "--out", "here", "--jobs", "--json")
    )
    run = dwell.open_run("here")
    assert (found["run"], found["seed"], found["policy"]) == ("here", 7, "dtp")
    assert found["summary"]["cost"] == pytest.approx(run.windows["cost"].mean())
    assert found["summary"]["migrations"] == run.decisions["migrated"].sum()
    assert run.has_jobs


def test_a_run_that_is_all_warm_up(cell: Path) -> None:
    cell.write_text(SMALL + "warmup_windows: 5\n", encoding="utf-8")
    result = call("run", cell, "--windows", "5", "--out", "here")
    assert result.exit_code == 0
    assert "none after the 5 of warm-up" in result.stdout
    assert dwell.open_run("here").windows.height == 5
    assert read_json(call("run", cell, "--windows", "5", "--json"))["summary"] is None


def test_what_never_ends_is_null_in_json(cell: Path) -> None:
    cell.write_text(SMALL.replace("delay_ms: 1}", "delay_ms: 1, loss: 0.9}"), encoding="utf-8")
    found = read_json(call("run", cell, "--policy", "OFF", "--windows", "5", "--json"))
    assert found["summary"]["p95_ms"] is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scenario", "stres"), ("unknown scenario", "did you mean 'stress'?")),
        (("--policy", "dpt"), ("unknown policy", "did you mean 'dtp'?", "LOC, OFF")),
        (("--estimator", "profil"), ("unknown estimator", "profile")),
        (("--windows", "0"), ("--windows",)),
        (("--seed", "-1"), ("--seed",)),
        (("--seed", "one"), ("--seed",)),
        (("--out", "small.yaml"), ("is not a run",)),
    ],
)
def test_a_wrong_argument_changes_nothing(
    cell: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    result = call("run", cell, *arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    for word in words:
        assert word in result.stderr
    assert [path.name for path in cell.parent.iterdir()] == ["small.yaml"]


def test_another_run_is_not_replaced_unless_asked_for(cell: Path) -> None:
    words = ("run", cell, "--windows", "5", "--out", "kept")
    assert call(*words).exit_code == 0
    assert call(*words).exit_code == 0, "the same run again"
    other = call(*words, "--seed", "2")
    assert (other.exit_code, other.stdout) == (2, "")
    assert "kept holds another run" in other.stderr
    assert dwell.open_run("kept").meta["seed"] == 1
    # So many windows can not be drawn: the folder is looked at before.
    more = call("run", cell, "--windows", str(1 << 32), "--out", "kept")
    assert (more.exit_code, more.stdout) == (2, "")
    assert "kept holds another run" in more.stderr
    assert call(*words, "--seed", "2", "--force").exit_code == 0
    assert dwell.open_run("kept").meta["seed"] == 2


def test_a_study_given_to_run_is_called_one(cell: Path) -> None:
    Path("study.yaml").write_text("dwell-study: 1\ncell: small.yaml\n", encoding="utf-8")
    result = call("run", "study.yaml")
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "dwell study" in result.stderr


def test_unknown_names_are_listed_once(cell: Path) -> None:
    result = call("run", cell, "--scenario", "xyzzy")
    assert result.exit_code == 2
    assert result.stderr.count("baseline") == 1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("E: {exec_ms: 2}", "E: {exec_ms: 30}", "plan takes 30 ms a job on E"),
        ("to: plan}", "to: plan, bytes: 160000}", "64 Mbit/s over R->E, which carries 20"),
    ],
)
def test_check_warns_of_stages_and_links_that_cannot_keep_up(
    cell: Path, old: str, new: str, words: str
) -> None:
    assert old in SMALL
    text = SMALL.replace("delay_ms: 1}", "delay_ms: 1, rate_mbps: 20}")
    cell.write_text(text, encoding="utf-8")
    assert call("check", cell).stderr == ""
    cell.write_text(text.replace(old, new), encoding="utf-8")
    result = call("check", cell)
    assert result.exit_code == 0
    assert words in result.stderr


def test_a_folder_that_cannot_be_written_is_a_failure(
    cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> Path:
        raise RunError("here: cannot be written (No space left on device)")

    monkeypatch.setattr(Run, "save", full)
    result = call("run", cell, "--windows", "2")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "No space left" in result.stderr


def test_names_that_are_no_file_names(cell: Path) -> None:
    cell.write_text(SMALL.replace("name: small", "name: ../a b/c"), encoding="utf-8")
    assert read_json(call("run", cell, "--windows", "2", "--json"))["run"] == (
        "runs/.._a_b_c-baseline-dtp-1"
    )


# ---------------------------------------------------------------------------------- report


def test_report_writes_the_page_and_the_trace(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept", "--jobs")
    result = call("report", "kept")
    assert (result.exit_code, result.stdout) == (0, "report: kept/report.html\n")
    assert Path("kept/report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    found = read_json(call("report", "kept", "--out", "r.html", "--trace", "t.json", "--json"))
    assert found == {"report": "r.html", "trace": "t.json"}
    assert Path("r.html").is_file()
    assert json.loads(Path("t.json").read_text(encoding="utf-8"))["traceEvents"]


def test_report_of_what_is_not_there(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    without_jobs = call("report", "kept", "--trace", "t.json")
    assert (without_jobs.exit_code, without_jobs.stdout) == (2, "")
    assert "dwell run --jobs" in without_jobs.stderr
    assert {path.name for path in cell.parent.iterdir()} == {"small.yaml", "kept"}
    assert not Path("kept/report.html").exists()
    assert call("report", "nowhere").exit_code == 2
    assert call("report", ".").exit_code == 2


def test_a_page_that_cannot_be_written_is_a_failure(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    result = call("report", "kept", "--out", "small.yaml/report.html")
    assert result.exit_code == 1
    assert "error: " in result.stderr


# ---------------------------------------------------------------------------------- schema


def test_schema_is_json() -> None:
    assert read_json(call("schema"))["title"] == "Dwell cell"


# ------------------------------------------------------------------------------------ demo


def test_demo_prints_tables_and_writes_the_page(tmp_path: Path) -> None:
    arguments = ("--seeds", "2", "--windows", "8", "--processes", "1", "--out", tmp_path / "out")
    result = call("demo", *arguments)
    assert (result.exit_code, result.stderr) == (0, "")
    for words in ("Cell canonical", "Robot CPU stress", "DTP", "our reconstruction"):
        assert words in result.stdout
    assert result.stdout.endswith(f"report: {tmp_path / 'out' / 'report.html'}\n")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.startswith("<!DOCTYPE html>")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["report.html"]


def test_demo_as_json(tmp_path: Path) -> None:
    arguments = ("--seeds", "1", "--windows", "7", "--processes", "1", "--out", tmp_path, "--json")
    found = read_json(call("demo", *arguments))
    rows = found["comparisons"]["canonical"]
    corrected = {"dtp+corrected", "cusum+corrected"}
    others = {"LOC", "SO", "HYB", "atp", "dtp", "dtp, no caps", "latency-first"}
    assert {row["policy"] for row in rows} == others | corrected
    assert {row["seeds"] for row in rows} == {1}


@pytest.mark.skipif(not REAL.is_dir(), reason="the measurements are not beside the repository")
def test_demo_on_measurements(tmp_path: Path) -> None:
    arguments = ("--seeds", "1", "--windows", "8", "--processes", "1", "--out", tmp_path)
    result = call("demo", "--real", REAL, *arguments)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "Cell real\n" in result.stdout
    assert "Cell real-5g\n" in result.stdout
    assert (tmp_path / "report.html").is_file()


def test_demo_without_its_measurements_is_a_mistake(tmp_path: Path) -> None:
    result = call("demo", "--real", tmp_path, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "does not exist" in result.stderr
    assert not (tmp_path / "out").exists()


def test_examples_are_found_or_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_examples(None) == ROOT / "examples"
    assert find_examples(tmp_path) == tmp_path
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dwell, "__file__", str(tmp_path / "a" / "b" / "c" / "__init__.py"))
    with pytest.raises(ProblemError, match="--examples"):
        find_examples(None)
