"""A recorded run on the time line says what its tables say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

import dwell
from dwell.dash.recorded_cell import RecordedCell, difference, same_realisation
from dwell.errors import RunError
from dwell.model import Weights
from dwell.study.verdict import verdict_of
from tests.cells.late_cycles import late_run, without_late_cycles
from tests.cells.rated import idle_cell
from tests.dash.recorded import small_run

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def cell(run_folder: Path) -> RecordedCell:
    return RecordedCell(run_folder)


@pytest.fixture(scope="module")
def run(run_folder: Path) -> dwell.Run:
    return dwell.open_run(run_folder)


def test_the_whole_line_has_all_cycles_misses_and_moves(cell: RecordedCell, run: dwell.Run) -> None:
    whole = cell.described()
    view = cell.view(whole["begin"], whole["end"], 50)
    assert view["cycles"] == whole["cycles"] == run.cycles.height
    assert view["missed"] == sum(view["bins"]["missed"]) == run.cycles["missed"].sum()
    moves = [event for event in view["events"] if event["kind"] == "move"]
    assert len(moves) == run.decisions["migrated"].sum() > 0
    json.dumps([whole, view], allow_nan=False)


def test_cycles_after_the_last_window_are_not_shown(tmp_path: Path) -> None:
    run = late_run()
    both = {"cut": without_late_cycles(run), "whole": run}
    cells = [RecordedCell(one.save(tmp_path / name)) for name, one in both.items()]
    found, expected = (
        [cell.described() | {"source": ""}, cell.view(0.0, 2.0, 50), cell.state(1.5)]
        for cell in cells
    )
    assert found == expected
    assert found[0]["missed"] == found[0]["cycles"] == 20


def test_idle_cycles_are_neither_counted_nor_lost(tmp_path: Path) -> None:
    run = dwell.simulate(idle_cell(), seed=1, windows=4)
    idle = run.cycles["outcome"].cast(pl.String) == "idle"
    cell = RecordedCell(run.save(tmp_path / "idle"))
    whole = cell.described()
    view = cell.view(whole["begin"], whole["end"], 50)
    assert 0 < idle.sum() < len(idle) == view["released"]
    assert view["cycles"] == whole["cycles"] == sum(view["bins"]["count"]) == (~idle).sum()
    never_done = run.cycles["latency_ns"].is_null() & ~idle
    assert sum(view["bins"]["lost"]) == never_done.sum()


def test_a_state_is_what_was_known_then(cell: RecordedCell, run: dwell.Run) -> None:
    window = run.windows.row(20, named=True)
    size, period_s = 10, 0.020
    close_s = (window["first_cycle"] + size) * period_s
    state = cell.state(close_s + 0.001)
    assert state["window"]["number"] == 20
    assert state["window"]["seen"]["violation_rate"] == pytest.approx(
        window["seen_violation_rate"], abs=1e-4
    )
    decision = run.decisions.filter(pl.col("window") == 20).row(0, named=True)
    assert state["decision"]["reason"] == decision["reason"]
    assert state["candidates"]["OFF"]["cost"] == pytest.approx(decision["j_OFF"], abs=1e-4)
    before = run.decisions.filter(pl.col("window") == 19).row(0, named=True)
    predicted = before[f"est_l95_ms_{window['placement']}"]
    assert state["predicted"]["l95_ms"] == pytest.approx(predicted, abs=1e-4)
    assert cell.state(close_s - 0.001)["window"]["number"] == 19
    assert cell.state(0.0).get("window") is None
    json.dumps(state, allow_nan=False)


def test_a_weighed_age_is_shown_as_seen_and_as_estimated(tmp_path: Path) -> None:
    problem = dwell.load("examples/canonical.yaml")
    objective = replace(
        problem.objective,
        weights=Weights(age=1.0),
        targets=replace(problem.objective.targets, age_ms=80.0),
    )
    run = dwell.simulate(replace(problem, objective=objective), seed=1, windows=8)
    run.save(tmp_path / "run")
    cell = RecordedCell(tmp_path / "run")
    state = cell.state(float(run.cycles["release_ns"][-1]) / 1e9)
    window = run.windows.row(state["window"]["number"], named=True)
    assert state["window"]["seen"]["age_ms"] == pytest.approx(window["seen_age_ms"], abs=1e-4)
    assert state["candidates"]["LOC"]["age_ms"] > 0
    assert cell.described()["weighs_age"] is True


def test_the_age_is_that_of_the_newest_cycle_in_effect(cell: RecordedCell, run: dwell.Run) -> None:
    at_s = 5.003
    done = run.cycles.filter(pl.col("release_ns") + pl.col("latency_ns") <= at_s * 1e9)
    newest_ms = done["release_ns"].max()
    assert isinstance(newest_ms, int)
    assert cell.state(at_s)["age_ms"] == pytest.approx(at_s * 1e3 - newest_ms / 1e6, abs=1e-3)


def test_a_cell_that_misses_is_degraded(cell: RecordedCell) -> None:
    ends = cell.described()["end"]
    words = {cell.state(at * ends / 40)["health"] for at in range(41)}
    assert "degraded" in words
    assert cell.state(0.0)["health"] == "unmeasured"


def test_jobs_are_those_of_the_cycles_in_view(cell: RecordedCell, run: dwell.Run) -> None:
    found = cell.jobs(1.0, 1.1)
    numbers = [cycle["cycle"] for cycle in found["cycles"]]
    assert numbers == [50, 51, 52, 53, 54]
    expected = run.jobs.filter(pl.col("cycle").is_between(50, 54))
    assert len(found["jobs"]) == expected.height
    first = expected.row(0, named=True)
    assert found["jobs"][0]["node"] == first["node"]
    assert found["jobs"][0]["ready_ms"] == (first["ready_ns"] - 1_000_000_000) / 1e6


def test_a_run_without_jobs_says_so(tmp_path: Path) -> None:
    small_run(tmp_path / "run", jobs=False)
    cell = RecordedCell(tmp_path / "run")
    assert not cell.described()["has_jobs"]
    assert cell.jobs(0.0, 1.0)["known"] is False


def test_runs_of_one_realisation_go_by_cycles(tmp_path: Path) -> None:
    first, second, other = (
        small_run(tmp_path / f"{policy}-{seed}", policy=policy, seed=seed)
        for policy, seed in (("dtp", 1), ("LOC", 1), ("dtp", 2))
    )
    assert same_realisation(first, second)
    assert not same_realisation(first, other)
    assert not same_realisation(dwell.Run({**first.meta, "kind": "live"}, {}), second)
    cell = RecordedCell(tmp_path / "dtp-1", "cycle")
    assert cell.described()["end"] == cell.described()["cycles"]
    assert cell.state(100.5)["cycle"] == 100
    assert [one["cycle"] for one in cell.jobs(100, 102)["cycles"]] == [100, 101]


def test_disturbances_stand_among_the_events(tmp_path: Path) -> None:
    run = small_run(tmp_path / "run")
    document = run.meta
    document["problem"]["scenarios"]["stress"][0].update({"at_s": 2.0, "for_s": 3.0})
    dwell.Run(
        document, {name: getattr(run, name) for name in ("cycles", "windows", "decisions")}
    ).save(tmp_path / "run")
    view = RecordedCell(tmp_path / "run").view(0.0, 20.0, 50)
    at = [event["at"] for event in view["events"] if event["kind"] == "disturbance"]
    assert at == [2.0, 5.0]


def stressed(folder: Path, **changes: object) -> RecordedCell:
    """Return a run whose stress of R has other times."""
    run = small_run(folder)
    run.meta["problem"]["scenarios"]["stress"][0].update(changes)
    tables = {name: getattr(run, name) for name in ("cycles", "windows", "decisions")}
    dwell.Run(run.meta, tables).save(folder)
    return RecordedCell(folder)


def test_disturbances_are_shown_while_they_act(tmp_path: Path) -> None:
    cell = stressed(tmp_path / "run", at_s=2.0, for_s=3.0)
    assert cell.described()["disturbed"] == [(2.0, 5.0)]
    assert cell.state(1.9)["disturbed"] == {}
    (text,) = cell.state(2.1)["disturbed"].values()
    assert "busy thread" in text
    assert cell.state(5.0)["disturbed"] == {}


def test_a_run_has_a_verdict_its_moves_and_its_worst_window(
    cell: RecordedCell, run: dwell.Run
) -> None:
    told = cell.described()
    counted = run.windows.filter(~pl.col("warmup"))
    missed = run.cycles["missed"].to_numpy()[-counted.height * 10 :]
    verdict = verdict_of(run, run.problem, missed.mean())
    assert told["verdict"]["word"] == verdict.word
    assert told["verdict"]["text"] == str(verdict)
    assert told["moves"]["migrations"] > 0
    assert told["worst"]["rate"] == counted["violation_rate"].max()
    assert cell.state(told["worst"]["at"])["window"]["number"] == told["worst"]["number"]
    json.dumps(told, allow_nan=False)


def test_a_run_that_is_all_warm_up_has_no_verdict(tmp_path: Path) -> None:
    run = small_run(tmp_path / "run", windows=12)
    tables = {name: getattr(run, name) for name in ("cycles", "windows", "decisions")}
    tables["windows"] = tables["windows"].with_columns(warmup=pl.lit(value=True))
    dwell.Run(run.meta, tables).save(tmp_path / "run")
    told = RecordedCell(tmp_path / "run").described()
    assert "verdict" not in told
    assert told["worst"] is None


@pytest.mark.parametrize(("policy", "shown"), [("dtp", "DTP"), ("LOC", "LOC, without moves")])
def test_a_policy_is_shown_without_its_parameters(tmp_path: Path, policy: str, shown: str) -> None:
    small_run(tmp_path / "run", policy=policy)
    assert RecordedCell(tmp_path / "run").described()["about"]["policy"] == shown


def test_placements_without_moves_are_shown_next_to_the_run(tmp_path: Path) -> None:
    run = small_run(tmp_path / "run")
    others = {"LOC": {"violation_rate": 0.25, "l95_ms": 1.0, "cost": 1.0}}
    run.with_facts(placements=others).save(tmp_path / "other")
    assert RecordedCell(tmp_path / "other").described()["never_moving"] == {"LOC": 0.25}


def test_the_difference_of_two_runs_is_v_d_of_the_second_less_the_first(tmp_path: Path) -> None:
    for policy in ("dtp", "LOC"):
        small_run(tmp_path / policy, policy=policy)
    one, other = (RecordedCell(tmp_path / policy, "cycle") for policy in ("dtp", "LOC"))
    found = difference(one, other, 0.0, 600.0, 100)
    rates = [
        cell.run.cycles["missed"].to_numpy().reshape(-1, 10).mean(axis=1) for cell in (one, other)
    ]
    assert found["points"] == pytest.approx(100 * (rates[1] - rates[0]), abs=1e-3)
    assert len(difference(one, other, 0.0, 600.0, 7)["points"]) <= 7
    same = difference(one, one, 0.0, 600.0, 100)["points"]
    assert set(same) == {0.0}


def test_episodes_stand_among_the_events_as_they_were_drawn(tmp_path: Path) -> None:
    run = small_run(tmp_path / "run")
    document = run.meta
    document["problem"]["scenarios"]["stress"][0]["episodes"] = {
        "name": "rush",
        "every_s": 2.0,
        "for_s": 0.5,
    }
    dwell.Run(
        document, {name: getattr(run, name) for name in ("cycles", "windows", "decisions")}
    ).save(tmp_path / "run")
    view = RecordedCell(tmp_path / "run").view(0.0, 20.0, 50)
    at = [event["at"] for event in view["events"] if event["kind"] == "disturbance"]
    assert at == [2.0, 2.5, 4.5, 5.0, 7.0, 7.5, 9.5, 10.0]


def test_a_damaged_table_is_named(tmp_path: Path) -> None:
    small_run(tmp_path / "run")
    file = tmp_path / "run" / "windows.parquet"
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(RunError, match=r"windows\.parquet"):
        RecordedCell(tmp_path / "run")


def test_both_copies_of_a_cycle_are_shown(tmp_path: Path) -> None:
    problem = dwell.load(EXAMPLES / "replicas.yaml")
    run = dwell.simulate(problem, policy="NOW", seed=1, windows=2, jobs=True)
    run.save(tmp_path / "run")
    cell = RecordedCell(tmp_path / "run")
    nodes = {one["name"]: one["nodes"] for one in cell.described()["candidates"]}
    assert nodes["ONE"] == {"camera": ["R"], "policy": ["A"], "drive": ["R"]}
    assert nodes["NOW"] == {"camera": ["R"], "policy": ["A", "B"], "drive": ["R"]}
    jobs = cell.jobs(1.0, 1.1)["jobs"]
    placed = [(job["task"], job["node"], job["second"]) for job in jobs]
    assert ("policy", "A", False) in placed
    assert ("policy", "B", True) in placed
