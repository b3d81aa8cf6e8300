"""Fleets of which no cell moves: in every size, and whatever is drawn, what a fleet's run shows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import dwell
from dwell.cellfile import from_document
from dwell.model import Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.sim.fleet import phased
from dwell.sim.static_fleet import StaticFleet
from tests.cells.with_traces import trace_cell

EXAMPLES = Path(__file__).parents[2] / "examples"
PHASES = ("even", "sync", "random")


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load(EXAMPLES / "canonical.yaml")


@pytest.fixture
def traced(tmp_path: Path) -> Problem:
    """Return a cell that replays a file by its time, so that what it meets goes by its phase."""
    rows = [f"{at},{1 + at % 7},{5 + at * 13 % 60}\n" for at in range(0, 30_000, 20)]
    (tmp_path / "data.csv").write_text("sent,up,work\n" + "".join(rows))
    how: dict[str, Any] = {"file": "data.csv", "by": "time", "time": "sent", "wrap": True}
    cell = trace_cell({**how, "column": "up"}, {**how, "column": "work"})
    return from_document(cell, folder=tmp_path)


def rates(static: StaticFleet, fleet: Fleet) -> list[float]:
    return [float(missed.mean()) for missed in static.play(fleet).missed]


def shown(fleet: Fleet, policy: str) -> list[float]:
    """Return V_D of every cell, of the run that a fleet has."""
    run = dwell.simulate_fleet(fleet, seed=2, windows=8, policy=policy, estimator="profile")
    tables = [one.arrays("windows") for one in run.cells.values()]
    return [float(one["violation_rate"][~one["warmup"]].mean()) for one in tables]


@pytest.mark.parametrize("phases", PHASES)
@pytest.mark.parametrize("scenario", ["edge-cpu-stress", "network-impairment"])
def test_every_size_of_it_in_any_order(canonical: Problem, scenario: str, phases: Any) -> None:
    jitter = replace(
        canonical.pipeline, release_jitter_ms=canonical.pipeline.tasks["sensing"].on["R1"].exec_ms
    )
    entries = (
        FleetEntry(replace(canonical, pipeline=jitter), 1, scenario),
        FleetEntry(replace(canonical, pipeline=jitter), 1),
    )
    fleet = Fleet("hall", entries, ("E",), phases=phases, coordination="none")
    static = StaticFleet(seed=2, duration_ns=fleet.duration_ns(8))
    for count in (3, 1, 2):
        sized = fleet.with_count(count)
        assert rates(static, sized.changed(policy="SO")) == pytest.approx(
            shown(sized, "SO"), abs=1e-12
        )


@pytest.mark.parametrize("phases", PHASES)
def test_what_is_replayed_goes_by_the_phase(traced: Problem, phases: Any) -> None:
    fleet = Fleet("hall", (FleetEntry(traced, 1),), ("E",), phases=phases, coordination="none")
    static = StaticFleet(seed=2, duration_ns=fleet.duration_ns(8))
    for count in (2, 4, 3):
        sized = fleet.with_count(count)
        found = rates(static, sized.changed(policy="LOC"))
        assert found == pytest.approx(shown(sized, "LOC"), abs=1e-12)
        assert min(found) > 0


def test_cells_of_several_files(canonical: Problem) -> None:
    slower = replace(canonical, name="slower", pipeline=replace(canonical.pipeline, period_ms=50.0))
    entries = (FleetEntry(canonical, 2), FleetEntry(slower, 2, phase_ms=7.0))
    fleet = Fleet("hall", entries, ("E",), phases="even", coordination="none")
    static = StaticFleet(seed=2, duration_ns=fleet.duration_ns(8))
    found = rates(static, fleet.changed(policy="SO"))
    assert found == pytest.approx(shown(fleet, "SO"), abs=1e-12)


def test_cells_that_are_equal_keep_their_own_folders(canonical: Problem) -> None:
    folders = ["one", "another"]
    fleets = [
        Fleet("hall", (FleetEntry(replace(canonical, folder=folder), 1),), ("E",))
        for folder in folders
    ]
    assert [problem.folder for fleet in fleets for problem in phased(fleet, 1)] == folders
