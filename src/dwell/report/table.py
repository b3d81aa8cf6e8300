"""Tables: rows and columns once, written as HTML, as text for a terminal, and as LaTeX."""

from __future__ import annotations

import io
import itertools
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from dwell.report.formatting import (
    Measure,
    shown_contender,
    shown_scenario,
    write_interval,
    write_number,
)
from dwell.report.palette import CIRCLE, MUTED, Palette
from dwell.study import Interval

Row: TypeAlias = "Mapping[str, Any]"
Columns: TypeAlias = "list[Text | Measure]"
Kind: TypeAlias = Literal["text", "cell", "policy", "placement", "scenario", "word"]

#: Width of sentences in text.
PROSE = 100
#: Rows of a table of what a run may have any number of.
MOST_ROWS = 200
#: What the words of verdicts mean for who waits for them; all others are open.
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

    Parameters
    ----------
    column : str
        Key of the rows.
    name : str
        Heading.
    kind : {"text", "cell", "policy", "placement", "scenario", "word"}
        A cell's name stays on one line. Other names are written as they are everywhere and have
        their colour; words of verdicts are marked (see `WORDS`).
    link : str
        Where a cell leads to, a format of the row: ``#window-{window}``.
    """

    column: str
    name: str
    kind: Kind = "text"
    link: str = ""


class Cell(NamedTuple):
    """A cell as it is written.

    Parameters
    ----------
    error : str
        Error of the number, as text.
    kind : str
        ``num``, or the kind of a `Text`; of a word what it means.
    sort : float or str
        By which rows are sorted.
    colour : str
        Colour of the mark before a name.
    marker : str
        Shape of that mark, as in figures.
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

    Parameters
    ----------
    slug : str
        Its name in files and links.
    columns : sequence of Text or Measure
        Numbers have an interval where a row has the ends of one (``NAME_low``, ``NAME_high``).
    rows : sequence of mapping of str to value
        By the names of columns; None, NaN or nothing where nothing is known.
    group : Text, optional
        Rows of equal values in this column, which follow each other, stand under one heading.
    caption : str
        Plain text.
    palette : Palette, optional
        Colours of policies and placements.
    compact : bool
        Whether ``±`` stands before the larger half of an interval however much they differ: for
        terminals.
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
        """Yield every group's heading, empty without groups, and the cells of its rows."""
        group, columns = self.group, [self._sized(column) for column in self.columns]
        for heading, rows in itertools.groupby(
            self.rows, lambda row: "" if group is None else self._text(group, row).text
        ):
            yield heading, [[self._cell(column, row) for column in columns] for row in rows]

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
        number = math.nan if value is None else float(value)
        low, high = (row.get(f"{column.column}{end}") for end in ("_low", "_high"))
        if low is None or high is None:
            shown = column.factor * number
            text = write_number(shown, column.decimals, signed=column.signed) if shown else "0"
            return Cell(text, kind="num", sort=_sortable(shown))
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
    """Return intervals as the columns of a row; ends that are not known are left out."""
    found: dict[str, float | None] = {}
    for name, known in values.items():
        found[name] = known.value
        if known.known:
            found |= {f"{name}_low": known.low, f"{name}_high": known.high}
    return found


def table_text(table: Table, *, width: int | None = None) -> str:
    """Return a table as text: its title, a line a row, its caption.

    Parameters
    ----------
    width : int, optional
        Columns of the terminal: cells fold where they are too few. As wide as it takes where None.
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
    """Return a sentence as lines of at most `PROSE` columns, and of the terminal's where given."""
    return textwrap.wrap(text, min(width or PROSE, PROSE), break_on_hyphens=False)
