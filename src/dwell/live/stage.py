"""Stages: the user's code, and its messages."""

from __future__ import annotations

import difflib
import functools
import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast, runtime_checkable

from dwell.errors import LiveError

__all__ = [
    "Actuator",
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
    """A task's code. It may also have ``start()``, ``stop()`` and `Stateful`'s two methods.

    An attribute ``inputs``, a mapping from source task to `msgspec.Struct` type, says what the
    structs that arrive are.
    """

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Turn a cycle's inputs, by the task they come from, into its output.

        A source task gets an empty mapping's worth: one message from ``stamper`` without payload.
        """
        ...


@runtime_checkable
class Stateful(Protocol):
    """A stage whose state moves with it."""

    def snapshot(self) -> bytes:
        """Write the state as it is after the last call of `process`."""
        ...

    def restore(self, state: bytes) -> None:
        """Take a state over."""
        ...


class Actuator(Protocol):
    """Applies commands; it is called behind the gate.

    It may also have ``stop()``, which is called after `zero` where its process is told to end.
    What raises is called again (docs/deploy.md).
    """

    def apply(self, command: Message) -> None:
        """Apply a command."""
        ...

    def hold(self) -> None:
        """Stay as it is: no command came for too long."""
        ...

    def zero(self) -> None:
        """Stop: no command came for too long."""
        ...


class _Function:
    """A stage that is one function."""

    def __init__(self, function: Callable[[Mapping[str, Message]], Message]) -> None:
        self.process = function
        self.inputs: Mapping[str, type] = getattr(function, "inputs", {})


class _Apply:
    """An actuator that is one function, and does nothing when commands stay out."""

    def __init__(self, function: Callable[[Message], None]) -> None:
        self.apply = function

    def hold(self) -> None:
        """Do nothing."""

    zero = hold


def load_stage(name: str, where: str) -> Stage:
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
    if callable(getattr(found, "process", None)):
        return cast("Stage", found)
    if _is_function(found):
        return _Function(cast("Callable[[Mapping[str, Message]], Message]", found))
    raise LiveError(f"{where}: {name} is no stage: it has no method process(inputs)")


def load_actuator(name: str, where: str) -> Actuator:
    """Import an actuator and make it; see `load_stage`."""
    found = _made(name, where)
    if callable(getattr(found, "apply", None)):
        for method in ("hold", "zero"):
            if not callable(getattr(found, method, None)):
                raise LiveError(f"{where}: {name} has no method {method}()")
        return cast("Actuator", found)
    if _is_function(found):
        return _Apply(cast("Callable[[Message], None]", found))
    raise LiveError(f"{where}: {name} is no actuator: it has no method apply(command)")


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
