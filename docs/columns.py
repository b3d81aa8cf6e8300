"""The page of columns, from their declarations: `python -m docs.columns` writes it."""

from __future__ import annotations

from pathlib import Path

from dwell.model.table_columns import TABLES, Column
from dwell.record import OUTCOME_SENTENCES, REASON_SENTENCES

PAGE = Path(__file__).with_name("reference") / "columns.md"
TEXT = """# Which columns does a run have?

A run has the tables `run.cycles`, `run.windows` and `run.decisions`, and on request `run.jobs` and
`run.processes`; its folder has them as Parquet files. `<resource>` and `<candidate>` are names: a
resource is a node, for its CPU, or `<node>.<kind>`, such as `E.gpu`, for accelerators of a kind.
A word in brackets marks columns of some runs only: *live* runs; runs with *shadows* (an estimator
that sends them, or live fallbacks); runs whose estimator states its *support*; runs with decisions
*between* the ends of windows. An empty last column: never null. [Concepts](../concepts.md) defines
the words.

Folders have the version 3 (`schema_version`); other versions are refused. `run.meta` is the content
of `run.json`; `run.problem` the cell, from there (traces by name, without their data);
`run.disturbances` the changes of nodes and links: as measured if the run has them, else from its
scenario. `python -m docs.columns` writes this page.

"""
HEAD = """\
| column | type | unit | meaning | null |
|---|---|---|---|---|
"""


def page() -> str:
    """Return the page."""
    parts = []
    for name, table in TABLES.items():
        request = "; kept on request" if table.on_request else ""
        rows = "".join(map(row, table.columns))
        parts.append(f"## {name}\n\nOne row is {table.sentence}{request}.\n\n{HEAD}{rows}")
    outcomes = "".join(f"| `{name}` | {text} |\n" for name, text in OUTCOME_SENTENCES.items())
    reasons = "".join(f"| `{name}` | {text} |\n" for name, text in REASON_SENTENCES.items())
    parts.append(
        "## Outcomes and reasons\n\n| outcome | a cycle or a job |\n|---|---|\n"
        f"{outcomes}\n| reason | meaning of a decision |\n|---|---|\n{reasons}"
    )
    return TEXT + "\n".join(parts)


def row(column: Column) -> str:
    """Return the row of a column."""
    name = column.name.replace("{", "<").replace("}", ">")
    of = f" ({' or '.join(column.of)})" if column.of else ""
    return f"| `{name}`{of} | {column.kind} | {column.unit} | {column.sentence} | {column.null} |\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
