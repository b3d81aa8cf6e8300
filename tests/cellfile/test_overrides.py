"""Values put into a cell at dotted paths, and what is wrong with them where they are given."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.cellfile import load
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.overrides import Override, check_apart, load_with, open_cell
from dwell.errors import ProblemError
from dwell.model import Constant, LogNormal

MIN_DWELL = ("controller", "min_dwell")


def test_a_cell_with_other_values_is_another_cell(folder: Path) -> None:
    cell = open_cell(folder / "cell.yaml")
    changed = cell.changed([Override("here", MIN_DWELL, 7)])
    assert changed.problem.controller.min_dwell == 7
    assert cell.problem == load(folder / "cell.yaml")
    assert changed.problem.name == cell.problem.name


def test_settings_are_yaml_at_paths(folder: Path) -> None:
    file = folder / "cell.yaml"
    problem = load_with(
        file,
        [
            "period_ms=50",
            "links[0].delay_ms={lognormal: {mean: 2, cv: 0.5}}",
            "tasks.planning.on.E.exec_ms=0x10",
            "controller.policy=LOC",
        ],
    )
    assert problem.pipeline.period_ms == 50
    assert problem.fabric.links["E->R1"].delay_ms == LogNormal(2, 0.5)
    assert problem.pipeline.tasks["planning"].on["E"].exec_ms == Constant(16)
    assert problem.controller.policy == "LOC"
    assert problem.folder == load(file).folder


def test_without_settings_it_is_the_cell(folder: Path) -> None:
    assert load_with(folder / "cell.yaml", []) == load(folder / "cell.yaml")


def test_every_setting_that_is_wrong_is_told_at_its_option(folder: Path) -> None:
    with pytest.raises(ProblemError) as caught:
        load_with(folder / "cell.yaml", ["period_ms=-1", "nodes.E.cores=0", "window_cycles=5"])
    assert [fault.path for fault in caught.value.faults] == [
        "--set period_ms",
        "--set nodes.E.cores",
    ]
    assert caught.value.source == str(folder / "cell.yaml")


def test_a_path_within_another_ones_is_refused() -> None:
    faults = Faults()
    places = {"one": ("objective",), "two": ("objective", "caps"), "three": None, "four": ("name",)}
    check_apart(places, faults)
    (fault,) = faults.error().faults
    assert (fault.path, fault.message) == ("two", "is a part of objective; give one of them")


def test_faults_of_several_values_together_are_told_where_asked(folder: Path) -> None:
    faults = Faults()
    both = [
        Override("first", ("links",), []),
        Override("second", MIN_DWELL, -1),
    ]
    assert open_cell(folder / "cell.yaml").attempt(both[:1], faults, "all", " (no links)") is None
    assert {fault.path for fault in faults.error().faults} == {"all"}
    assert all(fault.message.endswith(" (no links)") for fault in faults.error().faults)
    assert open_cell(folder / "cell.yaml").attempt(both[1:], faults, "all") is None
    assert "second" in {fault.path for fault in faults.error().faults}
