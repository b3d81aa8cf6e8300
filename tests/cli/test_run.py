"""`dwell run`: what it prints, saves and refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import yaml

import dwell
from dwell.errors import RunError
from dwell.model import Constant
from dwell.model.evolve import evolve
from dwell.record import Run
from tests.cells.many import document_of
from tests.cli.small_cell import SMALL, assert_refused, call, read_json


def test_cycles_on_their_way_when_a_run_ends_are_told_apart_from_lost_ones(cell: Path) -> None:
    """A task that takes more than a period: the queue before it grows to the end."""
    cell.write_text(SMALL.replace("{R: {exec_ms: 8}", "{R: {exec_ms: 130}"), encoding="utf-8")
    arguments = ("run", cell, "--policy", "LOC", "--windows", "10")
    row = read_json(call(*arguments, "--out", "one", "--json"))["summary"]
    assert row["lost"] == 0
    assert row["in_flight"] > row["cycles"] / 2
    text = call(*arguments, "--out", "two").stdout
    assert re.search(rf"^unfinished at the end +{row['in_flight']}$", text, re.MULTILINE)
    assert "inf" not in text
    assert "unfinished" not in call("run", cell, "--policy", "OFF", "--out", "three").stdout


def test_run_saves_and_sums_up(cell: Path) -> None:
    result = call("run", cell, "--scenario", "stress", "--policy", "OFF", "--windows", "12")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "small, stress, OFF, seed 1: 12 windows of 10 cycles" in result.stdout
    assert "dwell report runs/small-stress-OFF-1, or dwell dash runs" in result.stdout
    run = dwell.open_run("runs/small-stress-OFF-1")
    assert run.windows.height == 12
    assert run.meta["scenario"] == "stress"
    assert not run.has_jobs


def test_it_ends_with_a_verdict_and_with_what_other_placements_would_have_done(cell: Path) -> None:
    result = call("run", cell, "--scenario", "stress", "--policy", "OFF", "--out", "there")
    found = read_json(
        call("run", cell, "--scenario", "stress", "--policy", "OFF", "--out", "here", "--json")
    )
    kept = dwell.open_run("here").meta["placements"]
    assert found["placements"] == kept
    rates = {name: numbers["violation_rate"] for name, numbers in kept.items()}
    assert rates["OFF"] == found["summary"]["violation_rate"] == found["verdict"]["rate"]
    assert found["verdict"]["word"] in {"kept", "missed", "open"}
    assert f"{rates['OFF'] * 100:.2f} %" in result.stdout
    assert f"(aim: under 5 %): {found['verdict']['word']}" in result.stdout
    assert f"{min(rates.values()) * 100:.2f} % if" in result.stdout


def test_a_saved_run_without_them_can_be_made_again(cell: Path) -> None:
    call("run", cell, "--out", "here")
    file = Path("here", "run.json")
    meta = json.loads(file.read_text())
    del meta["placements"]
    file.write_text(json.dumps(meta))
    assert call("run", cell, "--out", "here").exit_code == 0


def test_of_a_cell_of_microseconds_times_are_not_written_as_nothing(cell: Path) -> None:
    small = SMALL.replace("period_ms: 20", "period_ms: 0.05").replace(
        "delay_ms: 1}", "delay_ms: 0}"
    )
    for exec_ms in ("1", "8", "2"):
        small = small.replace(f"{{exec_ms: {exec_ms}}}", f"{{exec_ms: 0.00{exec_ms}}}")
    cell.write_text(small, encoding="utf-8")
    shown = call("run", cell, "--windows", "12").stdout
    assert re.findall(r"\b0\.0+ ms", shown) == []
    assert "0.0090 ms" in shown
    assert "0.0090" in call("check", cell).stdout


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


ROWS = [1 + 7 * (row * 37 % 101) / 101 for row in range(2_000)]


def write_with_traces(folder: Path, files: str) -> Path:
    """Write a cell that replays two files, one by row and one by time, and the files."""
    (folder / "data").mkdir(parents=True)
    lines = [f"{20 * row},{value}\n" for row, value in enumerate(ROWS)]
    for name in ("work.csv", "delay.csv"):
        (folder / "data" / name).write_text("sent_ms,ms\n" + "".join(lines), encoding="utf-8")
    work = f"{{trace: {{file: {files}/work.csv, column: ms}}}}"
    delay = f"{{trace: {{file: {files}/delay.csv, column: ms, by: time, wrap: true}}}}"
    text = SMALL.replace("{exec_ms: 8}", f"{{exec_ms: {work}}}").replace(
        "delay_ms: 1}", f"delay_ms: {delay}}}"
    )
    cell = folder / "small.yaml"
    cell.write_text(text, encoding="utf-8")
    return cell


def test_a_run_is_the_same_wherever_the_files_of_its_cell_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = tmp_path / "first", tmp_path / "elsewhere" / "second"
    here = write_with_traces(first, "data")
    shutil.copytree(first, second)
    bare = tmp_path / "alone" / "small.yaml"
    bare.parent.mkdir()
    shutil.copy(here, bare)
    runs = []
    commands: list[tuple[Path, tuple[str | Path, ...]]] = [
        (tmp_path, (here,)),
        (first, ("small.yaml",)),
        (second, ("small.yaml",)),
        (tmp_path, ("elsewhere/../elsewhere/second/small.yaml",)),
        (tmp_path, (bare, "--traces", first)),
        (second, (bare, "--traces", ".")),
    ]
    for number, (current, words) in enumerate(commands):
        monkeypatch.chdir(current)
        out = tmp_path / f"run-{number}"
        read_json(call("run", *words, "--windows", "40", "--jobs", "--out", out, "--json"))
        runs.append(dwell.open_run(out))
    for run in runs[1:]:
        assert_same(run, runs[0])


def test_a_run_is_the_same_where_a_cell_names_its_traces_absolutely(tmp_path: Path) -> None:
    runs = []
    for name in ("first", "second"):
        cell = write_with_traces(tmp_path / name, str(tmp_path / name / "data"))
        found = read_json(
            call("run", cell, "--windows", "40", "--out", tmp_path / f"of-{name}", "--json")
        )
        runs.append(dwell.open_run(found["run"]))
    assert_same(*runs)


def assert_same(run: Run, other: Run) -> None:
    for table in ("cycles", "windows", "decisions"):
        assert getattr(run, table).equals(getattr(other, table))


def test_run_as_json_says_where_traces_begin(tmp_path: Path) -> None:
    cell = write_with_traces(tmp_path, "data")
    arguments = ("run", cell, "--policy", "LOC", "--windows", "40", "--jobs")
    found = read_json(call(*arguments, "--out", tmp_path / "run", "--json"))
    starts = {start["file"]: start for start in found["traces"]}
    assert starts.keys() == {"data/work.csv", "data/delay.csv"}
    assert starts["data/work.csv"]["columns"] == ["ms"]
    row = starts["data/work.csv"]["row"]
    jobs = dwell.open_run(found["run"]).jobs.filter(task="plan").sort("cycle")
    took_ms = ((jobs["end_ns"] - jobs["start_ns"]) / 1e6).to_list()
    assert took_ms[:3] == pytest.approx(ROWS[row - 1 : row + 2])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scenario", "stres"), ("unknown scenario", "did you mean 'stress'?")),
        (("--policy", "dpt"), ("unknown policy", "did you mean 'dtp'?", "LOC, OFF")),
        (("--estimator", "profil"), ("unknown estimator", "profile")),
        (("--windows", "0"), ("--windows",)),
        (("--windows", "1000000000"), ("windows: 1000000000 windows", "at most 4294967295")),
        (("--seconds", "1e15"), ("--seconds", "from 0 to 9.2e9")),
        (("--seconds", "inf"), ("--seconds", "from 0 to 9.2e9")),
        (("--seconds", "9e9"), ("--seconds 9e+09", "at most 4294967295")),
        (("--seed", "-1"), ("--seed",)),
        (("--seed", "one"), ("--seed",)),
        (("--out", "small.yaml"), ("is not a run",)),
    ],
)
def test_a_wrong_argument_changes_nothing(
    cell: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    result = call("run", cell, *arguments)
    assert_refused(result, *words)
    assert [path.name for path in cell.parent.iterdir()] == ["small.yaml"]


def test_a_scenario_that_the_run_does_not_reach_is_warned_of(cell: Path) -> None:
    late = cell.read_text(encoding="utf-8") + "  late: [{node: R, at_s: 100, stress_threads: 3}]\n"
    cell.write_text(late, encoding="utf-8")
    done = call("run", cell, "--scenario", "late", "--windows", "5")
    assert done.exit_code == 0
    assert f"{cell}: warning: scenarios.late: begins at 100 s, " in done.stderr
    for words in (("--scenario", "stress"), ("--scenario", "late", "--seconds", "101")):
        length = () if "--seconds" in words else ("--windows", "5")
        again = call("run", cell, *words, *length, "--force")
        assert (again.exit_code, "warning" in again.stderr) == (0, False)


def test_another_run_is_not_replaced_unless_asked_for(cell: Path) -> None:
    words = ("run", cell, "--windows", "5", "--out", "kept")
    assert call(*words).exit_code == 0
    assert call(*words).exit_code == 0, "the same run again"
    other = call(*words, "--seed", "2")
    assert_refused(other, "kept holds another run")
    assert dwell.open_run("kept").meta["seed"] == 1
    file = Path("kept/run.json")
    earlier = {**json.loads(file.read_text(encoding="utf-8")), "schema_version": 1}
    file.write_text(json.dumps(earlier), encoding="utf-8")
    assert_refused(call(*words), "kept holds another run")
    assert call(*words, "--force").exit_code == 0
    # So many windows can not be drawn: the folder is looked at before.
    more = call("run", cell, "--windows", str(1 << 32), "--out", "kept")
    assert_refused(more, "kept holds another run")
    assert call(*words, "--seed", "2", "--force").exit_code == 0
    assert dwell.open_run("kept").meta["seed"] == 2


def test_values_of_the_cell_are_set_for_one_run(cell: Path) -> None:
    call("run", cell, "--windows", "5")
    settings = ("--set", "period_ms=40", "--set", "tasks.plan.on.R.exec_ms=15.5")
    more = ("--set", "objective.caps={latency_ms: 40}", "--set", "links[0].loss=1e-1")
    result = call("run", cell, "--windows", "5", *settings, *more)
    assert result.exit_code == 0, result.output
    folders = sorted(path.name for path in Path("runs").iterdir())
    assert folders == [
        "small-baseline-dtp-1",
        "small-baseline-dtp-1-period_ms=40-tasks.plan.on.R.exec_ms=15.5"
        "-objective.caps=_latency_ms__40_-links_0_.loss=1e-1",
    ]
    problem = dwell.open_run(Path("runs", folders[1])).problem
    assert problem.pipeline.period_ms == 40
    assert problem.pipeline.tasks["plan"].on["R"].exec_ms == Constant(15.5)
    assert problem.objective.caps.latency_ms == 40
    assert problem.fabric.links["E->R"].loss == 0.1
    # The run says the N_min that the cell leaves to the estimator.
    stated = evolve(dwell.load(cell), {"controller.min_dwell": 0})
    assert dwell.open_run(Path("runs", folders[0])).problem == stated


def test_a_long_list_of_values_still_names_a_folder(cell: Path) -> None:
    words = [f"nodes.E.cores={'0' * 300}{cores}" for cores in (1, 2)]
    for word in words:
        assert call("run", cell, "--windows", "2", "--set", word).exit_code == 0
    assert len(list(Path("runs").iterdir())) == 2


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["period_ms"], ["--set period_ms: has no `=`; write PATH=VALUE"]),
        (["=5"], ["--set : not a path"]),
        (["perid_ms=5"], ["--set perid_ms: unknown key 'perid_ms'; did you mean 'period_ms'?"]),
        (["tasks.plann.input=all"], ["the cell's tasks have no 'plann'; did you mean 'plan'?"]),
        (["links[3].loss=0"], ["--set links[3].loss: there is no links[3]; links has 1 items"]),
        (["period_ms=x"], ["--set period_ms: 'x' is not allowed"]),
        (["period_ms=-1"], ["--set period_ms: -1 is not allowed"]),
        (["period_ms="], ["--set period_ms: nothing is given"]),
        (["nodes.E={tier: edge"], ["--set nodes.E: not a YAML document"]),
        (["nodes.E.cores=1", "nodes.E.cores=2"], ["--set nodes.E.cores: is given twice"]),
        (
            ["objective.caps={latency_ms: 5}", "objective.caps.latency_ms=6"],
            ["--set objective.caps.latency_ms: is a part of objective.caps; give one of them"],
        ),
        (["period_ms=0", "seed", "links[1].loss=0"], ["--set seed: has", "--set links[1].loss:"]),
        (
            ["window_cycles=0", "nodes.E.cores=0"],
            ["--set window_cycles: 0", "--set nodes.E.cores:"],
        ),
        (["deadline_ms=3000"], ["--set deadline_ms: "]),
        (["controller.policy=dpt"], ["--set controller.policy: "]),
        (
            ["controller.decide_cycles=10", "window_cycles=5"],
            ["decide_cycles: 10 is not allowed; it must be at most window_cycles = 5; lower"],
        ),
        (["links=[]", "nodes.E.cores=2"], ["--set: ", "(with links=[], nodes.E.cores=2)"]),
    ],
)
def test_a_setting_that_is_wrong_is_named(cell: Path, settings: list[str], said: list[str]) -> None:
    result = call("run", cell, *(word for one in settings for word in ("--set", one)))
    assert_refused(result, f"{cell}: ", *said)
    assert not Path("runs").exists()


def test_a_shorter_window_names_the_key_that_no_longer_fits(cell: Path) -> None:
    cell.write_text(f"{SMALL}\ncontroller: {{decide_cycles: 8}}\n", encoding="utf-8")
    result = call("run", cell, "--set", "window_cycles=5")
    assert_refused(
        result,
        "--set window_cycles: controller.decide_cycles: 8 is not allowed",
        "at most window_cycles = 5; lower decide_cycles, or raise window_cycles",
    )


def test_a_fault_of_the_cell_itself_is_its_own(cell: Path) -> None:
    cell.write_text(SMALL.replace("tier: edge", "tier: egde"), encoding="utf-8")
    result = call("run", cell, "--set", "period_ms=x")
    assert_refused(result, "small.yaml:7: nodes.E.tier: 'egde' is not allowed")
    assert "--set" not in result.stderr


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


def test_a_folder_that_cannot_be_written_is_a_failure(
    cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> Path:
        raise RunError("here: cannot be written (No space left on device)")

    monkeypatch.setattr(Run, "save", full)
    result = call("run", cell, "--windows", "2")
    assert_refused(result, "No space left", code=1)


def test_names_that_are_no_file_names(cell: Path) -> None:
    cell.write_text(SMALL.replace("name: small", "name: 'S\u00fcd x:y'"), encoding="utf-8")
    assert read_json(call("run", cell, "--windows", "2", "--json"))["run"] == (
        "runs/S\u00fcd_x_y-baseline-dtp-1"
    )


@pytest.mark.parametrize("name", ["../../evil", "a?b"])
def test_a_cell_whose_name_is_none_is_refused(cell: Path, name: str) -> None:
    cell.write_text(SMALL.replace("name: small", f"name: {name}"), encoding="utf-8")
    for command in ("check", "run", "live run", "live status --cell"):
        assert_refused(call(*command.split(), cell), f"name: '{name}' is not a name")
    assert sorted(path.name for path in cell.parent.iterdir()) == [cell.name]


def test_a_cell_of_many_candidates_is_run_and_its_record_opens(tmp_path: Path) -> None:
    cell, folder = tmp_path / "many.yaml", tmp_path / "run"
    cell.write_text(yaml.safe_dump(document_of(100), sort_keys=False), encoding="utf-8")
    result = call("run", cell, "--windows", "2", "--out", folder)
    assert (result.exit_code, result.stderr) == (0, "")
    assert re.search(r"^windows by placement +R-R-R 100 %$", result.stdout, re.MULTILINE)
    assert dwell.open_run(folder).problem.shadow_fraction == 1 / 99
    given = ("--windows", "2", "--out", tmp_path / "given", "--set")
    assert call("run", cell, *given, "controller.shadow_fraction=0.01").exit_code == 0
    assert dwell.open_run(tmp_path / "given").problem.shadow_fraction == 0.01
    refused = call("run", cell, *given, "controller.shadow_fraction=0.05")
    assert refused.exit_code == 2
    assert "each of 99 alternatives is more than all cycles" in refused.stderr
