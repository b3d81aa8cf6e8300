"""Runs of a fleet: their folder, and what is told of one that is not whole."""

from __future__ import annotations

import shutil
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal

import dwell
from dwell.errors import RunError
from dwell.model import Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun, open_fleet

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def canonical() -> Problem:
    return dwell.load(EXAMPLES / "canonical.yaml")


@pytest.fixture(scope="module")
def played(canonical: Problem) -> FleetRun:
    fleet = Fleet("hall", (FleetEntry(canonical, 3),), ("E",), coordination="none")
    return dwell.simulate_fleet(fleet, seed=2, windows=7, policy="SO")


@pytest.fixture
def folder(played: FleetRun, tmp_path: Path) -> Path:
    return played.save(tmp_path / "hall")


def told(folder: Path) -> str:
    with pytest.raises(RunError) as error:
        open_fleet(folder)
    return str(error.value).replace(f"{folder}", "HALL")


def test_a_folder_holds_all_that_was_played(played: FleetRun, folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {
        "fleet.json",
        "fleet-windows.parquet",
        *("canonical-01", "canonical-02", "canonical-03"),
    }
    opened = open_fleet(folder)
    assert (opened.fleet, opened.seed, opened.guard) == (played.fleet, 2, False)
    assert opened.phases_ms == played.phases_ms
    for table in ("windows", "decisions", "load"):
        assert_frame_equal(getattr(opened, table), getattr(played, table))
    for name, run in opened.cells.items():
        assert_frame_equal(run.cycles, played.cells[name].cycles)
        assert_frame_equal(dwell.open_run(folder / name).cycles, run.cycles)


def test_the_folder_of_the_same_fleet_is_written_again(played: FleetRun, folder: Path) -> None:
    shutil.rmtree(folder / "canonical-02")
    played.save(folder)
    assert len(open_fleet(folder).cells) == 3


def test_other_folders_are_left_alone(played: FleetRun, folder: Path, tmp_path: Path) -> None:
    other = dwell.simulate_fleet(played.fleet, seed=3, windows=7)
    with pytest.raises(RunError, match="holds the runs of another fleet; choose another folder"):
        other.save(folder)
    with pytest.raises(RunError, match="exists and is no fleet's; choose another folder"):
        played.save(folder / "canonical-01")
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="exists and is no fleet's"):
        played.save(tmp_path / "file")
    with pytest.raises(RunError, match="is a fleet's folder; name the run of a cell in it"):
        dwell.open_run(folder)


def test_a_fleet_that_was_interrupted_says_how_many_runs_are_whole(
    played: FleetRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "hall"

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(played.cells["canonical-03"], "save", interrupted)
        with pytest.raises(KeyboardInterrupt):
            played.save(folder)
    assert told(folder).splitlines() == [
        "HALL: 2 of 3 runs are whole; remove what is damaged, and the same command makes the "
        "others again",
        "  HALL/canonical-03: no such folder",
    ]
    played.save(folder)
    assert len(open_fleet(folder).cells) == 3


def test_what_is_damaged_is_told(folder: Path, tmp_path: Path) -> None:
    (folder / "canonical-01" / "windows.parquet").unlink()
    shutil.rmtree(folder / "canonical-03")
    assert told(folder).splitlines()[1:] == [
        "  HALL/canonical-01: incomplete run, without windows",
        "  HALL/canonical-03: no such folder",
    ]
    (folder / "fleet.json").write_text("{")
    assert "HALL/fleet.json: cannot be read" in told(folder)
    (folder / "fleet.json").write_text('{"schema_version": 3, "cells": []}')
    assert told(folder) == "HALL/fleet.json: cannot be read (KeyError('fleet'))"
    (folder / "fleet.json").write_text('{"schema_version": 9}')
    assert told(folder).startswith("HALL/fleet.json: schema_version is 9; this version")
    (folder / "fleet.json").unlink()
    assert told(folder) == "HALL: no fleet's folder (it has no fleet.json)"
    assert "no such folder" in told(tmp_path / "nowhere")


def test_tables_of_cells_with_other_candidates_have_nulls(canonical: Problem) -> None:
    fan_in = dwell.load(EXAMPLES / "fan-in.yaml")
    entries = (FleetEntry(canonical, 1), FleetEntry(fan_in, 1))
    fleet = dwell.simulate_fleet(Fleet("two", entries, coordination="none"), windows=6)
    decisions = fleet.decisions
    kind = decisions.schema["placement"]
    assert isinstance(kind, pl.Enum)
    assert set(kind.categories) >= {"SO", "PARTS"}
    of = decisions.select("cell", "j_SO", "j_PARTS").unique("cell", maintain_order=True)
    assert [cell for cell, *_ in of.rows()] == ["canonical-01", "fan-in-01"]
    assert [row[1:].count(None) for row in of.rows()] == [1, 1]
