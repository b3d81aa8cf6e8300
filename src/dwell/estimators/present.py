"""Present: the measured conditions of a cell, and the changes of nodes under them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dwell.estimators.measured import Message, Part
from dwell.kernels.rows import Rows
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats, Ints

#: A fraction of a thread below this counts as 0, above 1 - this as 1.
FRACTION = 0.15
#: Most foreign threads of a node in addition to the declared threads.
MOST_THREADS = 64


@dataclass(frozen=True, slots=True)
class Present:
    """Measured conditions: all that differs from the declared cell."""

    #: Milliseconds, in the order of cycles: times of jobs alone on their node, or delays of
    #: messages, infinite if lost.
    demands: Mapping[Part, Floats] = field(default_factory=FrozenDict)
    #: Foreign threads of a node in addition to its bursts. A negative number is added to the mean
    #: number of declared threads, which is then constant.
    threads: Mapping[str, float] = field(default_factory=FrozenDict)
    #: Nodes that are down.
    down: frozenset[str] = frozenset()
    #: Rates of links.
    rates_mbps: Mapping[str, float] = field(default_factory=FrozenDict)

    def __repr__(self) -> str:
        what = [*map(str, self.demands), *self.threads, *(f"{name} down" for name in self.down)]
        what += [f"{name} at {mbps:.3g} Mbit/s" for name, mbps in self.rates_mbps.items()]
        return f"<Present: {', '.join(what) or 'as declared'}>"

    @property
    def lost(self) -> dict[str, float]:
        """Share of lost messages, by link: the mean of its flows."""
        lost: dict[str, list[float]] = {}
        for part, values in self.demands.items():
            if isinstance(part, Message):
                share = np.count_nonzero(np.isinf(values)) / len(values)
                lost.setdefault(part.link, []).append(share)
        return {link: sum(shares) / len(shares) for link, shares in lost.items()}

    def changes(self, rows: Rows, nodes: Mapping[str, int], release_ns: Ints) -> Rows:
        """Return the changes of nodes with the measured foreign threads and outages.

        `rows` are the declared changes, and `nodes` are the numbers of the nodes in them.
        """
        if not self.threads and not self.down:
            return rows
        other = [name for name in nodes if name in self.threads or name in self.down]
        is_other = np.zeros(1 + max(nodes.values()), np.bool_)
        is_other[[nodes[name] for name in other]] = True
        pieces = [rows[~is_other[rows["node"]]]]
        for name in other:
            own = rows[rows["node"] == nodes[name]]
            pieces.append(with_threads(own, self.threads.get(name, 0.0), release_ns))
            if name in self.down:
                pieces[-1]["is_down"] = 1
        return in_order(pieces)


#: The conditions as declared.
AS_DECLARED = Present()


def in_order(pieces: Sequence[Rows]) -> Rows:
    """Return changes of several nodes in the order of their instants."""
    changes = np.concatenate(pieces)
    return changes[np.argsort(changes["at_ns"], kind="stable")]


def with_threads(rows: Rows, threads: float, release_ns: Ints) -> Rows:
    """Return a node's changes with more or fewer threads; a fraction is a share of periods."""
    at_ns, stress = rows["at_ns"], rows["stress"]
    if threads < 0.0:
        spans = np.diff(np.append(at_ns, max(int(release_ns[-1]), int(at_ns[-1]))))
        usual = float((stress * spans).sum()) / max(float(spans.sum()), 1.0)
        rows, threads = rows[:1].copy(), max(usual + threads, 0.0)
        at_ns, stress = rows["at_ns"], rows["stress"]
    whole = math.floor(min(threads, MOST_THREADS))
    rest = min(threads, MOST_THREADS) - whole
    if rest > 1 - FRACTION:
        whole, rest = whole + 1, 0.0
    if rest < FRACTION:
        changed = rows.copy()
        changed["stress"] += whole
        return changed
    release_ns = release_ns[:-1]
    all_ns = np.sort(np.concatenate((at_ns, release_ns[release_ns > at_ns[0]])))
    # Faster than `np.unique`, which hashes, by a factor of ten: the values are sorted.
    all_ns = all_ns[np.append(True, all_ns[1:] != all_ns[:-1])]
    cycle = np.searchsorted(release_ns, all_ns, side="right")
    more = np.floor((cycle + 1) * rest) - np.floor(cycle * rest)
    changed = np.zeros(len(all_ns), rows.dtype)
    changed["at_ns"], changed["node"] = all_ns, rows["node"][0]
    last = np.searchsorted(at_ns, all_ns, side="right") - 1
    changed["stress"] = stress[last] + whole + more.astype(np.int64)
    changed["is_down"] = rows["is_down"][last]
    return changed
