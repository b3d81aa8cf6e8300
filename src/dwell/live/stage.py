"""Stages: the user's code, and its messages."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast, runtime_checkable

from dwell.errors import LiveError

__all__ = [
    "Actuator",
    "CellActuator",
    "CellStage",
    "Message",
    "Stage",
    "Stateful",
    "load_actuator",
    "load_function",
    "load_stage",
]


@dataclass(frozen=True, slots=True)
class Message:
    """Input of a stage from a task before it, and its output.

    Parameters
    ----------
    payload : bytes, numpy array, msgspec.Struct, or None
        An array that arrives may not be written to: copy it first.
    cycle : int
        Filled in for messages that arrive.
    released_ns : int
        Release of the cycle on this node's clock, as ``time.monotonic_ns`` counts it.
    age_ms : float
        Time since the release when the stage was called.
    """

    payload: Any = None
    cycle: int = 0
    released_ns: int = 0
    age_ms: float = 0.0


class Stage(Protocol):
    """A task's code. It may also have what else `CellStage` has."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Turn a cycle's inputs, by the task they come from, into its output.

        A source task gets an empty mapping's worth: one message from ``stamper`` without payload.
        """


@runtime_checkable
class Stateful(Protocol):
    """A stage whose state moves with it."""

    def snapshot(self) -> bytes:
        """Write the state as it is after the last call of `process`."""

    def restore(self, state: bytes) -> None:
        """Take a state over."""


class Actuator(Protocol):
    """Applies commands; it is called behind the gate. It may also have ``inputs`` and ``stop()``.

    What raises is called again (docs/deploy.md).
    """

    def apply(self, command: Message) -> None:
        """Apply a command."""

    def hold(self) -> None:
        """Stay as it is: no command came for too long."""

    def zero(self) -> None:
        """Stop: no command came for too long."""


class CellStage(ABC):
    """A stage as a worker calls it: all that a user's need not have has a default.

    Attributes
    ----------
    inputs : mapping of str to type
        By source task, the `msgspec.Struct` that arrives; without, structs arrive as dicts.
    stateful : bool
        Whether its state moves with it: it has `snapshot` of its own.
    has_frames : bool
        Whether it can wait for a frame: it has `wait` of its own.
    """

    inputs: Mapping[str, type] = {}
    stateful: bool = False
    has_frames: bool = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.stateful = cls.snapshot is not CellStage.snapshot
        cls.has_frames = cls.wait is not CellStage.wait

    @abstractmethod
    def process(self, inputs: Mapping[str, Message]) -> Message:
        """As `Stage.process`."""

    def start(self) -> None:
        """Get ready, before the first cycle."""
        return

    def stop(self) -> None:
        """Let go of what it has, after the last cycle."""
        return

    def wait(self) -> object:
        """Return when there is a new frame, which begins a cycle."""
        raise LiveError("no method wait(), though live.release is frames")

    def snapshot(self) -> bytes:
        """As `Stateful.snapshot`."""
        raise LiveError("no method snapshot()")

    def restore(self, state: bytes) -> None:
        """As `Stateful.restore`."""
        raise LiveError("no method restore()")


class CellActuator(ABC):
    """An actuator as a sink calls it: all that a user's need not have has a default.

    Attributes
    ----------
    inputs : mapping of str to type
        By its task, the `msgspec.Struct` that commands are.
    """

    inputs: Mapping[str, type] = {}

    @abstractmethod
    def apply(self, command: Message) -> None:
        """As `Actuator.apply`."""

    def hold(self) -> None:
        """As `Actuator.hold`."""
        return

    def zero(self) -> None:
        """As `Actuator.zero`."""
        return

    def stop(self) -> None:
        """Let go of what it has; called after `zero` where its process is told to end."""
        return


class _UserStage(CellStage):
    """A user's stage, or one that is a function, and what it does without."""

    def __init__(self, given: object, process: Callable[[Mapping[str, Message]], Message]) -> None:
        self._process = process
        self.stateful = isinstance(given, Stateful)
        self.has_frames = callable(getattr(given, "wait", None))
        _take(self, given, ("inputs", "start", "stop", "wait", "snapshot", "restore"))

    def process(self, inputs: Mapping[str, Message]) -> Message:
        return self._process(inputs)


class _UserActuator(CellActuator):
    """A user's actuator, or one that is a function, and what it does without."""

    def __init__(self, given: object, apply: Callable[[Message], None]) -> None:
        self._apply = apply
        _take(self, given, ("inputs", "hold", "zero", "stop"))

    def apply(self, command: Message) -> None:
        self._apply(command)


def _take(own: CellStage | CellActuator, given: object, members: Sequence[str]) -> None:
    """Have those of these members that a user's object has stand before the defaults."""
    for name in members:
        if (member := getattr(given, name, None)) is not None:
            setattr(own, name, member)


def load_stage(name: str, where: str) -> CellStage:
    """Import a stage and make it.

    Parameters
    ----------
    name : str
        ``package.module:Name``, from the local cell file.
    where : str
        Field it stands in, for messages.

    Raises
    ------
    LiveError
        If it is not there, cannot be imported or made, or is no stage.
    """
    found = _made(name, where)
    if isinstance(found, CellStage):
        return found
    process = found if _is_function(found) else getattr(found, "process", None)
    if not callable(process):
        raise LiveError(f"{where}: {name} is no stage: it has no method process(inputs)")
    return _UserStage(found, process)


def load_actuator(name: str, where: str) -> CellActuator:
    """Import an actuator and make it; see `load_stage`."""
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
    """Import a function that returns a number, or an object that is called like one."""
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
    """Return the function or object that a name stands for; a class is called."""
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
