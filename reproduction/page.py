"""One page of tables: the verdicts of every question, and what else its runs show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jinja2
import polars as pl

from dwell.study import UNTOLD, untold
from reproduction.verdicts import Answer, brief, counted

#: Metrics that are written in per cent.
SHARES = (
    "violation_rate",
    "u_",
    "share",
    "over_",
    "regret",
    "node_",
    "rule_and",
    "estimate",
    "luck",
)


class Question(NamedTuple):
    """A question that was answered: its name, its title and the answer."""

    name: str
    title: str
    answer: Answer


def page(
    questions: list[Question],
    *,
    answers: str,
    scale: str,
    version: str,
    pictures: Sequence[str] = (),
) -> str:
    """Return the page.

    Parameters
    ----------
    answers : str
        What it begins with, as HTML.
    pictures : sequence of str
        Studies that have figures, ``runs/STUDY/report.html``.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    shown = [
        {
            "name": one.name,
            "title": one.title,
            "counts": _table("", counted(one.answer.verdicts)),
            "verdicts": _table("", brief(one.answer.verdicts)),
            "tables": [_table(title, frame) for title, frame in one.answer.tables.items()],
        }
        for one in questions
    ]
    words = [word for one in questions for word in one.answer.verdicts["word"]]
    once = {"sign": UNTOLD, "words": untold(words), "of": len(words)}
    template = environment.get_template("page.html")
    return template.render(
        answers=answers,
        questions=shown,
        scale=scale,
        version=version,
        pictures=pictures,
        untold=once,
    )


def _table(title: str, frame: pl.DataFrame) -> dict[str, object]:
    """Return a frame as texts; the ends of an interval stand behind its value."""
    ends = {f"{name}{end}" for name in frame.columns for end in ("_low", "_high")}
    ends |= {"low", "high"} if "effect" in frame.columns else set()
    names = [name for name in frame.columns if name not in ends]
    columns = [{"name": name, "number": frame[name].dtype.is_numeric()} for name in names]
    rows = [[_cell(name, row) for name in names] for row in frame.iter_rows(named=True)]
    return {"title": title, "columns": columns, "rows": rows}


def _cell(name: str, row: Mapping[str, object]) -> str:
    value = row[name]
    if not isinstance(value, float):
        return "" if value is None else str(value)
    low, high = ("low", "high") if name == "effect" else (f"{name}_low", f"{name}_high")
    metric = str(row.get("metric", "")) if name == "effect" else name
    ends = [row[end] for end in (low, high) if row.get(end) is not None]
    interval = [_number(end, metric) for end in ends]
    return f"{_number(value, metric)} [{', '.join(interval)}]" if interval else _number(value, name)


def _number(value: object, metric: str) -> str:
    """Write a number to three digits, a share in per cent."""
    if not isinstance(value, float):
        return "–"
    if metric.startswith(("p", "change_of")):
        return f"{value:.2g}"
    return f"{100 * value:.1f}" if metric.startswith(SHARES) else f"{value:.4g}"
