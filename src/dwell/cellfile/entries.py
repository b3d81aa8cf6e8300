"""The structure of a cell file: its keys, their types, units and bounds, each stated once.

These models say what may stand where. They hold no default that the model of `dwell.model` has
too: a key that is absent is None here, and the constructors of the model fill it.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from dwell.cellfile.rendering import as_read
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import bounds
from dwell.model.bounds import Bound
from dwell.policies.registry import REGISTRY as POLICIES

JsonSchema = dict[str, Any]


def wrong(message: str) -> PydanticCustomError:
    """Return an error that says `message`, whatever braces it holds."""
    return PydanticCustomError("wrong", "{message}", {"message": message})


@dataclass(frozen=True, slots=True)
class Number:
    """A finite number within a bound, as an annotation of a field."""

    bound: Bound

    def read(self, value: object) -> float:
        """Return the number, or raise with its value, the bound and a remedy."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            remedy = _unquoted(value) if isinstance(value, str) else ""
            raise wrong(f"{as_read(value)} is not allowed; it must be {self.bound}{remedy}")
        if abs(value) > sys.float_info.max and self.bound.high == math.inf:
            raise wrong(f"{as_read(value)} is not allowed; leave the key out for no limit")
        # A whole number may be written 6e4; JSON Schema says the same of its integers.
        if self.bound.whole and isinstance(value, float) and value.is_integer():
            value = int(value)
        if not self.bound.holds(value):
            raise wrong(f"{as_read(value)} is not allowed; it must be {self.bound}")
        return value if self.bound.whole else float(value)

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        return self.json_schema()

    def json_schema(self) -> JsonSchema:
        """Return the JSON Schema of the number."""
        bound = self.bound
        result: JsonSchema = {"type": "integer" if bound.whole else "number"}
        plain = int if bound.whole else float
        result["exclusiveMinimum" if bound.above else "minimum"] = plain(bound.low)
        if bound.high != math.inf:
            result["exclusiveMaximum" if bound.below else "maximum"] = plain(bound.high)
        return result


@dataclass(frozen=True, slots=True)
class Columns:
    """One column name, or a list of them, as an annotation of a field."""

    def read(self, value: object) -> str | tuple[str, ...]:
        """Return the name, or the names as a tuple."""
        if isinstance(value, str):
            return value
        if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
            return tuple(value)
        given = as_read(value)
        raise wrong(f"{given} is not allowed; it must be a column name, or a list of them")

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        name = {"type": "string"}
        return {"anyOf": [name, {"type": "array", "items": name, "minItems": 1}]}


def _unquoted(text: str) -> str:
    """Return a remedy for a text that was meant as a number."""
    try:
        number = float(text)
    except ValueError:
        return ""
    return f"; write {text.replace('_', '')} without quotes" if math.isfinite(number) else ""


class Entry(BaseModel):
    """A mapping of a cell file: known keys only, and no conversions."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, defer_build=True)


def optional(description: str, **more: Any) -> Any:
    """Declare a key that may be left out: it is None then, and the model knows its default."""
    return Field(None, description=description, **more)


Value = Annotated[float, Number(bounds.VALUE)]
Mean = Annotated[float, Number(bounds.MEAN)]
Real = Annotated[float, Number(bounds.REAL)]
Cv = Annotated[float, Number(bounds.CV)]
TimeMs = Annotated[float, Number(bounds.TIME_MS)]
RateMbps = Annotated[float, Number(bounds.RATE_MBPS)]
Weight = Annotated[float, Number(bounds.WEIGHT)]
Target = Annotated[float, Number(bounds.TARGET)]
Cap = Annotated[float, Number(bounds.CAP)]
ForeignThreads = Annotated[int, Number(bounds.FOREIGN_THREADS)]
Workers = Annotated[int, Number(bounds.WORKERS)]


# ------------------------------------------------------------------------------- processes


class UniformEntry(Entry):
    """Uniform between two values."""

    low: Value = Field(description="Smallest value.")
    high: Value = Field(description="Largest value, at least `low`.")


class NormalEntry(Entry):
    """Gaussian, clipped from below at `min`."""

    mean: Real = Field(description="Mean before clipping.")
    std: Value = Field(description="Standard deviation before clipping.")
    min: Value | None = optional("What smaller values are raised to; default 0.")


class LogNormalEntry(Entry):
    """Lognormal; mean and coefficient of variation are those of the value, not of its log."""

    mean: Mean = Field(description="Mean.")
    cv: Cv = Field(description="Coefficient of variation: standard deviation / mean.")


class GammaEntry(Entry):
    """Gamma with a mean and a coefficient of variation."""

    mean: Mean = Field(description="Mean.")
    cv: Annotated[float, Number(bounds.GAMMA_CV)] = Field(
        description="Coefficient of variation: standard deviation / mean."
    )


class ExponentialEntry(Entry):
    """Exponential."""

    mean: Mean = Field(description="Mean.")


class AR1Entry(Entry):
    """Positive autoregression: lognormal values, each correlated with the one before."""

    mean: Mean = Field(description="Mean.")
    cv: Cv = Field(description="Coefficient of variation: standard deviation / mean.")
    rho: Annotated[float, Number(bounds.RHO)] = Field(
        description="Correlation of a cycle's value with the one before."
    )


class TraceEntry(Entry):
    """A recorded column, replayed in order; columns of one file share their rows."""

    file: str = Field(
        description="A .parquet or .csv file, relative to the cell file's folder.", min_length=1
    )
    column: str = Field(description="Column with the values: milliseconds, or bare factors.")
    by: Literal["row", "time"] | None = optional(
        "`row` (default): each cycle takes the next row. `time`: each cycle takes the latest row "
        "sent at or before its release."
    )
    time: str | None = optional(
        "Column with the instant of each row, ms; only with `by: time`; default `sent_ms`."
    )
    group: Annotated[str | tuple[str, ...], Columns()] | None = optional(
        "Column, or columns, whose values tell recordings apart; a run without `wrap` stays "
        "within one."
    )
    on_negative: Literal["error", "drop", "clip"] | None = optional(
        "What to do with rows whose value is negative, missing or not finite: `error` (default), "
        "`drop` the row for all columns, or `clip` negative values to 0."
    )
    wrap: bool | None = optional(
        "Whether to go on at the beginning when the rows end; default false."
    )
    sha256: str | None = optional(
        "Digest of the data that a recorded problem used; other data are refused.",
        pattern=r"^[0-9a-f]{64}$",
    )


class ProcessEntry(Entry):
    """A number, or one named random process."""

    constant: Value | None = optional("Always this value.")
    uniform: UniformEntry | None = None
    normal: NormalEntry | None = None
    lognormal: LogNormalEntry | None = None
    gamma: GammaEntry | None = None
    exponential: ExponentialEntry | None = None
    ar1: AR1Entry | None = None
    trace: TraceEntry | None = None

    number: ClassVar[Number] = Number(bounds.VALUE)

    @model_validator(mode="wrap")
    @classmethod
    def _number_or_one(
        cls, value: object, handler: ModelWrapValidatorHandler[ProcessEntry]
    ) -> ProcessEntry:
        names = ", ".join(cls.model_fields)
        if isinstance(value, dict):
            entry = handler(value)
            if len(value) != 1:
                has = f"{len(value)} of them ({', '.join(value)})" if value else "none"
                raise wrong(f"needs exactly one process and has {has}; choose one of {names}")
            return entry
        if isinstance(value, int | float) and not isinstance(value, bool):
            return cls.model_construct(constant=cls.number.read(value))
        remedy = f"a number from 0 to 1e9, or one of {names} with its values"
        quoted = _unquoted(value) if isinstance(value, str) else ""
        if isinstance(value, str) and value in cls.model_fields:
            remedy = f"written with its values, as `{{{value}: {{...}}}}`"
        raise wrong(f"{as_read(value)} is not allowed; it must be {remedy}{quoted}")

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        # `handler` answers with a reference; the alternatives belong to what it refers to.
        reference = handler(schema)
        inner = handler.resolve_ref_schema(reference)
        described = inner.pop("description", None)
        mapping = {**inner, "minProperties": 1, "maxProperties": 1}
        mapping.pop("title", None)
        inner.clear()
        inner.update(description=described, anyOf=[cls.number.json_schema(), mapping])
        return reference


# ---------------------------------------------------------------------------------- fabric


class QuotaEntry(Entry):
    """CPU bandwidth control of the kernel (cgroup), on the cell's own work."""

    cpu: Annotated[float, Number(bounds.QUOTA_CPU)] = Field(
        description="Cores' worth of run time in every period."
    )
    period_ms: Annotated[float, Number(bounds.QUOTA_PERIOD_MS)] = Field(
        description="Period after which the budget is filled again, ms."
    )
    slack_ms: Annotated[float, Number(bounds.QUOTA_SLACK_MS)] | None = optional(
        "Run time that is kept beyond the period when nothing runs, ms; default 0. Linux keeps 1."
    )
    tick_ms: Annotated[float, Number(bounds.QUOTA_TICK_MS)] | None = optional(
        "Time between the ticks at which a used-up budget is noticed and threads take turns, ms; "
        "default 0, at once. Linux: 1000 / HZ. One core, `fair`."
    )


class BurstsEntry(Entry):
    """Episodes that come and go in every scenario: quiet, then disturbed, and so on."""

    every_ms: ProcessEntry = Field(description="Quiet time between bursts, ms; mean above 0.01.")
    for_ms: ProcessEntry = Field(description="Duration of a burst, ms; mean above 0.01.")


class NodeBurstsEntry(BurstsEntry):
    """Foreign work on a node, of other tenants."""

    threads: ForeignThreads | None = optional("Threads of foreign work during a burst; default 0.")


class LinkBurstsEntry(BurstsEntry):
    """Episodes of extra delay on a link."""

    add_delay_ms: ProcessEntry | None = optional(
        "Added to the delay of every message during a burst, ms; default 0."
    )


class NodeEntry(Entry):
    """A computer."""

    tier: Literal["robot", "edge", "cloud"] = Field(
        description="Kind of computer: robot, edge or cloud."
    )
    cores: Annotated[int, Number(bounds.CORES)] | None = optional("Cores of its CPU; default 1.")
    scheduler: Literal["fair", "fifo", "priority"] | None = optional(
        "How jobs share the cores: `fair` (default, processor sharing), `fifo` (one after "
        "another) or `priority` (preemptive, by the tasks' `priority`)."
    )
    accelerators: dict[str, Annotated[int, Number(bounds.ACCELERATORS)]] | None = optional(
        "How many accelerators of each kind it has, as `{gpu: 1}`."
    )
    quota: QuotaEntry | None = optional("CPU bandwidth limit; none by default.")
    background: Annotated[float, Number(bounds.BACKGROUND)] | None = optional(
        "Cores that others than the jobs always take, in small pieces; default 0."
    )
    background_beside: Annotated[float, Number(bounds.BACKGROUND)] | None = optional(
        "What of `background` is taken while jobs run and no foreign thread does, on a node with "
        "a quota; all of it by default."
    )
    background_hz: Annotated[float, Number(bounds.BACKGROUND_HZ)] | None = optional(
        "How often in a second something of `background` wakes, in the mean, on a node whose "
        "quota has `tick_ms`: the kernel looks at the quota then, too; default 0."
    )
    interference: Annotated[float, Number(bounds.INTERFERENCE)] | None = optional(
        "How many times as much core time jobs take while foreign threads run; default 1."
    )
    contention: Annotated[float, Number(bounds.CONTENTION)] | None = optional(
        "Share of a CPU's time that others take from what runs there, and that the node's quota "
        "does not count; default 0."
    )
    contention_stressed: dict[str, Annotated[float, Number(bounds.CONTENTION)]] | None = optional(
        "What `contention` is while another node, on the same CPUs, has foreign threads, as `{R1: "
        "0.4}`; of several the largest counts."
    )
    bursts: NodeBurstsEntry | None = optional("Foreign work, in every scenario.")


class RetransmitEntry(Entry):
    """`drop`, or how long after a lost attempt the next one follows."""

    retransmit_ms: Annotated[float, Number(bounds.RETRANSMIT_MS)] | None = Field(
        description="Time after which a lost message is sent again, ms."
    )

    @model_validator(mode="wrap")
    @classmethod
    def _drop(
        cls, value: object, handler: ModelWrapValidatorHandler[RetransmitEntry]
    ) -> RetransmitEntry:
        if value == "drop":
            return cls.model_construct(retransmit_ms=None)
        if not isinstance(value, dict):
            remedy = "`drop` (default) or `{retransmit_ms: 20}`"
            raise wrong(f"{as_read(value)} is not allowed; it must be {remedy}")
        return handler(value)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        return {"anyOf": [{"const": "drop"}, handler(schema)]}


class LinkEntry(Entry):
    """A directed connection between two nodes."""

    source: str = Field(alias="from", description="Node that sends.")
    target: str = Field(alias="to", description="Node that receives.")
    both_ways: bool | None = optional(
        "Whether there is the same link back too, drawn independently; default false."
    )
    delay_ms: ProcessEntry = Field(description="Propagation delay of a message, ms.")
    rate_mbps: RateMbps | None = optional(
        "Serialisation rate, megabits a second; unlimited by default."
    )
    loss: Annotated[float, Number(bounds.LOSS)] | None = optional(
        "Probability that an attempt to send a message is lost; default 0."
    )
    on_loss: RetransmitEntry | None = optional(
        "What happens to a lost message: `drop` (default) or retransmission."
    )
    in_order: bool | None = optional("Whether no message overtakes another; default false.")
    bursts: LinkBurstsEntry | None = optional("Episodes of extra delay, in every scenario.")


# -------------------------------------------------------------------------------- pipeline


class ExecutionEntry(Entry):
    """How a task runs on one node."""

    exec_ms: ProcessEntry = Field(
        description="Time that one job needs when nothing disturbs it, with all its threads, ms."
    )
    threads: Annotated[int, Number(bounds.THREADS)] | None = optional(
        "Cores that one job can use at once; default 1. On a node with fewer it takes so many "
        "times as long."
    )
    workers: Workers | None = optional(
        "Jobs of this task that may run there at a time; default: the task's."
    )
    accelerator: str | None = optional("Kind of accelerator that it runs on instead of the CPU.")
    standby: Annotated[int, Number(bounds.STANDBY)] | None = optional(
        "Further workers that a live node keeps, to take over when the first is silent; default 0."
    )
    before_ms: Annotated[float, Number(bounds.HANDED_MS)] | None = optional(
        "What of `exec_ms` another thread of its worker does before it; default 0."
    )
    after_ms: Annotated[float, Number(bounds.HANDED_MS)] | None = optional(
        "What of `exec_ms` another thread of its worker does after it; default 0."
    )


class InputEntry(Entry):
    """`queue`, `latest`, or how many complete input sets may wait."""

    depth: Annotated[int, Number(Bound(1, bounds.MAX_COUNT, whole=True))] = Field(
        alias="queue", description="Input sets that may wait; beyond it the oldest is replaced."
    )

    @model_validator(mode="wrap")
    @classmethod
    def _words(cls, value: object, handler: ModelWrapValidatorHandler[InputEntry]) -> InputEntry:
        if value == "queue":
            return cls.model_construct(depth=0)
        if value == "latest":
            return cls.model_construct(depth=1)
        if not isinstance(value, dict):
            remedy = "`queue` (default), `latest` or `{queue: 8}`"
            raise wrong(f"{as_read(value)} is not allowed; it must be {remedy}")
        return handler(value)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchema:
        return {"anyOf": [{"enum": ["queue", "latest"]}, handler(schema)]}


class TaskEntry(Entry):
    """A stage of the pipeline."""

    on: dict[str, ExecutionEntry | None] = Field(
        description="Nodes it can run on, and how; one anchors it, more make it relocatable.",
        json_schema_extra={"minProperties": 1},
    )
    input: InputEntry | None = optional(
        "What waits for a worker: `queue` (default) without a bound, `latest` only, or a bounded "
        "queue."
    )
    workers: Workers | None = optional(
        "Jobs that may run at a time on each node that does not say; default 1."
    )
    priority: Annotated[int, Number(bounds.PRIORITY)] | None = optional(
        "Larger runs first on a node with the priority scheduler; default 0."
    )
    scale: str | None = optional("Name under `scales` of what multiplies its execution times.")
    offset_ms: TimeMs | None = optional(
        "Start of a source after the cycle's release, ms; default 0."
    )
    start_ms: TimeMs | None = optional(
        "Time that a new worker needs before its first job, ms; default 0."
    )
    state_bytes: Annotated[int, Number(bounds.STATE_BYTES)] | None = optional(
        "State that a cold migration carries, bytes; default 0."
    )
    run: str | None = optional("Class or function of a live worker, as `package.module:Name`.")


class FlowEntry(Entry):
    """A precedence edge: what one task sends to another."""

    source: str = Field(alias="from", description="Task that sends.")
    target: str = Field(alias="to", description="Task that receives.")
    payload_bytes: Annotated[int, Number(bounds.BYTES)] | None = optional(
        "Payload of a message, bytes; default 0.", alias="bytes"
    )


# ------------------------------------------------------------- scenarios, objective, control


class EpisodesEntry(Entry):
    """Episodes that come and go: off, then on, and so on."""

    name: str = Field(description="Name of the episodes; what shares it comes and goes together.")
    every_s: ProcessEntry = Field(description="Time between episodes, s; mean above 1e-5.")
    for_s: ProcessEntry = Field(description="Duration of an episode, s; mean above 1e-5.")


class DisturbanceEntry(Entry):
    """One thing that happens to a node or to a link for a while."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["node"]}, {"required": ["link"]}]}
    )

    at_s: Annotated[float, Number(bounds.AT_S)] | None = optional(
        "Begin, seconds from the start of the run; default 0."
    )
    for_s: Annotated[float, Number(bounds.FOR_S)] | None = optional(
        "Duration, seconds; default: to the end."
    )
    episodes: EpisodesEntry | None = optional(
        "When it is on within that time; default: all the time."
    )
    ramp_s: Annotated[float, Number(bounds.RAMP_S)] | None = optional(
        "Time in which it grows from nothing, and in which it falls again at its end, in 31 equal "
        "steps each, seconds; default 0."
    )
    node: str | None = optional("Node that it happens to.")
    link: str | None = optional("Link that it happens to, as `R1->E`.")
    down: bool | None = optional("Whether the node or the link is down meanwhile; default false.")
    stress_threads: ForeignThreads | None = optional("Foreign threads on the node; default 0.")
    both_ways: bool | None = optional("Whether it happens to the link back as well; default false.")
    add_delay_ms: ProcessEntry | None = optional(
        "Added to the delay of every message on the link, ms."
    )
    loss: Annotated[float, Number(bounds.ADDED_LOSS)] | None = optional(
        "Probability of loss on the link, besides its own; default 0."
    )
    rate_mbps: RateMbps | None = optional(
        "Rate of the link meanwhile, where its own is not lower, Mbit/s."
    )


class WeightsEntry(Entry):
    """Weights of the terms of the cost J; at least one above 0."""

    latency: Weight | None = optional("Of L95 / target; default 1.")
    violations: Weight | None = optional("Of the violation rate; default 3.")
    robot: Weight | None = optional("Of robot utilisation / target; default 0.5.")
    edge: Weight | None = optional("Of edge utilisation / target; default 0.3.")
    switching: Weight | None = optional("Of the share of moved tasks; default 0.5.")
    cloud: Weight | None = optional(
        "Of cloud utilisation / target; by default, cloud nodes count as edge nodes."
    )


class TargetsEntry(Entry):
    """Design targets that normalise latency and utilisation."""

    latency_ms: Target | None = optional("Of L95, ms; default: the deadline.")
    robot: Target | None = optional("Of robot utilisation; default 0.7.")
    edge: Target | None = optional("Of edge utilisation; default 0.7.")
    cloud: Target | None = optional("Of cloud utilisation; needed where `weights` has `cloud`.")


class CapsEntry(Entry):
    """Hard caps; a candidate above one is not eligible."""

    latency_ms: Cap | None = optional("On L95, ms; none by default.")
    utilisation: Cap | None = optional(
        "On the utilisation of every node and accelerator, as 0.98; none by default."
    )


class ObjectiveEntry(Entry):
    """What makes one placement better than another."""

    weights: WeightsEntry | None = optional("Weights of the terms of J.")
    targets: TargetsEntry | None = optional("Design targets.")
    caps: CapsEntry | None = optional("Hard caps.")
    tiers: dict[str, Literal["robot", "edge", "cloud"]] | None = optional(
        "Nodes whose utilisation counts, and as which tier; default: all, as their own tier."
    )
    accelerators: bool | None = optional(
        "Whether accelerators of these nodes count in their tiers, too; default false."
    )


class ControllerEntry(Entry):
    """The controller: where it sits, what it runs, and how its orders travel."""

    on: str | None = optional("Node it sits on; default: the first edge node, else the first node.")
    policy: str | None = optional(
        "A policy (`dtp`, default), `package.module:Class` of your own, or a candidate: the "
        "placement that never moves.",
        examples=list(POLICIES),
    )
    initial: str | None = optional("Candidate to start with; default: the first.")
    min_dwell: Annotated[int, Number(bounds.MIN_DWELL)] | None = optional(
        "Windows that a placement stays at least (N_min); default 3."
    )
    min_improvement: Annotated[float, Number(bounds.MIN_IMPROVEMENT)] | None = optional(
        "Improvement of J that a migration must promise; default 0.05."
    )
    escape: bool | None = optional(
        "Whether an incumbent over a cap may leave before the hysteresis is met; default false."
    )
    estimator: str | None = optional(
        "How the QoS of candidates is estimated; default `profile`; also `package.module:Class` "
        "of your own.",
        examples=list(ESTIMATORS),
    )
    shadow_fraction: Annotated[float, Number(bounds.SHADOW_FRACTION)] | None = optional(
        "Share of cycles that are also sent through each alternative, where the estimator uses "
        "shadow jobs; default 0.05, or 1/(alternatives) where that is less."
    )
    half_life_windows: Annotated[float, Number(bounds.HALF_LIFE_WINDOWS)] | None = optional(
        "Windows after which a measurement counts half; default 2."
    )
    migration: str | None = optional(
        "`warm` (default): a moved task is ready at once; `cold`: after its `start_ms` and the "
        "transfer of its `state_bytes`."
    )
    guard_cycles: Annotated[int, Number(bounds.GUARD_CYCLES)] | None = optional(
        "Periods without a completion after which the guard moves to a fallback; default 3."
    )
    probe_cycles: Annotated[int, Number(bounds.PROBE_CYCLES)] | None = optional(
        "Cycles that must complete through another placement, too, before the guard's is left for "
        "it, and that the guard rests for after its own move; default 30."
    )
    fallbacks: list[str] | None = optional(
        "Candidates that the guard may move to, best first; none: no guard."
    )
    order_delay_ms: TimeMs | None = optional("Time that an order travels, ms; default 0.")
    order_lead_cycles: Annotated[int, Number(bounds.LEAD_CYCLES)] | None = optional(
        "Cycles between a window's close and its order's first; default 0."
    )
    close_grace_ms: TimeMs | None = optional(
        "Time that a window stays open for stragglers after the release of the first cycle beyond "
        "it, ms; default 0. No window closes before the last deadline of its cycles."
    )


class MovingTargetEntry(Entry):
    """What the robot follows: a sine wave."""

    amplitude_mm: Annotated[float, Number(bounds.AMPLITUDE_MM)] = Field(
        description="Amplitude, mm; errors are proportional to it."
    )
    period_s: Annotated[float, Number(bounds.TARGET_PERIOD_S)] = Field(
        description="Duration of one swing, s; at least two periods of the cell."
    )


class ServoEntry(Entry):
    """The reference loop that the commands of every run are tried on."""

    plant: Literal["integrator", "double-integrator"] = Field(
        description="What a command sets: the velocity (`integrator`), or the acceleration."
    )
    gain: Annotated[float, Number(bounds.SERVO_GAIN)] = Field(
        description="Command for an error of 1: 1/s, for a `double-integrator` 1/s²."
    )
    damping: Annotated[float, Number(bounds.DAMPING)] | None = optional(
        "Command for an error that grows by 1 a second, 1/s; for a `double-integrator`, which "
        "needs it."
    )
    target: MovingTargetEntry = Field(description="What the robot follows.")


class EndpointEntry(Entry):
    """An address and the first port behind it."""

    address: str = Field(description="Name or address of the host.", min_length=1)
    port: Annotated[int, Number(bounds.PORT)] = Field(description="First port.")


class HostEntry(Entry):
    """Where a node's processes listen."""

    address: str | None = optional("Name or address of the host; default 127.0.0.1.", min_length=1)
    port: Annotated[int, Number(bounds.PORT)] | None = optional(
        "First port, default 7450; each process of the node takes three."
    )
    seen_from: dict[str, EndpointEntry] | None = optional(
        "Where it is reached from nodes that do not reach it there."
    )


class LiveEntry(Entry):
    """What the live runtime needs to know beside the problem."""

    hosts: dict[str, HostEntry] | None = optional(
        "Where each node is reached; by default all are this machine."
    )
    release: str | None = optional(
        "A cycle begins by the clock (`timer`, default), or when the first source has a picture "
        "(`frames`)."
    )
    clock: str | None = optional(
        "Clocks are compared by messages (`estimated`, default), or taken for synchronous "
        "(`system`: PTP, chrony)."
    )
    mode: str | None = optional(
        "Decisions are carried out (`control`, default) or recorded (`advise`)."
    )
    relay: str | None = optional(
        "Node that carries small messages where a direct link fails; default: the controller's."
    )
    max_age_ms: Annotated[float, Number(bounds.AGE_MS)] | None = optional(
        "Age from which a command is not applied, ms; default: two periods."
    )
    silence: str | None = optional(
        "What the actuator is told without commands: `hold` (default) or `zero`."
    )
    checkpoint_cycles: Annotated[int, Number(bounds.CHECKPOINT_CYCLES)] | None = optional(
        "Cycles between copies of a state to its fallback; default 25, 0: none."
    )
    degraded_at: Annotated[float, Number(bounds.DEGRADED_AT)] | None = optional(
        "Share of missed cycles in the last three windows above which the cell is degraded; "
        "default 0.1."
    )
    actuators: dict[str, str] | None = optional(
        "What applies the commands of a sink task, as `package.module:Name`."
    )
    observer: str | None = optional(
        "What looks on where `dwell live run` runs the cell, as `package.module:Name`."
    )


# ------------------------------------------------------------------------------------ cell


class CellEntry(Entry):
    """A pipeline on its robots: tasks, flows, nodes, links, candidates, scenarios, objective."""

    dwell: Literal[1] = Field(description="Version of this format.")
    name: str | None = optional("Name of the cell; default: the file's.")
    period_ms: Annotated[float, Number(bounds.PERIOD_MS)] = Field(
        description="Time between two releases (P), ms."
    )
    deadline_ms: Annotated[float, Number(bounds.DEADLINE_MS)] | None = optional(
        "Latency beyond which a cycle is missed (D <= P), ms; default: P."
    )
    release_jitter_ms: ProcessEntry | None = optional(
        "Added to the instant of every release, ms; default 0."
    )
    window_cycles: Annotated[int, Number(bounds.WINDOW_CYCLES)] | None = optional(
        "Cycles of a window (W); default 50."
    )
    warmup_windows: Annotated[int, Number(bounds.WARMUP_WINDOWS)] | None = optional(
        "First windows of a run that statistics leave out; default 0."
    )
    nodes: dict[str, NodeEntry | None] = Field(
        description="Computers by name.", json_schema_extra={"minProperties": 1}
    )
    links: list[LinkEntry | None] | None = optional("Connections between nodes; none by default.")
    tasks: dict[str, TaskEntry | None] = Field(
        description="Stages of the pipeline by name.", json_schema_extra={"minProperties": 1}
    )
    flows: list[FlowEntry | None] | None = optional(
        "What tasks send to one another, a directed acyclic graph."
    )
    scales: dict[str, ProcessEntry | None] | None = optional(
        "Per-cycle factors that tasks may name, as the scene's complexity."
    )
    candidates: dict[str, dict[str, str] | None] = Field(
        description="Placements the policy may choose, by name: relocatable task to node; anchored "
        "tasks follow.",
        json_schema_extra={"minProperties": 1},
    )
    scenarios: dict[str, list[DisturbanceEntry | None] | None] | None = optional(
        "What happens to the cell, by name: a list of disturbances. `baseline: []` exists always."
    )
    objective: ObjectiveEntry | None = optional("Cost, targets and caps.")
    controller: ControllerEntry | None = optional("Policy and protocol.")
    servo: ServoEntry | None = optional(
        "A loop on which the tracking error of every run is computed; none by default."
    )
    live: LiveEntry | None = optional("Hosts and habits of the live runtime.")
