"""Schema of a Run, made from the columns that `dwell.model.table_columns` declares.

`column_types` returns the types of a table's columns for one cell, `json_schema` the JSON Schema of
a row. `row_of` and `frame_of` take values by column name and return a row of a journal or a table.
To add a column, declare it in `table_columns` and add its value to the code that fills the table.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, cast, get_args

from dwell.errors import RunError
from dwell.model import REASONS, Problem, Reason
from dwell.model.instants import NEVER_NS
from dwell.model.table_columns import TABLES, Column, Feature, columns_of, those_with
from dwell.record.table_arrays import Names

if TYPE_CHECKING:
    import polars as pl

#: Version of the folders of runs and fleets; Dwell reads this version only.
SCHEMA_VERSION = 3

#: Outcomes of a cycle or a job, in the order of the kernels' codes.
OUTCOMES = ("in_flight", "done", "dropped", "replaced", "node_down", "not_applied", "idle")
OUTCOME_SENTENCES: Mapping[str, str] = {
    "done": "it was completed",
    "dropped": "a message or an input was lost",
    "replaced": "a newer one took its place",
    "node_down": "a node was down",
    "not_applied": "its command was ready, and the actuator raised",
    "in_flight": "unfinished at the end",
    "idle": "no sink was due",
}
#: Explanation of each reason of a decision.
REASON_SENTENCES: Mapping[Reason, str] = {
    "dwell": "too soon after the last migration",
    "hold": "no other placement promised enough",
    "migrate": "another placement promised more than the least improvement",
    "capped": "the cheapest placement within the caps; a cheaper one was over a cap",
    "infeasible": "all candidates are over a cap, this one least",
    "guard": "the robot moved by itself",
    "pinned": "an operator pinned the cell to this placement",
    "drained": "an operator drained a node of the placement before",
    "ordered": "another controller, or an order without an answer, moved the cell",
}


def shown_reason(reason: str) -> str:
    """Return the reason of a decision as pages and the terminal show it."""
    return REASON_SENTENCES["infeasible"] if reason == "infeasible" else reason


#: Polars types and their names in JSON Schema; names become an enumeration.
JSON_TYPES: Mapping[str, str] = {
    "Int64": "integer",
    "Float64": "number",
    "Boolean": "boolean",
    "String": "string",
}

#: Types of a table's columns: the name of a Polars type, or the categories of an Enum.
Types: TypeAlias = Mapping[str, str | Sequence[str]]
#: Types of the columns, by table.
Columns: TypeAlias = Mapping[str, Types]
Row: TypeAlias = tuple[object, ...]
#: Values of a row by column.
Values: TypeAlias = Mapping[str, object]


def require_version(written: Mapping[str, Any], source: str = "") -> None:
    """Refuse the record of a run or fleet with another version of the schema.

    Raises
    ------
    RunError
        If the version differs; the message begins with `source`.
    """
    version = written.get("schema_version")
    if version != SCHEMA_VERSION:
        raise RunError(
            f"{source}schema_version is {version!r}; this version of Dwell reads "
            f"{SCHEMA_VERSION} only: make the run again"
        )


def column_types(table: str, problem: Problem, features: Collection[Feature] = ()) -> Types:
    """Return the types of a table's columns, in the order of the columns.

    Parameters
    ----------
    table : str
        One of `TABLES`.
    problem : Problem
        The cell, whose nodes, tasks and candidates appear in names and types.
    features : collection of {"live", "shadows", "support"}
        Features of the run.
    """
    return {name: kind for name, _, kind in _columns(table, problem, features)}


def json_schema(table: str, problem: Problem, columns: Collection[str]) -> dict[str, Any]:
    """Return the JSON Schema of a table's rows as objects.

    The JSON object of a row omits null and infinite values.

    Parameters
    ----------
    table : str
        One of `TABLES`.
    columns : collection of str
        Columns of the table; undeclared columns are ignored.
    """
    properties = {}
    for name, column, kind in _columns(table, problem, get_args(Feature)):
        if name in columns:
            typed: dict[str, Any] = {"type": "string", "enum": kind}
            if isinstance(kind, str):
                typed = {"type": JSON_TYPES[kind]}
            absent = column.null and f" Absent: {column.null}."
            unit = column.unit and f" Unit: {column.unit}."
            properties[name] = {**typed, "description": f"{column.sentence}{unit}{absent}"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "description": f"One row is {TABLES[table].sentence}.",
        "type": "object",
        "properties": properties,
    }


def _columns(
    table: str, problem: Problem, features: Collection[Feature]
) -> Iterator[tuple[str, Column, str | list[str]]]:
    """Yield the name, declaration and type of every column, in the order of the table."""
    names: dict[str, list[str]] = {
        "candidate": list(problem.candidates),
        "node": list(problem.fabric.nodes),
        "task": list(problem.pipeline.tasks),
        "outcome": list(OUTCOMES),
        "reason": list(REASONS),
    }
    resources = problem.fabric.resources.values()
    for column in those_with(features, TABLES[table].columns):
        kind: str | list[str] = names.get(column.kind) or column.kind
        for one in columns_of(column.name, resources, names["candidate"], problem.pipeline.chains):
            yield one.name, column, kind


def require_table(table: str, problem: Problem, frame: pl.DataFrame, source: str) -> None:
    """Check that a table has its required columns, with values of the declared types.

    Raises
    ------
    RunError
        If a column is missing or has invalid values; the message begins with `source`.
    """
    import polars as pl

    needed = column_types(table, problem)
    for name, column, kind in _columns(table, problem, get_args(Feature)):
        if name not in frame.columns:
            if name in needed and not column.is_new:
                raise RunError(f"{source}: lacks the column {name!r}")
            continue
        series, names = frame[name], None if isinstance(kind, str) else kind
        wanted = (pl.String, pl.Enum) if names or kind == "String" else (getattr(pl, str(kind)),)
        if not isinstance(series.dtype, wanted):
            raise RunError(f"{source}: column {name!r} has the type {series.dtype}")
        if not column.null and series.null_count():
            raise RunError(f"{source}: column {name!r} lacks values")
        least = series.min() if series.dtype == pl.Int64 and table != "jobs" else 0
        if isinstance(least, int) and least < 0:
            raise RunError(f"{source}: column {name!r} has {least}, which is negative")
        if names and (unknown := sorted({*series.drop_nulls().cast(pl.String)} - {*names})):
            raise RunError(f"{source}: column {name!r} has {unknown[0]!r}, which the cell has not")
    index = next(iter(needed))
    if table in ("cycles", "windows") and not (frame[index].diff().drop_nulls() > 0).all():
        raise RunError(f"{source}: column {index!r} does not grow")


def row_of(types: Types, values: Values) -> Row:
    """Return values in the order of a table's columns.

    Parameters
    ----------
    types : mapping of str to str, or to the names of an Enum
        Types of the table's columns.
    values : mapping of str to object
        Values by column.

    Raises
    ------
    ValueError
        If the names of the columns and of the values differ.
    """
    _require_columns(types, values)
    return tuple(values[name] for name in types)


def frame_of(
    table: str, problem: Problem, values: Mapping[str, object], features: Collection[Feature] = ()
) -> pl.DataFrame:
    """Return a table; NaN and `NEVER_NS` become null in columns that may be null.

    Parameters
    ----------
    table : str
        One of `TABLES`.
    values : mapping of str to sequence, array, Series or `Names`
        Values by column, all of the same length.
    features : collection of {"live", "shadows", "support"}
        Features of the run.

    Raises
    ------
    ValueError
        If the names of the columns and of the values differ.
    """
    import polars as pl

    types, nullable = {}, set()
    for name, column, kind in _columns(table, problem, features):
        types[name] = kind
        if column.null:
            nullable.add(name)
    _require_columns(types, values)
    # Cast column by column: one query over all columns is slower than that for a short table.
    made = []
    for name, dtype in polars_schema(types).items():
        series = _series(name, values[name], dtype, nullable=name in nullable)
        made.append(series if series.dtype == dtype else series.cast(dtype))
    return pl.DataFrame(made)


def _series(name: str, values: object, dtype: pl.DataType, *, nullable: bool) -> pl.Series:
    import numpy as np
    import polars as pl

    if isinstance(values, Names):
        return pl.Series(name, values.known, pl.Enum(values.known))[values.places]
    given = cast("Iterable[object]", values)
    if nullable and dtype == pl.Float64():
        return pl.Series(name, np.asarray(given, np.float64), nan_to_null=True)
    series = pl.Series(name, given)
    if nullable and isinstance(values, np.ndarray) and dtype == pl.Int64():
        never = values >= NEVER_NS
        return series.set(pl.Series(never), None) if never.any() else series
    return series


def polars_schema(types: Types) -> dict[str, pl.DataType]:
    """Return the Polars data types of columns."""
    import polars as pl

    # Make each Enum once: most columns share one, and an Enum is slow to make.
    enums = {id(kind): kind for kind in types.values() if not isinstance(kind, str)}
    made = {key: pl.Enum(names) for key, names in enums.items()}
    return {
        name: getattr(pl, kind)() if isinstance(kind, str) else made[id(kind)]
        for name, kind in types.items()
    }


def _require_columns(types: Types, values: Mapping[str, object]) -> None:
    if types.keys() != values.keys():
        missing = ", ".join(name for name in types if name not in values) or "none"
        unknown = ", ".join(name for name in values if name not in types) or "none"
        raise ValueError(f"columns without values: {missing}; values without columns: {unknown}")
