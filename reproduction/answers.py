"""The answers to RQ1 to RQ4: the comparisons that were named before the run, and a figure of each.

What they came to at full scale stands in ``ANSWERS.md``, in words.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import polars as pl
import vl_convert
from markdown_it import MarkdownIt

from reproduction.page import SHARES
from reproduction.verdicts import COLUMNS, brief

FOLDER = Path(__file__).parent
WORDS = FOLDER / "ANSWERS.md"
#: What `WORDS` and its figures are of: the primary comparisons at full scale, with their kin.
FOUND = FOLDER / "answers"


class Compared(NamedTuple):
    """A comparison of a question: policies `first` and `second`, by a metric, in a scenario."""

    question: str
    claim: str
    scenario: str
    first: str
    second: str
    metric: str


#: One comparison a research question, chosen before any run was seen.
PRIMARY: Mapping[str, Compared] = {
    # What comes and goes is what moving while a pipeline runs is for; R1 is the paper's node.
    "RQ1": Compared(
        "concurrent",
        "T2 and T3 together beat tuned ATP",
        "R1 1 a core on-off",
        "dtp+corrected",
        "atp-tuned",
        "violation_rate",
    ),
    "RQ2": Compared(
        "reversion",
        "Having HYB helps a rule during network faults",
        "both links",
        "dtp+corrected",
        "dtp+corrected LOC or SO",
        "violation_rate",
    ),
    # The cell's own dwell and price of a move, where the best placement changes at random.
    "RQ3": Compared(
        "chatter",
        "The penalty is calmer than a threshold of the same mean",
        "bursts",
        "corrected, N_min = 3, penalty 0.2",
        "corrected, N_min = 3, threshold 0.2",
        "migrations",
    ),
    # The weight of what the targets are about.
    "RQ4": Compared(
        "weights",
        "One weight changed changes a metric",
        "bursts",
        "α_V × ½",
        "as in the cell",
        "violation_rate",
    ),
}

#: What a figure shows of a row: the primary comparison, the same one elsewhere, others there.
PARTS = PRIMARY_PART, ELSEWHERE, OTHERS = "primary", "elsewhere", "others"


def found(verdicts: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """Return the rows of every answer, from the verdicts of the questions that were asked.

    Returns
    -------
    dict of str to DataFrame
        By research question: ``part`` (`PARTS`) and the columns of a verdict. The primary
        comparison comes first; the others differ from it in the scenario or in who is compared.
    """
    return {
        name: rows_of(primary, verdicts[primary.question])
        for name, primary in PRIMARY.items()
        if primary.question in verdicts
    }


def rows_of(primary: Compared, verdicts: pl.DataFrame) -> pl.DataFrame:
    """Return the row of a primary comparison, then those of its kin (see `found`)."""
    there = pl.col("scenario") == primary.scenario
    same = (pl.col("first") == primary.first) & (pl.col("second") == primary.second)
    part = (
        pl.when(there & same)
        .then(pl.lit(PRIMARY_PART))
        .when(same)
        .then(pl.lit(ELSEWHERE))
        .when(there)
        .then(pl.lit(OTHERS))
    )
    kin = verdicts.filter(claim=primary.claim, metric=primary.metric)
    rows = kin.select(part.alias("part"), *COLUMNS).drop_nulls("part")
    order = pl.col("part").replace_strict(dict(zip(PARTS, range(len(PARTS)), strict=True)))
    return rows.sort(order, maintain_order=True)


def page_of(answers: Mapping[str, pl.DataFrame]) -> str:
    """Return the words as HTML; figures are those of `answers` where these have them."""
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(words())

    def shown(image: re.Match[str]) -> str:
        name, alternative = image.group(1), image.group(2)
        return f'<figure role="img" aria-label="{alternative}">{_svg_of(name, answers)}</figure>'

    return re.sub(r'<p><img src="answers/(RQ\d)\.svg" alt="([^"]*)"\s*/?></p>', shown, html)


def words() -> str:
    """Return what was written of the run at full scale."""
    return WORDS.read_text(encoding="utf-8")


def _svg_of(name: str, answers: Mapping[str, pl.DataFrame]) -> str:
    if name in answers:
        return svg(answers[name])
    return (FOUND / f"{name}.svg").read_text(encoding="utf-8")


def write(answers: Mapping[str, pl.DataFrame], folder: Path) -> None:
    """Write the rows of every answer, and its figure, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in answers.items():
        rows.write_csv(folder / f"{name}.csv")
        (folder / f"{name}.svg").write_text(svg(rows), encoding="utf-8")


# --------------------------------------------------------------------------------- figures

#: Readable on white and on black.
INK, COLOURS = "#808080", {"lower": "#0072b2", "higher": "#d55e00"}
WIDTH_PX = 460


def svg(rows: pl.DataFrame) -> str:
    """Draw the effects of an answer with their intervals: where, then against whom."""
    drawn = str(vl_convert.vegalite_to_svg(_drawing(brief(rows))))
    return re.sub(r' (?:role|aria-[\w-]+)="[^"]*"', "", drawn)


def _drawing(rows: pl.DataFrame) -> dict[str, object]:
    primary = rows.row(0, named=True)
    share = primary["metric"].startswith(SHARES)
    unit, heading = (100.0, ", points") if share else (1.0, "")
    shown = rows.with_columns(pl.col("effect", "low", "high") * unit)
    pair = pl.format("{} less {}", "first", "second")
    panels = [
        (ELSEWHERE, pl.col("scenario"), f"{primary['first']} less {primary['second']}"),
        (OTHERS, pair, f"in {primary['scenario']}"),
    ]
    axis = primary["metric"].replace("violation_rate", "V_D") + heading
    drawn = [
        _panel(shown.filter(pl.col("part").is_in([PRIMARY_PART, part])), label, title, axis)
        for part, label, title in panels
        if part in rows["part"]
    ]
    style = {
        "font": "system-ui, sans-serif",
        "view": {"stroke": None},
        "axis": {
            "labelColor": INK,
            "titleColor": INK,
            "gridColor": INK,
            "gridOpacity": 0.2,
            "domainColor": INK,
            "tickColor": INK,
            "labelLimit": 420,
            "titleFontWeight": "normal",
        },
        "title": {"color": INK, "anchor": "start", "fontWeight": "normal"},
        "legend": {"labelColor": INK, "titleColor": INK},
    }
    return {"vconcat": drawn, "background": "transparent", "config": style}


def _panel(rows: pl.DataFrame, label: pl.Expr, title: str, axis: str) -> dict[str, object]:
    """Draw a point and an interval for each row; the primary comparison is larger."""
    known = rows.filter(pl.col("effect").is_finite())
    data = known.select(
        "part",
        "effect",
        "low",
        "high",
        "word",
        label=label,
        is_primary=pl.col("part") == PRIMARY_PART,
    )
    words = list(dict.fromkeys(data["word"]))
    colours = [COLOURS.get(word, INK) for word in words]
    colour = {
        "field": "word",
        "title": None,
        "scale": {"domain": words, "range": colours},
        "legend": {"orient": "bottom"},
    }
    shared = {
        "y": {"field": "label", "type": "nominal", "sort": data["label"].to_list(), "title": None},
        "color": colour,
    }
    x = {"field": "effect", "type": "quantitative", "title": axis}
    return {
        "title": title,
        "width": WIDTH_PX,
        "height": {"step": 18},
        "data": {"values": data.to_dicts()},
        "encoding": shared,
        "layer": [
            {
                "mark": {"type": "rule", "color": INK},
                "encoding": {
                    "x": {"datum": 0},
                    "y": {"value": 0},
                    "y2": {"value": "height"},
                    "color": {"value": INK},
                },
            },
            {
                "mark": {"type": "rule", "strokeWidth": 2},
                "encoding": {"x": {**x, "field": "low"}, "x2": {"field": "high"}},
            },
            {
                "mark": {"type": "point", "filled": True, "opacity": 1},
                "encoding": {
                    "x": x,
                    "size": {"condition": {"test": "datum.is_primary", "value": 160}, "value": 50},
                    "shape": {
                        "condition": {"test": "datum.is_primary", "value": "diamond"},
                        "value": "circle",
                    },
                },
            },
        ],
    }
