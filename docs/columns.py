"""The tables of the page of columns, from their declarations: `python -m docs.columns`."""

from __future__ import annotations

from pathlib import Path

from dwell.model.table_columns import (
    GUARD,
    LOST,
    TABLES,
    UNCOMPARED,
    UNMEASURED,
    UNSEEN,
    UNTOLD,
    Column,
)
from dwell.record import OUTCOME_SENTENCES, REASON_SENTENCES

PAGE = Path(__file__).with_name("reference") / "columns.md"
#: Words for the usual reasons of null.
WORDS = {
    "guard": GUARD,
    "lost": LOST,
    "uncompared": UNCOMPARED,
    "uncounted": UNTOLD,
    "unmeasured": UNMEASURED,
    "unseen": UNSEEN,
}
#: Begin of the text that is not written by hand.
FIRST = "The last column has the reasons of null:"
HEAD = "| column | type | meaning | null |\n|---|---|---|---|\n"


def tables() -> str:
    """Return the tables of columns, outcomes and reasons."""
    legend = "; ".join(f"*{word}*: {reason}" for word, reason in WORDS.items())
    parts = [f"{FIRST} {legend}.\n"]
    for name, table in TABLES.items():
        kept = "; kept on request" if table.on_request else ""
        rows = "".join(map(_row, table.columns))
        parts.append(f"## {name}\n\nOne row is {table.sentence}{kept}.\n\n{HEAD}{rows}")
    outcomes = "".join(f"| `{name}` | {text} |\n" for name, text in OUTCOME_SENTENCES.items())
    reasons = "".join(f"| `{name}` | {text} |\n" for name, text in REASON_SENTENCES.items())
    parts.append(
        "## Outcomes and reasons\n\n| outcome | end of a cycle or a job |\n|---|---|\n"
        f"{outcomes}\n| reason | reason of a decision |\n|---|---|\n{reasons}"
    )
    return "\n".join(parts)


def _row(column: Column) -> str:
    name = column.name.replace("{", "<").replace("}", ">")
    tables = f" ({' or '.join(column.of)})" if column.of else ""
    null = column.null
    for word, reason in WORDS.items():
        null = null.replace(reason, f"*{word}*")
    kind = f"{column.kind}, {column.unit}" if column.unit else column.kind
    cells = (f"`{name}`{tables}", kind, column.sentence, null)
    return f"| {' | '.join(cells)} |\n"


def page() -> str:
    """Return the page."""
    text = PAGE.read_text(encoding="utf-8")
    return text[: text.index(FIRST)] + tables()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
