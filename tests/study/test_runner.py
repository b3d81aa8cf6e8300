"""What a study finds: the runs of its contenders, by the point's own measure, in one order."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from dwell import draw, simulate, simulate_realisation
from dwell.cellfile.study_paths import with_settings
from dwell.errors import MetricError
from dwell.model import Problem
from dwell.record import Run
from dwell.study import Contender, Point, StudyResult, compare, run_study
from dwell.study.judged_cost import judged_cost
from dwell.study.reference import references
from dwell.study.summary import summarise
from tests.cells.small import make_problem
from tests.study.test_study import grid, make_study

PROBLEM = make_problem()
CARELESS = {"objective.weights.violations": 0.0, "objective.tiers": {"R2": "robot"}}


@pytest.fixture(scope="module")
def result() -> StudyResult:
    """Return a study of every kind: points that are drawn alike and not, settings, references."""
    study = make_study(
        points=grid(dwells=range(1, 3), delays=range(1, 3)),
        contenders=(
            Contender("LOC", "LOC"),
            Contender("dtp", "dtp"),
            Contender("careless", "dtp", settings=CARELESS),
        ),
        references=True,
    )
    return run_study(study, processes=1)


def rows(result: StudyResult, **labels: object) -> pl.DataFrame:
    return result.runs.filter(*(pl.col(name) == value for name, value in labels.items()))


def test_runs_are_in_the_order_of_the_study(result: StudyResult) -> None:
    study = result.study
    columns = (*result.parameters, "scenario", "policy", "seed")
    points = [tuple(point.values.values()) for point in study.points]
    expected = itertools.product(points, study.scenarios, study.policies, study.seeds)
    assert result.runs.select(columns).rows() == [(*point, *rest) for point, *rest in expected]
    assert result.runs.columns[: len(columns)] == list(columns)
    assert result.parameters == ("parameter.controller.min_dwell", "parameter.links[0].delay_ms")


def test_a_row_is_the_summary_of_that_run(result: StudyResult) -> None:
    problem = result.study.points[3].problem
    run = simulate(problem, scenario="network-impairment", policy="dtp", seed=2, windows=6)
    labels: Mapping[str, Any] = {"scenario": "network-impairment", "policy": "dtp", "seed": 2}
    values = dict(zip(result.parameters, (2, 2), strict=True))
    found = rows(result, **labels, **values).row(0, named=True)
    expected = summarise(run, problem, labels)
    assert {name: found[name] for name in expected.row} == expected.row
    costs = result.costs.filter(
        *(pl.col(name) == value for name, value in {**labels, **values}.items())
    )
    wanted = pl.DataFrame(expected.costs, infer_schema_length=None).fill_nan(None)
    assert_frame_equal(costs.select(wanted.columns), wanted)


def test_distributions_are_those_of_all_seeds(result: StudyResult) -> None:
    problem = result.study.points[0].problem
    within, cycles = np.zeros(320, np.int64), 0
    for seed in (1, 2, 3):
        run = simulate(problem, scenario="baseline", policy="dtp", seed=seed, windows=6)
        summary = summarise(run, problem, {})
        within, cycles = within + summary.within, cycles + int(summary.row["cycles"])
    first = result.latencies.filter(
        pl.col(result.parameters[0]) == 1,
        pl.col(result.parameters[1]) == 1,
        pl.col("scenario") == "baseline",
        pl.col("policy") == "dtp",
    )
    assert first["share"].to_list() == (within / cycles).tolist()
    assert result.latencies.height == 4 * 2 * 7 * len(first)


def test_a_comparison_is_a_study_of_one_point() -> None:
    study = make_study()
    found = run_study(study, processes=1)
    comparison = compare(
        PROBLEM,
        scenarios=study.scenarios,
        policies=study.policies,
        seeds=study.seeds,
        windows=study.windows,
        processes=1,
    )
    for name in ("runs", "costs", "latencies"):
        assert_frame_equal(getattr(found, name), getattr(comparison, name), check_exact=True)
    assert_frame_equal(found.table(), comparison.table())


def test_progress_counts_runs() -> None:
    seen: list[tuple[int, int]] = []
    study = make_study(seeds=(1,))
    run_study(study, processes=1, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(2, 4), (4, 4)]


def test_the_table_has_one_row_a_group(result: StudyResult) -> None:
    table = result.table(["cost", "regret"])
    assert table.height == 4 * 2 * 7
    assert {"cost", "cost_low", "cost_high", "regret", "seeds"} <= set(table.columns)
    assert table["seeds"].unique().to_list() == [3]
    assert "best_static" not in result.table().columns


def test_a_metric_that_no_run_has_gets_the_nearest_name(result: StudyResult) -> None:
    with pytest.raises(MetricError) as caught:
        result.table(["cost", "violaton_rate"])
    hint = "unknown metric 'violaton_rate'; did you mean 'violation_rate'?"
    assert str(caught.value) == hint
    with pytest.raises(MetricError, match="unknown metric 'scenario'"):
        result.table(["scenario"])


# ------------------------------------------------------------------------- contenders, judging


def test_settings_change_the_controller_and_not_what_happens(result: StudyResult) -> None:
    problem = result.study.points[0].problem
    realisation = draw(problem, scenario="network-impairment", seed=1, windows=6)
    seen = with_settings(problem, CARELESS)
    run = simulate_realisation(seen, realisation, policy="dtp")
    found = rows(result, scenario="network-impairment", policy="careless", seed=1).row(
        0, named=True
    )
    assert found["migrations"] == summarise(run, problem, {}).row["migrations"]
    assert found["cost"] == judged_cost(run, problem)
    # By its own measure, misses cost nothing.
    assert found["cost"] > summarise(run, seen, {}).row["cost"]
    assert found["u_robot"] == summarise(run, problem, {}).row["u_robot"]


# ------------------------------------------------------------------------------- references


def test_references_are_rows_and_columns(result: StudyResult) -> None:
    problem = result.study.points[0].problem
    realisation = draw(problem, scenario="network-impairment", seed=2, windows=6)
    known = references(problem, realisation)
    mine = rows(result, scenario="network-impairment", seed=2).head(7)
    assert mine["policy"].to_list() == ["LOC", "dtp", "careless", *known.runs]
    assert mine["reference_cost"].unique().to_list() == [known.cost]
    assert mine["best_static"].unique().to_list() == [known.best_static]
    for row in mine.to_dicts():
        assert row["regret"] == pytest.approx(row["cost"] / known.cost - 1)
        assert row["oracle_regret"] == pytest.approx(row["cost"] / known.costs["oracle"] - 1)
    clairvoyant = mine.filter(pl.col("policy") == "clairvoyant").row(0, named=True)
    assert clairvoyant["cost"] == known.costs["clairvoyant"]


def test_every_run_is_compared_with_the_reference_of_its_own_realisation(
    result: StudyResult,
) -> None:
    for index, point in enumerate(result.study.points):
        problem, values = (
            point.problem,
            dict(zip(result.parameters, point.values.values(), strict=True)),
        )
        for seed in (1, 3):
            realisation = draw(problem, scenario="network-impairment", seed=seed, windows=6)
            known = references(problem, realisation)
            runs = {
                "LOC": simulate_realisation(problem, realisation, policy="LOC"),
                "dtp": simulate_realisation(problem, realisation, policy="dtp"),
                "careless": simulate_realisation(
                    result.study.contenders[2].problem(problem), realisation, policy="dtp"
                ),
                **known.runs,
            }
            for name, run in runs.items():
                found = rows(
                    result, scenario="network-impairment", policy=name, seed=seed, **values
                ).row(0, named=True)
                assert found["reference_cost"] == known.cost, (index, name)
                assert found["regret"] == found["cost"] / known.cost - 1.0
                assert found["share_kept"] == share_kept(known.run, run, problem)


def share_kept(reference: Run, run: Run, problem: Problem) -> float:
    """Share of the reference's windows with at most 5 % misses in which a run misses as few."""
    width, first = problem.window_cycles, problem.warmup_windows * problem.window_cycles
    few = []
    for one in (reference, run):
        missed = one.cycles["missed"].to_list()[first:]
        whole = range(0, len(missed) - width + 1, width)
        few.append([sum(missed[at : at + width]) <= 0.05 * width for at in whole])
    both = [mine for theirs, mine in zip(*few, strict=False) if theirs]
    return sum(both) / len(both) if both else 1.0


def test_references_are_simulated_again_after_a_stop(result: StudyResult, tmp_path: Path) -> None:
    folder = tmp_path / "there"
    run_study(result.study, folder=folder, processes=1)
    names = [*(folder / "parts").glob("*.parquet")]
    lost = [path for path in names if "oracle" in pl.read_parquet(path)["policy"].to_list()]
    assert 0 < len(lost) < len(names)
    for path in (*lost, folder / "runs.parquet"):
        path.unlink()
    again = run_study(result.study, folder=folder, processes=1)
    assert_frame_equal(again.runs, result.runs, check_exact=True)


def test_a_candidate_among_the_references_shows_what_it_shows_alone(result: StudyResult) -> None:
    alone = run_study(replace(result.study, references=False), processes=1)
    columns = alone.runs.columns
    for policy in ("LOC", "dtp"):
        assert_frame_equal(rows(result, policy=policy).select(columns), rows(alone, policy=policy))


# --------------------------------------------------------------------------------- failures


def test_a_point_is_where_its_values_say() -> None:
    with pytest.raises(TypeError):
        Point({"a": 1}, PROBLEM).values["a"] = 2  # type: ignore[index]
