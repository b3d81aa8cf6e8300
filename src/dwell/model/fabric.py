"""Fabric: the computers and the directed links between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

from dwell.model.bounds import (
    ACCELERATORS,
    BACKGROUND,
    BACKGROUND_HZ,
    BURST_MEAN,
    CONTENTION,
    CORES,
    FOREIGN_THREADS,
    INTERFERENCE,
    LOSS,
    QUOTA_CPU,
    QUOTA_PERIOD_MS,
    QUOTA_SLACK_MS,
    QUOTA_TICK_MS,
    RATE_MBPS,
    RETRANSMIT_MS,
    counted,
    require,
)
from dwell.model.frozen import FrozenDict, require_names, shortened
from dwell.model.objective import TIERS, Tier
from dwell.model.process import Constant, Process, require_mean

Scheduler: TypeAlias = Literal["fair", "fifo", "priority"]
SCHEDULERS: tuple[Scheduler, ...] = ("fair", "fifo", "priority")


@dataclass(frozen=True, slots=True)
class Bursts:
    """An alternating renewal process: quiet for `every_ms`, then disturbed for `for_ms`.

    What the disturbance does belongs to what it is declared on: `threads` of foreign work on a
    node, `add_delay_ms` to every message on a link.
    """

    every_ms: Process
    for_ms: Process
    threads: int = 0
    add_delay_ms: Process = field(default_factory=lambda: Constant(0.0))

    def __post_init__(self) -> None:
        for path, process in (("every_ms", self.every_ms), ("for_ms", self.for_ms)):
            require_mean(BURST_MEAN, path, process)
        FOREIGN_THREADS.check("threads", self.threads)

    @property
    def share(self) -> float:
        """Share of the time in which it disturbs."""
        on_ms, off_ms = self.for_ms.expectation, self.every_ms.expectation
        return on_ms / (on_ms + off_ms)


@dataclass(frozen=True, slots=True)
class Quota:
    """CPU bandwidth control: `cpu` cores' worth of run time in every `period_ms`.

    Parameters
    ----------
    slack_ms : float
        Run time that a core has drawn and keeps, beyond the end of a period, when it goes idle.
        Linux keeps 1 ms.
    tick_ms : float
        Time between the ticks at which the kernel notices that the quota is used up, and lets
        threads take turns; 0 for a kernel that notices at once and shares evenly. Linux: 1000 / HZ.
    """

    cpu: float
    period_ms: float
    slack_ms: float = 0.0
    tick_ms: float = 0.0

    def __post_init__(self) -> None:
        QUOTA_CPU.check("quota.cpu", self.cpu)
        QUOTA_PERIOD_MS.check("quota.period_ms", self.period_ms)
        QUOTA_SLACK_MS.check("quota.slack_ms", self.slack_ms)
        QUOTA_TICK_MS.check("quota.tick_ms", self.tick_ms)
        # In nanoseconds it must not be none.
        require(not 0 < self.tick_ms < 0.001, "quota.tick_ms", self.tick_ms, "0, or 0.001 at least")


@dataclass(frozen=True, slots=True)
class Node:
    """A computer.

    Parameters
    ----------
    scheduler : {"fair", "fifo", "priority"}
        How jobs share the cores.
    accelerators : mapping of str to int
        How many of each kind it has.
    bursts : Bursts, optional
        Foreign work of other tenants, in every scenario.
    quota : Quota, optional
        CPU bandwidth limit on everything that runs there.
    background : float
        Cores that are always taken, in small pieces, by others than the jobs; less than
        `capacity`.
    background_beside : float, optional
        What of it is taken while jobs run and no foreign thread does; all of it if left out. Only
        of a node with a quota.
    background_hz : float
        How often in a second something of it wakes, in the mean: what the kernel looks at the quota
        for, and picks anew who runs. Only of a node whose quota has ticks.
    interference : float
        How many times as much core time jobs take while foreign threads run, whose data take the
        place of theirs in the caches; at least 1.
    contention : float
        Share of a CPU's time that others take from what runs there, and that no quota counts: what
        else a machine does whose CPUs the node has not for itself. Only of a node with a quota.
    contention_stressed : mapping of str to float
        The same while another node, by name, has foreign threads: one that has the same CPUs. Of
        several the largest counts.
    """

    name: str
    tier: Tier
    cores: int = 1
    scheduler: Scheduler = "fair"
    accelerators: Mapping[str, int] = field(default_factory=FrozenDict)
    bursts: Bursts | None = None
    quota: Quota | None = None
    background: float = 0.0
    background_beside: float | None = None
    background_hz: float = 0.0
    interference: float = 1.0
    contention: float = 0.0
    contention_stressed: Mapping[str, float] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        require(self.tier in TIERS, "tier", self.tier, f"one of {', '.join(TIERS)}")
        bound = f"one of {', '.join(SCHEDULERS)}"
        require(self.scheduler in SCHEDULERS, "scheduler", self.scheduler, bound)
        CORES.check("cores", self.cores)
        for kind, count in self.accelerators.items():
            ACCELERATORS.check(f"accelerators.{kind}", count)
        if self.bursts is not None and self.bursts.add_delay_ms != Constant(0.0):
            delay = self.bursts.add_delay_ms
            require(False, "bursts.add_delay_ms", delay, "left out: only a link adds a delay")
        INTERFERENCE.check("interference", self.interference)
        BACKGROUND.check("background", self.background)
        bound = f"less than {self.capacity:g}, what the node can do"
        require(self.background < self.capacity, "background", self.background, bound)
        if self.background_beside is not None:
            beside, bound = self.background_beside, f"0 to {self.background:g}, the background"
            require(0.0 <= beside <= self.background, "background_beside", beside, bound)
            bound = "left out: only a quota gives others something to wait for"
            require(self.quota is not None, "background_beside", beside, bound)
        BACKGROUND_HZ.check("background_hz", self.background_hz)
        if self.background_hz > 0.0:
            ticks = self.quota is not None and self.quota.tick_ms > 0
            bound = "0 where there is no `quota` with `tick_ms`; elsewhere it is looked at any time"
            require(ticks, "background_hz", self.background_hz, bound)
        stressed = self.contention_stressed.items()
        shares = {f"contention_stressed.{name}": share for name, share in stressed}
        for path, share in {"contention": self.contention, **shares}.items():
            CONTENTION.check(path, share)
            bound = "0 where there is no quota; elsewhere it is `background`"
            require(self.quota is not None or share == 0.0, path, share, bound)
        if self.quota is not None and self.quota.tick_ms > 0:
            tick_ms, bound = self.quota.tick_ms, "0 where a node has several cores, or is not fair"
            require(self.cores == 1 and self.scheduler == "fair", "quota.tick_ms", tick_ms, bound)
        object.__setattr__(self, "accelerators", FrozenDict(self.accelerators))
        object.__setattr__(self, "contention_stressed", FrozenDict(self.contention_stressed))

    @property
    def capacity(self) -> float:
        """Cores' worth of work it can do: what its utilisation is relative to."""
        return min(self.quota.cpu, self.cores) if self.quota is not None else float(self.cores)

    @property
    def burst_threads(self) -> float:
        """Foreign threads of its bursts, in the mean."""
        return self.bursts.share * self.bursts.threads if self.bursts is not None else 0.0

    @property
    def spare(self) -> float:
        """Cores that jobs and foreign threads share; a quota is what the background takes from."""
        return float(self.cores) if self.quota is not None else self.cores - self.background

    @property
    def pace(self) -> float:
        """Core time that what runs on a core receives of its time."""
        return 1.0 - self.contention

    def wall_ns(self, core_ms: float) -> int:
        """Time in which what runs on a core receives so much core time."""
        return round(core_ms * 1e6 / self.pace)

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
    """What works in a cell, and may be busy: a node's CPU, or the accelerators of one of its kinds.

    Parameters
    ----------
    name : str
        The node's, or ``<node>.<kind>``: ``E.gpu``.
    node : str
        Name of the node.
    kind : str
        Kind of the accelerators; empty for the CPU.
    capacity : float
        What its utilisation is relative to: cores' worth of work, or number of accelerators.
    """

    name: str
    node: str
    kind: str
    capacity: float

    @property
    def path(self) -> str:
        """Where a cell file declares it."""
        return f"nodes.{self.node}.accelerators.{self.kind}" if self.kind else f"nodes.{self.node}"

    @property
    def described(self) -> str:
        """What it is, as messages have it."""
        return f"accelerator {self.kind} of node {self.node}" if self.kind else f"node {self.node}"


def resources_of(nodes: Mapping[str, Node | None]) -> Iterator[Resource]:
    """Yield the CPUs of nodes, in their order, then their accelerators; None is an unknown node."""
    for name, node in nodes.items():
        yield Resource(name, name, "", math.nan if node is None else node.capacity)
    for name, node in nodes.items():
        for kind, count in ({} if node is None else node.accelerators).items():
            yield Resource(accelerator_name(name, kind), name, kind, float(count))


def accelerator_tiers(
    nodes: Mapping[str, Node | None], tiers: Mapping[str, Tier]
) -> dict[str, Tier]:
    """Return the tier of every kind of accelerators of the nodes that have one in J."""
    return {
        one.name: tiers[one.node] for one in resources_of(nodes) if one.kind and one.node in tiers
    }


def accelerator_name(node: str, kind: str) -> str:
    """Return the name of a kind of a node's accelerators as a resource."""
    return f"{node}.{kind}"


@dataclass(frozen=True, slots=True)
class Link:
    """A directed connection.

    Parameters
    ----------
    source, target : str
        Node names.
    delay_ms : Process
        Propagation delay, one value a message.
    rate_mbps : float
        Serialisation rate, megabits a second; infinite where messages do not queue.
    loss : float
        Probability that an attempt to send a message is lost, in [0, 1).
    retransmit_ms : float, optional
        Timeout after which a lost attempt is repeated; None drops the message.
    in_order : bool
        Whether a message waits for those sent before it.
    bursts : Bursts, optional
        Episodes of extra delay, in every scenario.
    """

    source: str
    target: str
    delay_ms: Process
    rate_mbps: float = math.inf
    loss: float = 0.0
    retransmit_ms: float | None = None
    in_order: bool = False
    bursts: Bursts | None = None

    def __post_init__(self) -> None:
        require(self.source != self.target, "to", self.target, "another node than `from`")
        RATE_MBPS.check("rate_mbps", self.rate_mbps)
        LOSS.check("loss", self.loss)
        if self.retransmit_ms is not None:
            RETRANSMIT_MS.check("on_loss.retransmit_ms", self.retransmit_ms)
        if self.bursts is not None:
            threads = self.bursts.threads
            require(threads == 0, "bursts.threads", threads, "left out: only a node has threads")

    @property
    def name(self) -> str:
        """``R1->E``."""
        return f"{self.source}->{self.target}"


@dataclass(frozen=True, slots=True)
class Fabric:
    """Nodes and links."""

    nodes: Mapping[str, Node]
    links: Mapping[str, Link] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        require(len(self.nodes) > 0, "nodes", dict(self.nodes), "at least one node")
        require_names("nodes", self.nodes)
        require_names("links", self.links)
        object.__setattr__(self, "nodes", FrozenDict(self.nodes))
        object.__setattr__(self, "links", FrozenDict(self.links))

    def __repr__(self) -> str:
        nodes = [
            f"{one.name} ({one.tier}, {counted(one.cores, 'core')})" for one in self.nodes.values()
        ]
        return f"<Fabric: {shortened(nodes)}; {counted(len(self.links), 'link')}>"

    @property
    def resources(self) -> Mapping[str, Resource]:
        """The nodes' CPUs, then their accelerators, by name."""
        return {one.name: one for one in resources_of(self.nodes)}

    def tier(self, tier: Tier) -> tuple[str, ...]:
        """Names of a tier's nodes, in the file's order."""
        return tuple(name for name, node in self.nodes.items() if node.tier == tier)
