"""A recorded fleet on the time line says what the tables of its cells say."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from dwell.dash.recorded_fleet import RecordedFleet
from dwell.errors import RunError
from dwell.record import FleetRun, open_fleet
from dwell.record.run import FLEET
from tests.dash.recorded import small_fleet


@pytest.fixture(scope="module")
def fleet(fleet_folder: Path) -> RecordedFleet:
    return RecordedFleet(fleet_folder)


@pytest.fixture(scope="module")
def runs(fleet_folder: Path) -> FleetRun:
    return open_fleet(fleet_folder)


def test_cells_stand_worst_first(fleet: RecordedFleet, runs: FleetRun) -> None:
    cells = fleet.described()["cells"]
    counted = runs.windows.filter(~pl.col("warmup"))
    rates = dict(counted.group_by("cell").agg(pl.col("violation_rate").mean()).iter_rows())
    assert {cell["name"]: cell["rate"] for cell in cells} == pytest.approx(rates, abs=1e-9)
    assert [cell["rate"] for cell in cells] == sorted(rates.values(), reverse=True)
    assert [[*runs.cells][cell["place"]] for cell in cells] == [cell["name"] for cell in cells]


def test_the_aim_of_served_cells_is_their_limit(
    fleet: RecordedFleet, fleet_folder: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(fleet_folder, tmp_path / "pack")
    written = json.loads((folder / FLEET).read_text())
    written["fleet"] |= {"objective": "served", "limit": 0.99}
    (folder / FLEET).write_text(json.dumps(written))
    found = RecordedFleet(folder).described()
    assert (fleet.described()["aim"], found["aim"]) == (0.05, 0.99)
    assert "open" in fleet.described()["verdicts"]
    assert set(found["verdicts"]) == {"kept"}


def test_strips_have_the_windows_of_every_cell(fleet: RecordedFleet, runs: FleetRun) -> None:
    described = fleet.described()
    view = fleet.view(0.0, described["end"], 400)
    for cell, shown in zip(described["cells"], view["cells"], strict=True):
        windows = runs.cells[cell["name"]].windows
        assert shown["windows"] == windows.height
        assert shown["over"] == (windows["l95_ms"] > cell["deadline_ms"]).sum()
        highs = [high for high in shown["bins"]["high"] if high is not None]
        assert max(highs) == pytest.approx(windows["l95_ms"].max(), abs=1e-3)
        placed = {described["placements"][i]["name"] for i in shown["ribbon"]["placement"]}
        assert placed == set(windows["placement"].unique())
    json.dumps([described, view], allow_nan=False)


def test_a_state_has_where_all_are_and_the_load_of_the_shared_node(
    fleet: RecordedFleet, runs: FleetRun
) -> None:
    at_s = 4.003
    state = fleet.state(at_s)
    for cell, shown in zip(fleet.described()["cells"], state["cells"], strict=True):
        run, phase_s = runs.cells[cell["name"]], runs.phases_ms[cell["name"]] / 1e3
        k = int((at_s - phase_s) / 0.2)
        row = run.windows.row(k, named=True)
        assert shown["placement"] == row["placement"]
        assert shown["window"]["number"] == k - 1
        decision = run.decisions.filter(pl.col("window") == k - 1).row(-1, named=True)
        assert shown["decision"]["reason"] == decision["reason"]
    used = runs.load["u_E"].to_numpy()
    assert state["used"]["E"] == pytest.approx(used[int(at_s / 0.2) - 1], abs=1e-4)
    unwell = sum(cell["health"] == "degraded" for cell in state["cells"])
    assert (state["health"] == "degraded") == bool(unwell)
    before = fleet.state(0.0)
    assert before["used"] == {"E": None}
    assert (before["health"], before["headline"]) == ("unmeasured", "no window has closed yet")
    assert {cell["health"] for cell in before["cells"]} == {"unmeasured"}
    json.dumps([before, state], allow_nan=False)


def test_rounds_of_the_ledger_are_known(fleet: RecordedFleet, runs: FleetRun) -> None:
    asked = runs.decisions.filter(pl.col("phi_before").is_not_null())
    view = fleet.view(0.0, fleet.described()["end"], 1_500)
    assert len(view["rounds"]["at"]) == 2 * asked.height > 0
    found = np.array(view["rounds"]["of"]["phi"]) * len(runs.cells)
    assert found.max() == pytest.approx(asked["phi_before"].max(), abs=1e-3)
    last = fleet.state(fleet.described()["end"])
    assert last["round"] == asked["round"].max()


def test_cells_by_placement_sum_up_to_all(fleet: RecordedFleet) -> None:
    lines = fleet.view(0.0, fleet.described()["end"], 400)["windows"]["of"]
    counts = np.array([column for name, column in lines.items() if name.startswith("on ")])
    assert (counts.sum(axis=0) == 3).all()


def test_events_name_their_cells(fleet: RecordedFleet, runs: FleetRun) -> None:
    events = fleet.view(0.0, 100.0, 50)["events"]
    moves = [event["text"] for event in events if event["kind"] == "move"]
    assert len(moves) == runs.decisions["migrated"].sum() > 0
    assert all(text.partition(": ")[0] in runs.cells for text in moves)
    (stress,) = (event["text"] for event in events if event["kind"] == "disturbance")
    assert stress.startswith("2 of the cells: robot stress begins")


def test_cycles_are_those_of_the_cell_that_is_opened(fleet: RecordedFleet, runs: FleetRun) -> None:
    for place, run in enumerate(runs.cells.values()):
        assert fleet.cell(place).described()["cycles"] == run.cycles.height


def test_many_cells_take_little_room_at_any_zoom(tmp_path: Path) -> None:
    run = small_fleet(tmp_path / "pack", cells=64, windows=200, jobs=False)
    fleet = RecordedFleet(tmp_path / "pack")
    described = fleet.described()
    assert len(described["cells"]) == len(run.cells) == 64
    sizes = [
        len(json.dumps(fleet.view(0.0, share * described["end"], 1_500), allow_nan=False))
        for share in (1.0, 0.5, 0.1, 0.01)
    ]
    assert max([*sizes, len(json.dumps(fleet.state(5.0)))]) < 1_000_000


def test_a_fleet_of_which_nothing_is_whole_is_refused(fleet_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(fleet_folder, tmp_path / "pack")
    for run in folder.glob("small-*"):
        (run / "windows.parquet").write_bytes(b"PAR1")
    with pytest.raises(RunError, match="0 of 3 runs are whole") as error:
        RecordedFleet(folder)
    assert "windows.parquet" in str(error.value)
