"""The page of a fleet: every cell, the worst first, who is where, and what rounds have changed."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import replace

import polars as pl
import pytest

import dwell
from dwell.errors import SimulationError
from dwell.model import NodeDisturbance
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun
from dwell.report.figure import printed_svg
from dwell.report.figure_files import figure_files
from dwell.report.fleet_page import fleet_page
from dwell.report.page import Definitions, page_html
from dwell.report.palette import Palette
from dwell.report.timeline import MOST_BINS, MOST_MARKS
from dwell.study.fleet_summary import refusals
from tests.cells.fleets import fleet_of, one_job, within
from tests.report.pages import Page, facts_of, figure_of, silent_on_warmup, table_of

WORDS = {"stress": (NodeDisturbance("R", at_s=1.0, for_s=1.0, stress_threads=1),)}


def ledger_of(count: int) -> Fleet:
    """Return cells of which not all fit on the edge, under a ledger."""
    return replace(
        fleet_of((within(one_job(), 5.0), count)), coordination="ledger", estimator="profile"
    )


@pytest.fixture(scope="module")
def run() -> FleetRun:
    return dwell.simulate_fleet(ledger_of(4), seed=1, windows=30, policy="dtp")


def test_cells_stand_with_the_worst_first(run: FleetRun) -> None:
    page = fleet_page(run)
    table = table_of(page, "cell-table")
    rates = [row["violation_rate"] for row in table.rows]
    assert rates == sorted(rates, reverse=True)
    worst = str(table.rows[0]["cell"])
    windows = run.cells[worst].windows
    assert rates[0] == windows.filter(~windows["warmup"])["violation_rate"].mean()
    assert facts_of(page)["V_D of the worst cell"].error == worst
    assert int(facts_of(page)["cells that keep the aim"].value) <= sum(one < 0.05 for one in rates)
    moved = run.decisions.filter("migrated").group_by("cell").len()
    moves = dict(moved.iter_rows())
    assert {row["cell"]: row["moves"] for row in table.rows} == {
        name: moves.get(name, 0) for name in run.cells
    }
    drawn = figure_of(page, "cells").frames["rows"]
    assert drawn.filter(measure="L95 (ms)")["limit"].to_list() == [5.0] * 4
    assert drawn.filter(measure="V_D (%)")["limit"].to_list() == [5.0] * 4


def test_the_aim_of_served_cells_is_their_limit() -> None:
    run = dwell.simulate_fleet(ledger_of(2), seed=1, windows=30, policy="dtp", phases="even")
    served = copy(run)
    served.fleet = replace(run.fleet, objective="served", limit=0.9)
    page = fleet_page(served)
    assert {row["verdict"] for row in table_of(page, "cell-table").rows} == {"kept"}
    assert facts_of(page)["cells that keep the aim"].error == "of 2; under 90 %"
    drawn = figure_of(page, "cells").frames["rows"]
    assert drawn.filter(measure="V_D (%)")["limit"].to_list() == [90.0] * 2
    for one, limit in ((served, "90 %"), (run, "5 %")):
        assert f'"{limit}"' in json.dumps(figure_of(fleet_page(one), "time").draw(800.0))


def test_a_cell_has_the_numbers_of_other_pages(run: FleetRun) -> None:
    page = fleet_page(run)
    assert silent_on_warmup(page) == []
    rate = table_of(page, "cell-table").rows[0]["violation_rate"]
    assert facts_of(page)["V_D of the worst cell"].value == f"{100 * rate:.2f} %"


def test_stays_of_a_cell_follow_each_other(run: FleetRun) -> None:
    stays = figure_of(fleet_page(run), "time").frames["placed"]
    for name, one in run.cells.items():
        mine = stays.filter(cell=name)
        placed = one.windows["placement"].cast(str)
        assert (
            mine["placement"].to_list()
            == placed.filter(placed.rle_id().diff().fill_null(1) > 0).to_list()
        )
        assert mine["begin"].to_list()[1:] == mine["end"].to_list()[:-1]
        assert mine["begin"][0] == 0.0
    frames = figure_of(fleet_page(run), "time").frames
    assert frames["moves"].height == run.decisions["migrated"].sum()
    assert frames["nodes"]["used"].to_list() == (run.load["u_E"] * 100).to_list()
    rates = frames["rates"]
    assert (rates["q1"] <= rates["median"]).all()
    assert (rates["median"] <= rates["q3"]).all()
    far = rates.filter(pl.col("max") > 2.5 * pl.col("q3") - 1.5 * pl.col("q1"))
    assert rates["outlier"].drop_nulls().to_list() == far["worst"].to_list()


def test_a_long_run_has_fewer_marks(run: FleetRun) -> None:
    windows = MOST_MARKS + 1
    long = dwell.simulate_fleet(fleet_of((one_job(), 2)), seed=1, windows=windows, policy="OFF")
    frames = figure_of(fleet_page(long), "time").frames
    assert frames["rates"].height <= MOST_BINS
    assert frames["nodes"].height <= MOST_BINS


def test_rounds_have_phi_before_and_after(run: FleetRun) -> None:
    page = fleet_page(run)
    asked = run.decisions.filter(pl.col("phi_before").is_not_null())
    assert asked["migrated"].any()
    drawn = figure_of(page, "rounds").frames["rows"]
    assert drawn["round"].to_list() == sorted(asked["round"].to_list())
    rows = table_of(page, "round-table").rows
    assert len(rows) == asked["migrated"].sum()
    assert all(row["fall"] > 0 and row["to"] != row["from"] for row in rows)
    # A round begins at the close of a window.
    assert all(row["at"] == pytest.approx(0.2 * round(row["at"] / 0.2)) for row in rows)


@pytest.mark.parametrize(
    ("text", "candidate", "reason"),
    [
        ("SO: ledger: Φ would rise by 0.31", "SO", "ledger: Φ would rise"),
        ("SO: ledger: Φ would fall by 1e-05, 0.2 is owed", "SO",
         "ledger: Φ would fall by less than is owed"),
        ("HYB: ledger: Φ would not fall", "HYB", "ledger: Φ would not fall"),
        ("HYB: cap of canonical-07", "HYB", "cap of canonical-07"),
        ("SO: chance: 0.12", "SO", "chance"),
    ],
)  # fmt: skip
def test_refusals_are_counted_by_reason(
    run: FleetRun, text: str, candidate: str, reason: str
) -> None:
    said = pl.lit(text).alias("refused")
    cells = {
        name: dwell.Run(one.meta, {
            "cycles": one.cycles, "windows": one.windows,
            "decisions": one.decisions.with_columns(said),
        })
        for name, one in run.cells.items()
    }  # fmt: skip
    refusing = FleetRun(
        run.fleet,
        cells,
        lambda: run.load,
        seed=1,
        seconds=1.0,
        guard=False,
        phases_ms=run.phases_ms,
    )
    count = refusing.decisions.height
    assert refusals(refusing) == {(candidate, reason): count}
    assert table_of(fleet_page(refusing), "refused").rows == [
        {"to": candidate, "reason": reason, "count": count}
    ]


def test_it_is_a_whole_page_that_links_to_those_of_cells(run: FleetRun) -> None:
    page = Page(page_html(fleet_page(run, links={"one-02": "one-02/report.html"})))
    assert page.outside == ["a href=one-02/report.html"]
    assert len(page.ids) == len(set(page.ids))
    assert {"Cells, the worst first", "Rounds of the ledger"} <= set(page.headings)
    alone = Page(page_html(fleet_page(run), static=True))
    assert not alone.outside
    assert "script" not in alone.tags


def test_its_figures_and_tables_are_files_too(run: FleetRun) -> None:
    page = fleet_page(run)
    files = dict(figure_files(page))
    assert {"time.pdf", "cells.svg", "rounds.csv", "cell-table.tex"} <= files.keys()
    assert all(printed_svg(one).startswith("<svg") for one in page.figures)


def test_cells_of_several_kinds_say_what_befell_how_many() -> None:
    slow = replace(within(one_job(1.0, name="slow", period_ms=20.0), 15.0), scenarios=WORDS)
    entries = (FleetEntry(one_job(), 2), FleetEntry(slow, 1, scenario="stress"))
    fleet = Fleet("hall", entries, ("E",), phases="sync", coordination="none")
    page = fleet_page(dwell.simulate_fleet(fleet, seed=1, windows=12, policy="OFF"))
    spans = figure_of(page, "time").frames["spans"]
    assert "R: 1 busy thread (1 of 3 cells)" in spans["what"].to_list()
    limits = figure_of(page, "cells").frames["rows"].filter(measure="L95 (ms)")
    assert dict(limits.select("cell", "limit").iter_rows()) == {
        "one-01": 10.0, "one-02": 10.0, "slow-01": 15.0
    }  # fmt: skip
    about = page.sections[-1].blocks[0]
    assert isinstance(about, Definitions)
    assert about.entries["cells"] == "2 one (baseline), 1 slow (stress)"
    assert not [section for section in page.sections if section.title.startswith("Rounds")]


def test_a_fleet_that_shares_nothing_has_no_load() -> None:
    fleet = fleet_of((one_job(), 2), shared=())
    page = fleet_page(dwell.simulate_fleet(fleet, seed=1, windows=12, policy="LOC"))
    assert "sharing nothing" in page.subtitle
    assert figure_of(page, "time").frames["nodes"].is_empty()
    assert printed_svg(figure_of(page, "time"))


def test_without_a_window_after_the_warm_up_there_is_no_page() -> None:
    cell = replace(one_job(), warmup_windows=5)
    run = dwell.simulate_fleet(fleet_of((cell, 2)), seed=1, windows=5, policy="OFF")
    with pytest.raises(SimulationError, match="no window is left after the warm-up"):
        fleet_page(run)


def test_a_placement_has_its_colour_whoever_else_is_used() -> None:
    cell = one_job()
    first = {"ELSEWHERE": cell.candidates["OFF"]}
    fleet = fleet_of((replace(cell, candidates={**first, **cell.candidates}), 2))
    page = fleet_page(dwell.simulate_fleet(fleet, seed=1, windows=12, policy="LOC"))
    colour = Palette.of(fleet.entries[0].cell.candidates).placements["LOC"]
    scale = figure_of(page, "time").spec()["vconcat"][1]["layer"][1]["encoding"]["color"]["scale"]
    assert scale == {"domain": ["LOC"], "range": [colour]}
