"""Fabric: the computers and the directed links between them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Literal, NamedTuple, TypeAlias

from dwell.model.bounds import (
    BACKGROUND_HZ,
    BURST_MEAN,
    FOREIGN_THREADS,
    LARGEST,
    RATE_MBPS,
    Bound,
    counted,
    require,
)
from dwell.model.declaration import declared, key
from dwell.model.frozen import FrozenDict, require_names, shortened
from dwell.model.objective import Tier
from dwell.model.process import Constant, Process, require_mean

Scheduler: TypeAlias = Literal["fair", "fifo", "priority"]


@declared()
class Bursts:
    """Episodes of disturbance in every scenario: quiet for `every_ms`, then disturbed.

    On a node a burst adds `threads` of foreign work; on a link it adds `add_delay_ms` to every
    message.
    """

    every_ms: Process = key("Quiet time between bursts, ms; mean above 0.01.")
    for_ms: Process = key("Duration of a burst, ms; mean above 0.01.")
    threads: int = key("Threads of foreign work during a burst.", FOREIGN_THREADS, default=0)
    add_delay_ms: Process = key(
        "Added to the delay of every message during a burst, ms.",
        default_factory=lambda: Constant(0.0),
    )

    def __post_init__(self) -> None:
        for path, process in (("every_ms", self.every_ms), ("for_ms", self.for_ms)):
            require_mean(BURST_MEAN, path, process)

    @property
    def share(self) -> float:
        """Expected share of the time within a burst."""
        on_ms, off_ms = self.for_ms.expectation, self.every_ms.expectation
        return on_ms / (on_ms + off_ms)


@declared("quota")
class Quota:
    """CPU bandwidth control of the kernel (cgroup), on the cell's own work."""

    cpu: float = key("Cores' worth of run time in every period.", Bound(1e-3, 4096))
    period_ms: float = key("Period after which the budget is filled again, ms.", Bound(1, 1000))
    slack_ms: float = key(
        "Run time that a core has drawn and keeps, beyond the end of a period, when it goes idle, "
        "ms. Linux keeps 1.",
        Bound(0, 1000),
        default=0.0,
        is_rare=True,
        tier="measured",
    )
    tick_ms: float = key(
        "Time between the ticks at which a used-up budget is noticed and threads take turns, ms; "
        "0: at once, and threads share evenly. Linux: 1000 / HZ. One core, `fair`.",
        Bound(0, 1000),
        default=0.0,
        is_rare=True,
        tier="measured",
    )

    def __post_init__(self) -> None:
        # A smaller tick would round to 0 ns.
        require(not 0 < self.tick_ms < 0.001, "quota.tick_ms", self.tick_ms, "0, or 0.001 at least")


@declared()
class Node:
    """A computer."""

    name: str
    tier: Tier = key("Kind of computer: robot, edge or cloud.", tier="first")
    cores: int = key("Cores of its CPU.", Bound(1, 4096, whole=True), default=1, tier="first")
    scheduler: Scheduler = key(
        "How jobs share the cores: `fair` (processor sharing), `fifo` (one after another) or "
        "`priority` (preemptive, by the tasks' `priority`).",
        default="fair",
    )
    accelerators: Mapping[str, int] = key(
        "How many accelerators of each kind it has, as `{gpu: 1}`.",
        Bound(1, 4096, whole=True),
        default_factory=FrozenDict,
    )
    price_per_hour: float = key(
        "Money per hour while a placement uses it; in reports only, not in J.",
        Bound(0, LARGEST),
        default=0.0,
        is_rare=True,
    )
    bursts: Bursts | None = key(
        "Foreign work of other tenants, in every scenario.", default=None, tier="measured"
    )
    quota: Quota | None = key("CPU bandwidth limit on everything that runs there.", default=None)
    background: float = key(
        "Cores that other work always takes, in small pieces; less than the node's capacity.",
        Bound(0, 4096),
        default=0.0,
        is_rare=True,
        tier="measured",
    )
    background_beside: float | None = key(
        "Part of `background` that is used while jobs run without foreign threads, on a node "
        "with a quota.",
        Bound(0, 4096),
        default=None,
        usual="all of it",
        tier="measured",
    )
    background_hz: float = key(
        "Mean wake-ups of `background` per second, on a node whose quota has `tick_ms`: each "
        "makes the kernel check the quota and schedule again.",
        BACKGROUND_HZ,
        default=0.0,
        is_rare=True,
        tier="measured",
    )
    interference: float = key(
        "Factor on the core time of jobs while foreign threads run and replace the jobs' data in "
        "the caches.",
        Bound(1, 100),
        default=1.0,
        is_rare=True,
        tier="measured",
    )

    def __post_init__(self) -> None:
        if self.bursts is not None and self.bursts.add_delay_ms != Constant(0.0):
            delay = self.bursts.add_delay_ms
            require(False, "bursts.add_delay_ms", delay, "left out: only a link adds a delay")
        bound = f"less than {self.capacity:g}, the node's capacity"
        require(self.background < self.capacity, "background", self.background, bound)
        if self.background_beside is not None:
            beside, bound = self.background_beside, f"0 to {self.background:g}, the background"
            require(0.0 <= beside <= self.background, "background_beside", beside, bound)
            bound = "left out: only a quota gives others something to wait for"
            require(self.quota is not None, "background_beside", beside, bound)
        if self.background_hz > 0.0:
            ticks = self.quota is not None and self.quota.tick_ms > 0
            bound = "0 without a `quota` with `tick_ms`, which is checked at any time"
            require(ticks, "background_hz", self.background_hz, bound)
        if self.quota is not None and self.quota.tick_ms > 0:
            tick_ms, bound = self.quota.tick_ms, "0 where a node has several cores, or is not fair"
            require(self.cores == 1 and self.scheduler == "fair", "quota.tick_ms", tick_ms, bound)

    @property
    def capacity(self) -> float:
        """Number of cores that its utilisation is relative to, at most the quota."""
        return min(self.quota.cpu, self.cores) if self.quota is not None else float(self.cores)

    @property
    def burst_threads(self) -> float:
        """Mean number of foreign threads of its bursts."""
        return self.bursts.share * self.bursts.threads if self.bursts is not None else 0.0

    @property
    def spare(self) -> float:
        """Cores for jobs and foreign threads; with a quota, the background reduces the quota."""
        return float(self.cores) if self.quota is not None else self.cores - self.background

    @property
    def budget_ms(self) -> float:
        """Core time that jobs have in each of the quota's periods without foreign threads, ms."""
        beside = self.background_beside
        return self._budget_ms(self.background if beside is None else beside)

    @property
    def stressed_budget_ms(self) -> float:
        """Core time that jobs and foreign threads have in each of the quota's periods, ms."""
        return self._budget_ms(self.background)

    def _budget_ms(self, background: float) -> float:
        if self.quota is None:
            return math.inf
        cpu = self.capacity - background if background else self.quota.cpu
        return cpu * self.quota.period_ms


class Resource(NamedTuple):
    """A node's CPU, or its accelerators of one kind."""

    #: The node's name, or ``<node>.<kind>``: ``E.gpu``.
    name: str
    #: Name of the node.
    node: str
    #: Kind of the accelerators; empty for the CPU.
    kind: str
    #: Number of cores, at most the quota, or number of accelerators.
    capacity: float

    @property
    def path(self) -> str:
        """Its path in a cell file."""
        return f"nodes.{self.node}.accelerators.{self.kind}" if self.kind else f"nodes.{self.node}"

    @property
    def described(self) -> str:
        """Its description in messages."""
        return f"accelerator {self.kind} of node {self.node}" if self.kind else f"node {self.node}"


def resources_of(nodes: Mapping[str, Node | None]) -> Iterator[Resource]:
    """Yield the CPUs of nodes, then their accelerators, in order; None is an unknown node."""
    for name, node in nodes.items():
        yield Resource(name, name, "", math.nan if node is None else node.capacity)
    for name, node in nodes.items():
        for kind, count in ({} if node is None else node.accelerators).items():
            yield Resource(accelerator_name(name, kind), name, kind, float(count))


def accelerator_tiers(
    nodes: Mapping[str, Node | None], tiers: Mapping[str, Tier]
) -> dict[str, Tier]:
    """Return the tier of every kind of accelerators of the nodes in `tiers`."""
    return {
        one.name: tiers[one.node] for one in resources_of(nodes) if one.kind and one.node in tiers
    }


def accelerator_name(node: str, kind: str) -> str:
    """Return the name of a kind of a node's accelerators as a resource."""
    return f"{node}.{kind}"


@declared()
class Link:
    """A directed connection between two nodes."""

    source: str = key("Node that sends.", named="from", tier="first")
    target: str = key("Node that receives.", named="to", tier="first")
    delay_ms: Process = key("Propagation delay of a message, ms.", tier="first")
    rate_mbps: float = key(
        "Serialisation rate, megabits per second; without it messages do not queue.",
        RATE_MBPS,
        default=math.inf,
        usual="unlimited",
        tier="first",
    )
    loss: float = key(
        "Probability that an attempt to send a message is lost.",
        Bound(0, 1, below=True),
        default=0.0,
        tier="first",
    )
    retransmit_ms: float | None = key(
        "Time after which a lost message is sent again, ms; without it the message is dropped.",
        Bound(1e-3, LARGEST),
        default=None,
        named="on_loss.retransmit_ms",
    )
    price_per_gb: float = key(
        "Money per 10⁹ payload bytes that it transmits, lost and repeated messages included.",
        Bound(0, LARGEST),
        default=0.0,
        is_rare=True,
    )
    in_order: bool = key(
        "Whether messages arrive in the order in which they were sent; they wait for a lost "
        "message that is sent again.",
        default=False,
    )
    bursts: Bursts | None = key(
        "Episodes of extra delay, in every scenario.", default=None, tier="measured"
    )

    def __post_init__(self) -> None:
        require(self.source != self.target, "to", self.target, "another node than `from`")
        if self.bursts is not None:
            threads = self.bursts.threads
            require(threads == 0, "bursts.threads", threads, "left out: only a node has threads")

    @property
    def name(self) -> str:
        """``R1->E``."""
        return f"{self.source}->{self.target}"

    @property
    def price_per_byte(self) -> float:
        """Money per byte that it transmits."""
        return self.price_per_gb / 1e9


@declared()
class Fabric:
    """Nodes and links."""

    nodes: Mapping[str, Node] = key("Computers by name.", tier="first")
    links: Mapping[str, Link] = key(
        "Connections between nodes.", default_factory=FrozenDict, tier="first"
    )

    def __post_init__(self) -> None:
        require(len(self.nodes) > 0, "nodes", dict(self.nodes), "at least one node")
        require_names("nodes", self.nodes)
        require_names("links", self.links)

    def __repr__(self) -> str:
        nodes = [
            f"{one.name} ({one.tier}, {counted(one.cores, 'core')})" for one in self.nodes.values()
        ]
        return f"<Fabric: {shortened(nodes)}; {counted(len(self.links), 'link')}>"

    @property
    def resources(self) -> Mapping[str, Resource]:
        """The nodes' CPUs, then their accelerators, by name."""
        return {one.name: one for one in resources_of(self.nodes)}

    @property
    def has_prices(self) -> bool:
        """Whether bytes on some link have a price."""
        return any(link.price_per_gb > 0 for link in self.links.values())

    @property
    def has_node_prices(self) -> bool:
        """Whether some node has a price."""
        return any(node.price_per_hour > 0 for node in self.nodes.values())

    def price_per_hour(self, nodes: Collection[str]) -> float:
        """Price of some nodes, money per hour."""
        return sum(node.price_per_hour for name, node in self.nodes.items() if name in nodes)

    def tier(self, tier: Tier) -> tuple[str, ...]:
        """Names of a tier's nodes, in the file's order."""
        return tuple(name for name, node in self.nodes.items() if node.tier == tier)
