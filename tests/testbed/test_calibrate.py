"""Calibrate: runs of a cell that is known give that cell back, from the file of another one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.errors import RunError
from dwell.model import Constant, Gamma, Problem, Quota
from dwell.model.document import to_document
from dwell.record import Run
from dwell.sim import draw, simulate_realisation
from dwell.testbed.calibrate import Calibrated, calibrate
from dwell.testbed.measured import look_at
from dwell.testbed.node_loads import TOGETHER, wakes

CELL = """
dwell: 1
name: known
period_ms: 50
deadline_ms: 50
window_cycles: 30
warmup_windows: 2
nodes:
  R1: {tier: robot, cores: 1, quota: {cpu: 0.4, period_ms: 4}}
  E: {tier: edge, cores: 1, quota: {cpu: 0.8, period_ms: 4}}
links:
  - {from: R1, to: E, both_ways: true, delay_ms: {lognormal: {mean: 0.7, cv: 0.3}}, rate_mbps: 940}
tasks:
  see: {on: {R1: {exec_ms: 9}}}
  find:
    input: latest
    on:
      R1: {exec_ms: 9}
      E: {exec_ms: 9}
  act: {on: {R1: {exec_ms: 9}}}
flows:
  - {from: see, to: find, bytes: 300000}
  - {from: find, to: act, bytes: 1000}
candidates:
  LOC: {find: R1}
  OFF: {find: E}
scenarios:
  stress: [{node: E, stress_threads: 2}]
  far: [{link: R1->E, add_delay_ms: 20}]
objective:
  weights: {latency: 1, violations: 3, robot: 0.2, edge: 0.1, switching: 0.2}
  targets: {latency_ms: 50, robot: 0.9, edge: 0.9}
  caps: {latency_ms: 400}
controller: {on: E, policy: LOC, initial: LOC, estimator: profile}
"""
#: Of the stage alone, and of the messaging of a job's worker that lies on the cycle's way.
STAGE_MS = {("see", "R1"): 1.6, ("find", "R1"): 5.0, ("find", "E"): 4.5, ("act", "R1"): 0.2}
MESSAGING_MS = {("see", "R1"): 0.5, ("find", "R1"): 0.7, ("find", "E"): 0.6, ("act", "R1"): 0.2}
#: More of its worker's messaging, which delays nothing: background.
OFF_WAY_MS = {("see", "R1"): 0.2}
IDLE = 0.004
BACKGROUND = {"R1": 0.06, "E": 0.1}
BESIDE = {"R1": 0.04, "E": 0.05}
#: Of E, the only node that a run stresses.
INTERFERENCE = 1.25
CONTENTION = {"R1": 0.15, "E": 0.1}
ADDED_MS = 0.35
#: How often something wakes, per second, in the mean over the four runs.
HZ = {"R1": 900.0, "E": 1500.0}
WINDOWS = 60
BASE = 20_000


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cell = tmp_path_factory.mktemp("cell") / "known.yaml"
    cell.write_text(CELL)
    return cell


@pytest.fixture(scope="module")
def truth(nominal: Path) -> Problem:
    """The cell that is there, which nobody knows."""
    problem = dwell.load(nominal)
    tasks = {
        task.name: replace(
            task,
            on={
                node: replace(
                    of,
                    exec_ms=Gamma(STAGE_MS[task.name, node] + MESSAGING_MS[task.name, node], 0.12),
                )
                for node, of in task.on.items()
            },
        )
        for task in problem.pipeline.tasks.values()
    }
    fabric = replace(
        problem.fabric,
        nodes={
            node: replace(
                of,
                background=BACKGROUND[node],
                background_beside=BESIDE[node],
                interference=INTERFERENCE if node == "E" else 1.0,
                contention=CONTENTION[node],
            )
            for node, of in problem.fabric.nodes.items()
        },
        links={
            name: replace(link, delay_ms=replace(link.delay_ms, mean=0.7 + ADDED_MS))  # type: ignore[type-var]
            for name, link in problem.fabric.links.items()
        },
    )
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks), fabric=fabric)


def share(bytes_: int, of: int) -> float:
    """Part of a task's messaging that a message is; as large as it is, and as any is."""
    return (BASE + bytes_) / of


def observed(truth: Problem, nominal: Path, placement: str, scenario: str = "baseline") -> Run:
    """Record a run of the true cell as a live one is recorded."""
    real = draw(truth, scenario=scenario, seed=7, windows=WINDOWS)
    played = simulate_realisation(truth, real, policy=placement, jobs=True)
    exec_ns = {site: real.exec_ns[row] for row, site in enumerate(real.sites)}
    jobs = played.jobs.filter(pl.col("end_ns").is_not_null())
    cycles, tasks, nodes = (jobs[name].to_list() for name in ("cycle", "task", "node"))
    sites = list(zip(tasks, nodes, strict=True))
    slower = INTERFERENCE if scenario == "stress" else 1.0
    took = [
        exec_ns[s][c] * (slower if s[1] == "E" else 1.0) for s, c in zip(sites, cycles, strict=True)
    ]
    over_ns = np.array([round(MESSAGING_MS[site] * 1e6) for site in sites])
    cpu_ns = np.array(took).round().astype(np.int64) - over_ns
    # A worker reads before its stage starts, and writes after it has ended.
    bytes_of = {"see": (0, 300_000), "find": (300_000, 1_000), "act": (1_000, 0)}
    of = np.array([2 * BASE + sum(bytes_of[task]) for task in tasks])
    read, wrote = (
        np.array([BASE + bytes_of[task][i] for task in tasks]) / of * over_ns for i in (0, 1)
    )
    first = np.array(tasks) == "see"
    jobs = jobs.with_columns(
        ready_ns=pl.col("ready_ns") + pl.Series(np.where(first, 0, read)).cast(pl.Int64),
        start_ns=pl.col("start_ns") + pl.Series(read).cast(pl.Int64),
        end_ns=pl.col("end_ns") - pl.Series(wrote).cast(pl.Int64),
        cpu_ns=pl.Series(cpu_ns),
    )
    beside = pl.col("node").cast(pl.String).replace_strict(BESIDE, return_dtype=pl.Float64)
    took_ns = pl.col("end_ns") - pl.col("start_ns")
    outside = pl.col("node").cast(pl.String).replace_strict(CONTENTION, return_dtype=pl.Float64)
    jobs = jobs.with_columns(
        others_ns=(beside * took_ns).cast(pl.Int64), outside_ns=(outside * took_ns).cast(pl.Int64)
    )
    document = to_document(dwell.load(nominal))
    meta = {**played.meta, "kind": "live", "scenario": scenario, "problem": document}
    meta["wakes_hz"] = {node: hz * (1.1 if placement == "OFF" else 0.7) for node, hz in HZ.items()}
    tables: Mapping[str, Any] = {
        "cycles": played.cycles,
        "windows": played.windows,
        "decisions": played.decisions,
        "jobs": jobs,
        "processes": processes(truth, played, jobs),
    }
    return Run(meta, tables)


def processes(truth: Problem, played: Run, jobs: pl.DataFrame) -> pl.DataFrame:
    """What the workers took in every window; of the rest only that there is something."""
    rows = []
    grace_ms = truth.controller.close_grace_ms
    span_ns = (truth.window_cycles * truth.pipeline.period_ms + grace_ms) * 1e6
    for window, first in played.windows.select("window", "first_cycle").iter_rows():
        inside = jobs.filter(pl.col("cycle").is_between(first, first + truth.window_cycles - 1))
        for task, node in STAGE_MS:
            of = inside.filter((pl.col("task") == task) & (pl.col("node") == node))
            each_ms = MESSAGING_MS[task, node] + OFF_WAY_MS.get((task, node), 0.0)
            spent_ns = int(of["cpu_ns"].sum()) + of.height * each_ms * 1e6
            rows.append((window, f"{task}@{node}", node, round(spent_ns + IDLE * span_ns)))
        rows += [(window, f"agent@{node}", node, 10**6) for node in BACKGROUND]
    schema = {"window": pl.Int64, "process": pl.String, "node": pl.String, "cpu_ns": pl.Int64}
    return pl.DataFrame(rows, schema=schema, orient="row")


@pytest.fixture(scope="module")
def folders(truth: Problem, nominal: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    at = tmp_path_factory.mktemp("runs")
    plan = (("LOC", "baseline"), ("OFF", "baseline"), ("OFF", "stress"), ("OFF", "far"))
    return [
        observed(truth, nominal, placement, scenario).save(at / f"{placement}-{scenario}")
        for placement, scenario in plan
    ]


@pytest.fixture(scope="module")
def calibrated(
    nominal: Path, folders: list[Path], tmp_path_factory: pytest.TempPathFactory
) -> Calibrated:
    out = tmp_path_factory.mktemp("out") / "measured.yaml"
    return calibrate(nominal, folders, out, say=lambda line: None)


def test_execution_times_are_found(calibrated: Calibrated) -> None:
    about = calibrated.report["tasks"]
    for (task, node), stage_ms in STAGE_MS.items():
        found = about[f"{task}@{node}"]
        assert found["stage_ms"] == pytest.approx(stage_ms, rel=0.02)
    # What a message took of its sender and of its receiver is parted by their messaging in all.
    for node in ("R1", "E"):
        way = [("see", "R1"), ("find", node), ("act", "R1")]
        of = [about[f"{task}@{where}"] for task, where in way]
        besides_ms = sum(one["before_ms"] + one["after_ms"] for one in of)
        assert besides_ms == pytest.approx(sum(MESSAGING_MS[site] for site in way), rel=0.08)
    assert calibrated.missing == ()
    # What is stressed says nothing of its node, and a link that is worse nothing of itself.
    assert "OFF-stress" not in about["find@E"]["of_runs"]
    assert "OFF-stress" in about["see@R1"]["of_runs"]


def test_backgrounds_and_links_are_found(calibrated: Calibrated) -> None:
    for node, cores in BACKGROUND.items():
        assert calibrated.report["background"][node] == pytest.approx(cores, abs=0.006)
        found = calibrated.problem.fabric.nodes[node]
        assert found.interference == pytest.approx(INTERFERENCE if node == "E" else 1.0, rel=0.05)
        assert found.background_beside == pytest.approx(BESIDE[node], abs=0.001)
        assert found.contention == pytest.approx(CONTENTION[node], abs=0.001)
    assert calibrated.problem.fabric.nodes["R1"].quota == Quota(0.4, 4)
    for link in ("R1->E", "E->R1"):
        assert calibrated.report["links"][link]["added_ms"] == pytest.approx(ADDED_MS, abs=0.25)


@pytest.mark.parametrize(("cpus", "found"), [([0], {"E": 0.3}), ([1], {})])
def test_a_node_on_the_same_cpus_takes_more_of_them_while_it_is_stressed(
    nominal: Path, folders: list[Path], tmp_path: Path, cpus: list[int], found: dict[str, float]
) -> None:
    run = dwell.open_run(folders[2])
    took_ns = pl.col("end_ns") - pl.col("start_ns")
    outside = pl.when(pl.col("node") == "R1").then(0.3 * took_ns).otherwise("outside_ns")
    jobs = run.jobs.with_columns(outside_ns=outside.cast(pl.Int64))
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    tables |= {"processes": run.processes}
    meta = {**run.meta, "testbed": {"nodes": {"R1": {"cpus": [0]}, "E": {"cpus": cpus}}}}
    folder = Run(meta, {**tables, "jobs": jobs}).save(tmp_path / "OFF-stress")
    runs = [*folders[:2], folder]
    node = calibrate(nominal, runs, tmp_path / "out.yaml", say=print).problem.fabric.nodes["R1"]
    assert node.contention_stressed == pytest.approx(found, abs=0.001)
    assert node.contention == pytest.approx(CONTENTION["R1"], abs=0.001)


def test_what_a_node_takes_beside_a_job_varies_with_the_job(
    nominal: Path, folders: list[Path], calibrated: Calibrated, tmp_path: Path
) -> None:
    run = dwell.open_run(folders[0])
    found = run.jobs["task"].cast(pl.String) == "find"
    more_ns = np.random.default_rng(1).gamma(2, 0.5e6, run.jobs.height)
    more = pl.Series(np.where(found, more_ns, 0)).cast(pl.Int64)
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    tables |= {"processes": run.processes}
    jobs = run.jobs.with_columns(others_ns=pl.col("others_ns") + more)
    folder = Run(run.meta, {**tables, "jobs": jobs}).save(tmp_path / "LOC-baseline")
    said = calibrate(nominal, [folder, *folders[1:]], tmp_path / "out.yaml", say=lambda line: None)
    usual, now = (one.report["tasks"]["find@R1"] for one in (calibrated, said))
    # The mean is the background's, what it varies by is the job's: the quota is the same.
    assert now["mean_ms"] == pytest.approx(usual["mean_ms"], abs=0.01)
    assert now["std_ms"] ** 2 == pytest.approx(usual["std_ms"] ** 2 + 0.5, rel=0.2)
    # All of the background at most.
    assert said.report["background_beside"]["R1"] == said.report["background"]["R1"]


def test_a_job_beside_a_job_is_no_background(
    nominal: Path, truth: Problem, folders: list[Path]
) -> None:
    run = dwell.open_run(folders[0])
    shadowed = (pl.col("task").cast(pl.String) == "find") & (pl.col("cycle") % 5 == 0)
    # A shadow begins within the job, and ends after it; what it takes is counted as others'.
    shadows = run.jobs.filter(shadowed).with_columns(
        start_ns=(pl.col("start_ns") + pl.col("end_ns")) // 2,
        end_ns=pl.col("end_ns") + 10**6,
        shadow=pl.lit(value=True),
    )
    jobs = run.jobs.with_columns(
        others_ns=pl.col("others_ns") + pl.when(shadowed).then(5 * 10**6).otherwise(0),
        shadow=pl.lit(value=False),
    )
    jobs = pl.concat([jobs, shadows.select(jobs.columns)])
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    both = [
        look_at("one", one, dwell.load(nominal))
        for one in (run, Run(run.meta, {**tables, "processes": run.processes, "jobs": jobs}))
    ]
    (taken_s, took_s), (left_s, out_of_s) = (one.beside["R1"] for one in both)
    assert left_s / out_of_s == pytest.approx(taken_s / took_s, rel=1e-3)
    assert out_of_s < 0.95 * took_s
    for one in both:
        assert np.abs(one.visits["find", "R1"].beside_ms).max() < 0.01


def test_what_the_end_of_a_cycle_takes_is_counted_where_it_can_be(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    run = dwell.open_run(folders[0])
    last = pl.col("task").cast(pl.String) == "act"
    jobs = run.jobs.with_columns(ending_ns=pl.when(last).then(pl.lit(700_000)))
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    told = Run(run.meta, {**tables, "processes": run.processes, "jobs": jobs})
    found = [look_at("one", one, dwell.load(nominal)).ends_ms for one in (run, told)]
    assert found[0]["act", "R1"] < 0.5
    assert found[1] == {("act", "R1"): pytest.approx(0.7)}


def test_how_often_something_wakes_is_of_nodes_whose_quota_has_ticks(
    calibrated: Calibrated, nominal: Path, folders: list[Path]
) -> None:
    assert calibrated.report["background_hz"] == {}
    problem = dwell.load(nominal)
    measured = [look_at(folder.name, dwell.open_run(folder), problem) for folder in folders]
    nodes = dict(problem.fabric.nodes)
    nodes["E"] = replace(nodes["E"], quota=Quota(0.8, 4.0, tick_ms=4.0))
    ticking = replace(problem, fabric=replace(problem.fabric, nodes=nodes))
    assert wakes(measured, ticking) == {"E": pytest.approx(HZ["E"] / TOGETHER)}
    # Runs of before it was recorded say nothing, and leave it out.
    for one in measured:
        del one.run.meta["wakes_hz"]
    assert wakes(measured, ticking) == {}


@pytest.mark.parametrize(
    ("placement", "scenario"), [("LOC", "baseline"), ("OFF", "baseline"), ("OFF", "stress")]
)
def test_the_calibrated_cell_predicts_the_true_one(
    calibrated: Calibrated, truth: Problem, placement: str, scenario: str
) -> None:
    shown = []
    for problem, seed in ((truth, 11), (calibrated.problem, 12)):
        real = draw(problem, scenario=scenario, seed=seed, windows=150)
        run = simulate_realisation(problem, real, policy=placement)
        latency_ms = run.cycles["latency_ns"].to_numpy() / 1e6
        busy = [run.windows[f"u_{node}"].mean() for node in BACKGROUND]
        shown.append((np.quantile(latency_ms, 0.95), latency_ms.mean(), *busy))
    (true_l95, true_mean, *true_busy), (l95, mean, *busy) = shown
    assert l95 == pytest.approx(true_l95, rel=0.03)
    assert mean == pytest.approx(true_mean, rel=0.03)
    assert busy == pytest.approx(true_busy, abs=0.02)


def test_the_sidecar_names_the_runs_and_checks_the_cell(calibrated: Calibrated) -> None:
    said = json.loads(calibrated.sidecar.read_text())
    assert calibrated.sidecar.name == "measured.calibration.json"
    assert said["runs"] == ["LOC-baseline", "OFF-baseline", "OFF-stress", "OFF-far"]
    for row in said["check"]:
        assert row["predicted"]["mean_ms"] == pytest.approx(row["measured"]["mean_ms"], rel=0.04)


def test_the_check_plays_runs_with_the_estimators_that_they_had(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    """Shadow jobs load nodes: of a run without any, a cell that has some says nothing."""
    probing = tmp_path / "probing.yaml"
    half = "estimator: shadow, shadow_fraction: 0.5"
    probing.write_text(CELL.replace("estimator: profile", half))
    run, at = dwell.open_run(folders[0]), tmp_path / "runs"
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    tables |= {"processes": run.processes, "jobs": run.jobs}
    told = {name: Run({**run.meta, "estimator": name}, tables) for name in ("Profile", "Shadow")}
    runs = [*(one.save(at / name) for name, one in told.items()), folders[1]]
    said = calibrate(probing, runs, tmp_path / "out.yaml", say=lambda line: None).report["check"]
    without, beside = (row["predicted"]["u_E"] for row in said[:2])
    assert beside > without + 0.05
    # One of a user's own cannot be played.
    told["Oracle"] = Run({**run.meta, "estimator": "Oracle"}, tables)
    mine = [told["Oracle"].save(at / "Oracle"), folders[1]]
    said = calibrate(probing, mine, tmp_path / "out.yaml", say=lambda line: None).report["check"]
    assert [row["run"] for row in said] == [folders[1].name]


def test_links_that_nobody_emulates_have_their_own_delays(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    lan = tmp_path / "lan.yaml"
    lan.write_text(CELL.replace("delay_ms: {lognormal: {mean: 0.7, cv: 0.3}}", "delay_ms: 0"))
    said: list[str] = []
    found = calibrate(lan, folders[:2], tmp_path / "out.yaml", emulated=False, say=said.append)
    # Under a quota a message also waits for its sender's and its receiver's next period.
    assert 0.9 < found.report["links"]["R1->E"]["mean_ms"] < 3.5
    assert any(line.startswith("R1->E:") for line in said)


def test_what_was_not_visited_stays(nominal: Path, folders: list[Path], tmp_path: Path) -> None:
    said: list[str] = []
    found = calibrate(nominal, folders[:1], tmp_path / "out.yaml", say=said.append)
    assert found.missing == ("find@E",)
    assert found.problem.pipeline.tasks["find"].on["E"].exec_ms == Constant(9)
    assert "find@E: not measured, as it was" in said


def test_bad_input_is_refused_all_at_once(
    nominal: Path, truth: Problem, folders: list[Path], tmp_path: Path
) -> None:
    bare = dwell.simulate(truth, seed=1, windows=3, policy="LOC").save(tmp_path / "bare")
    other = observed(truth, nominal, "LOC")
    other.meta["problem"]["window_cycles"] = 20
    other.meta["problem"]["nodes"]["X"] = {"tier": "robot"}
    others = other.save(tmp_path / "other")
    with pytest.raises(RunError) as caught:
        calibrate(nominal, [bare, others, tmp_path / "none"], tmp_path / "out.yaml")
    said = str(caught.value)
    assert "bare: it kept no jobs with CPU times; record it with --jobs" in said
    assert "other: its nodes are E, R1, X, those of the cell E, R1" in said
    assert "other: window_cycles was 20, not 30" in said
    assert "none: no such folder" in said
    assert not (tmp_path / "out.yaml").exists()
    for out, words in ((nominal, "is the cell itself"), (tmp_path / "out", "ends in .yaml")):
        with pytest.raises(RunError, match=words):
            calibrate(nominal, folders, out)
    with pytest.raises(RunError, match="LOC-baseline: named twice"):
        calibrate(nominal, [folders[0], folders[0]], tmp_path / "out.yaml")
