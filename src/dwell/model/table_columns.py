"""Declarations of the columns of all tables.

A `Column` declares name, type, unit and the meaning of null. A table may have a column for each
resource, each candidate, each pair of them, or each chain; `clash_faults` finds equal names among
them.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple, TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.fabric import Resource

#: Type of a column: a number, a truth value, a text, or a name of the cell.
Kind: TypeAlias = Literal[
    "Int64", "Float64", "Boolean", "String", "candidate", "node", "task", "outcome", "reason"
]
#: Optional features of a run: `live` processes; shadows through alternatives (`shadows`); an
#: estimator that reports samples and age of its estimates (`support`); a cell of a `fleet`;
#: decisions between the ends of windows (`between`); a weighed `age`; a `price` of bytes;
#: a cap on `misses`; a `chain` in place of the latency; candidates with two copies (`replicas`).
Feature: TypeAlias = Literal[
    "live",
    "shadows",
    "support",
    "fleet",
    "between",
    "age",
    "price",
    "misses",
    "chain",
    "replicas",
]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table, or one for each resource, candidate or chain.

    Parameters
    ----------
    name : str
        With ``{resource}``, ``{candidate}`` or ``{chain}`` for a column per resource, candidate
        or chain.
    kind : str
        A type of Polars, or the kind of its names.
    sentence : str
        Meaning of the column.
    unit : str
        Unit of a number; empty for a count, a share and a bare number.
    null : str
        When it is null, or NaN; empty if it never is.
    of : tuple of `Feature`
        Features of which a run needs at least one to have the column; empty for all runs.
    is_new : bool
        Whether a run of this version of the schema may lack it.
    """

    name: str
    kind: Kind
    sentence: str
    unit: str = ""
    null: str = ""
    of: tuple[Feature, ...] = ()
    is_new: bool = False


@dataclass(frozen=True, slots=True)
class TableSchema:
    """A table of a Run.

    Parameters
    ----------
    sentence : str
        Meaning of a row.
    columns : tuple of tuple of Column
        In their order; a column per resource and candidate is ordered by resource first.
    numbered : bool
        Whether its first column numbers the rows; a repeated row replaces the earlier row.
    on_request : bool
        Whether a run has it only on request.
    """

    sentence: str
    columns: tuple[Column, ...]
    numbered: bool = False
    on_request: bool = False


LOST = "no sink completed the cycle"
UNCOMPARED = "the clocks were not compared"
APART = f"{LOST}, or {UNCOMPARED}"
UNSEEN = "the controller did not see the close"
GUARD = "a move of the guard or of an operator"
UNMEASURED = "an accelerator of a live cell that was not measured"
UNTOLD = "not counted"
LIVE: tuple[Feature, ...] = ("live",)
SHADOWS: tuple[Feature, ...] = ("shadows",)
REPLICAS: tuple[Feature, ...] = ("replicas",)
SUPPORT: tuple[Feature, ...] = ("support",)
FLEET: tuple[Feature, ...] = ("fleet",)
BETWEEN: tuple[Feature, ...] = ("between",)
AGE: tuple[Feature, ...] = ("age",)
PRICE: tuple[Feature, ...] = ("price",)
MISSES: tuple[Feature, ...] = ("misses",)
CHAIN: tuple[Feature, ...] = ("chain",)
UNACTUATED = "the chain did not actuate in the cycle"
UNASKED = "the ledger was not asked"

#: Columns of a study's tables with names in them: share of the windows that began under a
#: candidate, mean utilisation of a resource.
SHARE_OF, USE_OF = "share_{candidate}", "node_{resource}"
#: Columns of chains: L95 of the data age, share over its bound, and L95 of the reaction time.
OF_CHAINS = AGE_OF, OVER_AGE_OF, REACTION_OF = (
    "age_l95_{chain}",
    "age_missed_{chain}",
    "reaction_l95_{chain}",
)

CYCLES = (
    Column("cycle", "Int64", "Number of the cycle, from 0 without gaps."),
    Column("release_ns", "Int64", "Its release, since the beginning of the run.", "ns"),
    Column("placement", "candidate", "The candidate that it was stamped with."),
    Column("latency_ns", "Int64", "Release to completion of the last sink.", "ns", LOST),
    Column(
        "missed",
        "Boolean",
        "Later than D, or unfinished when its window closed; or its data were over the "
        "`max_age_ms` of a chain; or its command was not applied. False if a live run's controller "
        "could not know of it, or after the last window of a simulated run.",
    ),
    Column("outcome", "outcome", "Its end."),
    Column("compute_ns", "Int64", "Part of the latency: execution.", "ns", APART),
    Column("queue_ns", "Int64", "Part of the latency: waiting.", "ns", APART),
    Column("network_ns", "Int64", "Part of the latency: links.", "ns", APART),
    Column("lead", "Boolean", "Whether it belongs to no window."),
    Column(
        "chain_latency_ns",
        "Int64",
        "Release to the actuation of the chain `objective.latency`.",
        "ns",
        UNACTUATED,
        CHAIN,
    ),
    Column("chain_age_ns", "Int64", "Data age at this actuation.", "ns", UNACTUATED, CHAIN),
    Column("run", "Int64", "Id of the run, as stamped.", of=LIVE),
    Column("number", "Int64", "Number of the cycle, as stamped.", of=LIVE),
    Column("term", "Int64", "Term of the order, as stamped.", of=LIVE),
    Column("heard", "Boolean", "False if it is known only from neighbouring cycles.", of=LIVE),
    Column("actuated", "Boolean", "Whether all its commands were applied.", of=LIVE),
    Column(
        "interval_ns",
        "Int64",
        "From the arrival of its stamp at the controller to the arrival of its last completion, "
        "by one clock; the two messages' delays may differ.",
        "ns",
        "one of them did not arrive",
        LIVE,
    ),
    Column(
        "stamper_interval_ns",
        "Int64",
        "From its release to the arrival of its last completion at the stamper, less half the "
        "best round trip to the sink's node, by the stamper's clock; includes the completion's "
        "extra delay.",
        "ns",
        "it arrived through the relay, or not at all",
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
    Column(
        "u_{resource}",
        "Float64",
        "Utilisation of a resource, foreign work included.",
        null=UNMEASURED,
    ),
    Column("seen_age_ms", "Float64", "Mean age up to the close, as in J.", "ms", UNSEEN, AGE),
    Column(
        "seen_price_per_hour",
        "Float64",
        "Price of the bytes that links transmitted up to the close, money per hour.",
        null=f"{UNSEEN}, or a live cell",
        of=PRICE,
    ),
    Column("cost", "Float64", "J of the observed QoS.", null=UNSEEN),
    Column(
        AGE_OF,
        "Float64",
        "L95 of a chain's data age over the actuations of its cycles; infinite without any.",
        "ms",
    ),
    Column(
        OVER_AGE_OF,
        "Float64",
        "Share of these actuations whose age is over `max_age_ms`; 1 without any.",
    ),
    Column(
        REACTION_OF,
        "Float64",
        "L95 of the reaction times of a chain that end at these actuations; infinite without any.",
        "ms",
    ),
    Column("overtaken", "Int64", "Its cycles that completed after a later cycle.", is_new=True),
    Column(
        "late_copies",
        "Int64",
        "Messages of its cycles that were dropped, because those of the other copy came first.",
        of=REPLICAS,
    ),
    Column("shadow_cycles", "Int64", "Cycles that were sent twice.", of=SHADOWS),
    Column("shadow_bytes", "Int64", "Bytes of shadows on links.", "bytes", of=SHADOWS),
    Column(
        "shadow_{resource}",
        "Float64",
        "Share of a resource for shadows.",
        null=UNMEASURED,
        of=SHADOWS,
    ),
    Column("term", "Int64", "Term of its last cycle.", of=LIVE),
    Column("lead", "Int64", "Cycles before it that belong to no window.", of=LIVE),
    Column("heard", "Int64", "Cycles with at least one received message.", of=LIVE),
    Column("bound_ms", "Float64", "The largest bound of its cycles.", "ms", UNCOMPARED, LIVE),
    Column(
        "unproven",
        "Boolean",
        "Whether `bound_ms` is over 20 % of D, or the end of a cycle is unknown.",
        of=LIVE,
    ),
    Column("closed_unix_ns", "Int64", "Time of day of its close.", "ns", of=LIVE),
)
DECISIONS = (
    Column("window", "Int64", "The window of the last cycle that it looked at, or the next one."),
    Column("incumbent", "candidate", "The placement before."),
    Column("placement", "candidate", "The placement after."),
    Column("migrated", "Boolean", "Whether they differ."),
    Column("reason", "reason", "Which rule made it."),
    Column("dwell", "Int64", "n_d after it: whole windows of W since the last migration."),
    Column(
        "delta_j",
        "Float64",
        "J of the incumbent, with the switching term of its own last decision, less J of the best "
        "candidate.",
        null="the policy computes none",
    ),
    Column("last_cycle", "Int64", "The last cycle that it looked at."),
    Column(
        "cycles", "Int64", "How many cycles it looked at; 0: a move of the guard or of an operator."
    ),
    Column("dwell_cycles", "Int64", "n_d in cycles."),
    Column("seen_l95_ms", "Float64", "L95 of the cycles that it looked at.", "ms", GUARD, BETWEEN),
    Column("seen_violation_rate", "Float64", "V_D of these cycles.", null=GUARD, of=BETWEEN),
    Column(
        "u_{resource}",
        "Float64",
        "Utilisation of a resource from the release of the first of them.",
        null=f"{GUARD}, or {UNMEASURED}",
        of=BETWEEN,
    ),
    Column("seen_age_ms", "Float64", "Mean age since the first of them.", "ms", GUARD, AGE),
    Column(
        "seen_price_per_hour",
        "Float64",
        "Price of transmitted bytes since the first of them, money per hour.",
        null=f"{GUARD}, or a live cell",
        of=PRICE,
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
        "est_l95_error_ms_{candidate}",
        "Float64",
        "Standard error of its estimated L95; 0 if the estimator states none.",
        "ms",
        GUARD,
    ),
    Column(
        "est_violation_error_{candidate}",
        "Float64",
        "Standard error of its estimated V_D; 0 in the same cases.",
        null=GUARD,
    ),
    Column("est_age_ms_{candidate}", "Float64", "Its estimated mean age.", "ms", GUARD, AGE),
    Column(
        "est_price_per_hour_{candidate}",
        "Float64",
        "Its estimated price of transmitted bytes, money per hour.",
        null=GUARD,
        of=PRICE,
    ),
    Column(
        "est_misses_{candidate}",
        "Float64",
        "Its estimated share of the stretches of k cycles with more than m misses.",
        null=GUARD,
        of=MISSES,
    ),
    Column(
        "est_u_{resource}_{candidate}",
        "Float64",
        "Its estimated utilisation of a resource.",
        null=f"{GUARD}, or {UNMEASURED}",
    ),
    Column("eligible_{candidate}", "Boolean", "Whether it is within the caps.", null=GUARD),
    Column(
        "excess_{candidate}",
        "Float64",
        "Its largest value / cap − 1; ∞ if its L95 is lost, and has a cap.",
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
    Column("phi_before", "Float64", "Φ of the fleet as it is, as played.", null=UNASKED, of=FLEET),
    Column("phi_after", "Float64", "Φ with the simulated moves.", null=UNASKED, of=FLEET),
    Column("round", "Int64", "Round of the ledger.", null="no ledger", of=FLEET),
    Column(
        "refused",
        "String",
        "A decision that was not carried out, and why: `migrated` is false, `placement` the old "
        "placement, and `reason` the policy's. In a fleet also the incumbent while its windows "
        "disagree with the simulated windows.",
        null="the decision was carried out",
        of=("live", "fleet"),
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
        "neither by the end of the run, or a later input replaced it (live)",
    ),
    Column("outcome", "outcome", "Its end."),
    Column("shadow", "Boolean", "Whether it is a shadow's.", of=("live", "shadows")),
    Column("second", "Boolean", "Whether it is of the second copy.", of=REPLICAS),
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
        "CPU time of all other processes of its node during the job.",
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
        "CPU time of its node between the end of a sink's job and the hand-over of its command.",
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

#: Suffixes of a column over seeds: its mean, and the ends of its interval.
ENDS = ("", "_low", "_high")

#: Names of the columns by table.
TEMPLATES: Mapping[str, Sequence[str]] = {
    **{name: [column.name for column in table.columns] for name, table in TABLES.items()},
    "runs": [of + end for of in (SHARE_OF, USE_OF, *OF_CHAINS) for end in ENDS],
}


class NamedColumn(NamedTuple):
    """A column of one cell: its name, and the resource, candidate or chain in it, if any."""

    name: str
    resource: Resource | None
    candidate: str
    chain: str = ""

    @property
    def of(self) -> str:
        """The resource and the candidate in its name, for messages."""
        names = [] if self.resource is None else [self.resource.described]
        if self.candidate:
            names.append(f"candidate {self.candidate}")
        if self.chain:
            names.append(f"chain {self.chain}")
        return ", ".join(names) or "every cell"

    @property
    def path(self) -> str:
        """Path in a cell file of the chain, the candidate, or the resource in its name."""
        if self.chain:
            return f"chains.{self.chain}"
        if self.candidate or self.resource is None:
            return f"candidates.{self.candidate}"
        return self.resource.path


def those_with(features: Collection[Feature], columns: Iterable[Column]) -> Iterator[Column]:
    """Yield the columns that a run with some features has."""
    for column in columns:
        if not column.of or not set(column.of).isdisjoint(features):
            yield column


def columns_of(
    template: str,
    resources: Iterable[Resource],
    candidates: Iterable[str],
    chains: Iterable[str] = (),
) -> Iterator[NamedColumn]:
    """Yield the columns that a declaration is for a cell: all candidates of a resource, then on."""
    if "{chain}" in template:
        for chain in chains:
            yield NamedColumn(template.format(chain=chain), None, "", chain)
        return
    of_resources = list(resources) if "{resource}" in template else [None]
    of_candidates = list(candidates) if "{candidate}" in template else [""]
    for resource, candidate in itertools.product(of_resources, of_candidates):
        name = template.format(resource=resource and resource.name, candidate=candidate)
        yield NamedColumn(name, resource, candidate)


def clash_faults(
    resources: Iterable[Resource], candidates: Sequence[str], chains: Sequence[str] = ()
) -> Iterator[Fault]:
    """Yield a fault for every two resources, or columns of a table, that would have one name."""
    known: dict[str, Resource] = {}
    for resource in resources:
        first = known.setdefault(resource.name, resource)
        if first is not resource:
            yield Fault(
                resource.path,
                f"{first.described} and {resource.described} would both be called "
                f"{resource.name!r} where a resource is named; rename one of them",
            )
    for table, templates in TEMPLATES.items():
        taken: dict[str, NamedColumn] = {}
        # Fixed columns first: a clash with a fixed column is a fault of the cell's name.
        for template in sorted(templates, key=lambda one: "{" in one):
            for column in columns_of(template, known.values(), candidates, chains):
                one = taken.setdefault(column.name, column)
                if one is not column:
                    yield Fault(
                        column.path,
                        f"a table of {table} would have two columns {column.name!r}: of {one.of} "
                        f"and of {column.of}; rename one of them",
                    )


@cache
def require_apart(
    resources: tuple[Resource, ...], candidates: tuple[str, ...], chains: tuple[str, ...] = ()
) -> None:
    """Raise a ProblemError with all names of a cell that would give two columns the same name."""
    if faults := list(clash_faults(resources, candidates, chains)):
        raise ProblemError(faults)
