"""Realisation: one draw of everything random in a scenario, before any policy acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["LinkSegment", "NodeChange", "Realisation"]


class NodeChange(NamedTuple):
    """From `at_ns` on, a node has `threads` foreign threads in all, and is `down` or not."""

    at_ns: int
    node: str
    threads: int
    down: bool


class LinkSegment(NamedTuple):
    """From `at_ns` until the link's next segment: its whole state, its own loss and rate included.

    Parameters
    ----------
    at_ns : int
        Begin; the first segment of a link begins at 0.
    link : str
        ``R1->E``.
    down : bool
    loss : float
        Probability that one attempt is lost.
    rate_mbps : float
        Infinite where messages do not queue.
    layers : tuple of int
        Which of the link's extra-delay layers add to the delay of every message.
    """

    at_ns: int
    link: str
    down: bool
    loss: float
    rate_mbps: float
    layers: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Realisation:
    """All that is random in a run of N cycles, for every feasible (task, node) and every link.

    Parameters
    ----------
    scenario : str
    seed : int or None
        None where it was recorded, not drawn.
    windows : int
        Windows of W cycles the run has; N = windows * W.
    release_ns : int64 array, shape (N + 1,)
        Release instant of every cycle, ascending; the last entry closes the last window.
    sites : tuple of (task, node)
        Rows of `exec_ns`.
    exec_ns : int64 array, shape (sites, N)
        Execution time of each cycle's job, scale included.
    hops : tuple of (source task, target task, link)
        Rows of `delay_ns` and `loss_keys`: a flow on a link that it crosses in some candidate.
    delay_ns : int64 array, shape (hops, N)
        Propagation delay of each cycle's message, without disturbances.
    loss_keys : uint64 array, shape (hops,)
        Stream of the attempts of each hop (see `dwell.kernels.streams.attempt_uniform`).
    layers : tuple of (hop index, layer)
        Rows of `extra_ns`; `layer` counts per link.
    extra_ns : int64 array, shape (layers, N)
        Extra delay of each cycle's message while the layer is active.
    node_changes : tuple of NodeChange
        Ascending in time.
    link_segments : tuple of LinkSegment
        Per link ascending in time.
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
    node_changes: tuple[NodeChange, ...]
    link_segments: tuple[LinkSegment, ...]

    @property
    def cycles(self) -> int:
        """N."""
        return len(self.release_ns) - 1
