"""The schema of a Run: every column of every table, declared once.

A `Column` says what a column is called, what it holds, in which unit, and when it is null.
`column_types` gives the types of a table's columns for one cell, `row_of` and `frame_of` bring
values that go by the columns' names into their order, as a row of a journal or as a table. A new
column is a declaration here and a value, of its name, where it is computed.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from dwell.model import REASONS, Problem, Reason

if TYPE_CHECKING:
    import polars as pl

SCHEMA_VERSION = 1

#: What became of a cycle or a job. Their order is that of the kernels' codes.
OUTCOMES = ("in_flight", "done", "dropped", "replaced", "node_down")
OUTCOME_SENTENCES: Mapping[str, str] = {
    "done": "it was completed",
    "dropped": "a message or an input was lost",
    "replaced": "a newer one took its place",
    "node_down": "a node was down",
    "in_flight": "unfinished at the end",
}
#: Why it was decided so, by the rule that made the decision.
REASON_SENTENCES: Mapping[Reason, str] = {
    "dwell": "too soon after the last migration",
    "hold": "no other placement promised enough",
    "migrate": "another placement promised more than the least improvement",
    "capped": "the cheapest placement within the caps; a cheaper one was over a cap",
    "infeasible": "every placement was over a cap, and those nearest to it were compared",
    "guard": "the robot moved by itself",
}

#: Types of a table's columns: a name of Polars', or the categories of an Enum.
Types: TypeAlias = Mapping[str, str | Sequence[str]]
#: Those of every table.
Columns: TypeAlias = Mapping[str, Types]
Row: TypeAlias = tuple[object, ...]
#: Values of a row by column.
Values: TypeAlias = Mapping[str, object]

#: What a column holds: a number, a truth value, a text, or a name of the cell's.
Kind: TypeAlias = Literal[
    "Int64", "Float64", "Boolean", "String", "candidate", "node", "task", "outcome", "reason"
]
#: What a run has that not every run has: `live` processes; cycles that may be sent through
#: alternatives, too (`shadows`); an estimator that says what stands behind its estimates
#: (`support`).
Feature: TypeAlias = Literal["live", "shadows", "support"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table, or one for each node or candidate.

    Parameters
    ----------
    name : str
        With ``{node}`` and ``{candidate}`` where there is one for each.
    kind : str
        A type of Polars', or what its names are names of.
    sentence : str
        Meaning of the column.
    unit : str
        Unit of a number; empty for a count, a share and a bare number.
    null : str
        When it is null; empty where it never is. NaN is null there, too.
    of : tuple of {"live", "shadows", "support"}
        Runs that have it: those with one of these; all where empty.
    """

    name: str
    kind: Kind
    sentence: str
    unit: str = ""
    null: str = ""
    of: tuple[Feature, ...] = ()


@dataclass(frozen=True, slots=True)
class TableSchema:
    """A table of a Run.

    Parameters
    ----------
    sentence : str
        Meaning of a row.
    columns : tuple of tuple of Column
        In their order; one for each node and candidate goes through the candidates of a node first.
    numbered : bool
        Whether its first column numbers the rows; a row that comes again replaces the one before.
    on_request : bool
        Whether a run has it only where it was asked for.
    """

    sentence: str
    columns: tuple[Column, ...]
    numbered: bool = False
    on_request: bool = False


LOST = "no sink completed the cycle"
UNCOMPARED = "the clocks were not compared"
APART = f"{LOST}, or {UNCOMPARED}"
UNSEEN = "the controller did not see the close"
GUARD = "a move of the guard's own"
UNTOLD = "not counted"
LIVE: tuple[Feature, ...] = ("live",)
SHADOWS: tuple[Feature, ...] = ("shadows",)
SUPPORT: tuple[Feature, ...] = ("support",)

CYCLES = (
    Column("cycle", "Int64", "Number of the cycle, from 0 without gaps."),
    Column("release_ns", "Int64", "Its release, since the beginning of the run.", "ns"),
    Column("placement", "candidate", "The candidate that it was stamped with."),
    Column("latency_ns", "Int64", "Release to completion of the last sink.", "ns", LOST),
    Column(
        "missed",
        "Boolean",
        "Later than D, or unfinished when its window closed, which is no earlier.",
    ),
    Column("outcome", "outcome", "What became of it."),
    Column("compute_ns", "Int64", "Part of the latency: execution.", "ns", APART),
    Column("queue_ns", "Int64", "Part of the latency: waiting.", "ns", APART),
    Column("network_ns", "Int64", "Part of the latency: links.", "ns", APART),
    Column("run", "Int64", "Id of the run, as stamped.", of=LIVE),
    Column("number", "Int64", "Number of the cycle, as stamped.", of=LIVE),
    Column("term", "Int64", "Term of the order, as stamped.", of=LIVE),
    Column("lead", "Boolean", "Whether it belongs to no window.", of=LIVE),
    Column("heard", "Boolean", "False where it is known by its neighbours only.", of=LIVE),
    Column("actuated", "Boolean", "Whether all its commands were applied.", of=LIVE),
    Column(
        "interval_ns",
        "Int64",
        "From its stamp to its last completion, as both arrived at the controller: one clock "
        "alone, but with what the two messages' ways differ by.",
        "ns",
        "one of them was not heard",
        LIVE,
    ),
    Column(
        "stamper_interval_ns",
        "Int64",
        "From its release to the arrival of its last completion at the stamper, less half the "
        "best round trip to the sink's node: the stamper's clock alone, with what the completion "
        "was late.",
        "ns",
        "it came over the detour, or not at all",
        LIVE,
    ),
    Column(
        "bound_ns",
        "Int64",
        "Bound of the error of its latency, by the clocks.",
        "ns",
        UNCOMPARED,
        LIVE,
    ),
)
WINDOWS = (
    Column("window", "Int64", "Number of the window, from 0."),
    Column("first_cycle", "Int64", "Its first cycle."),
    Column("warmup", "Boolean", "Whether statistics leave it out."),
    Column("placement", "candidate", "The candidate of its first cycle."),
    Column("mixed", "Boolean", "Whether its cycles had more than one placement."),
    Column("l95_ms", "Float64", "L95 of final latencies; infinite of a lost cycle.", "ms"),
    Column("violation_rate", "Float64", "V_D: share of its cycles that missed."),
    Column("seen_l95_ms", "Float64", "L95 as seen at the close.", "ms", UNSEEN),
    Column("seen_violation_rate", "Float64", "V_D as seen at the close.", null=UNSEEN),
    Column("u_{node}", "Float64", "Utilisation of a node, foreign work included."),
    Column("cost", "Float64", "J of what was seen.", null=UNSEEN),
    Column("shadow_cycles", "Int64", "Cycles that were sent twice.", of=SHADOWS),
    Column("shadow_bytes", "Int64", "What their shadows put on links.", "bytes", of=SHADOWS),
    Column("shadow_{node}", "Float64", "Share of a node's cores for shadows.", of=SHADOWS),
    Column("term", "Int64", "Term of its last cycle.", of=LIVE),
    Column("lead", "Int64", "Cycles before it that belong to no window.", of=LIVE),
    Column("heard", "Int64", "Cycles of which anything was heard.", of=LIVE),
    Column("bound_ms", "Float64", "The largest bound of its cycles.", "ms", UNCOMPARED, LIVE),
    Column("unproven", "Boolean", "Whether that is over 20 % of D.", of=LIVE),
    Column("closed_unix_ns", "Int64", "Time of day of its close.", "ns", of=LIVE),
)
DECISIONS = (
    Column("window", "Int64", "The window that it was made on."),
    Column("incumbent", "candidate", "The placement before."),
    Column("placement", "candidate", "The placement after."),
    Column("migrated", "Boolean", "Whether they differ."),
    Column("reason", "reason", "Which rule made it."),
    Column("dwell", "Int64", "n_d after it: windows since the last migration."),
    Column(
        "delta_j",
        "Float64",
        "Measured J of the incumbent less the estimated J of the best candidate.",
        null="the policy computes none",
    ),
    Column(
        "j_{candidate}",
        "Float64",
        "Estimated J of a candidate against the incumbent.",
        null="the policy prices none",
    ),
    Column("est_l95_ms_{candidate}", "Float64", "Its estimated L95.", "ms", GUARD),
    Column("est_violation_rate_{candidate}", "Float64", "Its estimated V_D.", null=GUARD),
    Column(
        "est_u_{node}_{candidate}", "Float64", "Its estimated utilisation of a node.", null=GUARD
    ),
    Column("eligible_{candidate}", "Boolean", "Whether it is within the caps.", null=GUARD),
    Column(
        "excess_{candidate}",
        "Float64",
        "Its largest value / cap − 1; ∞ where its L95 is lost, and has a cap.",
        null=f"{GUARD}, or no caps",
    ),
    Column(
        "est_samples_{candidate}", "Float64", "Samples behind its estimate.", null=GUARD, of=SUPPORT
    ),
    Column(
        "est_age_windows_{candidate}",
        "Float64",
        "Age of the newest of them.",
        "windows",
        GUARD,
        SUPPORT,
    ),
    Column(
        "refused",
        "String",
        "What was decided and not done, and why: `migrated` is false then, `placement` the old "
        "one, and `reason` the policy's.",
        null="what was decided was done",
        of=LIVE,
    ),
)
JOBS = (
    Column("cycle", "Int64", "Its cycle."),
    Column("task", "task", "Its task."),
    Column("node", "node", "Where it ran."),
    Column("ready_ns", "Int64", "When it became ready, as `release_ns`.", "ns"),
    Column("start_ns", "Int64", "When it started.", "ns", "it did not"),
    Column(
        "end_ns",
        "Int64",
        "When it completed, or was lost.",
        "ns",
        "neither by the end of the run, or it was replaced in a live one",
    ),
    Column("outcome", "outcome", "What became of it."),
    Column("shadow", "Boolean", "Whether it is a shadow's.", of=("live", "shadows")),
    Column(
        "cpu_ns",
        "Int64",
        "CPU time from its start until the stage's `process()` has returned, reading the inputs "
        "included.",
        "ns",
        UNTOLD,
        LIVE,
    ),
    Column(
        "others_ns",
        "Int64",
        "CPU time of all other processes of its node meanwhile.",
        "ns",
        UNTOLD,
        LIVE,
    ),
    Column(
        "outside_ns",
        "Int64",
        "CPU time of everybody else on its node's CPUs meanwhile.",
        "ns",
        UNTOLD,
        LIVE,
    ),
    Column(
        "handover_ns",
        "Int64",
        "CPU time of its node between a release, or the end of the job before on the same node, "
        "and its start.",
        "ns",
        UNTOLD,
        LIVE,
    ),
    Column(
        "ending_ns",
        "Int64",
        "CPU time of its node between the end of a sink's and the hand-over of its command.",
        "ns",
        UNTOLD,
        LIVE,
    ),
)
PROCESSES = (
    Column("window", "Int64", "The window."),
    Column("process", "String", "Name of the process."),
    Column("node", "node", "Its node."),
    Column(
        "cpu_ns",
        "Int64",
        "CPU time that it took from the release of the window's first cycle to its close.",
        "ns",
    ),
)

TABLES: Mapping[str, TableSchema] = {
    "cycles": TableSchema("a cycle", CYCLES, numbered=True),
    "windows": TableSchema("a window", WINDOWS, numbered=True),
    "decisions": TableSchema("a decision, or a move of the guard", DECISIONS),
    "jobs": TableSchema("a job that is known to have become ready", JOBS, on_request=True),
    "processes": TableSchema("a window and a process of a live cell", PROCESSES, on_request=True),
}


def column_types(table: str, problem: Problem, features: Collection[Feature] = ()) -> Types:
    """Return the types of a table's columns, in their order.

    Parameters
    ----------
    table : str
        One of `TABLES`.
    problem : Problem
        Its nodes, tasks and candidates.
    features : collection of {"live", "shadows", "support"}
        Features of the run.
    """
    return {name: kind for name, _, kind in _columns(table, problem, features)}


def _columns(
    table: str, problem: Problem, features: Collection[Feature]
) -> Iterator[tuple[str, Column, str | list[str]]]:
    """Yield name, declaration and type of every column, in the order of nodes, then candidates."""
    names: dict[str, list[str]] = {
        "candidate": list(problem.candidates),
        "node": list(problem.fabric.nodes),
        "task": list(problem.pipeline.tasks),
        "outcome": list(OUTCOMES),
        "reason": list(REASONS),
    }
    for column in TABLES[table].columns:
        if column.of and set(column.of).isdisjoint(features):
            continue
        kind: str | list[str] = names.get(column.kind) or column.kind
        nodes = names["node"] if "{node}" in column.name else [""]
        candidates = names["candidate"] if "{candidate}" in column.name else [""]
        for node, candidate in itertools.product(nodes, candidates):
            yield column.name.format(node=node, candidate=candidate), column, kind


def row_of(types: Types, values: Values) -> Row:
    """Return values in the order of a table's columns.

    Parameters
    ----------
    types : mapping of str to str, or to the names of an Enum
        Types of the table's columns.
    values : mapping of str to object
        By column.

    Raises
    ------
    ValueError
        If a column has no value, or a value no column.
    """
    _require_columns(types, values)
    return tuple(values[name] for name in types)


def frame_of(
    table: str, problem: Problem, values: Mapping[str, object], features: Collection[Feature] = ()
) -> pl.DataFrame:
    """Return a table; NaN of a column that may be null is null.

    Parameters
    ----------
    table : str
        One of `TABLES`.
    values : mapping of str to sequence, array or Series
        By column; all of one length.
    features : collection of {"live", "shadows", "support"}
        Features of the run.

    Raises
    ------
    ValueError
        If a column has no values, or values no column.
    """
    import polars as pl

    types, nullable = {}, []
    for name, column, kind in _columns(table, problem, features):
        types[name] = kind
        if kind == "Float64" and column.null:
            nullable.append(name)
    _require_columns(types, values)
    frame = pl.DataFrame({name: values[name] for name in types})
    had = frame.schema
    other = {name: dtype for name, dtype in polars_schema(types).items() if had[name] != dtype}
    if other:
        frame = frame.with_columns(pl.col(name).cast(dtype) for name, dtype in other.items())
    return frame.with_columns(pl.col(nullable).fill_nan(None)) if nullable else frame


def polars_schema(types: Types) -> dict[str, pl.DataType]:
    """Return types as Polars has them."""
    import polars as pl

    # Most Enums of a table are of the same names, and each is costly to make.
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
