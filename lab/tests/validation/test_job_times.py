"""Times of jobs by task and node, and of messages by link, in runs and in predictions of them."""

from __future__ import annotations

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from dwell import simulate
from dwell_lab.validation.job_times import finished_jobs, job_times, jobs_of, links_of, profiles_of
from tests.cells.late_cycles import late_run, without_late_cycles
from tests.cells.small import make_problem

PROBLEM = make_problem()
SCENARIOS = ("baseline", "robot-cpu-stress", "network-impairment")


@pytest.fixture(scope="module")
def jobs() -> pl.DataFrame:
    """Return the jobs of every candidate in some scenarios."""
    parts: list[pl.DataFrame] = []
    for scenario in SCENARIOS:
        for policy in PROBLEM.candidates:
            run = simulate(PROBLEM, scenario=scenario, policy=policy, seed=1, windows=8, jobs=True)
            parts.append(jobs_of(run, scenario, policy, len(parts)))
    return pl.concat(parts)


def test_profiles_are_of_the_baseline(jobs: pl.DataFrame) -> None:
    profiles = profiles_of(jobs, PROBLEM)
    assert set(zip(profiles["task"], profiles["node"], strict=True)) == {
        (task, placement[task])
        for task in PROBLEM.pipeline.tasks
        for placement in PROBLEM.candidates.values()
    }
    alone = profiles.filter(task="planning", node="R2").row(0, named=True)
    # Of LOC and HYB, without the two windows of the warm-up.
    assert (alone["jobs"], alone["runs"]) == (2 * 60, 2)
    assert alone["wall_ms"] == pytest.approx(7.0, rel=0.1)
    assert alone["told_ms"] == 7.0
    assert (profiles["wall_ms_p5"] <= profiles["wall_ms_p95"]).all()
    assert profiles["cpu_ms"].is_null().all()
    assert profiles_of(None, PROBLEM).schema == profiles.schema


def test_messages_are_those_between_nodes_in_every_scenario(jobs: pl.DataFrame) -> None:
    links, delays = links_of(jobs, PROBLEM)
    assert links["scenario"].unique(maintain_order=True).to_list() == list(SCENARIOS)
    rows = {(row["scenario"], row["link"]): row for row in links.to_dicts()}
    impaired = [link for name, link in rows if name == "network-impairment" and "E" in link]
    assert impaired
    for link in impaired:
        usual = rows["baseline", link]["mean_ms"]
        assert rows["network-impairment", link]["mean_ms"] > usual + 5
    for _, mine in delays.group_by("scenario", "link"):
        assert mine["share"].is_sorted()
        assert mine["delay_ms"].is_sorted()
    for given, empty in zip((links, delays), links_of(None, PROBLEM), strict=True):
        assert empty.schema == given.schema


def test_jobs_after_the_last_window_do_not_count() -> None:
    run = late_run()
    found, expected = (
        jobs_of(one, "baseline", "LOC", 1) for one in (run, without_late_cycles(run))
    )
    assert_frame_equal(found, expected)


def test_jobs_are_compared_where_they_were_kept() -> None:
    run, other = (
        simulate(PROBLEM, policy="LOC", seed=seed, windows=60, jobs=True) for seed in (101, 1)
    )
    mine, said = (finished_jobs(one, PROBLEM.window_cycles) for one in (run, other))
    found = job_times("baseline", "LOC", PROBLEM, [mine], [said])
    row = found.filter(task="planning", node="R2").row(0, named=True)
    assert row["jobs"] == 58 * 10
    for name in ("measured_ms", "predicted_ms"):
        assert row[name] == pytest.approx(7.0, rel=0.05)
    assert row["cell_ms"] == pytest.approx(7.0, rel=0.01)
    assert row["core_ms"] is None
    none = job_times("baseline", "LOC", PROBLEM, [], [])
    assert none.is_empty()
    assert none.schema == found.schema
