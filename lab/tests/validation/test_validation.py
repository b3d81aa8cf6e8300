"""Predicted beside measured: simulated runs stand for measured ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import polars as pl
import pytest

from dwell import Run, simulate
from dwell.errors import RunError
from dwell.model import (
    Execution,
    Gamma,
    LogNormal,
    NodeDisturbance,
    Placement,
    Problem,
)
from dwell.study.predicted_moves import predicted_moves
from dwell_lab.validation.measured_run import read_measured
from dwell_lab.validation.validation import GOALS, Validation, validate
from tests.cells.small import make_problem
from tests.report.live_runs import live_run

WINDOWS = 102
SEEDS = 6


def slower(problem: Problem, factor: float) -> Problem:
    """Return a cell whose tasks take `factor` times as long."""

    def scaled(execution: Execution) -> Execution:
        process = execution.exec_ms
        assert isinstance(process, LogNormal)
        return replace(execution, exec_ms=LogNormal(process.mean * factor, process.cv))

    tasks = {
        name: replace(task, on={node: scaled(one) for node, one in task.on.items()})
        for name, task in problem.pipeline.tasks.items()
    }
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))


def measured(problem: Problem, scenario: str, policy: str, *seeds: int) -> dict[str, Run]:
    return {
        f"{scenario}-{policy}-{seed}": simulate(
            problem, scenario=scenario, policy=policy, seed=seed, windows=WINDOWS
        )
        for seed in seeds
    }


def with_meta(run: Run, **changes: object) -> Run:
    """Return a run whose record says something else."""
    return Run(
        {**run.meta, **changes},
        {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions},
    )


@cache
def truth() -> Validation:
    problem = make_problem(window_cycles=40)
    runs: dict[str, Run] = {}
    for scenario in ("baseline", "robot-cpu-stress", "network-impairment"):
        runs |= measured(problem, scenario, "LOC", 101, 102)
    runs |= measured(problem, "robot-cpu-stress", "dtp", 101, 102)
    return validate(runs, problem, seeds=SEEDS)


class TestTruth:
    @pytest.mark.parametrize("goal", GOALS)
    def test_predicts_itself(self, goal: str) -> None:
        found = {(one.scenario, one.policy): one.verdict(goal) for one in truth().groups}
        assert set(found.values()) <= {"met", "explained"}, found

    def test_groups_are_in_the_order_of_the_cell(self) -> None:
        assert [(one.scenario, one.policy) for one in truth().groups] == [
            ("baseline", "LOC"),
            ("robot-cpu-stress", "LOC"),
            ("robot-cpu-stress", "dtp+profile"),
            ("network-impairment", "LOC"),
        ]

    def test_short_measurements_are_told(self) -> None:
        group = truth().groups[0]
        assert group.minutes == pytest.approx(2 * 100 * 40 * 33 / 60e3)
        assert group.short

    def test_intervals_are_around_their_values(self) -> None:
        for group in truth().groups:
            for one in group.figures.values():
                for interval in (one.measured, one.predicted, one.error):
                    if interval.known:
                        assert interval.low <= interval.value <= interval.high, one

    def test_table_has_every_figure_of_every_group(self) -> None:
        table = truth().table
        counts = table.group_by("scenario", "policy").len()["len"]
        assert counts.min() == counts.max() == len(truth().groups[0].figures)
        row = table.row(0, named=True)
        figure = truth().groups[0].figures["l95_ms"]
        assert row["metric"] == "l95_ms"
        assert row["error"] == pytest.approx(row["predicted"] / row["measured"] - 1)
        assert (row["measured"], row["verdict"]) == (figure.measured.value, figure.verdict)

    def test_the_same_again(self) -> None:
        problem = make_problem()
        runs = measured(problem, "baseline", "LOC", 101)
        one, other = (validate(runs, problem, seeds=2) for _ in range(2))
        assert one.table.equals(other.table, null_equal=True)


class TestWrongCells:
    def test_times_30_percent_too_low_are_caught(self) -> None:
        problem = make_problem()
        runs = measured(problem, "baseline", "LOC", 101, 102)
        (group,) = validate(runs, slower(problem, 0.7), seeds=SEEDS).groups
        assert group.verdict("l95_ms") == "missed"
        use = group.uses["R1"]
        assert use.error.value == pytest.approx(-0.3 * use.measured.value, rel=0.1)
        assert group.figures["l95_ms"].error.high < -0.1

    def test_rates_are_explained_where_the_mass_lies_at_the_deadline(self) -> None:
        problem = make_problem()
        pipeline = replace(problem.pipeline, deadline_ms=26.5)
        problem = replace(problem, pipeline=pipeline)
        runs = measured(problem, "baseline", "LOC", 101, 102)
        (group,) = validate(runs, slower(problem, 0.96), seeds=SEEDS).groups
        rate = group.figures["violation_rate"]
        assert abs(rate.error.value) > 0.02
        assert group.verdict("l95_ms") == "met"
        assert rate.verdict == "explained"
        low, high = group.allowed_rates
        assert low < rate.measured.value < high
        assert 1.0 < group.factor < 1.1
        assert group.predicted.rate_if(group.factor) == pytest.approx(rate.measured.value, abs=1e-3)

    def test_another_dominant_placement_is_caught(self) -> None:
        problem = make_problem()
        tasks = dict(problem.pipeline.tasks)
        heavy = {
            node: replace(one, exec_ms=Gamma(30.0 if node == "E" else 1.0, 0.2))
            for node, one in tasks["perception"].on.items()
        }
        tasks["perception"] = replace(tasks["perception"], on=heavy)
        other = replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))
        runs = measured(problem, "robot-cpu-stress", "dtp", 101)
        (group,) = validate(runs, other, seeds=3).groups
        assert group.dominant[0] != group.dominant[1]
        assert group.verdict("dominant") == "missed"


class TestWhatCounts:
    def test_excluded_windows_are_left_out_of_both(self) -> None:
        problem = make_problem()
        (name, run), *_ = measured(problem, "baseline", "LOC", 101).items()
        run = with_meta(run, excluded_windows=[5, 7, 1])
        (group,) = validate({name: run}, problem, seeds=2).groups
        # The second window is one of the warm-up.
        assert group.measured.windows == WINDOWS - 2 - 2
        assert group.predicted.windows == 2 * group.measured.windows
        assert group.excluded == 3

    def test_a_placement_that_the_cell_does_not_list_is_predicted_too(self) -> None:
        problem = make_problem()
        unseen = Placement({"sensing": "R1", "perception": "R1", "planning": "E", "control": "R2"})
        larger = replace(problem, candidates={**problem.candidates, "ROB-EDGE": unseen})
        runs = measured(larger, "baseline", "ROB-EDGE", 101)
        (group,) = validate(runs, problem, seeds=2).groups
        assert group.policy == "ROB-EDGE"
        assert group.dominant == ("ROB-EDGE", "ROB-EDGE")
        assert group.verdict("l95_ms") == "met"

    def test_live_runs(self) -> None:
        run = live_run(policy="dtp", scenario="baseline", estimator="Profile")
        found = read_measured("run", run, make_problem())
        assert found.contender == "dtp+profile"
        assert validate([run], make_problem(), seeds=2).groups[0].measured.windows == 5


def refusals() -> Iterator[tuple[str, Callable[[Run], Run], str]]:
    def problem_with(**changes: object) -> Callable[[Run], Run]:
        return lambda run: with_meta(run, problem={**run.meta["problem"], **changes})

    def node_with(**changes: object) -> Callable[[Run], Run]:
        def changed(run: Run) -> Run:
            nodes = run.meta["problem"]["nodes"]
            nodes = {**nodes, "R1": {**nodes["R1"], **changes}}
            return with_meta(run, problem={**run.meta["problem"], "nodes": nodes})

        return changed

    def part_with(part: str, **more: object) -> Callable[[Run], Run]:
        def changed(run: Run) -> Run:
            problem = run.meta["problem"]
            return with_meta(run, problem={**problem, part: {**problem[part], **more}})

        return changed

    def with_a_task(run: Run) -> Run:
        larger = part_with("tasks", log={"on": {"E": {"exec_ms": 1.0}}})(run).meta["problem"]
        flow = {"from": "perception", "to": "log", "bytes": 10}
        return with_meta(run, problem={**larger, "flows": [*larger["flows"], flow]})

    def played(run: Run) -> Run:
        return with_meta(run, played=[{"node": "R1", "stress_threads": 7, "at_s": 1, "for_s": 2}])

    yield "name", problem_with(name="other"), "another cell: name is 'other', not 'small'"
    yield "period", problem_with(period_ms=40.0), "period_ms is 40.0, not 33.0"
    yield "nodes", part_with("nodes", X={"tier": "robot"}), "its nodes are E, R1, R2, X, not E, R1"
    yield "tasks", with_a_task, "its tasks are control, log, perception, planning, sensing, not"
    yield "unreadable", problem_with(nodes={}), "the cell cannot be read: nodes: none is declared"
    yield "quota", node_with(quota={"cpu": 0.4, "period_ms": 4.0}), "nodes.R1.quota was"
    yield "cores", node_with(cores=2), "nodes.R1.cores was 2 in the run and is 4 in the cell"
    yield "scenario", lambda run: with_meta(run, scenario="storm"), "scenario 'storm' is not in"
    yield "policy", lambda run: with_meta(run, policy="Mine()"), "unknown policy 'Mine()'"
    yield (
        "parameters",
        lambda run: with_meta(run, policy="DTP(initial='SO', min_dwell=9)"),
        "policy was DTP(initial='SO', min_dwell=9); by the cell it would be DTP(initial='LOC'",
    )
    yield "estimator", lambda run: with_meta(run, estimator="Oracle"), "estimator 'Oracle'"
    yield "played", played, "was played, which scenario 'baseline' does not have"
    yield "record", lambda run: with_meta(run, problem=None), "does not say which cell"
    yield "windows", lambda run: with_meta(run, excluded_windows="all"), "numbers of windows"
    yield (
        "nothing",
        lambda run: with_meta(run, excluded_windows=list(range(6))),
        "every window after the warm-up is excluded",
    )


class TestBadInput:
    @pytest.mark.parametrize(
        ("change", "message"),
        [pytest.param(change, message, id=name) for name, change, message in refusals()],
    )
    def test_refused(self, change: Callable[[Run], Run], message: str) -> None:
        problem = make_problem()
        run = change(simulate(problem, policy="LOC", seed=1, windows=6))
        with pytest.raises(RunError, match=r"^mine: ") as caught:
            validate({"mine": run}, problem)
        assert message in str(caught.value)

    def test_candidate_of_the_same_name(self) -> None:
        problem = make_problem()
        other = replace(problem, candidates={**problem.candidates, "LOC": problem.candidates["SO"]})
        run = simulate(other, policy="LOC", seed=1, windows=6)
        with pytest.raises(RunError, match=r"candidate LOC was .* in the run; in the cell"):
            validate([run], problem)

    def test_scenario_of_the_same_name(self) -> None:
        problem = make_problem()
        other = replace(
            problem,
            scenarios={"robot-cpu-stress": (NodeDisturbance("R1", stress_threads=1),)},
        )
        run = simulate(other, scenario="robot-cpu-stress", policy="LOC", seed=1, windows=6)
        with pytest.raises(RunError, match="'robot-cpu-stress' differs between the run"):
            validate([run], problem)

    def test_calibration_runs(self) -> None:
        problem = make_problem()
        run = simulate(problem, policy="LOC", seed=1, windows=6)
        with pytest.raises(RunError, match="a: the cell was calibrated from this run"):
            validate({"a": run, "b": run}, problem, calibrated_from=["a"])

    def test_calibration_runs_by_what_their_stamps_carry(self) -> None:
        run = live_run(policy="dtp", scenario="baseline", estimator="Profile")
        tables = {"windows": run.windows, "decisions": run.decisions}
        stamped = Run(run.meta, {**tables, "cycles": run.cycles.with_columns(run=pl.lit(1795))})
        with pytest.raises(RunError, match="mine: the cell was calibrated from this run"):
            validate({"mine": stamped}, make_problem(), calibrated_from=["1795"])

    def test_all_faults_at_once(self) -> None:
        problem = make_problem()
        run = simulate(problem, policy="LOC", seed=1, windows=6)
        bad = with_meta(run, scenario="storm"), with_meta(run, policy="Mine()")
        with pytest.raises(RunError) as caught:
            validate(dict(zip("ab", bad, strict=True)), problem)
        assert [line[0] for line in str(caught.value).splitlines()] == ["a", "b"]

    def test_no_runs_and_no_seeds(self) -> None:
        problem = make_problem()
        with pytest.raises(RunError, match="no runs"):
            validate([], problem)
        run = simulate(problem, policy="LOC", seed=1, windows=6)
        with pytest.raises(RunError, match="seeds is 1"):
            validate([run], problem, seeds=1)


def test_moves_are_those_of_the_measured_runs_that_count() -> None:
    problem = make_problem(window_cycles=40)
    runs = measured(problem, "network-impairment", "dtp", 101, 102)
    found = validate(runs, problem, seeds=2).moves
    for name, run in runs.items():
        mine = found.filter(run=name)
        assert set(mine["policy"]) == {"dtp+profile"}
        assert mine.drop("scenario", "policy", "run").equals(predicted_moves(run))
    assert set(found["run"]) == set(runs)
    first = found.row(0, named=True)
    left_out = with_meta(runs[first["run"]], excluded_windows=[first["window"]])
    fewer = validate({first["run"]: left_out}, problem, seeds=2).moves
    assert first["window"] not in fewer["window"]
