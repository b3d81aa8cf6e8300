"""Addresses of the nodes of a live cell, and settings of its processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from dwell.model.bounds import LARGEST, MAX_COUNT, Bound, require
from dwell.model.declaration import declared, key
from dwell.model.frozen import FrozenDict
from dwell.model.objective import AIM
from dwell.model.ros_topics import RosActuator

#: Number of closed windows whose V_D determines whether a cell is degraded.
RECENT_WINDOWS = 3

PORT = Bound(1024, 65_000, whole=True)


@declared()
class Endpoint:
    """An address and the first of the ports behind it."""

    address: str = key("Name or address of the host.")
    port: int = key("First port.", PORT)

    def __post_init__(self) -> None:
        require(bool(self.address.strip()), "address", self.address, "a host's name or address")


@declared()
class Host:
    """The addresses on which a node's processes listen."""

    address: str = key("Name or address of the host.", default="127.0.0.1", tier="first")
    port: int = key(
        "First port; each process of the node takes three.", PORT, default=7450, tier="first"
    )
    seen_from: Mapping[str, Endpoint] = key(
        "Other addresses for nodes that need them: behind NAT, a tunnel, or emulated links.",
        default_factory=FrozenDict,
    )

    def __post_init__(self) -> None:
        Endpoint(self.address, self.port)

    def endpoint(self, node: str) -> Endpoint:
        """Address and port by which another node reaches it."""
        return self.seen_from.get(node) or Endpoint(self.address, self.port)


@declared("live")
class LiveSettings:
    """Settings of the live runtime, in addition to the problem."""

    hosts: Mapping[str, Host] = key(
        "Address of each node.",
        default_factory=FrozenDict,
        usual="all are this machine",
        digested="hosts",
        tier="first",
    )
    release: Literal["timer", "frames"] = key(
        "Whether a cycle begins by the clock (`timer`), or when the first source has a picture "
        "(`frames`).",
        default="timer",
    )
    clock: Literal["estimated", "system"] = key(
        "Whether clocks are compared by messages (`estimated`), or taken for synchronous "
        "(`system`: PTP, chrony).",
        default="estimated",
    )
    mode: Literal["control", "advise"] = key(
        "Whether decisions are carried out (`control`) or recorded (`advise`).",
        default="control",
        digested="decision",
    )
    relay: str | None = key(
        "Node that carries small messages if a direct link fails.",
        default=None,
        usual="the controller's",
    )
    max_age_ms: float | None = key(
        "Age from which a command is not applied, ms; at least D.",
        Bound(0, LARGEST, above=True),
        default=None,
        usual="max(2 nP, D + nP) of a task that runs in every n-th cycle",
    )
    silence: Literal["hold", "zero"] = key(
        "Method of the actuator that is called without commands.", default="hold"
    )
    checkpoint_cycles: int = key(
        "Runs of a task between copies of its state to its fallback; 0: none.",
        Bound(0, MAX_COUNT, whole=True),
        default=25,
    )
    degraded_at: float = key(
        "Share of the cycles of the last three windows above which the cell is degraded: missed, "
        "not applied, or released too often or too seldom.",
        Bound(0, 1),
        default=AIM,
    )
    actuators: Mapping[str, str | RosActuator] = key(
        "Actuator of each sink task: `package.module:Name`, or `{ros2: {...}}` for a ROS 2 topic.",
        default_factory=FrozenDict,
        digested="code",
        tier="first",
    )
    observer: str | None = key(
        "Observer of the cell in `dwell live run`, as `package.module:Name`.",
        default=None,
        digested="decision",
    )

    def __post_init__(self) -> None:
        for task, actuator in self.actuators.items():
            if isinstance(actuator, str):
                require_callable_name(f"live.actuators.{task}", actuator)
        if self.observer is not None:
            require_callable_name("live.observer", self.observer)

    def require_in_time(self, deadline_ms: float) -> None:
        """Check that no command within its deadline is too old for the actuator.

        Raises
        ------
        ProblemError
            If `max_age_ms` is given and less than the deadline.
        """
        given_ms = self.max_age_ms
        bound = f"at least deadline_ms = {deadline_ms:g}; raise it, or leave it out"
        require(given_ms is None or given_ms >= deadline_ms, "live.max_age_ms", given_ms, bound)

    def degraded_by(self, rates: Sequence[float]) -> bool:
        """Return whether V_D of the last windows is too high, both on average and in the last.

        The condition on the last window ends the state soon after a disturbance.
        """
        return bool(rates) and min(sum(rates) / len(rates), rates[-1]) > self.degraded_at


def require_callable_name(path: str, name: str) -> None:
    """Raise a ProblemError unless `name` has the form ``package.module:Name``."""
    module, colon, attribute = name.partition(":")
    parts = f"{module}.{attribute}".split(".")
    holds = bool(colon) and all(part.isidentifier() for part in parts)
    require(holds, path, name, "of the form package.module:Name")
