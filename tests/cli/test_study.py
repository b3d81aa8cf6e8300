"""`dwell study`: what it prints, writes and answers."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import polars as pl
import pytest

from dwell.report.formatting import shown_policy
from dwell.study.parts import BATCH_RUNS
from dwell.study.reference import REFERENCES
from tests.cli.small_cell import SMALL, assert_refused, call, interrupt_at_first_sign, read_json

STUDY = """\
dwell-study: 1
name: a small one
cell: small.yaml
windows: 20
seeds: 2
references: true
policies: [LOC, dtp]
parameters:
  objective.weights.switching: [0, 1]
"""


@pytest.fixture
def study(cell: Path) -> Path:
    """Return a small study beside the small cell."""
    path = cell.with_name("study.yaml")
    path.write_text(STUDY, encoding="utf-8")
    return path


def test_a_study_prints_tables_and_keeps_them(study: Path) -> None:
    result = call("study", study, "--processes", "1")
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert lines[0] == "Baseline (objective.weights.switching = 0)"
    assert lines[1].split() == [
        "V_D",
        "(%)",
        "J",
        "migrations",
        "regret",
        "(%)",
        "over",
        "oracle",
        "(%)",
    ]
    policies = ("LOC", "dtp", *REFERENCES)
    for line, policy in zip(lines[2:8], policies, strict=True):
        assert line.startswith(f"{shown_policy(policy)} ")
    assert "Stress (objective.weights.switching = 1)" in lines
    assert lines[-1] == "tables: studies/a_small_one"
    runs = pl.read_parquet("studies/a_small_one/runs.parquet")
    assert runs.height == 2 * 2 * 6 * 2
    again = call("study", study)
    assert (again.exit_code, again.stdout) == (0, result.stdout)


def test_scenarios_that_no_run_reaches_are_warned_of_once(study: Path) -> None:
    late = "scenarios: {baseline: , late: [{node: R, at_s: 1000, stress_threads: 3}]}\n"
    study.write_text(STUDY.replace("references: true\n", late), encoding="utf-8")
    done = call("study", study, "--processes", "1")
    assert done.exit_code == 0, done.output
    assert done.stderr.count(f"{study}: warning: scenarios.late: begins at 1000 s, ") == 1


def test_a_study_as_json(study: Path) -> None:
    arguments = ("--seeds", "1", "--windows", "10", "--out", "out", "--processes", "1")
    found = read_json(call("study", study, *arguments, "--json"))
    assert (found["study"], found["folder"], found["runs"]) == ("a small one", "out", 24)
    assert len(found["table"]) == 24
    row = found["table"][0]
    assert (row["parameter.objective.weights.switching"], row["policy"]) == (0, "LOC")
    assert row["seeds"] == 1
    assert row["regret_low"] is None
    assert pl.read_parquet("out/runs.parquet")["windows"].unique().to_list() == [10]


def test_where_seeds_are_few_the_text_asks_for_five(study: Path) -> None:
    arguments = ("--windows", "2", "--processes", "1")
    few = call("study", study, "--seeds", "2", "--out", "few", *arguments).stdout
    assert "at least 5" in few
    assert "at least 5" not in call("study", study, "--seeds", "5", *arguments).stdout


def test_every_fault_of_a_study_is_printed(study: Path) -> None:
    text = STUDY.replace("LOC, dtp", "LOC, dpt").replace("[0, 1]", "[0, -1]")
    study.write_text(text, encoding="utf-8")
    result = call("study", study)
    assert (result.exit_code, result.stdout) == (2, "")
    assert [line.split(" ")[1] for line in result.stderr.splitlines()] == [
        "policies.dpt:",
        "parameters.objective.weights.switching[1]:",
    ]
    assert not Path("studies").exists()


@pytest.mark.parametrize(
    ("objective", "key"),
    [
        ("latency: reaction", "latency"),
        ("weights: {age: 1}, targets: {age_ms: 50}", "weights.age"),
        ("weights: {price: 1}, targets: {price_per_hour: 1}", "weights.price"),
        ("caps: {misses: {m: 1, k: 20}}", "caps.misses"),
    ],
)
def test_an_objective_that_references_do_not_support_is_a_fault_of_the_file(
    cell: Path, study: Path, objective: str, key: str
) -> None:
    chain = "chains:\n  reaction: {from: sense, to: plan}\n"
    priced = SMALL.replace("delay_ms: 1}", "delay_ms: 1, price_per_gb: 1}")
    cell.write_text(f"{priced}{chain}objective: {{{objective}}}\n", encoding="utf-8")
    refused = call("study", study)
    assert_refused(refused, f"{study}:6: references: references do not support objective.{key} of")
    assert not Path("studies").exists()


@pytest.mark.parametrize(
    ("option", "value", "refused"),
    [
        (
            "--windows",
            "5",
            "error: --windows: 5 is not allowed; it must be more than the 5 windows",
        ),
        ("--seconds", "1", "error: --seconds 1: 5 is not allowed; it must be more than the 5"),
    ],
)
def test_runs_within_the_warm_up_are_refused(
    cell: Path, study: Path, option: str, value: str, refused: str
) -> None:
    cell.write_text(f"{SMALL}warmup_windows: 5\n", encoding="utf-8")
    assert_refused(call("study", study, option, value), refused)


@pytest.mark.parametrize(
    ("own", "policy", "refused"),
    [
        ("latency: reaction", "latency: other", "'other' is not allowed; it must be reaction, as"),
        ("caps: {latency_ms: 9}", "latency: reaction", "'reaction' is not allowed; it must be abs"),
        (
            "weights: {age: 1}, targets: {age_ms: 50}",
            "weights.age: 0",
            "weights.age: 0.0 is not allowed; it must be above 0, as in the cell",
        ),
    ],
)
def test_policies_whose_runs_the_cell_cannot_judge_are_a_fault_of_the_file(
    cell: Path, study: Path, own: str, policy: str, refused: str
) -> None:
    chain = "{from: sense, to: plan}"
    chains = f"chains: {{reaction: {chain}, other: {chain}}}\n"
    cell.write_text(f"{SMALL}{chains}objective: {{{own}}}\n", encoding="utf-8")
    policies = f"policies: {{LOC: LOC, mine: {{policy: dtp, objective.{policy}}}}}"
    text = STUDY.replace("references: true\n", "").replace("policies: [LOC, dtp]", policies)
    study.write_text(text, encoding="utf-8")
    found = call("study", study)
    assert_refused(found, f"{study}:6: policies.mine.objective.")
    assert refused in found.stderr


def test_references_do_not_support_idle_cycles(cell: Path, study: Path) -> None:
    cell.write_text(
        SMALL.replace("plan: {on", "plan: {every: 2, on").replace("plan}", "plan, sampled: true}"),
        encoding="utf-8",
    )
    assert_refused(call("study", study), f"{study}:6: references: references do not support cell")


def test_a_folder_of_another_study_is_refused(study: Path) -> None:
    arguments = ("--windows", "5", "--processes", "1", "--out", "out")
    assert call("study", study, "--seeds", "1", *arguments).exit_code == 0
    result = call("study", study, "--seeds", "2", *arguments)
    assert_refused(result, "error: out holds another study", "seeds: 1 there, 1, 2 now")


def test_a_folder_that_cannot_be_written_fails(study: Path) -> None:
    result = call("study", study, "--out", study / "out", "--processes", "1")
    assert result.exit_code == 1
    assert result.stderr == f"error: {study / 'out'}: cannot be written (Not a directory)\n"


def test_a_cluster_that_is_not_there_fails(study: Path) -> None:
    pytest.importorskip("distributed")
    result = call("study", study, "--dask", "nowhere")
    assert_refused(result, "error: no Dask scheduler answers at 'nowhere'", code=1)


def test_without_the_package_a_cluster_is_out_of_reach(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = call("study", study, "--dask", "tcp://127.0.0.1:8786")
    assert_refused(result, "pip install 'dwell-placement[dask]'", code=1)


def test_many_points_do_not_fill_the_screen(study: Path) -> None:
    values = ", ".join(str(value / 100) for value in range(25))
    text = STUDY.replace("[0, 1]", f"[{values}]").replace("references: true", "references: false")
    study.write_text(text, encoding="utf-8")
    result = call("study", study, "--seeds", "1", "--windows", "2", "--processes", "1")
    assert result.exit_code == 0, result.output
    assert result.stdout.count("V_D") == 40
    assert "40 of 50 tables are shown; runs.parquet has all runs." in result.stdout


def test_an_interrupted_study_says_how_to_go_on(study: Path) -> None:
    arguments = ["study", str(study), "--seeds", "2000", "--processes", "1", "--out", "out"]
    code, stdout, shown = interrupt_at_first_sign(arguments, study.parent, sign="cycles/s")
    assert (code, stdout) == (130, "")
    assert "Traceback" not in shown
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    assert re.search(r"\d+/16000 \d\.\d\d M cycles/s +\d:\d\d:\d\d", plain)
    (said,) = re.findall(r"interrupted: (\d+) of 16000 runs are finished and stay in out; ", plain)
    # It may come between the writing of the last batch and its counting.
    parts = [pl.read_parquet(part) for part in Path("out/parts").iterdir()]
    finished = [len(part) for part in parts if "asked" not in part.columns]
    assert 0 <= sum(finished) - int(said) <= BATCH_RUNS
    assert not list(Path("out").rglob(".*"))
