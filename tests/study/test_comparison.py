"""Comparisons: pairs, intervals, and the same result from any number of processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from dwell import simulate
from dwell.errors import DwellError, PolicyError, ProblemError, SimulationError
from dwell.model import QoS
from dwell.policies import DTP, Static
from dwell.study import Comparison, compare
from dwell.study.summary import summarise
from tests.cells.small import make_problem

POLICIES = ("LOC", "SO", "HYB", "dtp")
PROBLEM = make_problem()


def small(processes: int = 1, seeds: Sequence[int] = (1, 2, 3)) -> Comparison:
    return compare(
        PROBLEM,
        scenarios=("baseline", "network-impairment"),
        policies=POLICIES,
        seeds=seeds,
        windows=8,
        processes=processes,
    )


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return small()


def test_runs_come_in_the_order_they_were_asked_for(comparison: Comparison) -> None:
    labels = comparison.runs.select("scenario", "policy", "seed").rows()
    assert labels == [
        (scenario, policy, seed)
        for scenario in ("baseline", "network-impairment")
        for policy in POLICIES
        for seed in (1, 2, 3)
    ]


def test_the_number_of_processes_changes_nothing(comparison: Comparison) -> None:
    other = small(processes=2)
    assert_frame_equal(comparison.runs, other.runs)
    assert_frame_equal(comparison.costs, other.costs)
    assert_frame_equal(comparison.latencies, other.latencies)
    assert_frame_equal(comparison.table(), other.table())
    for key, example in comparison.examples.items():
        assert_frame_equal(example.windows, other.examples[key].windows)
        assert_frame_equal(example.decisions, other.examples[key].decisions)


def test_a_row_is_the_summary_of_that_run(comparison: Comparison) -> None:
    run = simulate(PROBLEM, scenario="network-impairment", policy="dtp", seed=2, windows=8)
    labels: dict[str, str | int] = {
        "scenario": "network-impairment",
        "policy": "dtp",
        "seed": 2,
    }
    expected = {**summarise(run, PROBLEM, labels).row, "unit": "window"}
    found = comparison.runs.filter(
        (pl.col("scenario") == "network-impairment")
        & (pl.col("policy") == "dtp")
        & (pl.col("seed") == 2)
    )
    assert found.row(0, named=True) == expected


def test_all_policies_play_the_same_realisation() -> None:
    own = Static(candidates=PROBLEM.candidates, initial="SO")
    found = compare(
        PROBLEM,
        scenarios=("network-impairment",),
        policies={"SO": "SO", "mine": own},
        seeds=(1, 2),
        windows=6,
        processes=1,
    )
    assert found.policies == ("SO", "mine")
    assert found.statics == ("SO",)
    columns = [name for name in found.runs.columns if name != "policy"]
    first, second = (
        found.runs.filter(pl.col("policy") == name).select(columns) for name in found.policies
    )
    assert_frame_equal(first, second)
    difference = found.difference("network-impairment", ("SO", "mine"), "cost")
    assert difference.value == 0
    # One run twice, which needs no interval.
    assert not difference.known


class Nearest:
    """Takes the placement with the lowest estimated L95."""

    def __init__(self, name: str = "") -> None:
        self.name = name

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return self.name or min(estimates, key=lambda name: estimates[name].l95_ms)


def test_an_object_in_a_list_has_its_classs_name() -> None:
    played = compare(
        PROBLEM,
        scenarios=("baseline",),
        policies=["LOC", Nearest(), DTP.from_problem(PROBLEM), "latency-first"],
        seeds=(1, 2),
        windows=6,
        processes=1,
    )
    assert played.policies == ("LOC", "Nearest", "DTP", "latency-first")
    costs = {name: table["cost"].to_list() for (name,), table in played.runs.group_by("policy")}
    assert costs["Nearest"] == costs["latency-first"]


def test_distributions_never_fall_and_end_at_what_finished(comparison: Comparison) -> None:
    for scenario in comparison.scenarios:
        for policy in POLICIES:
            line = comparison.latencies.filter(
                (pl.col("scenario") == scenario) & (pl.col("policy") == policy)
            )
            share = line["share"].to_numpy()
            assert (np.diff(share) >= 0).all()
            assert share[-1] <= 1
            at_deadline = line.filter(pl.col("latency_ms") == 33.0)["share"].item()
            cycles = comparison.values(scenario, policy, "cycles")
            rates = comparison.values(scenario, policy, "violation_rate")
            assert at_deadline == pytest.approx(1 - np.average(rates, weights=cycles))


def test_progress_counts_runs() -> None:
    seen: list[tuple[int, int]] = []
    compare(
        PROBLEM,
        scenarios=("baseline",),
        policies=("LOC", "SO"),
        seeds=(1, 2),
        windows=4,
        processes=1,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(2, 4), (4, 4)]


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"seeds": ()}, SimulationError, "seeds is empty"),
        ({"seeds": (1, 2, 1)}, SimulationError, "seeds holds 1 twice"),
        ({"policies": ("LOC", "LOC")}, SimulationError, "policies holds 'LOC' twice"),
        ({"windows": 2}, ProblemError, "more than the 2 windows of warm-up"),
        ({"scenarios": ("rain",)}, ProblemError, "unknown scenario 'rain'"),
        ({"policies": ("dpt",)}, PolicyError, "unknown policy 'dpt'"),
        (
            {"policies": (Nearest("LOC"), "LOC", Nearest("SO"))},
            SimulationError,
            r"policies holds 'Nearest' twice; .* policies={'first': \.\.\., 'second': ",
        ),
        ({"policies": (Nearest,)}, PolicyError, "Nearest'> is no policy: it must be an object"),
        ({"policies": (3,)}, PolicyError, "3 is no policy: it must be an object with a method"),
        ({"policies": {"SO": Nearest()}}, SimulationError, "'SO' is a candidate's name"),
    ],
)
def test_wrong_requests_are_refused(
    wrong: dict[str, object], error: type[DwellError], message: str
) -> None:
    right = {"scenarios": ("baseline",), "policies": ("LOC",), "seeds": (1,), "windows": 4}
    with pytest.raises(error, match=message):
        compare(PROBLEM, **{**right, **wrong}, processes=1)  # type: ignore[arg-type]
