"""Figures and tables as files for a paper."""

from __future__ import annotations

import io
import re

import polars as pl
import pytest

from dwell.display import Measure
from dwell.report.figure import COLUMN_PT
from dwell.report.figure_files import figure_files, table_tex
from dwell.report.run_page import run_page
from dwell.report.table import Table, Text
from tests.report.pages import small_run


@pytest.fixture(scope="module")
def files() -> dict[str, bytes | str]:
    return dict(figure_files(run_page(small_run())))


def test_figures_are_as_wide_as_a_column_with_text_of_seven_points(
    files: dict[str, bytes | str],
) -> None:
    for slug in ("time", "latencies", "split"):
        data = files[f"{slug}.pdf"]
        assert isinstance(data, bytes)
        box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ", data)
        assert box is not None
        assert COLUMN_PT - 2 <= float(box[1]) <= COLUMN_PT
        svg = str(files[f"{slug}.svg"])
        wide = re.search(r'width="([\d.]+)pt"', svg)
        assert wide is not None
        assert COLUMN_PT - 2 <= float(wide[1]) <= COLUMN_PT
        sizes = [float(size) for size in re.findall(r'font-size="([\d.]+)px"', svg)]
        assert sizes
        assert min(sizes) >= 7
        # Nothing is left of the page's colours.
        assert "var(--" not in svg


def test_what_a_figure_shows_is_a_table_beside_it(files: dict[str, bytes | str]) -> None:
    frame = pl.read_csv(io.StringIO(str(files["time-windows.csv"])))
    run = small_run()
    assert frame["l95"].to_list() == pytest.approx(run.windows["seen_l95_ms"].to_list())


def test_a_table_is_one_that_latex_reads() -> None:
    rows = [
        {"name": "a_b & c", "v": 0.052, "v_low": 0.04, "v_high": 0.07, "of": "x"},
        {"name": "V_D", "v": -1.0, "of": "y"},
    ]
    columns: list[Text | Measure] = [Text("name", "Δ_min"), Measure("v", "V_D", "%", 100.0)]
    text = table_tex(Table("t", "50 %", columns, rows, Text("of", "")))
    assert r"$\Delta_{\mathrm{min}}$ & $V_{\mathrm{D}}$ (\%) \\" in text
    assert r"a\_b \& c & 5.2 {\color{gray}[4.0, 7.0]} \\" in text
    assert r"$V_{\mathrm{D}}$ & $-$100 \\" in text
    assert r"\begin{tabular*}{252pt}{@{\extracolsep{\fill}}lr@{}}" in text
    assert text.count(r"\multicolumn{2}") == 2
    assert text.count("{") == text.count("}")
