"""Studies over fleets: what a row says, and that they go on where they were stopped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from polars.testing import assert_frame_equal

import dwell
from dwell.errors import SimulationError
from dwell.model.fleet import Fleet
from dwell.policies import by_name
from dwell.study import Contender, Point, Study, open_study, run_study
from dwell.study.summary import summarise
from tests.cells.fleets import fleet_of, one_job, within


def study_of(fleet: Fleet, *, counts: tuple[int, ...] = (1, 3)) -> Study:
    """Return a study of a fleet by its count; three at once with D = 5 are one too many."""
    points = [fleet.with_count(count) for count in counts]
    return Study(
        name="robots",
        points=tuple(
            Point({"fleet.count": count}, fleet.entries[0].cell, one)
            for count, one in zip(counts, points, strict=True)
        ),
        scenarios=("baseline",),
        contenders=(Contender("OFF", "OFF"), Contender("quick", "dtp", "profile")),
        seeds=(1, 2),
        windows=8,
    )


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return fleet_of((within(one_job(), 5.0), 1))


@pytest.fixture(scope="module")
def study(fleet: Fleet) -> Study:
    return study_of(fleet)


def test_a_row_is_the_worst_cell_with_the_cost_and_the_moves_of_all(
    study: Study, fleet: Fleet
) -> None:
    runs = run_study(study, processes=1).runs
    assert runs.height == study.runs == 8
    three = runs.filter((runs["parameter.fleet.count"] == 3) & (runs["policy"] == "OFF"))
    assert three["violation_rate"].to_list() == [1.0, 1.0]
    assert three["mean_violation_rate"].to_list() == pytest.approx([1 / 3, 1 / 3])
    assert three["cells"].to_list() == [3, 3]
    assert three["worst_cell"].to_list() == ["one-03", "one-03"]
    played = dwell.simulate_fleet(fleet.with_count(3), seed=1, windows=8, policy="OFF")
    rows = [summarise(run, run.problem, {}).row for run in played.cells.values()]
    costs = [float(row["cost"]) for row in rows]
    assert three["cost"][0] == pytest.approx(sum(costs) / 3)
    assert study.cycles == 2 * 2 * 8 * 20 * (1 + 3)


def test_it_goes_on_where_it_was_stopped(study: Study, tmp_path: Path) -> None:
    whole = run_study(study, folder=tmp_path / "whole", processes=1)
    run_study(replace(study), folder=tmp_path / "part", processes=1)
    # Two contenders in four items, of which the first keeps its parts.
    parts = sorted((tmp_path / "part" / "parts").glob("*.parquet"))
    assert len(parts) == 8
    for part in parts:
        if "-000000-" not in part.name:
            part.unlink()
    for table in ("runs", "costs", "latencies"):
        (tmp_path / "part" / f"{table}.parquet").unlink()
    done: list[int] = []
    again = run_study(
        study, folder=tmp_path / "part", processes=2, progress=lambda one, of: done.append(one)
    )
    assert done[0] == 2
    assert_frame_equal(again.runs, whole.runs)
    assert_frame_equal(open_study(tmp_path / "part").runs, whole.runs)


def test_another_fleet_is_another_study(study: Study, tmp_path: Path) -> None:
    run_study(study, folder=tmp_path / "here", processes=1)
    other = study_of(fleet_of((within(one_job(), 5.0), 1), phases="even"))
    with pytest.raises(dwell.DwellError, match="holds another study"):
        run_study(other, folder=tmp_path / "here", processes=1)


def test_settings_of_a_policy_are_those_of_every_cell(fleet: Fleet) -> None:
    one = Contender("slow", "dtp", "profile", {"controller.min_dwell": 9})
    changed = one.fleet(fleet.with_count(2), "baseline")
    assert {entry.cell.controller.min_dwell for entry in changed.entries} == {9}
    assert (changed.policy, changed.estimator) == ("dtp", "profile")


def test_policies_of_a_fleet_are_named(study: Study, fleet: Fleet) -> None:
    made = by_name("dtp", fleet.entries[0].cell)
    with pytest.raises(SimulationError, match="mine: the policies of a fleet have to be named"):
        replace(study, contenders=(Contender("mine", made),))
