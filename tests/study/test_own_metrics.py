"""Metrics of a user's own: columns of runs like any other, and faults that name them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest

import dwell
from dwell.errors import ProblemError, SimulationError
from dwell.report.study_page import study_page
from dwell.study import Contender, StudyResult, load_study, open_study, run_study
from dwell.study.family import Family
from tests.cli.small_cell import SMALL, call, read_json
from tests.report.pages import figure_of, table_of
from tests.study.test_study import make_study

METRICS = """\
import numpy as np


def slowest(run):
    return np.float32(run.cycles["latency_ns"].drop_nulls().max() / 1e6)


def moves(run):
    return int(run.decisions["migrated"].sum())


def none(run):
    return None


def yes(run):
    return True


def unknown(run):
    return float("nan")


def fails(run):
    return 1 / 0


constant = 3.0
"""

STUDY = """\
dwell-study: 1
name: own
cell: small.yaml
windows: 6
seeds: 5
references: true
policies: [LOC, dtp]
metrics:
  slowest_ms: "hall_metrics:slowest"
"""


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a study whose metrics are in a module next to it; the cell is elsewhere."""
    folder = tmp_path / "study"
    folder.mkdir()
    (folder / "small.yaml").write_text(SMALL)
    (folder / "hall_metrics.py").write_text(METRICS)
    path = folder / "study.yaml"
    path.write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    yield path
    for name in [name for name in sys.modules if name == "hall_metrics"]:
        del sys.modules[name]


def with_metric(study: Path, metric: str, name: str = "slowest_ms") -> Path:
    study.write_text(STUDY.replace("hall_metrics:slowest", metric).replace("slowest_ms", name))
    return study


def test_a_metric_is_a_column_of_all_runs(study: Path) -> None:
    result = run_study(load_study(study), folder=Path("out"), processes=2)
    problem = result.problem
    for policy in ("LOC", "dtp"):
        found = result.values("baseline", policy, "slowest_ms").tolist()
        runs = [
            dwell.simulate(problem, scenario="baseline", policy=policy, seed=seed, windows=6)
            for seed in result.seeds
        ]
        latencies = [run.cycles["latency_ns"].drop_nulls() for run in runs]
        assert found == pytest.approx([max(one.to_list()) / 1e6 for one in latencies], rel=1e-6)
    assert result.runs["slowest_ms"].dtype == pl.Float64
    assert set(result.runs.filter(pl.col("slowest_ms") > 0)["policy"]) == set(result.policies)
    # Over seeds, and between pairs of runs.
    assert {"slowest_ms", "slowest_ms_low"} <= set(result.table(["slowest_ms"]).columns)
    one, other = (result.values("stress", name, "slowest_ms") for name in ("LOC", "dtp"))
    difference = result.difference("stress", ("LOC", "dtp"), "slowest_ms")
    assert difference.value == pytest.approx((one - other).mean())
    pair = ({"scenario": "stress", "policy": "LOC"}, {"scenario": "stress", "policy": "dtp"})
    assert Family.of_runs(result.runs, "slower?", "slowest_ms", {"LOC, dtp": pair}).verdicts


def test_a_metric_is_in_the_page_and_in_what_the_command_prints(study: Path) -> None:
    done = call("study", study, "--out", "out", "--processes", "1")
    assert done.exit_code == 0, done.output
    assert "slowest_ms" in done.stdout.splitlines()[1]
    saved = open_study("out")
    assert saved.metrics == ("slowest_ms",)
    page = study_page(saved)
    assert figure_of(page, "slowest_ms").frames["rows"]["mean"].drop_nulls().gt(0).all()
    assert "slowest_ms" in table_of(page, "more").rows[0]
    again = read_json(call("study", study, "--out", "out", "--json"))
    assert again["table"][0]["slowest_ms"] > 0


def test_a_metric_over_parameters_is_in_the_page(study: Path) -> None:
    study.write_text(STUDY + "parameters: {objective.weights.switching: [0, 1]}\n")
    run_study(load_study(study), folder=Path("out"), processes=1)
    page = study_page(open_study("out"))
    assert table_of(page, "pivot-slowest_ms-0").rows
    assert "slowest_ms" in table_of(page, "points").rows[0]


def test_another_source_of_a_metric_plays_all_again(study: Path) -> None:
    command = (sys.executable, "-m", "dwell", "study", study, "--out", "out", "--processes", "1")
    subprocess.run(command, check=True, capture_output=True)
    before = pl.read_parquet("out/runs.parquet")
    parts = {part.name for part in Path("out/parts").iterdir()}
    module = study.with_name("hall_metrics.py")
    module.write_text(METRICS.replace("/ 1e6", "/ 1e3"))
    subprocess.run(command, check=True, capture_output=True)
    after = pl.read_parquet("out/runs.parquet")
    assert after["slowest_ms"].to_list() == pytest.approx((before["slowest_ms"] * 1e3).to_list())
    assert after.drop("slowest_ms").equals(before.drop("slowest_ms"))
    assert parts.isdisjoint(part.name for part in Path("out/parts").iterdir())


@pytest.mark.parametrize(
    ("metric", "message"),
    [
        ("absent:slowest", "metrics.slowest_ms: metric 'absent:slowest': no module"),
        ("hall_metrics:slowst", "has no function 'slowst'; did you mean 'slowest'?"),
        ("hall_metrics:constant", "'constant' in hall_metrics is not a function"),
        ("slowest", "'slowest' is not allowed; it must be package.module:function"),
    ],
)
def test_a_metric_that_is_not_there_is_a_fault_of_the_file(
    study: Path, metric: str, message: str
) -> None:
    with pytest.raises(ProblemError) as caught:
        load_study(with_metric(study, metric))
    assert message in str(caught.value)
    assert caught.value.faults[0].line == 9
    assert call("study", study).exit_code == 2
    assert not Path("studies").exists()


@pytest.mark.parametrize(
    ("metric", "message", "processes"),
    [
        ("none", "returned None; return a finite number", 1),
        ("yes", "returned True; return a finite number", 1),
        ("unknown", "returned nan; return a finite number", 1),
        ("fails", "ZeroDivisionError: division by zero (hall_metrics.py:25)", 1),
        ("fails", "ZeroDivisionError: division by zero (hall_metrics.py:25)", 2),
    ],
)
def test_a_metric_that_fails_is_named_with_its_run(
    study: Path, metric: str, message: str, processes: int
) -> None:
    asked = load_study(with_metric(study, f"hall_metrics:{metric}"))
    with pytest.raises(SimulationError) as caught:
        run_study(asked, folder=Path("out"), processes=processes)
    where = f"metrics.slowest_ms (hall_metrics:{metric}): policy LOC, scenario baseline, seed "
    assert str(caught.value).startswith(where)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "name", ["cost", "violation_rate", "share_of_luck", "tracking_rms_mm", "seed", "regret", "lost"]
)
def test_a_name_that_a_column_has_is_refused(study: Path, name: str) -> None:
    with pytest.raises(SimulationError, match=f"metrics.{name}: the tables have such a column"):
        run_study(load_study(with_metric(study, "hall_metrics:moves", name)), processes=1)


def test_a_metric_of_python_that_is_not_there_is_found_before_the_folder_is_made(
    tmp_path: Path,
) -> None:
    study = make_study(metrics={"mine": "absent:metric"}, folder=str(tmp_path))
    with pytest.raises(SimulationError, match="no module 'absent', neither in"):
        run_study(study, folder=tmp_path / "out", processes=1)
    assert not (tmp_path / "out").exists()


def test_a_metric_of_a_fleet_is_that_of_its_worst_cell(study: Path) -> None:
    study.with_name("pair.yaml").write_text(
        "dwell-fleet: 1\nname: pair\nshared: [E]\ncells:\n"
        "  - {cell: small.yaml, count: 2, scenario: stress}\n"
    )
    text = STUDY.replace("cell: small.yaml", "fleet: pair.yaml").replace("references: true\n", "")
    study.write_text(text)
    result: StudyResult = run_study(load_study(study), processes=1)
    fleet = Contender("LOC", "LOC").fleet(result.study.points[0].fleet, "stress")  # type: ignore[arg-type]
    run = dwell.simulate_fleet(fleet, seed=1, windows=6)
    row = result.runs.filter(policy="LOC", seed=1).row(0, named=True)
    worst = run.cells[row["worst_cell"]].cycles["latency_ns"].drop_nulls().to_list()
    assert row["slowest_ms"] == pytest.approx(max(worst) / 1e6, rel=1e-6)
