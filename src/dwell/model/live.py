"""Addresses of the nodes of a live cell, and settings of its processes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from dwell.model.bounds import AGE_MS, CHECKPOINT_CYCLES, DEGRADED_AT, PORT, require
from dwell.model.frozen import FrozenDict

RELEASES = ("timer", "frames")
CLOCKS = ("estimated", "system")
MODES = ("control", "advise")
SILENCES = ("hold", "zero")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An address and the first of the ports behind it."""

    address: str
    port: int

    def __post_init__(self) -> None:
        require(bool(self.address.strip()), "address", self.address, "a host's name or address")
        PORT.check("port", self.port)


@dataclass(frozen=True, slots=True)
class Host:
    """Address and ports of a node's processes.

    Parameters
    ----------
    port : int
        First port; each process of the node takes three.
    seen_from : mapping of str to Endpoint
        Where it is reached from those nodes that do not reach it there: behind a translation of
        addresses, a tunnel, or the links of a demonstration.
    """

    address: str = "127.0.0.1"
    port: int = 7450
    seen_from: Mapping[str, Endpoint] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        Endpoint(self.address, self.port)
        object.__setattr__(self, "seen_from", FrozenDict(self.seen_from))

    def endpoint(self, node: str) -> Endpoint:
        """Address and port by which another node reaches it."""
        return self.seen_from.get(node) or Endpoint(self.address, self.port)


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """Settings of the live runtime, beside the problem.

    Parameters
    ----------
    hosts : mapping of str to Host
        By node.
    release : {"timer", "frames"}
        Whether a cycle begins by the clock, or when the first source has a frame.
    clock : {"estimated", "system"}
        Whether clocks are compared by messages, or taken for synchronous (PTP, chrony).
    mode : {"control", "advise"}
        Whether decisions are carried out, or recorded only.
    relay : str, optional
        Node that carries small messages where a direct link fails; the controller's where None.
    max_age_ms : float, optional
        Age from which a command is not applied; two periods where None.
    silence : {"hold", "zero"}
        What the actuator is told when no command comes.
    checkpoint_cycles : int
        Cycles between two copies of a task's state to its fallback; 0 for none.
    degraded_at : float
        Share of the cycles of the last windows that may miss before the cell is degraded.
    actuators : mapping of str to str
        ``module:Name`` of what applies the commands of each sink task.
    observer : str, optional
        ``module:Name`` of what looks on, where `dwell live run` runs the cell: at the error of what
        it controls, say.
    """

    hosts: Mapping[str, Host] = field(default_factory=FrozenDict)
    release: str = "timer"
    clock: str = "estimated"
    mode: str = "control"
    relay: str | None = None
    max_age_ms: float | None = None
    silence: str = "hold"
    checkpoint_cycles: int = 25
    degraded_at: float = 0.1
    actuators: Mapping[str, str] = field(default_factory=FrozenDict)
    observer: str | None = None

    def __post_init__(self) -> None:
        words = (("release", RELEASES), ("clock", CLOCKS), ("mode", MODES), ("silence", SILENCES))
        for name, known in words:
            value = getattr(self, name)
            require(value in known, f"live.{name}", value, f"one of {', '.join(known)}")
        if self.max_age_ms is not None:
            AGE_MS.check("live.max_age_ms", self.max_age_ms)
        CHECKPOINT_CYCLES.check("live.checkpoint_cycles", self.checkpoint_cycles)
        DEGRADED_AT.check("live.degraded_at", self.degraded_at)
        for task, name in self.actuators.items():
            require_callable_name(f"live.actuators.{task}", name)
        if self.observer is not None:
            require_callable_name("live.observer", self.observer)
        object.__setattr__(self, "hosts", FrozenDict(self.hosts))
        object.__setattr__(self, "actuators", FrozenDict(self.actuators))


def require_callable_name(path: str, name: str) -> None:
    """Raise a ProblemError unless `name` has the form ``package.module:Name``."""
    module, colon, attribute = name.partition(":")
    parts = f"{module}.{attribute}".split(".")
    holds = bool(colon) and all(part.isidentifier() for part in parts)
    require(holds, path, name, "of the form package.module:Name")
