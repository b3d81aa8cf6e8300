"""Realisation: one sample of all random quantities of a scenario, independent of the policy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.model import Problem
from dwell.model.bounds import counted


class NodeChange(NamedTuple):
    """State of a node from `at_ns` on: number of foreign threads, and whether it is down."""

    at_ns: int
    node: str
    threads: int
    down: bool


class LinkSegment(NamedTuple):
    """Complete state of a link from `at_ns` until the link's next segment.

    Parameters
    ----------
    at_ns : int
        Begin; the first segment of a link begins at 0.
    link : str
        Name of the link, such as ``R1->E``.
    loss : float
        Probability that an attempt is lost, from the link itself and from disturbances.
    rate_mbps : float
        Infinite if messages do not queue.
    layers : tuple of int
        Active layers of extra delay, which add to the delay of every message.
    """

    at_ns: int
    link: str
    down: bool
    loss: float
    rate_mbps: float
    layers: tuple[int, ...]


class Phase(NamedTuple):
    """Phase of the quota periods and timer ticks of a node.

    Parameters
    ----------
    period_ago_ns, tick_ago_ns : int
        Time from the begin of a quota period, and from the last tick, to time 0.
    wakes : int
        Random stream of the times between wakes of the background (see ``attempts.h``), 63 bits.
    """

    period_ago_ns: int = 0
    tick_ago_ns: int = 0
    wakes: int = 0


class TraceStart(NamedTuple):
    """First row of the replay of a trace.

    Parameters
    ----------
    file : str
        Name of the trace file in the cell file.
    columns : tuple of str
        Columns that are replayed from this row on.
    row : int
        Row of the first cycle, counted from 1 without the rows that ``on_negative: drop`` omits.
    """

    file: str
    columns: tuple[str, ...]
    row: int


class NodeChanges(Sequence[NodeChange]):
    """Changes of all nodes, in ascending order of time; a sequence of `NodeChange`.

    Attributes
    ----------
    nodes : tuple of str
        Names of the nodes; the column `node` contains indices into them.
    table : int64 array, shape (changes, 4)
        Columns at_ns, node, threads, down.
    """

    def __init__(self, nodes: tuple[str, ...], table: NDArray[np.int64]) -> None:
        self.nodes, self.table = nodes, table

    @classmethod
    def of(cls, changes: Iterable[NodeChange]) -> NodeChanges:
        """Return changes as arrays."""
        if isinstance(changes, NodeChanges):
            return changes
        rows = list(changes)
        nodes = tuple(dict.fromkeys(change.node for change in rows))
        table = [[c.at_ns, nodes.index(c.node), c.threads, c.down] for c in rows]
        return cls(nodes, np.array(table, np.int64).reshape(len(rows), 4))

    def __repr__(self) -> str:
        return (
            f"<NodeChanges: {counted(len(self), 'change')} of {counted(len(self.nodes), 'node')}>"
        )

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, index: Any) -> Any:
        """Return a change, or the changes of a slice."""
        if isinstance(index, slice):
            return NodeChanges(self.nodes, self.table[index])
        at_ns, node, threads, down = self.table[index].tolist()
        return NodeChange(at_ns, self.nodes[node], threads, bool(down))


class LinkSegments(Sequence[LinkSegment]):
    """Segments of all links, in ascending order of time per link; a sequence of `LinkSegment`.

    Attributes
    ----------
    links : tuple of str
        Names of the links; the column `link` contains indices into them.
    table : int64 array, shape (segments, 4)
        Columns at_ns, link, down, and the layers as bits.
    table_f : float64 array, shape (segments, 2)
        Columns rate_mbps and loss.
    """

    def __init__(
        self, links: tuple[str, ...], table: NDArray[np.int64], table_f: NDArray[np.float64]
    ) -> None:
        self.links, self.table, self.table_f = links, table, table_f

    @classmethod
    def of(cls, segments: Iterable[LinkSegment]) -> LinkSegments:
        """Return segments as arrays."""
        if isinstance(segments, LinkSegments):
            return segments
        rows = list(segments)
        links = tuple(dict.fromkeys(segment.link for segment in rows))
        table = [
            [s.at_ns, links.index(s.link), s.down, sum(1 << layer for layer in s.layers)]
            for s in rows
        ]
        return cls(
            links,
            np.array(table, np.int64).reshape(len(rows), 4),
            np.array([[s.rate_mbps, s.loss] for s in rows], np.float64).reshape(len(rows), 2),
        )

    def __repr__(self) -> str:
        of = counted(len(self.links), "link")
        return f"<LinkSegments: {counted(len(self), 'segment')} of {of}>"

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, index: Any) -> Any:
        """Return a segment, or the segments of a slice."""
        if isinstance(index, slice):
            return LinkSegments(self.links, self.table[index], self.table_f[index])
        at_ns, link, down, mask = self.table[index].tolist()
        rate_mbps, loss = self.table_f[index].tolist()
        layers = tuple(i for i in range(mask.bit_length()) if mask >> i & 1)
        return LinkSegment(at_ns, self.links[link], bool(down), loss, rate_mbps, layers)


@dataclass(frozen=True, slots=True, eq=False)
class Realisation:
    """All random quantities of a run of N cycles, for every feasible (task, node) and every link.

    Parameters
    ----------
    seed : int or None
        None if the realisation was recorded.
    windows : int
        Number of windows of W cycles; N = windows * W, or less if the last window is incomplete.
    release_ns : int64 array, shape (N + 1,)
        Release instant of every cycle, ascending; the last entry is the release after the N cycles.
    sites : tuple of (task, node)
        Rows of `exec_ns`.
    exec_ns : int64 array, shape (sites, N)
        Execution time of each cycle's job, scale included; 0 in cycles in which the task is not
        due. The same holds for delays.
    hops : tuple of (source task, target task, link)
        Rows of `delay_ns` and `loss_keys`: a flow and a link that it uses in some candidate.
    delay_ns : int64 array, shape (hops, N)
        Propagation delay of each cycle's message, without disturbances.
    loss_keys : uint64 array, shape (hops,)
        Random stream of the attempts of each hop (see ``attempts.h``).
    layers : tuple of (hop index, layer)
        Rows of `extra_ns`; `layer` counts per link.
    extra_ns : int64 array, shape (layers, N)
        Extra delay of each cycle's message while the layer is active.
    node_changes : sequence of NodeChange
        Ascending in time; kept as `NodeChanges`.
    link_segments : sequence of LinkSegment
        Per link ascending in time; kept as `LinkSegments`.
    phases : mapping of str to Phase
        Phases of the nodes whose kernel checks quotas at ticks; other nodes have phase 0.
    trace_starts : tuple of TraceStart
        First row of each replayed trace.
    streams : str
        Prefix of the names of the random streams.
    forwards : tuple of (source task, target task, link)
        A sampled flow, and a link over which a node forwards its messages after the target has
        moved. Their rows of `delay_ns` and `loss_keys`, and their hop indices, follow those of
        `hops`; the columns are the cycles that the messages carry.
    """

    scenario: str
    seed: int | None
    windows: int
    release_ns: NDArray[np.int64]
    sites: tuple[tuple[str, str], ...]
    exec_ns: NDArray[np.int64]
    hops: tuple[tuple[str, str, str], ...]
    delay_ns: NDArray[np.int64]
    loss_keys: NDArray[np.uint64]
    layers: tuple[tuple[int, int], ...]
    extra_ns: NDArray[np.int64]
    node_changes: Sequence[NodeChange]
    link_segments: Sequence[LinkSegment]
    phases: Mapping[str, Phase] = field(default_factory=dict)
    trace_starts: tuple[TraceStart, ...] = ()
    streams: str = ""
    forwards: tuple[tuple[str, str, str], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "node_changes", NodeChanges.of(self.node_changes))
        object.__setattr__(self, "link_segments", LinkSegments.of(self.link_segments))

    def __repr__(self) -> str:
        return (
            f"<Realisation: {self.scenario}, seed {self.seed}, "
            f"{counted(self.windows, 'window')}, {counted(self.cycles, 'cycle')}; "
            f"{counted(len(self.sites), 'site')}, {counted(len(self.hops), 'hop')}>"
        )

    def until(self, cycles: int) -> Realisation:
        """Return the first cycles; the last window may become incomplete."""
        if cycles == self.cycles:
            return self
        return replace(
            self,
            release_ns=self.release_ns[: cycles + 1],
            exec_ns=self.exec_ns[:, :cycles],
            delay_ns=self.delay_ns[:, :cycles],
            extra_ns=self.extra_ns[:, :cycles],
        )

    def is_cut(self, problem: Problem) -> bool:
        """Whether the last window is incomplete."""
        return self.cycles < self.windows * problem.window_cycles

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.release_ns) - 1
