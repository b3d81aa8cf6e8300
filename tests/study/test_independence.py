"""Whether windows of a run are independent: of traces and of what lasts longer than a run no."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from typer.testing import CliRunner

from dwell.cellfile import from_document
from dwell.cli.commands import app
from dwell.model import Problem
from dwell.report import comparison_html, study_html
from dwell.study import compare, open_study, over_seeds, under, windows_behind
from dwell.study.independence import unit_of
from dwell.study.over_seeds import RUN, WINDOW

#: A run is 1,000 cycles of 20 ms: 20 s.
WINDOWS, WINDOW_CYCLES = 50, 20
#: Rows of a recording, of which a tenth in one stretch is bad; of those eight in ten miss.
ROWS, BAD = 40_000, 4_000
SENTENCE = "Runs, not windows, are independent in"


def document(delay: object = 2.0, **more: Any) -> dict[str, Any]:
    """A robot and an edge with one link, and a placement on either."""
    return {
        "dwell": 1,
        "period_ms": 20,
        "window_cycles": WINDOW_CYCLES,
        "warmup_windows": 0,
        "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
        "links": [
            {"from": "R", "to": "E", "delay_ms": delay},
            {"from": "E", "to": "R", "delay_ms": 1},
        ],
        "tasks": {
            "sense": {"on": {"R": {"exec_ms": 1}}},
            "plan": {"on": {"R": {"exec_ms": 12}, "E": {"exec_ms": 3}}},
            "act": {"on": {"R": {"exec_ms": 1}}},
        },
        "flows": [{"from": "sense", "to": "plan"}, {"from": "plan", "to": "act"}],
        "candidates": {"LOC": {"plan": "R"}, "SO": {"plan": "E"}},
        "controller": {"policy": "LOC", "estimator": "profile"},
        **more,
    }


def cell(folder: Path, delay: object = 2.0, **more: Any) -> Problem:
    return from_document(document(delay, **more), folder=folder)


def recording() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Delays of 2 ms, and 50 ms in eight of ten rows of the bad stretch."""
    delays = np.full(ROWS, 2.0)
    bad = np.arange(10_000, 10_000 + BAD)
    delays[bad[np.random.default_rng(1).random(BAD) < 0.8]] = 50.0
    return delays


@pytest.fixture(scope="module")
def replaying(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    folder = tmp_path_factory.mktemp("cell")
    pl.DataFrame({"delay_ms": recording()}).write_csv(folder / "delays.csv")
    trace = {"file": "delays.csv", "column": "delay_ms", "wrap": True}
    return cell(folder, {"trace": trace})


def studies(seeds: int) -> Iterator[pl.DataFrame]:
    """Yield 400 studies of runs that start at a row drawn at random, as a seed draws it."""
    delays = np.tile(recording(), 2) > 20.0
    before = np.concatenate(([0], np.cumsum(delays)))
    length = WINDOWS * WINDOW_CYCLES
    rng = np.random.default_rng(2)
    for _ in range(400):
        begins = rng.integers(ROWS, size=seeds)
        rates = (before[begins + length] - before[begins]) / length
        yield pl.DataFrame({"seed": range(seeds), "violation_rate": rates}).with_columns(
            windows=pl.lit(WINDOWS), unit=pl.lit(RUN)
        )


@pytest.mark.parametrize("seeds", [5, 10, 20])
def test_no_study_of_a_trace_says_under_five_for_a_cell_that_misses_eight(seeds: int) -> None:
    truth = float((recording() > 20.0).mean())
    assert truth == pytest.approx(0.08, abs=0.001)
    wrong = covered = by_windows = 0
    for runs in studies(seeds):
        rates = runs["violation_rate"].to_list()
        wrong += under(rates, windows=windows_behind(runs)) == "under"
        by_windows += under(rates, windows=windows_behind(runs.drop("unit"))) == "under"
        row = over_seeds(runs.with_columns(policy=pl.lit("SO")), ["policy"], ["violation_rate"])
        covered += row["violation_rate_low"][0] <= truth <= row["violation_rate_high"][0]
    assert wrong == 0
    assert covered >= 0.95 * 400
    # By windows as many studies are wrong as have no bad stretch.
    assert by_windows > (0.05 if seeds == 20 else 0.2) * 400


def test_played_runs_of_a_trace_have_the_run_as_their_unit(replaying: Problem) -> None:
    runs = compare(
        replaying, policies=["LOC", "SO"], seeds=range(1, 7), windows=WINDOWS, processes=1
    )
    assert set(runs.runs["unit"]) == {RUN}
    assert runs.windows_behind("baseline", "SO") is None
    assert SENTENCE in comparison_html(runs)


def episodes(every_s: float, for_s: float) -> dict[str, Any]:
    times = {
        "every_s": {"exponential": {"mean": every_s}},
        "for_s": {"exponential": {"mean": for_s}},
    }
    return {"link": "R->E", "add_delay_ms": 30, "episodes": {"name": "bad", **times}}


@pytest.mark.parametrize(
    ("disturbed", "unit"),
    [
        ([episodes(2, 1)], WINDOW),
        ([episodes(18, 3)], RUN),
        ([episodes(1, 25)], RUN),
        ([episodes(18, 3) | {"for_s": 600}], RUN),
        ([{"link": "R->E", "add_delay_ms": 30, "at_s": 5, "for_s": 5}], WINDOW),
    ],
)
def test_episodes_longer_than_a_run_make_it_the_unit(
    disturbed: list[dict[str, Any]], unit: str, tmp_path: Path
) -> None:
    problem = cell(tmp_path, scenarios={"bad": disturbed})
    assert unit_of([(problem, "bad")], WINDOWS) == unit
    assert unit_of([(problem, "baseline")], WINDOWS) == WINDOW
    # Of a fleet, one such cell is enough; a run ten times as long shows all that may come.
    assert unit_of([(problem, "baseline"), (problem, "bad")], WINDOWS) == unit
    assert unit_of([(problem, "bad")], 10 * WINDOWS) == WINDOW


@pytest.mark.parametrize(
    ("link", "unit"),
    [
        ({"bursts": {"every_ms": 900, "for_ms": 100, "add_delay_ms": 30}}, WINDOW),
        ({"bursts": {"every_ms": 60_000, "for_ms": 6_000, "add_delay_ms": 30}}, RUN),
        ({"delay_ms": {"ar1": {"mean": 3, "cv": 0.5, "rho": 0.9}}}, WINDOW),
        ({"delay_ms": {"ar1": {"mean": 3, "cv": 0.5, "rho": 0.9999}}}, RUN),
    ],
)
def test_bursts_and_slow_delays_make_a_run_the_unit_in_every_scenario(
    link: dict[str, Any], unit: str, tmp_path: Path
) -> None:
    links = [
        {"from": "R", "to": "E", "delay_ms": 2, **link},
        {"from": "E", "to": "R", "delay_ms": 1},
    ]
    assert unit_of([(cell(tmp_path, links=links), "baseline")], WINDOWS) == unit


def test_the_terminal_says_where_runs_are_the_unit(tmp_path: Path) -> None:
    whole = document(scenarios={"bad": [episodes(18, 3)]})
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(whole), encoding="utf-8")
    lines = ["dwell-study: 1", "name: s", "cell: cell.yaml", "windows: 50", "policies: [LOC, SO]"]
    (tmp_path / "study.yaml").write_text("\n".join(lines), encoding="utf-8")
    for windows, said in (("50", f"{SENTENCE} Bad:"), ("100", "")):
        folder = tmp_path / windows
        words = ["study", str(tmp_path / "study.yaml"), "--seeds", "3", "--windows", windows]
        result = CliRunner().invoke(app, [*words, "--out", str(folder), "--processes", "1"])
        assert result.exit_code == 0, result.output
        assert said in result.stdout
        assert (SENTENCE in result.stdout) is bool(said)
        assert (SENTENCE in study_html(open_study(folder))) is bool(said)
