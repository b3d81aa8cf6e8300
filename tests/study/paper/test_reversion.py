"""RQ2: which fault is where, and what of a gain is the fault's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import polars as pl
import pytest

from dwell.model import LinkDisturbance
from dwell.study.paper import Runner
from dwell.study.paper import reversion as module
from dwell.study.paper.reversion import (
    DTP,
    NONE,
    PAPERS,
    PLACES,
    beyond_control,
    chapter,
    control,
    crossed,
    fault,
    fault_scenarios,
    faults_in,
    reverting,
    sweep_points,
    verdict,
)
from tests.study.paper.families import make_family
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import check_written, told


@pytest.mark.parametrize(
    ("gains", "beyond", "expected"),
    [
        (["lower", "lower"], ["lower", "lower"], "yes"),
        (["lower", "same"], ["lower", "same"], "in part"),
        # It helps as much without the fault.
        (["same", "lower"], ["same", "open"], "no"),
        (["higher", "open"], ["higher", "open"], "no"),
        (["same", "same"], ["same", "same"], "no"),
        (["same", "open"], ["same", "open"], "not shown"),
    ],
)
def test_the_answer_counts_what_is_the_faults(
    gains: Sequence[str], beyond: Sequence[str], expected: str
) -> None:
    names = (PAPERS, "E to R2 + R1 stressed")
    pair = f"{DTP}, {reverting(DTP)}"
    # What HYB is worth without any fault is no answer.
    family = make_family(
        {f"{NONE} + R1 stressed: {pair}": "lower"}
        | {f"{name}: {pair}": one for name, one in zip(names, gains, strict=True)}
    )
    more = make_family({f"{name}: {DTP}": one for name, one in zip(names, beyond, strict=True)})
    answer, sentence = told(verdict(family, more))
    assert answer == expected
    assert f"Of 2 faults it lowers V_D in {gains.count('lower')}" in sentence
    words = {"lower": "lowers V_D", "higher": "raises V_D"}.get(
        gains[0], "is not shown to change V_D"
    )
    assert words in sentence


def test_the_control_has_the_stress_and_no_fault() -> None:
    found = fault_scenarios(make_cell())
    for name in faults_in(tuple(found)):
        alike = found[control(name)]
        assert not any(isinstance(item, LinkDisturbance) for item in alike)
        assert set(alike) <= set(found[name])
        assert any(isinstance(item, LinkDisturbance) for item in found[name])
    assert {control(name) for name in found} == set(found) - set(faults_in(tuple(found)))


def test_what_goes_beyond_the_control_is_a_difference_of_differences() -> None:
    rules = (DTP, module.CUSUM)
    shown = {
        (NONE, True): [0.30, 0.32, 0.34],
        (NONE, False): [0.40, 0.41, 0.45],
        ("R1 to E", True): [0.50, 0.53, 0.51],
        ("R1 to E", False): [0.80, 0.81, 0.82],
    }
    runs = pl.concat(
        pl.DataFrame(
            {
                "scenario": [scenario] * 3,
                "policy": [rule if having else reverting(rule)] * 3,
                "seed": [1, 2, 3],
                "violation_rate": values,
                "cost": values,
            }
        )
        for (scenario, having), values in shown.items()
        for rule in rules
    )
    found = beyond_control(runs, ("R1 to E",))["violation_rate"].comparisons[f"R1 to E: {DTP}"]
    expected = ((-0.30 - -0.10) + (-0.28 - -0.09) + (-0.31 - -0.11)) / 3
    assert getattr(found, "mean") == pytest.approx(expected)  # noqa: B009


def test_links_crossed_are_those_of_the_flows() -> None:
    problem = make_cell()
    found = {name: crossed(problem, placement) for name, placement in problem.candidates.items()}
    assert found == {
        "LOC": ("R1->R2",),
        "SO": ("R1->E", "E->R2"),
        "HYB": ("R1->E", "E->R2"),
    }


def test_a_fault_of_no_size_is_none() -> None:
    assert fault(PLACES[PAPERS], mean_ms=0.0, loss=0.0) == ()
    (lossy,) = fault(("E->R2",), mean_ms=0.0, loss=0.02)
    assert (lossy.link, lossy.loss, lossy.add_delay_ms) == ("E->R2", 0.02, None)
    (slow,) = fault(("E->R2",), mean_ms=10.0, loss=0.0)
    assert slow.add_delay_ms is not None
    assert slow.add_delay_ms.expectation == pytest.approx(10.0, rel=1e-3)


def test_the_sweep_has_every_size_in_every_place() -> None:
    found = sweep_points(make_cell(), SCALE)
    values = {tuple(point.values.values()) for point in found}
    assert len(values) == len(found) == 3 * 2 * 2
    assert (PAPERS, 40.0, 0.02) in values


def test_the_chapter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "PLACES", {PAPERS: PLACES[PAPERS]})
    monkeypatch.setattr(module, "JOINED", (NONE, PAPERS))
    monkeypatch.setattr(module, "CONDITIONS", {"R1 stressed": {"R1": 1.0}})
    monkeypatch.setattr(module, "SWEPT", (PAPERS,))
    written = chapter(make_cell(), SCALE, Runner(tmp_path, processes=1))
    check_written(written)
    tables = {table.slug: table.frame for table in written.tables}
    assert set(tables["reversion"]["scenario"]) == {
        *(NONE, PAPERS, module.SLOW),
        *(f"{NONE} + R1 stressed", f"{PAPERS} + R1 stressed"),
    }
    assert tables["reversion-beyond"].height == 3 * 2
    assert tables["reversion-sweep"].height == 4 * 4
