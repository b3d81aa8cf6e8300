"""Figures of chapters: every kind, with the data that studies give and with the worst."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import get_args
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure as Canvas

from dwell.report.drawing import draw
from dwell.report.palette import INK, MUTED, RAMP
from dwell.report.panels import Place, Scale, folded, legend_lines, parted, scale_of
from dwell.report.style import PageStyle
from dwell.report.svg import drawn, in_page
from dwell.study.chapter import Figure, FigureKind, Panel
from tests.report.paper_chapters import STATICS, every_kind, figures, one_of
from tests.study.cell import make_problem

KINDS: tuple[FigureKind, ...] = get_args(FigureKind)
LONG = "a contender with a name that no table has room for, and that no figure can do without"
SEVEN = ("LOC", "SO", "HYB", "REV", "ALT", "FAR", "OUT")


@pytest.fixture(scope="module")
def look() -> PageStyle:
    return PageStyle.of(make_problem(), every_kind())


def drawing(figure: Figure, look: PageStyle) -> ElementTree.Element:
    """Draw a figure as it stands in a page."""
    return ElementTree.fromstring(in_page(drawn(draw(figure, look), figure.slug), figure.title))


def texts(element: ElementTree.Element) -> str:
    return " ".join("".join(text.itertext()) for text in element.iter("text"))


def colours(element: ElementTree.Element) -> str:
    return " ".join(str(one.get("style")) for one in element.iter() if one.get("style"))


def with_frame(figure: Figure, rows: list[dict[str, object]], **changes: object) -> Figure:
    frame = pl.DataFrame(rows, infer_schema_length=None)
    return replace(figure, frame=frame, **changes)  # type: ignore[arg-type]


# ---------------------------------------------------------------------------- whatever is given


@pytest.mark.parametrize("kind", KINDS)
def test_a_figure_without_numbers_says_so(kind: FigureKind, look: PageStyle) -> None:
    figure = one_of(kind)
    empty = replace(figure, frame=figure.frame.clear())
    assert "Nothing to show" in texts(drawing(empty, look))


@pytest.mark.parametrize("kind", KINDS)
def test_one_point_of_one_series_is_a_figure(kind: FigureKind, look: PageStyle) -> None:
    figure = one_of(kind)
    one = replace(figure, frame=figure.frame.head(1), spans=None)
    assert "Nothing to show" not in texts(drawing(one, look))


def rough(kind: FigureKind) -> Figure:
    """Return a figure of seven candidates, names that are too long, and numbers that are none."""
    values = [math.nan, math.inf, -math.inf, None, 0.0, -3.0, 4e7]
    base = Figure("rough", "Rough & <ready>", kind, pl.DataFrame(), "x", "y", "series")
    if kind == "map":
        return with_frame(
            base,
            [
                {
                    "x": i % 4,
                    "y": i // 4,
                    "series": None if i == 5 else SEVEN[i % 7],
                    "margin": values[i % 7],
                    "marked": i % 3 == 0,
                }
                for i in range(20)
            ],
        )
    names = (*SEVEN, "dtp+corrected", LONG)
    across: list[object] = [*range(7)]
    if kind in ("intervals", "bars"):
        across = ["short", f"{LONG} indeed"]
    rows: list[dict[str, object]] = [
        {
            "x": x,
            "series": name,
            "facet": facet,
            "y": values[(i + j) % 7],
            "y_low": values[(i + j + 1) % 7],
            "y_high": values[(i + 2 * j) % 7],
            "placement": None if i == 3 else SEVEN[i % 7],
        }
        for facet in ("one", LONG)
        for i, x in enumerate(across)
        for j, name in enumerate(names)
    ]
    return with_frame(base, rows, facet="facet", y_unit="ms", line_at=33.0, line_label="D")


@pytest.mark.parametrize("kind", KINDS)
def test_rough_data_makes_a_figure(kind: FigureKind) -> None:
    figure = rough(kind)
    look = PageStyle.of(make_problem(), [replace(every_kind()[0], figures=(rough("map"), figure))])
    element = drawing(figure, look)
    assert element.get("aria-label") == "Rough & <ready>"
    shown = texts(element)
    for name in SEVEN:
        assert name in shown
    assert "nan" not in shown


@pytest.mark.parametrize("kind", ["intervals", "lines", "bars"])
def test_one_seed_has_no_intervals(kind: FigureKind, look: PageStyle) -> None:
    figure = one_of(kind)
    frame = figure.frame.filter(figure.frame[figure.facet or ""] == "baseline")
    bare = frame.drop("y_low", "y_high")
    none = frame.with_columns(y_low=pl.lit(None, pl.Float64), y_high=pl.lit(None, pl.Float64))
    first, second = (drawing(replace(figure, frame=one), look) for one in (bare, none))
    assert texts(first) == texts(second)


# ------------------------------------------------------------------------------ what they show


def test_names_with_many_series_have_a_panel_each(look: PageStyle) -> None:
    figure = next(figure for figure in figures() if figure.slug == "regret")
    canvas = draw(figure, look)
    assert [ax.get_title(loc="left") for ax in canvas.axes] == [
        "Step",
        "Drift",
        "Bursts",
        "Flapping",
        "Mixture",
    ]
    labels = [label.get_text() for label in canvas.axes[0].get_yticklabels()]
    assert labels == ["DTP (profile)", "DTP (shadow)", "DTP (scaling)", "DTP (corrected)"]


def test_the_level_is_marked_and_named(look: PageStyle) -> None:
    figure = one_of("intervals")
    canvas = draw(figure, look)
    for ax in canvas.axes:
        assert any(np.array_equal(line.get_xdata(), [5.0, 5.0]) for line in ax.get_lines())
    assert "dashed: 5 %" in texts(drawing(figure, look))


def test_nothing_has_an_open_mark_on_a_logarithmic_axis(look: PageStyle) -> None:
    rows: list[dict[str, object]] = [
        {"policy": name, "y": y} for name, y in zip(STATICS, (0.0, 0.02, 0.9), strict=True)
    ]
    figure = with_frame(one_of("intervals"), rows, facet=None)
    (ax,) = draw(figure, look).axes
    marks = [line for line in ax.get_lines() if line.get_marker() == "o"]
    assert [mark.get_markerfacecolor() == mark.get_markeredgecolor() for mark in marks] == [
        False,
        True,
        True,
    ]
    assert "open marks: less" in texts(drawing(figure, look))


def test_shares_of_placements_are_stacked_to_the_whole(look: PageStyle) -> None:
    figure = next(figure for figure in figures() if figure.slug == "shares")
    for ax in draw(figure, look).axes:
        bars = [patch for patch in ax.patches if patch.get_width() > 0]  # type: ignore[attr-defined]
        ends = [bar.get_x() + bar.get_width() for bar in bars]  # type: ignore[attr-defined]
        assert max(ends) == pytest.approx(100)
        assert len({round(bar.get_y(), 6) for bar in bars}) == 6  # type: ignore[attr-defined]


def test_measures_are_told_apart_by_their_filling(look: PageStyle) -> None:
    figure = one_of("bars")
    some = figure.frame.filter(
        (figure.frame["scenario"] == "step") & (figure.frame["output"] == "V_D")
    )
    (ax,) = draw(replace(figure, frame=some, facet=None, facet_row=None), look).axes
    filled = [to_rgba(patch.get_facecolor())[3] for patch in ax.patches]
    assert filled == [1.0, 0.0] * 5


def test_bars_begin_at_zero_on_a_linear_axis(look: PageStyle) -> None:
    rows: list[dict[str, object]] = [
        {"x": str(i), "part": "a", "y": y} for i, y in enumerate((0.001, 0.002, 9.0))
    ]
    figure = with_frame(one_of("bars"), rows, x="x", series="part", facet=None, facet_row=None)
    (ax,) = draw(figure, look).axes
    assert ax.get_xscale() == "linear"
    assert ax.get_xlim()[0] <= 0


def test_a_map_names_its_winners_and_hatches_what_is_marked(look: PageStyle) -> None:
    figure = one_of("map")
    one = figure.frame.filter(figure.frame["stress"] == "2 threads on R1")
    (ax,) = draw(replace(figure, frame=one, facet=None), look).axes
    assert [text.get_text() for text in ax.texts] == one["winner"].to_list()
    hatched = [patch for patch in ax.patches if patch.get_hatch()]
    assert len(hatched) == one["marked"].sum()
    shown = texts(drawing(figure, look))
    assert "not told apart" in shown
    assert "wins by nothing" in shown


def test_a_distribution_shows_what_is_left(look: PageStyle) -> None:
    grid = np.linspace(1, 100, 50)
    frame = pl.DataFrame({"x": grid, "y": grid / 100}).with_columns(policy=pl.lit("LOC"))
    figure = replace(one_of("ecdf"), frame=frame, facet=None)
    (ax,) = draw(figure, look).axes
    line = ax.get_lines()[0]
    assert np.asarray(line.get_ydata())[0] == pytest.approx(99)
    assert ax.get_xlim()[1] <= 3.1 * 33.3
    assert ax.get_yscale() == "log"


def test_a_timeline_shows_placements_disturbances_and_levels(look: PageStyle) -> None:
    figure = one_of("timeline")
    canvas = draw(figure, look)
    strip, happened, rates, tails, costs = canvas.axes
    assert len(strip.collections) == 5
    assert [text.get_text() for text in happened.get_yticklabels()] == [
        "4 threads on R1",
        "16 threads on E",
        "network fault",
    ]
    for ax, level in ((rates, 5.0), (tails, 33.3)):
        assert any(np.array_equal(line.get_ydata(), [level] * 2) for line in ax.get_lines())
    colours = {line.get_color() for line in costs.get_lines()}
    assert set(list(look.placements.values())[:3]) <= colours
    # Of each candidate the line, and a mark in each of its windows.
    marks = [line for line in costs.get_lines() if line.get_marker() == "o"]
    counted = [int(np.isfinite(np.asarray(line.get_ydata(), float)).sum()) for line in marks]
    placed = figure.frame.filter(figure.frame["panel"] == "V_D")["placement"]
    assert counted == [int((placed == name).sum()) for name in STATICS]


def test_panels_may_have_measures_of_their_own(look: PageStyle) -> None:
    figure = next(figure for figure in figures() if figure.slug == "steps")
    first, second = draw(figure, look).axes
    assert first.get_xlabel() == "change of V_D (points); dashed: no change"
    assert second.get_xlabel() == "change of migrations; dashed: no change"
    assert first.get_xlim() != second.get_xlim()


def test_panels_of_very_different_size_have_scales_of_their_own(look: PageStyle) -> None:
    rows: list[dict[str, object]] = [
        {"facet": facet, "x": x, "series": "LOC", "y": y * (x + 1)}
        for facet, y in (("small", 1.0), ("large", 100.0))
        for x in range(4)
    ]
    figure = with_frame(one_of("lines"), rows, facet="facet", series="series", y_unit="number")
    small, large = draw(figure, look).axes
    assert small.get_ylim()[1] < 5 < large.get_ylim()[1]
    assert "each on its own scale" in texts(drawing(figure, look))
    alike = replace(figure, frame=figure.frame.with_columns(pl.col("y").clip(0, 8)))
    first, second = draw(alike, look).axes
    assert first.get_ylim() == second.get_ylim()


def test_a_figure_may_be_parted_twice(look: PageStyle) -> None:
    figure = one_of("bars")
    assert figure.facet_row is not None
    grid = parted(figure, look, 5)
    # Ten scenarios do not stand side by side, and three outputs do.
    assert grid.turned
    assert (len(grid.rows), grid.columns) == (10, 3)
    few = replace(figure, frame=figure.frame.filter(figure.frame["scenario"] == "step"))
    assert (len(parted(few, look, 5).rows), parted(few, look, 5).columns) == (3, 1)


# --------------------------------------------------------------------------- axes and legends


def place(values: list[float], panel: Panel) -> Place:
    return Place("", pl.DataFrame({"y": values}, schema={"y": pl.Float64}), panel, own=False)


@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(math.nan) | st.just(math.inf), max_size=8),
    st.booleans(),
)
def test_everything_has_a_place_on_its_axis(values: list[float], log_y: bool) -> None:
    scale = scale_of([place(values, Panel(log_y=log_y))], ["y"])
    known = np.array([value for value in values if not math.isnan(value)])
    placed = scale.place(known)
    assert ((placed >= scale.low) & (placed <= scale.high)).all()
    finite = known[np.isfinite(known)]
    if not scale.log:
        assert not scale.hidden(finite).any()
    assert scale.high > scale.low


def test_amounts_that_span_much_have_a_logarithmic_axis() -> None:
    wide = [0.01, 0.012, 0.015, 0.9]
    assert scale_of([place(wide, Panel(y_unit="percent"))], ["y"]).log
    assert not scale_of([place(wide, Panel(y_unit="percent"))], ["y"], linear=True).log
    assert not scale_of([place(wide, Panel(y_unit="change"))], ["y"]).log
    assert not scale_of([place([-0.5, *wide], Panel(y_unit="percent"))], ["y"]).log


def test_a_wide_interval_does_not_squeeze_the_values() -> None:
    frame = pl.DataFrame({"y": [1.0, 2.0], "y_low": [-500.0, 1.9], "y_high": [900.0, 2.1]})
    scale = scale_of([Place("", frame, Panel(), own=False)], ["y", "y_low", "y_high"])
    assert scale.high - scale.low < 5
    assert scale.hidden(np.array([900.0]))[0]


@given(st.lists(st.text(st.characters(categories=["L"]), max_size=40), min_size=1, max_size=20))
def test_a_legend_fits(labels: list[str]) -> None:
    assert 1 <= legend_lines(labels) <= len(labels)


def test_long_titles_are_folded_between_words() -> None:
    assert folded("network impairment mild", 40) == "network impairment mild"
    assert folded("one two three four", 13) == "one two\nthree four"
    assert folded("network impairment mild", 20) == "network impairment\nmild"
    assert max(map(len, folded(LONG, 20).splitlines())) <= 20


def test_a_scale_knows_what_it_cannot_show() -> None:
    scale = Scale(0.5, 120.0, 1.0, 100.0)
    assert scale.place(np.array([0.0, 0.05, 5.0])).tolist() == [1.0, 5.0, 120.0]
    assert scale.hidden(np.array([0.0, 0.05, 5.0])).tolist() == [True, False, True]


# -------------------------------------------------------------------------------------- files


@pytest.fixture(scope="module")
def canvas(look: PageStyle) -> Canvas:
    rows: list[dict[str, object]] = [
        {"x": x, "series": str(x), "y": y}
        for x, y in ((0.001, 0.5), (0.002, 0.7), (0.004, 0.9), (0.008, 1.1))
    ]
    figure = Figure("f", "t", "lines", pl.DataFrame(rows), "x", "y", "series")
    return draw(replace(figure, y_label="V_D over N_min", x_label="α_S", log_x=True), look)


def test_numbers_on_axes_keep_their_digits(canvas: Canvas) -> None:
    assert ">0.001<" in drawn(canvas, "f")


def test_symbols_have_an_index(canvas: Canvas) -> None:
    shown = in_page(drawn(canvas, "f"), "t")
    assert re.search(r">V<tspan[^>]*>D</tspan><tspan[^>]*> over </tspan>N<tspan", shown)


def test_values_have_the_colours_of_the_page(canvas: Canvas) -> None:
    shown = in_page(drawn(canvas, "f"), "t")
    assert "var(--ramp-" in shown
    assert not any(colour in shown for colour in (INK, MUTED, *RAMP))
