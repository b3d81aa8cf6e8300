"""The answers to RQ1 to RQ5: a map each, its figure, and a table of what it counts.

`ANSWERS.md` has them in words; the tables in it are those of `FOUND`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import polars as pl
from markdown_it import MarkdownIt

from reproduction.maps import counts, number, svg
from reproduction.verdicts import NUMBERS

FOLDER = Path(__file__).parent
WORDS = FOLDER / "ANSWERS.md"
#: The maps that `WORDS` has tables and figures of.
FOUND = FOLDER / "answers"


class Asked(NamedTuple):
    """A research question: the module that answers it, and the labels that its table counts by."""

    question: str
    by: tuple[str, ...]


RESEARCH: Mapping[str, Asked] = {
    "RQ1": Asked("concurrent", ("panel",)),
    "RQ2": Asked("reversion", ("panel", "column")),
    "RQ3": Asked("chatter", ("panel",)),
    "RQ4": Asked("weights", ()),
    "RQ5": Asked("deciding", ("panel", "column")),
}


def read(folder: Path = FOUND) -> dict[str, pl.DataFrame]:
    """Return the maps in a folder, by research question."""
    floats = dict.fromkeys(NUMBERS, pl.Float64)
    files = {name: folder / f"{name}.csv" for name in RESEARCH}
    return {
        name: pl.read_csv(file, schema_overrides=floats).with_columns(
            pl.col(pl.String).fill_null("")
        )
        for name, file in files.items()
        if file.exists()
    }


def table(name: str, cells: pl.DataFrame) -> str:
    """Return what a map counts, as a table in Markdown; of the weights the largest shares."""
    if by := RESEARCH[name].by:
        return counts(cells, by)
    lines = [
        "| scenario | weight with the largest share | S_T | V_D spans, points |",
        "|---|---|---|---|",
    ]
    for (scenario,), mine in cells.group_by(["row"], maintain_order=True):
        *shares, span = mine.to_dicts()
        known = [one for one in shares if one["effect"] is not None]
        most = (
            max(known, key=lambda one: one["effect"]) if known else {"column": "–", "effect": None}
        )
        effects = [one["effect"] for one in (most, span)]
        told = ["–" if effect is None else number(float(effect)) for effect in effects]
        lines.append(f"| {scenario} | {most['column']} | {told[0]} | {told[1]} |")
    return "\n".join(lines)


def words(answers: Mapping[str, pl.DataFrame]) -> str:
    """Return what was written, with the tables of these maps."""

    def told(found: re.Match[str]) -> str:
        name = found.group(1)
        design = ", ".join(dict.fromkeys(answers[name]["design"])) if name in answers else ""
        inside = f"{design}:\n\n{table(name, answers[name])}" if design else found.group(2).strip()
        return f"<!-- {name} -->\n\n{inside}\n\n<!-- end -->"

    text = WORDS.read_text(encoding="utf-8")
    return re.sub(r"<!-- (RQ\d) -->(.*?)<!-- end -->", told, text, flags=re.DOTALL)


def page_of(answers: Mapping[str, pl.DataFrame]) -> str:
    """Return the words as HTML; tables and figures are those of `answers` where these have them."""
    plain = re.sub(r"<!--.*?-->", "", words(answers))
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(plain)
    drawn = {**read(), **answers}

    def shown(image: re.Match[str]) -> str:
        name, alternative = image.group(1), image.group(2)
        return f'<figure role="img" aria-label="{alternative}">{svg(drawn[name])}</figure>'

    return re.sub(r'<p><img src="answers/(RQ\d)\.svg" alt="([^"]*)"\s*/?></p>', shown, html)


def write(answers: Mapping[str, pl.DataFrame], folder: Path) -> None:
    """Write every map and its figure below a folder, and the words with their tables."""
    (folder / "answers").mkdir(parents=True, exist_ok=True)
    (folder / WORDS.name).write_text(words(answers), encoding="utf-8")
    for name, cells in answers.items():
        cells.write_csv(folder / "answers" / f"{name}.csv")
        drawn = svg(cells)
        (folder / "answers" / f"{name}.svg").write_text(drawn, encoding="utf-8")
