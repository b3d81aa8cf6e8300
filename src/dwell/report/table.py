"""Tables: rows and columns once, written as HTML, as text for a terminal, and as LaTeX."""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeAlias

from dwell.display import Measure
from dwell.report.formatting import shown_contender, shown_scenario, write_interval
from dwell.report.palette import CIRCLE, MUTED, Palette
from dwell.study import Interval

Row: TypeAlias = "Mapping[str, Any]"
Columns: TypeAlias = "list[Text | Measure]"
Kind: TypeAlias = Literal["text", "cell", "policy", "placement", "scenario", "word"]

#: Largest width of sentences in text, columns.
PROSE = 100
#: Largest number of rows in tables of moves.
MOST_ROWS = 200
#: Ends of the captions of tables, which say whether numbers include the warm-up.
WITHOUT_WARMUP, WITH_WARMUP = "Without the warm-up.", "With the warm-up."
#: Meaning of the words of verdicts; other words are open.
WORDS: Mapping[str, Literal["good", "bad"]] = {
    "under": "good",
    "over": "bad",
    "agrees": "good",
    "differs": "bad",
    "met": "good",
    "explained": "good",
    "kept": "good",
    "missed": "bad",
    "lower": "good",
    "higher": "bad",
}


class Text(NamedTuple):
    """A column of texts.

    `column` is the key of the rows and `name` the heading. The name of a cell stays on one line;
    policies and placements have their colour, and words of verdicts a mark (see `WORDS`). `link`
    is the target of a link, formatted with the row: ``#window-{window}``.
    """

    column: str
    name: str
    kind: Kind = "text"
    link: str = ""


class Cell(NamedTuple):
    """A cell of a table as text.

    `error` is the interval of a number. `kind` is a class of the page's style: ``num``, ``name``,
    ``cell``, ``text``, or ``word`` with its meaning. `sort` is the key for sorting rows. `colour`
    and `marker` describe the mark before a name.
    """

    text: str
    error: str = ""
    kind: str = "text"
    sort: float | str = ""
    colour: str = ""
    marker: str = ""
    link: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table.

    `slug` is its name in files and links. A row maps names of columns to values; an unknown value
    is None, NaN or missing. A number has an interval if the row has ``NAME_low`` and
    ``NAME_high``. Consecutive rows with equal values in the column `group` share a heading.
    `compact` writes every interval as ``±`` and its larger half, for terminals.
    """

    slug: str
    title: str
    columns: Sequence[Text | Measure]
    rows: Sequence[Row]
    group: Text | None = None
    caption: str = ""
    palette: Palette = field(default_factory=lambda: Palette.of(()))
    compact: bool = False

    @property
    def headings(self) -> tuple[str, ...]:
        """Headings of the columns, with units."""
        return tuple(
            column.name if isinstance(column, Text) else column.heading for column in self.columns
        )

    def groups(self) -> Iterator[tuple[str, list[list[Cell]]]]:
        """Yield the heading of every group (empty without groups) and the cells of its rows."""
        group, columns = self.group, [self._sized(column) for column in self.columns]
        for heading, rows in itertools.groupby(
            self.rows, lambda row: "" if group is None else self._text(group, row).text
        ):
            yield heading, [[self._cell(column, row) for column in columns] for row in rows]

    def parts(self, most: int) -> list[Table]:
        """Return tables with at most `most` columns after the first, which each of them has."""
        first, *others = self.columns
        still = WITHOUT_WARMUP if WITHOUT_WARMUP in self.caption else ""
        return [
            replace(
                self,
                slug=self.slug if begin == 0 else f"{self.slug}-{begin // most + 1}",
                title=self.title if begin == 0 else "",
                caption=self.caption if begin == 0 else still,
                columns=[first, *others[begin : begin + most]],
            )
            for begin in range(0, len(others), most)
        ]

    def _sized(self, column: Text | Measure) -> Text | Measure:
        """Return a column with decimals for the largest of its numbers."""
        if isinstance(column, Text):
            return column
        values = (row.get(column.column) for row in self.rows)
        return column.for_size(
            *(column.factor * one for one in values if isinstance(one, int | float))
        )

    def _cell(self, column: Text | Measure, row: Row) -> Cell:
        if isinstance(column, Text):
            return self._text(column, row)
        value = row.get(column.column)
        if isinstance(value, str):
            return Cell(value, kind="num", sort=value)
        number: float = math.nan if value is None else value
        low, high = (row.get(f"{column.column}{end}") for end in ("_low", "_high"))
        if low is None or high is None:
            return Cell(column.number(number), kind="num", sort=_sortable(column.factor * number))
        written = write_interval(Interval(number, low, high), column, larger_half=self.compact)
        return Cell(written.value, written.error, "num", _sortable(number))

    def _text(self, column: Text, row: Row) -> Cell:
        value = row.get(column.column)
        name = "–" if value is None or value == "" else str(value)
        known = value is not None and value != ""
        cell = Cell(name, sort=name, link=column.link.format(**row) if column.link else "")
        placements, policies = self.palette.placements, self.palette.policies
        match column.kind:
            case "word":
                return cell._replace(kind=f"word {WORDS.get(name, 'open')}")
            case "scenario":
                return cell._replace(text=shown_scenario(name))
            case "placement" if known:
                return cell._replace(kind="name", colour=placements.get(name, MUTED))
            case "policy" if known:
                style = policies.get(name)
                colour, marker = (style.colour, style.marker) if style else (MUTED, CIRCLE)
                shown = shown_contender(name)
                return cell._replace(text=shown, kind="name", colour=colour, marker=marker)
            case "cell":
                return cell._replace(kind="cell")
            case _:
                return cell if known else cell._replace(sort="")


def _sortable(value: float) -> float | str:
    return "" if math.isnan(value) else value


def interval_row(values: Mapping[str, Interval]) -> dict[str, float | None]:
    """Return intervals as the columns of a row, without unknown ends."""
    found: dict[str, float | None] = {}
    for name, known in values.items():
        found[name] = known.value
        if known.known:
            found |= {f"{name}_low": known.low, f"{name}_high": known.high}
    return found


def table_text(table: Table, *, width: int | None = None) -> str:
    """Return a table as text: title, rows and caption.

    `width` is the width of the terminal in columns, or None for rows of any width; long cells fold.
    """
    from rich.console import Console
    from rich.table import Table as Grid

    groups = list(table.groups())
    headings = table.headings
    texts = {
        heading: [[f"{cell.text} {cell.error}".strip() for cell in row] for row in rows]
        for heading, rows in groups
    }
    widths = [
        max(len(headings[i]), *(len(row[i]) for rows in texts.values() for row in rows), 0)
        for i in range(len(headings))
    ]
    buffer = io.StringIO()
    console = Console(file=buffer, width=width or 10_000, color_system=None, highlight=False)
    for heading, rows in texts.items():
        grid = Grid(box=None, padding=(0, 2, 0, 0), pad_edge=False)
        for index, (column, least) in enumerate(zip(table.columns, widths, strict=True)):
            grid.add_column(
                headings[index],
                justify="left" if isinstance(column, Text) else "right",
                no_wrap=index == 0,
                overflow="fold",
                min_width=least if width is None else None,
            )
        for row in rows:
            grid.add_row(*row)
        if heading:
            console.print(heading)
        console.print(grid)
        console.print()
    lines = [line.rstrip() for line in buffer.getvalue().rstrip().splitlines()]
    head = [table.title, ""] if table.title else []
    prose = wrapped(table.caption, width)
    return "\n".join([*head, *lines, *([""] if prose else []), *prose]) + "\n"


def wrapped(text: str, width: int | None = None) -> list[str]:
    """Return a text as lines of at most `PROSE` columns, or `width` if that is less."""
    return textwrap.wrap(text, min(width or PROSE, PROSE), break_on_hyphens=False)
