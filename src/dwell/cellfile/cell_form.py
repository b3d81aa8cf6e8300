"""The form of a cell file: the model's declarations, and keys that a file writes otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import (
    FAULTY,
    ChoiceForm,
    Definitions,
    Entry,
    FlagForm,
    Form,
    FormKey,
    JsonSchema,
    ListForm,
    MappingForm,
    NumberForm,
    Shape,
    TextForm,
    WrittenForm,
    form_of,
    key_of,
    not_allowed,
    optional,
    refused,
    required,
    shape_of,
    unquoted,
)
from dwell.cellfile.structure import FileKind
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import (
    Bursts,
    Caps,
    Chain,
    Constant,
    ControllerSettings,
    Endpoint,
    Episodes,
    Execution,
    Fabric,
    Flow,
    Host,
    Link,
    LinkDisturbance,
    LiveSettings,
    MissCap,
    MovingTarget,
    Node,
    NodeDisturbance,
    Objective,
    Pipeline,
    Problem,
    Process,
    Quota,
    Servo,
    Targets,
    Task,
    Weights,
)
from dwell.model.bounds import LARGEST, MAX_COUNT, NOT_EMPTY, VALUE, Bound, Pattern
from dwell.model.controller_settings import REPLICATE as POLICY
from dwell.model.controller_settings import ReplicateSettings
from dwell.model.declaration import DeclaredField, declared_fields
from dwell.model.document import VERSION
from dwell.model.every_placement import KEEP, RESERVED, EveryPlacement
from dwell.model.frozen import FrozenDict
from dwell.model.pipeline import WORKERS
from dwell.model.process import DRAWN
from dwell.model.replicated import Replicated
from dwell.model.ros_topics import RosActuator, RosCommands, RosTopic
from dwell.policies.registry import REGISTRY as POLICIES

NAME = TextForm()

# ------------------------------------------------------------------------------- processes


def _columns(value: Any) -> str | tuple[str, ...]:
    if isinstance(value, str):
        return value
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        return tuple(value)
    raise ValueError(not_allowed(value, "a column name, or a list of them"))


TRACE = Shape(
    "Trace",
    "A recorded column, replayed in order; columns of one file share their rows.",
    (
        required(
            "file",
            TextForm(NOT_EMPTY),
            "A .parquet or .csv file, relative to the cell file's folder.",
        ),
        required("column", NAME, "Column with the values: milliseconds, or bare factors."),
        optional(
            "by",
            ChoiceForm(("row", "time")),
            "`row`: each cycle takes the next row. `time`: each cycle takes the latest row sent at "
            "or before its release.",
            "row",
        ),
        optional(
            "time",
            NAME,
            "Column with the instant of each row, ms; only with `by: time`.",
            "sent_ms",
        ),
        optional(
            "group",
            WrittenForm(
                "text, list of texts",
                _columns,
                shown={
                    "anyOf": [
                        {"type": "string"},
                        {"type": "array", "items": {"type": "string"}, "minItems": 1},
                    ]
                },
            ),
            "Column, or columns, whose values tell recordings apart; a run without `wrap` stays "
            "within one.",
            "none",
        ),
        optional(
            "on_negative",
            ChoiceForm(("error", "drop", "clip")),
            "What to do with rows whose value is negative, missing or not finite: `error`, `drop` "
            "the row for all columns, or `clip` negative values to 0.",
            "error",
        ),
        optional(
            "wrap", FlagForm(), "Whether to continue with the first row after the last.", "false"
        ),
        optional(
            "sha256",
            TextForm(Pattern("[0-9a-f]{64}", "64 hexadecimal digits, as they were recorded")),
            "Digest of the data that a recorded problem used; other data are refused.",
        ),
    ),
)


@dataclass(frozen=True, eq=False)
class ProcessForm(Form):
    """A number, or one named random process: an `Entry` of it, or its `Constant`."""

    shape: Shape

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return a `Constant`, or the entry of the named process."""
        if isinstance(value, dict):
            entry = self.shape.read(value, path, faults)
            if len(value) != 1 and not faults.touches(path):
                has = f"{len(value)} of them ({', '.join(value)})" if value else "none"
                names = ", ".join(self.shape.names)
                faults.add(path, f"needs exactly one process and has {has}; choose one of {names}")
            if len(entry.values) != 1 or len(value) != 1:
                return FAULTY
            (found,) = entry.values.values()
            return found if isinstance(found, Entry) else Constant(found)
        if isinstance(value, int | float) and not isinstance(value, bool):
            number = NumberForm(VALUE).read(value, path, faults)
            return FAULTY if number is FAULTY else Constant(number)
        names = ", ".join(self.shape.names)
        remedy = f"a number from 0 to 1e9, or one of {names} with its values"
        quoted = unquoted(value) if isinstance(value, str) else ""
        if isinstance(value, str) and value in self.shape.names:
            remedy = f"written with its values, as `{{{value}: {{...}}}}`"
        return refused(value, f"{remedy}{quoted}", path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return a number or a mapping of one key."""
        if "Process" not in definitions:
            definitions["Process"] = {}
            mapping = self.shape.definition(definitions)
            says = mapping.pop("description")
            either = [
                NumberForm(VALUE).schema(definitions),
                {**mapping, "minProperties": 1, "maxProperties": 1},
            ]
            definitions["Process"] = {"description": says, "anyOf": either}
        return {"$ref": "#/$defs/Process"}


(CONSTANT,) = declared_fields(Constant)
PROCESS = ProcessForm(
    Shape(
        "Process",
        "A number, or one named random process.",
        (
            optional("constant", NumberForm(VALUE), CONSTANT.key.says),
            *(
                optional(name, shape_of(kind, {}), (kind.__doc__ or "").partition("\n")[0])
                for name, kind in DRAWN.items()
            ),
            optional("trace", TRACE, TRACE.says),
        ),
    )
)
#: What stands for a process at fault; it passes every check of meaning.
STAND_IN = Constant(1.0)
PROCESSES: Mapping[Any, Form] = {Process: PROCESS}


def _field(kind: type, name: str) -> DeclaredField:
    return next(one for one in declared_fields(kind) if one.name == name)


def _key(kind: type, name: str, **more: Any) -> FormKey:
    """Return the key of a field, in the form of its type; see `key_of`."""
    one = _field(kind, name)
    return key_of(one, form_of(one, PROCESSES), **more)


# ---------------------------------------------------------------------------------- fabric

NODE_BURSTS = shape_of(
    Bursts,
    PROCESSES,
    title="NodeBursts",
    without=("add_delay_ms",),
    says="Foreign work on a node, of other tenants.",
)
LINK_BURSTS = shape_of(
    Bursts,
    PROCESSES,
    title="LinkBursts",
    without=("threads",),
    says="Episodes of extra delay on a link.",
)
QUOTA = shape_of(Quota, {})
NODE = shape_of(
    Node,
    {Quota: QUOTA, Bursts: NODE_BURSTS},
    instead={
        "tier": _key(Node, "tier", stand_in="robot"),
        # Without its accelerators, a node would make the tasks' accelerators unknown.
        "accelerators": _key(Node, "accelerators", breaks=True),
    },
)


@dataclass(frozen=True, eq=False)
class WordsForm(Form):
    """One of several words, or a mapping with more detail.

    Parameters
    ----------
    means : mapping of str to object
        Meaning of each word.
    shape : Shape
        Shape with one key, whose value counts.
    remedy : str
        Description of the allowed values.
    """

    means: Mapping[str, Any]
    shape: Shape
    remedy: str

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return what is meant."""
        if isinstance(value, str) and value in self.means:
            return self.means[value]
        if not isinstance(value, dict):
            return refused(value, self.remedy, path, faults)
        entry = self.shape.read(value, path, faults)
        return entry if entry is FAULTY else entry.values.get(self.shape.keys[0].name)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the words or the mapping."""
        names = list(self.means)
        word = {"const": names[0]} if len(names) == 1 else {"enum": names}
        return {"anyOf": [word, self.shape.schema(definitions)]}


_RETRANSMIT = _field(Link, "retransmit_ms")
ON_LOSS = WordsForm(
    {"drop": None},
    Shape(
        "Retransmit",
        "How long after a lost attempt the next one follows.",
        (required("retransmit_ms", form_of(_RETRANSMIT, {}), _RETRANSMIT.key.says),),
    ),
    "`drop` (default) or `{retransmit_ms: 20}`",
)
LINK = shape_of(
    Link,
    {**PROCESSES, Bursts: LINK_BURSTS},
    instead={
        "delay_ms": _key(Link, "delay_ms", stand_in=STAND_IN),
        "retransmit_ms": optional(
            "retransmit_ms",
            ON_LOSS,
            "Treatment of a lost message: `drop` or retransmission.",
            "drop",
            named="on_loss",
        ),
    },
    further=(
        optional(
            "both_ways",
            FlagForm(),
            "Whether the same link exists in the other direction, too, with its own random values.",
            "false",
            tier="first",
        ),
    ),
)

# -------------------------------------------------------------------------------- pipeline

EXECUTION = shape_of(
    Execution,
    PROCESSES,
    instead={"exec_ms": _key(Execution, "exec_ms", stand_in=STAND_IN)},
)
INPUT = WordsForm(
    {"queue": 0, "latest": 1},
    Shape(
        "Input",
        "How many complete input sets may wait.",
        (
            required(
                "depth",
                NumberForm(Bound(1, MAX_COUNT, whole=True)),
                "Input sets that may wait; beyond it the oldest is replaced.",
                named="queue",
            ),
        ),
    ),
    "`queue` (default), `latest` or `{queue: 8}`",
)


def _fields(value: Any) -> Any:
    if isinstance(value, dict) and all(isinstance(name, str) for name in value):
        return value
    raise ValueError(not_allowed(value, "a mapping of the message's fields"))


ZERO = WrittenForm("mapping", _fields, shown={"type": "object"})
ROS_TOPIC = shape_of(RosTopic, {})
ROS_COMMANDS = shape_of(RosCommands, {}, instead={"zero": ZERO})
ROS_ACTUATOR = shape_of(RosActuator, {RosCommands: ROS_COMMANDS})


@dataclass(frozen=True, eq=False)
class ActuatorForm(Form):
    """The name of a class or function, or a mapping with the topic of the commands."""

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the name, or the entry of the mapping."""
        form = ROS_ACTUATOR if isinstance(value, dict) else NAME
        return form.read(value, path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the text or the mapping."""
        return {"anyOf": [NAME.schema(definitions), ROS_ACTUATOR.schema(definitions)]}


TASK = shape_of(
    Task,
    {RosTopic: ROS_TOPIC},
    instead={
        "on": MappingForm(EXECUTION, keeps=True, least=1),
        "depth": optional(
            "depth",
            INPUT,
            "Jobs that may wait for a worker: all (`queue`), the newest (`latest`), or a number.",
            "queue",
            named="input",
            tier="first",
        ),
    },
    further=(
        optional(
            "workers",
            NumberForm(WORKERS),
            "Jobs that may run at a time on each node.",
            "1",
        ),
    ),
)
FLOW, CHAIN = shape_of(Flow, {}), shape_of(Chain, {})
REPLICATED = shape_of(Replicated, {})
PLACED = MappingForm(NAME)


@dataclass(frozen=True, slots=True)
class CandidateForm(Form):
    """A placement: relocatable task to node; or `{replicas}`, two other candidates."""

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return a dict of nodes by task, or the entry of replicas."""
        # A task may have the name `replicas` or `after_ms`; its node is a text.
        replicated = value if isinstance(value, dict) else {}
        is_placed = isinstance(replicated.get("replicas", ""), str)
        if not is_placed or isinstance(replicated.get("after_ms"), float | int):
            return REPLICATED.read(value, path, faults)
        return PLACED.read(value, path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the schemas of both."""
        return {"anyOf": [PLACED.schema(definitions), REPLICATED.schema(definitions)]}


# ------------------------------------------------------------- scenarios, objective, control

TIMED = {**PROCESSES, Episodes: shape_of(Episodes, PROCESSES)}
#: Keys of a disturbance that belong to one kind of it.
NODE_KEYS = ("stress_threads",)
LINK_KEYS = ("both_ways", "add_delay_ms", "loss", "rate_mbps")


def _disturbance() -> Shape:
    node = shape_of(NodeDisturbance, TIMED)
    link = shape_of(LinkDisturbance, TIMED)
    known = {key.name: key for key in (*node.keys, *link.keys)}
    first = optional("node", NAME, known.pop("node").says, tier="first")
    further = (
        optional("link", NAME, "Disturbed link, as `R1->E`.", tier="first"),
        optional("both_ways", FlagForm(), "Whether it also disturbs the link back.", "false"),
    )
    return Shape(
        "Disturbance",
        "One thing that happens to a node or to a link for a while.",
        (first, *further, *known.values()),
        extra={"oneOf": [{"required": ["node"]}, {"required": ["link"]}]},
    )


DISTURBANCE = _disturbance()
MISSES = shape_of(MissCap, {})
WEIGHTS, TARGETS = shape_of(Weights, {}), shape_of(Targets, {})
CAPS = shape_of(Caps, {MissCap: MISSES})
OBJECTIVE = shape_of(
    Objective,
    {},
    instead={
        "weights": optional("weights", WEIGHTS, "Weights of the terms of J.", tier="first"),
        "targets": optional("targets", TARGETS, "Design targets.", tier="first"),
        "caps": optional("caps", CAPS, "Hard caps.", tier="first"),
        "accelerators": optional(
            "accelerators",
            FlagForm(),
            "Whether accelerators of these nodes count in their tiers, too.",
            "false",
        ),
    },
)
_POLICY, _ESTIMATOR = _field(ControllerSettings, "policy"), _field(ControllerSettings, "estimator")
_BASES = TextForm(known=tuple(name for name in POLICIES if name != POLICY))
REPLICATE = shape_of(ReplicateSettings, {}, title="Replicate", instead={"base": _BASES})
CONTROLLER = shape_of(
    ControllerSettings,
    {ReplicateSettings: REPLICATE},
    title="Controller",
    instead={
        "policy": key_of(_POLICY, TextForm(known=tuple(POLICIES))),
        "estimator": key_of(_ESTIMATOR, TextForm(known=tuple(ESTIMATORS))),
    },
)
TARGET = shape_of(MovingTarget, {})
SERVO = shape_of(Servo, {MovingTarget: TARGET})
_ADDRESS = TextForm(NOT_EMPTY)
ENDPOINT = shape_of(Endpoint, {}, instead={"address": _ADDRESS})
HOST = shape_of(Host, {Endpoint: ENDPOINT}, instead={"address": _ADDRESS})
LIVE = shape_of(
    LiveSettings,
    {Host: HOST},
    title="Live",
    instead={"actuators": MappingForm(ActuatorForm())},
)

# ------------------------------------------------------------------------------ candidates


def _search_state(value: Any) -> bool:
    if value is True or value == "found":
        return value is not True
    raise ValueError(not_allowed(value, "true; no candidate can have the name `all`"))


def _keep(value: Any) -> int:
    if isinstance(value, dict):
        raise ValueError(not_allowed(value, f"{KEEP}; no candidate can have the name `keep`"))
    return int(NumberForm(KEEP).number(value))


EVERY_PLACEMENT = shape_of(
    EveryPlacement,
    {},
    instead={
        "is_found": WrittenForm("`true`, `found`", _search_state, shown={"enum": [True, "found"]}),
        "keep": WrittenForm("2 to 8", _keep, shown=NumberForm(KEEP).schema({})),
    },
)
NAMED = MappingForm(CandidateForm(), keeps=True, least=1)


@dataclass(frozen=True, eq=False)
class CandidatesForm(Form):
    """Placements by name, the word `all`, or placements and the keys of a search."""

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return an entry with the placements by name, and with the entry of a search."""
        if value == "all":
            value = {"all": True}
        if not isinstance(value, dict):
            return refused(value, "`all`, or a mapping", path, faults)
        search = {name: value[name] for name in RESERVED if name in value}
        named = NAMED.read(
            {name: value[name] for name in value if name not in search}, path, faults
        )
        every = EVERY_PLACEMENT.read(search, path, faults) if search else None
        if search and "all" not in search and isinstance(search["keep"], int):
            faults.add(f"{path}.keep", "needs `all: true` next to it; add it, or remove keep")
        return candidates_entry(named, every)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the word, or the schema of a mapping."""
        search = EVERY_PLACEMENT.definition(definitions)["properties"]
        return {"anyOf": [{"const": "all"}, {**NAMED.schema(definitions), "properties": search}]}


def candidates_entry(named: Mapping[str, Any], every: Entry | None = None) -> Entry:
    """Return the entry of the candidates."""
    return Entry(CANDIDATES, "candidates", {"named": named, "every": every})


CANDIDATES = Shape("Candidates", "Placements the policy may choose.", ())

# ------------------------------------------------------------------------------------ cell

_SECTIONS = ("tasks", "flows", "scales", "chains")
_TIMING = [
    _key(Pipeline, one.name, stand_in=LARGEST if one.name == "period_ms" else FAULTY)
    for one in declared_fields(Pipeline)
    if one.name not in _SECTIONS
]
_SECTION_KEYS = {
    one.name: one.key for kind in (Pipeline, Fabric, Problem) for one in declared_fields(kind)
}


def _section(name: str, form: Form) -> FormKey:
    """An optional section of the file, with its description in the model."""
    about = _SECTION_KEYS[name]
    return optional(name, form, about.says, tier=about.tier)


NOTHING: Mapping[str, Any] = FrozenDict()


def _needed(name: str, form: Form, stand_in: Any = NOTHING) -> FormKey:
    """A required section of the file."""
    about = _SECTION_KEYS[name]
    return required(name, form, about.says, stand_in, tier=about.tier)


CELL = FileKind.of(
    "cell",
    "dwell",
    VERSION,
    "Cell",
    "A pipeline on its robots: tasks, flows, nodes, links, candidates, scenarios, objective.",
    _key(Problem, "name"),
    *_TIMING,
    _key(Problem, "window_cycles"),
    _key(Problem, "warmup_windows"),
    _needed("nodes", MappingForm(NODE, keeps=True, least=1)),
    _section("links", ListForm(LINK, keeps=True)),
    _needed("tasks", MappingForm(TASK, keeps=True, least=1)),
    _section("flows", ListForm(FLOW, keeps=True)),
    _section("scales", MappingForm(PROCESS, keeps=True)),
    _section("chains", MappingForm(CHAIN, keeps=True)),
    _needed("candidates", CandidatesForm(), candidates_entry({})),
    _section("scenarios", MappingForm(ListForm(DISTURBANCE, keeps=True), keeps=True)),
    _section("objective", OBJECTIVE),
    _section("controller", CONTROLLER),
    _section("servo", SERVO),
    _section("live", LIVE),
)
