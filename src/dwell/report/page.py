"""The page that figures and tables stand in: one file, no script, nothing from outside."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

__all__ = [
    "Cell",
    "definitions",
    "document",
    "figure",
    "items",
    "marked",
    "paragraph",
    "section",
    "swatch",
    "table",
]


class Cell(NamedTuple):
    """A cell of a table.

    Parameters
    ----------
    html : str
    kind : str
        Class: ``num`` for a number, ``err`` for what is known of its error, ``pair`` for the
        heading of both.
    columns : int
        How many it spans.
    """

    html: str
    kind: str = ""
    columns: int = 1


STYLE = """
:root { color-scheme: light dark;
  --paper: #fff; --ink: #1c1c1e; --muted: #66666b; --rule: #dededf; --tint: #f5f5f6;
  --good: #00694d; --bad: #b04a00; }
@media (prefers-color-scheme: dark) { :root {
  --paper: #17181a; --ink: #e6e6e8; --muted: #a0a0a6; --rule: #38393d; --tint: #202124;
  --good: #4cc9a0; --bad: #ff9a52; } }
@media print { :root { color-scheme: light;
  --paper: #fff; --ink: #000; --muted: #444; --rule: #bbb; --tint: #fff;
  --good: #00694d; --bad: #b04a00; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.6 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
main { max-width: 1040px; margin: 0 auto; padding: 72px 32px 120px; }
.prose, p, h1, h2, h3, ul, dl { max-width: 46em; }
h1 { font-size: 32px; line-height: 1.2; font-weight: 650; letter-spacing: -0.01em;
  margin: 0 0 8px; }
h2 { font-size: 22px; line-height: 1.3; font-weight: 650; margin: 80px 0 16px; }
h3 { font-size: 17px; line-height: 1.4; font-weight: 650; margin: 44px 0 8px; }
p, ul { margin: 0 0 14px; }
ul { padding-left: 1.2em; }
li { margin: 0 0 8px; }
.subtitle { color: var(--muted); margin-bottom: 40px; }
.question { font-size: 19px; line-height: 1.5; margin-bottom: 24px; }
.note, figcaption, caption { color: var(--muted); font-size: 14px; line-height: 1.5; }
.tag { font-size: 13px; font-weight: 600; margin-left: 10px; white-space: nowrap; }
.good { color: var(--good); } .bad { color: var(--bad); } .open { color: var(--muted); }
code { font: 0.9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
figure { margin: 28px 0 44px; }
figcaption { max-width: 52em; margin-top: 10px; }
svg { display: block; width: 100%; height: auto; color: var(--ink); overflow: visible;
  font-family: inherit; stroke-linejoin: round; }
.scroll { overflow-x: auto; margin: 20px 0 12px; }
table { border-collapse: collapse; font-size: 14px; line-height: 1.35;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; padding-bottom: 10px; }
th, td { padding: 5px 0; text-align: left; vertical-align: baseline; font-weight: 400; }
th { color: var(--muted); font-size: 13px; }
thead th { border-bottom: 1px solid var(--ink); padding: 0 0 6px; vertical-align: bottom; }
tbody tr + tr > * { border-top: 1px solid var(--rule); }
tbody th { color: inherit; font-size: inherit; padding-right: 18px; white-space: nowrap; }
td + td, th + th, th + td { padding-left: 14px; }
.num { text-align: right; white-space: nowrap; }
.err { padding-left: 5px !important; color: var(--muted); font-size: 12.5px;
  white-space: nowrap; }
thead .pair { text-align: right; padding-right: 20px; }
tr.group > * { padding: 30px 0 6px; border-top: 0 !important; border-bottom: 1px solid var(--ink);
  font-weight: 650; color: var(--ink); font-size: 15px; }
tr.first > * { border-top: 0 !important; }
.best { font-weight: 650; }
sub { font-size: 0.72em; line-height: 0; }
h1.chapter { margin-top: 120px; }
.swatch { display: inline-block; width: 10px; height: 10px; border-radius: 2px;
  margin-right: 7px; }
.ring { background: none !important; border: 2px solid var(--ink); border-radius: 5px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 20px; font-size: 15px; }
dt { color: var(--muted); } dd { margin: 0; }
@media (max-width: 640px) { main { padding: 40px 18px 80px; } dl { display: block; }
  dd { margin-bottom: 8px; } }
@media print { body { font-size: 10.5pt; } main { max-width: none; padding: 0; }
  h2 { margin-top: 32pt; } h2, h3 { break-after: avoid; }
  figure, tr, li { break-inside: avoid; } .scroll { overflow: visible; }
  table { font-size: 8.5pt; } th, .err { font-size: 8pt; }
  td + td, th + th, th + td { padding-left: 7px; } }
"""


def document(title: str, body: Iterable[str]) -> str:
    """Return a whole page.

    Parameters
    ----------
    title : str
        Plain text.
    body : iterable of str
        HTML.
    """
    content = "\n".join(body)
    return (
        "<!DOCTYPE html>\n"
        '<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{content}\n</main>\n</body>\n</html>\n"
    )


def section(heading: str, *parts: str) -> str:
    """Return a section; its heading is plain text, its parts are HTML."""
    return f"<section>\n<h2>{escape(heading)}</h2>\n" + "\n".join(parts) + "\n</section>"


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph of plain text."""
    attribute = f' class="{kind}"' if kind else ""
    return f"<p{attribute}>{marked(text)}</p>"


def items(texts: Iterable[str]) -> str:
    """Return a list of plain texts; `code` in them is set as such."""
    return "<ul>\n" + "\n".join(f"<li>{marked(text)}</li>" for text in texts) + "\n</ul>"


def definitions(entries: Mapping[str, str]) -> str:
    """Return a list of terms and what stands for them, both plain text."""
    rows = (f"<dt>{escape(term)}</dt><dd>{marked(text)}</dd>" for term, text in entries.items())
    return "<dl>\n" + "\n".join(rows) + "\n</dl>"


def figure(svg: str, caption: str) -> str:
    """Return a figure with a caption of plain text."""
    return f"<figure>\n{svg}\n<figcaption>{marked(caption)}</figcaption>\n</figure>"


def swatch(colour: str) -> str:
    """Return a small square of a placement's colour."""
    return f'<span class="swatch" style="background:{colour}"></span>'


def marked(text: str) -> str:
    """Escape a text; set `code` and the symbols with an index."""
    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
    return re.sub(r"\b(V_D|U_r|U_e)\b", lambda m: f"{m[0][0]}<sub>{m[0][2]}</sub>", html)


def _cells(row: Sequence[Cell], *, heading: bool = False) -> str:
    """Return the cells of a row; the first names it."""
    parts = []
    for index, cell in enumerate(row):
        name = "th" if heading or index == 0 else "td"
        attributes = f' class="{cell.kind}"' if cell.kind else ""
        attributes += f' colspan="{cell.columns}"' if cell.columns != 1 else ""
        parts.append(f"<{name}{attributes}>{cell.html}</{name}>")
    return "".join(parts)


def table(head: Sequence[Cell], rows: Iterable[tuple[str, Sequence[Cell]]], caption: str) -> str:
    """Return a table.

    Parameters
    ----------
    head : sequence of cells
    rows : iterable of (class, cells)
        A row's class is empty, or ``group`` for a heading across the table.
    caption : str
        Plain text.
    """
    lines = [
        f'<tr class="{kind}">{_cells(row)}</tr>' if kind else f"<tr>{_cells(row)}</tr>"
        for kind, row in rows
    ]
    body = "\n".join(lines)
    return (
        f'<div class="scroll"><table>\n<caption>{marked(caption)}</caption>\n'
        f"<thead><tr>{_cells(head, heading=True)}</tr></thead>\n<tbody>\n{body}\n</tbody>\n"
        "</table></div>"
    )
