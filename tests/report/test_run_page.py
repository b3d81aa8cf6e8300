"""The page of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from dwell import Run, draw, open_run, simulate
from dwell.errors import RunError
from dwell.model import Episodes, Exponential, LinkDisturbance, NodeDisturbance
from dwell.report import run_html
from dwell.report.figure import svg
from dwell.report.run_page import run_page
from dwell.study.predicted_moves import predicted_moves
from tests.cells.many import many
from tests.cells.small import make_problem
from tests.report.pages import (
    Page,
    facts_of,
    figure_of,
    silent_on_warmup,
    small_run,
    table_of,
)


@pytest.fixture(scope="module")
def html() -> str:
    return run_html(small_run(), static=True)


def test_it_is_self_contained_and_well_formed(html: str) -> None:
    page = Page(html)
    assert page.outside == []
    assert "script" not in page.tags
    assert len(set(page.ids)) == len(page.ids)


def test_the_answer_and_its_figure_come_first() -> None:
    page = run_page(small_run())
    cycles = small_run().cycles
    first = small_run().windows.filter(~pl.col("warmup"))["first_cycle"][0]
    rate = cycles.filter(pl.col("cycle") >= first)["missed"].mean()
    assert isinstance(rate, float)
    name, fact = next(iter(facts_of(page).items()))
    assert name.startswith("V_D")
    assert fact.value == f"{100 * rate:.2f} %"
    assert page.sections[0].blocks[0] is next(page.figures)


def test_every_table_says_whether_the_warm_up_is_in() -> None:
    assert silent_on_warmup(run_page(small_run())) == []


def test_a_symbol_has_its_index_in_text_and_figures(html: str) -> None:
    assert "V<sub>D</sub>" in html
    assert 'V<tspan dy=".3em" font-size="75%">D</tspan>' in html
    assert "V_D" not in Page(html).text


def test_migrations_are_those_after_the_warm_up() -> None:
    run, page = small_run(), run_page(small_run())
    first = run.windows.filter(~run.windows["warmup"])["window"][0]
    counted = run.decisions.filter(run.decisions["window"] >= first)
    migrations = int(counted["migrated"].sum())
    assert migrations > 0
    assert facts_of(page)["migrations"].value == str(migrations)
    assert len(table_of(page, "migrations").rows) == migrations


def test_a_bad_window_leads_to_its_cycles(html: str) -> None:
    run, page = small_run(), run_page(small_run())
    worst = table_of(page, "worst").rows[0]
    assert f'href="#window-{worst["window"]}"' in html
    assert f"window-{worst['window']}" in Page(html).ids
    figure = next(one for one in page.figures if one.slug == f"cycles-{worst['window']}")
    parts = figure.frames["parts"]
    assert parts["cycle"].n_unique() == make_problem().window_cycles
    mine = run.cycles.filter(pl.col("cycle").is_in(parts["cycle"].implode()))
    assert parts.filter(pl.col("part") == "computing")["time_ms"].sum() == pytest.approx(
        float(mine["compute_ns"].sum()) / 1e6
    )
    linked = next(page.figures).frames["windows"].filter(pl.col("link").is_not_null())
    assert worst["window"] in linked["window"]


def test_a_placement_that_never_moves_is_called_so() -> None:
    page = run_page(small_run("LOC"))
    assert page.title == "LOC on small"
    assert facts_of(page)["migrations"].value == "0"


def test_disturbances_shade_the_timeline() -> None:
    spans = next(run_page(small_run()).figures).frames["spans"]
    assert spans["what"].to_list() == ["warm-up", "R1: 4 busy threads"]
    assert spans["end"][1] == pytest.approx(12 * 10 / 30, rel=0.02)


def test_episodes_shade_it_as_they_were_drawn() -> None:
    problem = make_problem()
    wind = Episodes("wind", Exponential(1.0), Exponential(0.5))
    item = LinkDisturbance("R1", "E", down=True, episodes=wind)
    problem = replace(problem, scenarios={"windy": (item,)})
    run = simulate(problem, scenario="windy", policy="LOC", seed=4, windows=40)
    spans = next(run_page(run).figures).frames["spans"].filter(pl.col("what") != "warm-up")
    realisation = draw(problem, scenario="windy", seed=4, windows=40)
    down = [one.at_ns / 1e9 for one in realisation.link_segments if one.down]
    assert len(down) > 2
    assert spans["begin"].to_list() == pytest.approx(down)


def test_of_long_runs_several_windows_are_one_mark_and_the_extremes_show() -> None:
    run = simulate(make_problem(), scenario="baseline", policy="LOC", seed=1, windows=1300)
    windows = next(run_page(run).figures).frames["windows"]
    assert windows.height <= 600
    assert windows["l95_max"].max() == run.windows["seen_l95_ms"].max()
    assert windows["l95_min"].min() == run.windows["seen_l95_ms"].min()


def test_what_shadow_jobs_cost_is_told() -> None:
    run = small_run()
    assert "shadows" not in {table.slug for table in run_page(run).tables}
    windows = run.windows.with_columns(
        shadow_cycles=pl.lit(1),
        shadow_bytes=pl.lit(41250),
        shadow_R1=pl.lit(0.0),
        shadow_E=pl.lit(0.012),
        shadow_R2=pl.lit(0.004),
    )
    shown = Run(run.meta, {"cycles": run.cycles, "windows": windows, "decisions": run.decisions})
    (row,) = table_of(run_page(shown), "shadows").rows
    # 10 cycles of 33 ms a window: 330 kbit in 0.33 s.
    assert row["cycles"] == pytest.approx(0.1)
    assert row["rate_mbps"] == pytest.approx(1.0, rel=0.02)
    assert row["shadow_E"] == pytest.approx(0.012)


def test_a_run_from_its_folder_makes_the_same_page(html: str, tmp_path: Path) -> None:
    folder = small_run().save(tmp_path / "run")
    assert run_html(open_run(folder), static=True) == html


def test_a_run_that_lost_everything_has_a_page() -> None:
    scenarios = {"dead": (NodeDisturbance("R2", down=True),)}
    run = simulate(replace(make_problem(), scenarios=scenarios), scenario="dead", seed=1, windows=6)
    text = Page(run_html(run, static=True)).text
    assert "100.00 %" in text
    assert "∞" in text


def test_a_record_without_its_problem_is_refused() -> None:
    run = small_run()
    bare = Run({}, {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions})
    with pytest.raises(RunError, match="record of the problem is incomplete"):
        run_html(bare)


def test_final_l95_in_tables_and_l95_as_seen_in_the_figure_have_names_of_their_own() -> None:
    page = run_page(small_run())
    worst = next(table for table in page.tables if table.slug == "worst")
    assert "L95 final (ms)" in worst.headings
    figure = next(page.figures)
    assert "L95 seen (ms)" in svg(figure)
    assert "L95 seen" in figure.caption


def test_moves_are_predicted_then_seen() -> None:
    run, page = small_run(), run_page(small_run())
    expected = predicted_moves(run)
    assert not expected.is_empty()
    section = next(one for one in page.sections if one.title == "Predicted, then seen")
    figure, table = section.blocks
    assert table is table_of(page, "predicted-moves")
    assert [row["window"] for row in table_of(page, "predicted-moves").rows] == list(
        expected["window"]
    )
    assert figure is figure_of(page, "predicted")
    shown = figure_of(page, "predicted").frames["rows"]
    rates = (100 * expected["seen_violation_rate"]).to_list()
    assert shown["seen_violation_rate"].to_list() == pytest.approx(rates, nan_ok=True)


def test_a_run_without_moves_has_nothing_predicted_to_show() -> None:
    titles = [section.title for section in run_page(small_run("LOC")).sections]
    assert "Decisions" in titles
    assert "Predicted, then seen" not in titles


def test_phases_have_the_placements_that_some_phase_was_on() -> None:
    many_cell = many(30)
    stressed = (NodeDisturbance("R", stress_threads=3, at_s=4.0),)
    problem = replace(many_cell, scenarios={"stress": stressed})
    page = run_page(simulate(problem, scenario="stress", policy="R-R-R", seed=1, windows=8))
    columns = [one.column for one in table_of(page, "phases").columns]
    assert [one for one in columns if one.startswith("share")] == ["share_R-R-R"]
