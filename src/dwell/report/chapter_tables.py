"""Tables of a chapter as parts of a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from dwell.report.formatting import OURS, SYMBOL, Measure, Written
from dwell.report.page import Cell, marked, named, swatch, table
from dwell.report.palette import contended
from dwell.report.panels import floats
from dwell.report.style import CONTENDERS, PageStyle, key
from dwell.report.units import labelled, measure_of, write, write_over_seeds
from dwell.study import Interval
from dwell.study.chapter import Figure, Table, Unit

if TYPE_CHECKING:
    import polars as pl

__all__ = ["html", "noted"]

HEADINGS = {
    "violation_rate": "V_D",
    "l95_ms": "L95",
    "cost": "J",
    "u_robot": "U_r",
    "u_edge": "U_e",
}
#: Words that say how it came out, and how they are shown.
WORDS = {
    **dict.fromkeys(("under", "agrees", "met", "holds", "yes"), "good"),
    **dict.fromkeys(("over", "above", "differs", "missed", "no"), "bad"),
    **dict.fromkeys(
        ("open", "not shown", "in part", "agrees in part", "not asked"),
        "open",
    ),
}
# A table with more rows is folded away, a chapter's main table later than the others.
LONG, LONGEST = 24, 60
# A text that is longer may break into lines.
SHORT = 22
# Columns of a page from which on letters are smaller, and those from which on they are small.
SMALL, TIGHT = 8, 15
#: What is longer in the words of a study than a column has room for.
SHORTER = {"no difference shown": "not shown"}


class Column(NamedTuple):
    """A column as it is shown.

    Parameters
    ----------
    name : str
        In the frame.
    heading : str
        With its unit.
    unit : Unit
    interval : bool
        Whether the frame has an interval for any of its numbers.
    measure : Measure
        How its numbers are written.
    """

    name: str
    heading: str
    unit: Unit
    interval: bool
    measure: Measure


@dataclass(frozen=True, slots=True)
class Shown:
    """A table without its first column where that becomes the headings of groups.

    Parameters
    ----------
    columns : tuple of Column
    rows : list of dict
        The frame's.
    group : str
        Column of the groups; empty where there are none.
    """

    columns: tuple[Column, ...]
    rows: list[dict[str, object]]
    group: str

    @classmethod
    def of(cls, item: Table) -> Shown:
        """Find out what of a table is shown, and how."""
        names = [name for name in item.units if name in item.frame.columns]
        columns = tuple(_column(item, name) for name in names)
        group = columns[0].name if columns and _is_grouped(item.frame, columns) else ""
        rest = tuple(column for column in columns if column.name != group)
        return cls(rest, item.frame.to_dicts(), group)

    def lines(self) -> Iterator[tuple[object, dict[str, object]]]:
        """Yield every row with the group that begins with it, None where none does."""
        before: object = object()
        for row in self.rows:
            mine = row[self.group] if self.group else before
            yield (mine if self.group and mine != before else None), row
            before = mine


def html(item: Table, look: PageStyle, *, main: bool = False) -> str:
    """Return a table of a page: numbers with their intervals, long tables folded away.

    Parameters
    ----------
    item : Table
    look : PageStyle
    main : bool
        Whether it is what its chapter is about.
    """
    shown = Shown.of(item)
    head, width = [], 0
    for i, column in enumerate(shown.columns):
        text = marked(look.prose(column.heading))
        kind = "pair" if column.interval else "" if column.unit == "text" else "num"
        head.append(Cell(text, kind if i else "", 2 if column.interval else 1))
        width += 2 if column.interval else 1
    rows: list[tuple[str, Sequence[Cell]]] = []
    for group, row in shown.lines():
        if group is not None:
            rows.append(("group", [Cell(marked(look.titled(group)), columns=width)]))
        cells: list[Cell] = []
        for column in shown.columns:
            cells += _cells(row, column, look)
        rows.append(("", cells))
    note = noted(item, look)
    size = "wide of-chapter"
    size += f" {'tight' if width > TIGHT else 'small'}" if len(shown.columns) > SMALL else ""
    text = table(head, rows, kind=size)
    if len(shown.rows) > (LONGEST if main else LONG):
        text = f"<details><summary>{len(shown.rows)} rows</summary>\n{text}\n</details>"
    caption = f'<p class="note">{marked(note)}</p>' if note else ""
    return f"<h3>{marked(look.prose(item.title))}</h3>\n{caption}\n{text}"


def noted(item: Table | Figure, look: PageStyle) -> str:
    """Return what has to be known of a table or figure, and what ATP is where it is in it."""
    own = look.prose(item.note).strip()
    own += "" if not own or own.endswith((".", "!", "?")) else "."
    return f"{own} {OURS}".strip() if shows_atp(item) and OURS not in own else own


def shows_atp(item: Table | Figure) -> bool:
    """Whether ATP is in a table or figure: what shows it has to say what it is."""
    frame = item.frame
    texts = [name for name, kind in frame.schema.items() if not kind.is_numeric()]
    names = (str(value) for name in texts for value in frame[name].unique().drop_nulls())
    return any((known := contended(name)) is not None and known.family == "atp" for name in names)


def _column(item: Table, name: str) -> Column:
    unit = item.units[name]
    plain = name if SYMBOL.fullmatch(name) else name.replace("_", " ")
    heading = item.headings.get(name) or HEADINGS.get(name) or plain
    low = f"{name}_low"
    interval = unit != "text" and low in item.frame.columns and item.frame[low].is_not_null().any()
    values = floats(item.frame, name).tolist() if unit != "text" else []
    return Column(name, labelled(heading, unit), unit, interval, measure_of(unit, values))


def _is_grouped(frame: pl.DataFrame, columns: Sequence[Column]) -> bool:
    """Whether the first column names groups of rows: texts that repeat, row after row."""
    if len(columns) < 3 or columns[0].unit != "text" or columns[1].unit != "text":
        return False
    values = frame[columns[0].name].to_list()
    changes = sum(before != after for before, after in pairwise(values))
    once = changes + 1 == len(set(values))
    return len(values) > 3 and once and changes + 1 <= len(values) / 2


def _cells(row: dict[str, object], column: Column, look: PageStyle) -> list[Cell]:
    written = _written(row, column, look)
    if column.unit == "text":
        kind = "nowrap" if len(written.value) <= SHORT else "text"
        return [Cell(_text(row.get(column.name), column, look), kind)]
    number = Cell(escape(written.value), "num")
    return [number, Cell(escape(written.error), "err")] if column.interval else [number]


def _text(value: object, column: Column, look: PageStyle) -> str:
    """Return a text: a contender with its mark, a word that says how it came out in its colour."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    name = SHORTER.get(key(value), key(value))
    if name in WORDS:
        return f'<span class="{WORDS[name]} nowrap">{escape(name)}</span>'
    if name in look.placements:
        return swatch(look.placements[name]) + escape(name)
    if column.name in CONTENDERS and name in look.palette.policies:
        return named(look.shown(name), look.palette.policies[name].colour, ring=True)
    return marked(look.prose(look.shown(value)))


def _written(row: dict[str, object], column: Column, look: PageStyle) -> Written:
    value = row.get(column.name)
    if value is None:
        return Written("–", "")
    if isinstance(value, bool):
        return Written("yes" if value else "no", "")
    if column.unit == "text" or not isinstance(value, int | float):
        return Written(look.prose(look.shown(SHORTER.get(key(value), value))), "")
    low, high = row.get(f"{column.name}_low"), row.get(f"{column.name}_high")
    if isinstance(low, int | float) and isinstance(high, int | float):
        interval = Interval(value, low, high)
        return write_over_seeds(interval, column.unit, column.measure)
    return Written(write(value, column.unit, column.measure), "")
