"""Stages and actuators: the interfaces of the user's code, and its messages."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

from dwell.errors import LiveError
from dwell.model import FrozenDict

__all__ = [
    "Actuator",
    "CellActuator",
    "CellCode",
    "CellStage",
    "Message",
    "Stage",
    "StagePlace",
    "StageReport",
    "Stateful",
    "TopicRates",
    "load_actuator",
    "load_function",
    "load_stage",
]


@dataclass(frozen=True, slots=True)
class Message:
    """Input or output of a stage.

    Parameters
    ----------
    payload : bytes, numpy array, msgspec.Struct, or None
        A received array is read-only: copy it before changing it.
    cycle : int
        Number of the cycle, set in received messages.
    released_ns : int
        Release of the cycle on this node's clock, as in ``time.monotonic_ns``.
    age_ms : float
        Time since the release when the stage was called.
    stamp_ns : int, optional
        Time at which a sensor took the frame, on any clock: set by a source, passed on by Dwell,
        and given to the actuator. Inputs of stages do not have it.
    origins : mapping of str to int
        Oldest cycles from which the message descends, by source task; only in a cell with sampled
        flows or chains.
    """

    payload: Any = None
    cycle: int = 0
    released_ns: int = 0
    age_ms: float = 0.0
    stamp_ns: int | None = None
    origins: Mapping[str, int] = field(default_factory=FrozenDict)


@dataclass(frozen=True, slots=True)
class StagePlace:
    """Process of a stage or an actuator, and the limits of its messages.

    Parameters
    ----------
    cell, task : str
        Names of the cell and of the task.
    index : int
        Number of a standby, from 1; 0 for all others.
    folder : str, optional
        Folder of the cell file.
    max_age_ms : float
        Age from which a command is not applied.
    payload_bytes : int
        Declared bytes of the largest output.
    is_system_clock : bool
        Whether the system synchronises the clocks.
    """

    cell: str = ""
    task: str = ""
    index: int = 0
    folder: str | None = None
    max_age_ms: float = float("inf")
    payload_bytes: int = 0
    is_system_clock: bool = False


class TopicRates(NamedTuple):
    """Messages of a topic that a source reads.

    Parameters
    ----------
    rate_hz, jitter_ms : float
        Rate, and standard deviation of the intervals, of the last messages.
    lost : int
        Messages that the publishers have sent and that have not arrived.
    age_ms : float, optional
        Time since the last message.
    stamp_ms : float, optional
        Time from the stamp of the last message to its arrival, if the clocks are known to agree.
    """

    topic: str
    rate_hz: float = 0.0
    jitter_ms: float = 0.0
    lost: int = 0
    age_ms: float | None = None
    stamp_ms: float | None = None


class StageReport(NamedTuple):
    """State of a stage or an actuator between its calls: whether it can work, and why not."""

    ready: bool = True
    note: str = ""
    topic: TopicRates | None = None


class Stage(Protocol):
    """A task's code. It may also have the other members of `CellStage`."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Compute a cycle's output from its inputs, which are keyed by source task.

        A source task gets one message without payload, from ``stamper``.
        """


@runtime_checkable
class Stateful(Protocol):
    """A stage with a state, which moves with its task."""

    def snapshot(self) -> bytes:
        """Return the state after the last call of `process`."""

    def restore(self, state: bytes) -> None:
        """Replace the state with one from `snapshot`."""


class Actuator(Protocol):
    """Applies the commands that pass the gate.

    It may also have ``inputs``, ``start()`` and ``stop()``.

    A call of ``hold``, ``zero`` or ``stop`` that raises is repeated (docs/howto/deploy.md).
    """

    def apply(self, command: Message) -> None:
        """Apply a command."""

    def hold(self) -> None:
        """Hold the current state, because no command has arrived for too long."""

    def zero(self) -> None:
        """Stop, because no command has arrived for too long."""


class CellCode:
    """Base class of stages and actuators, with defaults for the optional methods.

    Attributes
    ----------
    inputs : mapping of str to type
        Type of the `msgspec.Struct` from each source task, or of the commands of a task; other
        structs become dicts.
    """

    inputs: Mapping[str, type] = {}

    def placed(self, place: StagePlace) -> None:
        """Take the process and its limits; called before `start`."""
        return

    def check(self) -> None:
        """Raise an error if `start` could not succeed, without an effect outside of the process."""
        return

    def start(self) -> None:
        """Prepare for the first cycle or command."""
        return

    def stop(self) -> None:
        """Release all resources at the end; called after `zero` of an actuator."""
        return

    def report(self) -> StageReport:
        """Return its state for a beat; another thread calls this, also during a call."""
        return StageReport()


class CellStage(CellCode, ABC):
    """Base class of stages.

    Attributes
    ----------
    stateful : bool
        Whether it has a state: it overrides `snapshot`.
    has_frames : bool
        Whether it can wait for a frame: it overrides `wait`.
    """

    stateful: bool = False
    has_frames: bool = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.stateful = cls.snapshot is not CellStage.snapshot
        cls.has_frames = cls.wait is not CellStage.wait

    @abstractmethod
    def process(self, inputs: Mapping[str, Message]) -> Message:
        """As `Stage.process`."""

    def wait(self) -> object:
        """Wait for a new frame, which begins a cycle."""
        raise LiveError("no method wait(), though live.release is frames")

    def snapshot(self) -> bytes:
        """As `Stateful.snapshot`."""
        raise LiveError("no method snapshot()")

    def restore(self, state: bytes) -> None:
        """As `Stateful.restore`."""
        raise LiveError("no method restore()")


class CellActuator(CellCode, ABC):
    """Base class of actuators.

    Attributes
    ----------
    stamp_from : str
        Source task whose stamp the commands get; empty for the oldest stamp.
    """

    stamp_from: str = ""

    @abstractmethod
    def apply(self, command: Message) -> None:
        """As `Actuator.apply`."""

    def hold(self) -> None:
        """As `Actuator.hold`."""
        return

    def zero(self) -> None:
        """As `Actuator.zero`."""
        return


class _UserStage(CellStage):
    """Adapter for a user's stage or function without the base class."""

    def __init__(self, given: object, process: Callable[[Mapping[str, Message]], Message]) -> None:
        self._process = process
        self.stateful = isinstance(given, Stateful)
        self.has_frames = callable(getattr(given, "wait", None))
        _take(self, given, ("inputs", "start", "stop", "wait", "snapshot", "restore"))

    def process(self, inputs: Mapping[str, Message]) -> Message:
        return self._process(inputs)


class _UserActuator(CellActuator):
    """Adapter for a user's actuator or function without the base class."""

    def __init__(self, given: object, apply: Callable[[Message], None]) -> None:
        self._apply = apply
        _take(self, given, ("inputs", "start", "hold", "zero", "stop"))

    def apply(self, command: Message) -> None:
        self._apply(command)


def _take(own: CellCode, given: object, members: Sequence[str]) -> None:
    """Replace the defaults of some members by the members that a user's object has."""
    for name in members:
        if (member := getattr(given, name, None)) is not None:
            setattr(own, name, member)


def load_stage(name: str, where: str) -> CellStage:
    """Import a stage; if it is a class, make an instance.

    Parameters
    ----------
    name : str
        ``package.module:Name``, from the local cell file.
    where : str
        Field with this name, for messages.

    Raises
    ------
    LiveError
        If it does not exist, its import or creation fails, or it is not a stage.
    """
    found = _made(name, where)
    if isinstance(found, CellStage):
        return found
    process = found if _is_function(found) else getattr(found, "process", None)
    if not callable(process):
        raise LiveError(f"{where}: {name} is no stage: it has no method process(inputs)")
    return _UserStage(found, process)


def load_actuator(name: str, where: str) -> CellActuator:
    """Import an actuator; if it is a class, make an instance; see `load_stage`."""
    found = _made(name, where)
    if isinstance(found, CellActuator):
        return found
    is_function = _is_function(found)
    apply = found if is_function else getattr(found, "apply", None)
    if not callable(apply):
        raise LiveError(f"{where}: {name} is no actuator: it has no method apply(command)")
    for method in () if is_function else ("hold", "zero"):
        if not callable(getattr(found, method, None)):
            raise LiveError(f"{where}: {name} has no method {method}()")
    return _UserActuator(found, apply)


def load_function(name: str, where: str) -> Callable[[], float]:
    """Import a function that returns a number, or an object that can be called like it."""
    if ":" not in name:
        raise LiveError(f"{where}: {name!r} is not of the form package.module:function")
    found = _made(name, where)
    if not callable(found):
        raise LiveError(f"{where}: {name} cannot be called")
    return cast("Callable[[], float]", found)


def _is_function(found: object) -> bool:
    kinds = (inspect.isfunction, inspect.ismethod, inspect.isbuiltin)
    return any(kind(found) for kind in kinds) or isinstance(found, functools.partial)


def _made(name: str, where: str) -> object:
    """Import the object with a name; call it if it is a class."""
    module_name, _, path = name.partition(":")
    try:
        found: object = importlib.import_module(module_name)
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise LiveError(f"{where}: importing {module_name} failed ({what})") from error
    for part in path.split("."):
        if not hasattr(found, part):
            near = difflib.get_close_matches(part, dir(found), n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise LiveError(f"{where}: {module_name} has no {path!r}{hint}")
        found = getattr(found, part)
    if not isinstance(found, type):
        return found
    try:
        return found()
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise LiveError(f"{where}: {name}() failed ({what})") from error
