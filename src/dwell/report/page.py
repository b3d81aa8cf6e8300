"""The page that figures and tables stand in: one file, no script, nothing from outside."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

from dwell.report.formatting import SYMBOL
from dwell.report.palette import INK, MUTED, PARTS, RAMP

__all__ = [
    "Cell",
    "definitions",
    "document",
    "figure",
    "items",
    "marked",
    "named",
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


RAMPS = " ".join(
    [f"--ramp-{i}: {colour};" for i, colour in enumerate(RAMP)]
    + [f"--{part}: {colour};" for part, colour in PARTS.items()]
)
STYLE = """
:root { color-scheme: light dark;
  --paper: #fff; --ink: #1c1c1e; --muted: #66666b; --rule: #dededf;
  --good: #00694d; --bad: #b04a00; RAMP }
@media (prefers-color-scheme: dark) { :root {
  --paper: #17181a; --ink: #e6e6e8; --muted: #a0a0a6; --rule: #38393d;
  --good: #4cc9a0; --bad: #ff9a52;
  --ramp-0: #6f4eb0; --ramp-1: #8766c8; --ramp-2: #9f80da; --ramp-3: #b79be8;
  --ramp-4: #d0b9f3; --ramp-5: #ead9fd;
  --compute: #d2d2d6; --queue: #85858b; --network: #4c4d52; } }
@media print { :root { color-scheme: light;
  --paper: #fff; --ink: #000; --muted: #444; --rule: #bbb;
  --good: #00694d; --bad: #b04a00; RAMP } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.6 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
main { max-width: 1100px; margin: 0 auto; padding: 72px 32px 120px; }
p, h1, h2, h3, ul, dl { max-width: 46em; }
h1 { font-size: 32px; line-height: 1.2; font-weight: 650; letter-spacing: -0.01em;
  margin: 0 0 8px; }
h1.chapter { margin-top: 120px; } h1 + h1.chapter { margin-top: 40px; font-size: 24px; }
h2 { font-size: 22px; line-height: 1.3; font-weight: 650; margin: 80px 0 16px; }
h3 + figure { margin-top: 14px; }
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
sub { font-size: 0.72em; line-height: 0; }
small { font-size: 12px; color: var(--muted); }
figure { margin: 28px 0 48px; }
figcaption { max-width: 52em; margin-top: 10px; }
svg { display: block; width: 100%; max-width: 960px; height: auto; color: var(--ink);
  overflow: visible; font-family: inherit; stroke-linejoin: round; }
.scroll { overflow-x: auto; margin: 20px 0 12px; }
.drawing { overflow-x: auto; overflow-y: hidden; padding-bottom: 2px; }
.drawing img { display: block; width: 100%; max-width: 960px; height: auto; }
table { border-collapse: collapse; font-size: 14px; line-height: 1.35;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; padding-bottom: 14px; max-width: 52em; }
th, td { padding: 5px 0 5px 12px; text-align: left; vertical-align: baseline; font-weight: 400; }
th:first-child, td:first-child { padding-left: 0; }
th { color: var(--muted); font-size: 13px; }
thead th { padding-bottom: 6px; vertical-align: bottom; }
thead tr:last-child th { border-bottom: 1px solid var(--ink); }
tbody tr + tr > * { border-top: 1px solid var(--rule); }
tbody th { color: inherit; font-size: inherit; white-space: nowrap; }
.num, .err { white-space: nowrap; }
.num { text-align: right; }
.err { padding-left: 5px; color: var(--muted); font-size: 12.5px; }
thead .pair { text-align: center; padding-left: 24px; white-space: nowrap; }
thead .over { text-align: center; color: var(--ink); padding-left: 36px; }
.begin { padding-left: 36px; }
.wide { width: 100%; }
.of-chapter thead :is(.pair, .num) { white-space: normal; }
.of-chapter thead th { max-width: 11em; }
.small { font-size: 13px; } .small th { font-size: 12.5px; } .small .err { font-size: 11.5px; }
.small :not(:first-child):is(td, th) { padding-left: 9px; } .small .err.err { padding-left: 4px; }
.tight { font-size: 12px; } .tight th { font-size: 12px; } .tight .err { font-size: 11px; }
.tight :not(:first-child):is(td, th) { padding-left: 5px; } .tight .err.err { padding-left: 2px; }
.tight .swatch { margin-right: 5px; } .tight small { font-size: 11px; }
.summary { width: 100%; } .summary :is(th, td) { padding-top: 8px; padding-bottom: 8px; }
.summary tbody th { white-space: normal; width: 30%; padding-right: 8px; }
.text { min-width: 11em; }
.prose { width: 100%; max-width: 52em; }
.prose :not(:first-child):is(td, th) { padding-left: 20px; }
.nowrap { white-space: nowrap; }
tr.group > * { padding: 30px 0 6px; border-top: 0 !important; border-bottom: 1px solid var(--ink);
  font-weight: 650; font-size: 15px; }
tr.group + tr > * { border-top: 0; }
tbody tr.group:first-child > * { padding-top: 16px; }
.best { font-weight: 650; }
.swatch { display: inline-block; width: 10px; height: 10px; border-radius: 2px;
  margin-right: 7px; }
.ring { background: none; border: 2px solid; border-radius: 5px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 6px 20px; font-size: 15px; }
dt { color: var(--muted); } dd { margin: 0; }
summary { cursor: pointer; color: var(--muted); font-size: 14px; margin: 12px 0; }
.evidence { margin-bottom: 24px; } .evidence li { margin-bottom: 4px; }
.files { margin-top: 4px; } .files a { color: inherit; }
a { color: inherit; text-decoration-color: var(--muted); text-underline-offset: 2px; }
@media (max-width: 640px) { main { padding: 40px 18px 80px; } dl { display: block; }
  dd { margin-bottom: 8px; } h1 { font-size: 27px; } h2 { margin-top: 56px; }
  .drawing svg, .drawing img { width: 760px; max-width: none; }
  caption { position: sticky; left: 0; max-width: calc(100vw - 36px); }
  .of-chapter { min-width: 820px; }
  .of-chapter tr:not(.group) > :first-child { position: sticky; left: 0; padding-right: 6px;
    background: var(--paper); }
  .of-chapter tr + tr:not(.group) > :first-child { box-shadow: inset 0 1px var(--rule); }
  .summary, .summary :is(tbody, tr, th, td) { display: block; width: auto !important; }
  .summary thead { display: none; } .summary tr { padding: 12px 0; }
  .summary tr + tr { border-top: 1px solid var(--rule); }
  .summary tr > :is(th, td) { padding: 2px 0 !important; border: 0 !important; } }
@media print { body { font-size: 10.5pt; } main { max-width: none; padding: 0; }
  h2 { margin-top: 32pt; } h2, h3 { break-after: avoid; }
  figure, tr, li { break-inside: avoid; } .drawing { overflow: visible; }
  .files a { text-decoration: none; } tr.group { break-after: avoid; }
  .scroll { overflow: visible; }
  table { font-size: 8.5pt; } th, .err, small { font-size: 8pt; }
  td, th { padding-left: 6px; } .err { padding-left: 3px; } }
""".replace("RAMP", RAMPS)


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


def items(texts: Iterable[str], kind: str = "") -> str:
    """Return a list of plain texts; `code` in them is set as such."""
    attribute = f' class="{kind}"' if kind else ""
    return (
        f"<ul{attribute}>\n" + "\n".join(f"<li>{marked(text)}</li>" for text in texts) + "\n</ul>"
    )


def definitions(entries: Mapping[str, str]) -> str:
    """Return a list of terms and what stands for them, both plain text."""
    rows = (f"<dt>{escape(term)}</dt><dd>{marked(text)}</dd>" for term, text in entries.items())
    return "<dl>\n" + "\n".join(rows) + "\n</dl>"


def figure(svg: str, caption: str) -> str:
    """Return a figure with a caption of plain text."""
    return (
        f'<figure>\n<div class="drawing">{svg}</div>\n'
        f"<figcaption>{marked(caption)}</figcaption>\n</figure>"
    )


def swatch(colour: str) -> str:
    """Return a small square of a placement's colour."""
    return f'<span class="swatch" style="background:{colour}"></span>'


def named(name: str, colour: str, *, ring: bool) -> str:
    """Return a name behind its mark: a square for a placement, a ring for what moves."""
    # What stands in brackets is set smaller: columns are narrow.
    html = re.sub(r"(\(.*\))$", r"<small>\1</small>", escape(name))
    if not ring:
        return swatch(colour) + html
    border = "currentColor" if colour == INK else "var(--muted)" if colour == MUTED else colour
    return f'<span class="swatch ring" style="border-color:{border}"></span>{html}'


def marked(text: str) -> str:
    """Escape a text; set `code` and the symbols with an index."""
    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text, quote=False))
    html = SYMBOL.sub(r"\1<sub>\2</sub>", html)
    # A number stays on one line with its unit.
    return re.sub(r"(?<=\d) (?=(?:%|ms|s)(?!\w))", "\u00a0", html)


def _cells(row: Sequence[Cell], *, heading: bool = False) -> str:
    """Return the cells of a row; the first names it."""
    parts = []
    for index, cell in enumerate(row):
        name = "th" if heading or index == 0 else "td"
        attributes = f' class="{cell.kind}"' if cell.kind else ""
        attributes += f' colspan="{cell.columns}"' if cell.columns != 1 else ""
        parts.append(f"<{name}{attributes}>{cell.html}</{name}>")
    return "".join(parts)


def table(
    head: Sequence[Cell],
    rows: Iterable[tuple[str, Sequence[Cell]]],
    caption: str = "",
    *,
    above: Sequence[Cell] = (),
    kind: str = "",
) -> str:
    """Return a table.

    Parameters
    ----------
    head : sequence of cells
    rows : iterable of (class, cells)
        A row's class is empty, or ``group`` for a heading across the table.
    caption : str
        Plain text.
    above : sequence of cells
        A second row of headings, over the first.
    kind : str
        Class of the table.
    """
    lines = [
        f'<tr class="{group}">{_cells(row)}</tr>' if group else f"<tr>{_cells(row)}</tr>"
        for group, row in rows
    ]
    heads = [f"<tr>{_cells(row, heading=True)}</tr>" for row in (above, head) if row]
    return (
        f'<div class="scroll"><table class="{kind}">\n'
        + (f"<caption>{marked(caption)}</caption>\n" if caption else "")
        + f"<thead>{''.join(heads)}</thead>\n<tbody>\n"
        + "\n".join(lines)
        + "\n</tbody>\n</table></div>"
    )
