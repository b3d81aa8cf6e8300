"""Load of shared nodes over time: what the cells' own windows show of it, and whose it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.model.fleet import Fleet, FleetEntry

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def hall() -> Fleet:
    canonical = dwell.load(EXAMPLES / "canonical.yaml")
    return Fleet("hall", (FleetEntry(canonical, 3),), ("E",), coordination="none")


def test_it_is_what_windows_of_the_same_instants_show(hall: Fleet) -> None:
    run = dwell.simulate_fleet(hall, windows=8, policy="SO", phases="sync")
    load = run.load
    assert load.columns == ["window", "start_ns", "u_E", *(f"own_E_{name}" for name in run.cells)]
    assert (
        load["start_ns"].to_list()
        == run.cells["canonical-01"].cycles["release_ns"][::100].to_list()
    )
    for one in run.cells.values():
        assert load["u_E"].to_numpy() == pytest.approx(one.windows["u_E"].to_numpy(), rel=1e-9)


def test_cells_off_it_have_no_part_in_it(hall: Fleet) -> None:
    first, *_ = hall.entries
    entries = (replace(first, count=2, policy="SO"), replace(first, count=1, policy="LOC"))
    load = dwell.simulate_fleet(replace(hall, entries=entries), windows=8, phases="even").load
    own = load.select("own_E_canonical-01", "own_E_canonical-02", "own_E_canonical-03").to_numpy()
    assert np.all(own[:, :2] > 0.05)
    assert np.all(own[:, 2] < 0.01)
    assert np.all(own.sum(axis=1) < load["u_E"].to_numpy() + 0.001)


def test_where_nothing_is_shared_there_is_none(hall: Fleet) -> None:
    load = dwell.simulate_fleet(replace(hall, shared=()), windows=6, policy="LOC").load
    assert load.columns == ["window", "start_ns"]
