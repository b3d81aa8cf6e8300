"""Waiting times of missed cycles, for resources and for links."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.arrays import CellArrays, flow_columns
from dwell.kernels.over_age import misses, stale_origins
from dwell.kernels.realisation import LinkSegments, Realisation
from dwell.model import Problem
from dwell.model.number_arrays import Ints
from dwell.model.placement import Copy

#: Waiting time in nanoseconds by ("resource", "E.gpu") or ("link", "R1->E").
Waiting: TypeAlias = Counter[tuple[str, str]]


def waiting_of(problem: Problem, real: Realisation, arrays: CellArrays) -> Waiting:
    """Sum the waiting times of the missed cycles after the warm-up; needs the log of all jobs.

    If a cycle's data are over the age limit of a chain, their cycle of origin counts, too.

    The wait for a resource is the time from readiness to completion minus the execution time. The
    wait for a link is the time until the message is sent, plus the time of repeated attempts.
    """
    tables, pipeline = arrays.tables, problem.pipeline
    first, last = problem.warmup_windows * problem.window_cycles, real.cycles
    counted = pipeline, real.release_ns, arrays, slice(first, last)
    # Old data waited in the cycle that they descend from.
    cycles = np.concatenate((first + np.flatnonzero(misses(*counted)), stale_origins(*counted)))
    logs, _, arrivals, _ = arrays.logs()
    log, arrived = logs[0, cycles], arrivals[0, cycles][:, flow_columns(problem)]
    stamps = tables.stamps[0, cycles]
    names, n_flows = [*pipeline.tasks], len(pipeline.flows)
    waits = Waiting()
    codes = [*problem.candidates]
    for name, copy, placement in _copies(problem):
        under = stamps == codes.index(name)
        if not under.any():
            continue
        # Common tasks have no job in the columns of the second copy.
        of, these = log[under], cycles[under]
        for task in names:
            i, node = copy * len(names) + names.index(task), placement[task]
            exec_ns = real.exec_ns[real.sites.index((task, node)), these]
            spent = of["end_ns"][:, i] - of["ready_ns"][:, i] - exec_ns
            resource = pipeline.tasks[task].on[node].resource(node)
            waits["resource", resource] += _sum(spent, of["end_ns"][:, i] >= 0)
        for j, flow in enumerate(pipeline.flows, copy * n_flows):
            here, there = placement[flow.source], placement[flow.target]
            if here == there:
                continue
            link = f"{here}->{there}"
            sent = of["end_ns"][:, names.index(flow.source)]
            if copy and placement[flow.source] != problem.candidates[name].first[flow.source]:
                sent = of["end_ns"][:, len(names) + names.index(flow.source)]
            own = _unhindered(
                real, (flow.source, flow.target, link), flow.payload_bytes, these, sent
            )
            known = (sent >= 0) & (arrived[under][:, j] >= 0)
            waits["link", link] += _sum(arrived[under][:, j] - sent - own, known)
    return waits


def _copies(problem: Problem) -> Iterator[tuple[str, int, Copy]]:
    """Yield the name of each candidate with the number and the placement of each copy."""
    for name, placement in problem.candidates.items():
        for number, copy in enumerate(placement.copies):
            yield name, number, copy


def _sum(waited_ns: Ints, known: NDArray[np.bool_]) -> int:
    return int(waited_ns[known].clip(min=0).sum())


def _unhindered(
    real: Realisation, hop: tuple[str, str, str], payload_bytes: int, cycles: Ints, sent: Ints
) -> Ints:
    """Return the transfer times (ns) of messages on a free link without loss."""
    row = real.hops.index(hop)
    taken = real.delay_ns[row, cycles].astype(np.float64)
    pieces = LinkSegments.of(real.link_segments)
    if hop[2] in pieces.links:
        own = pieces.table[:, 1] == pieces.links.index(hop[2])
        segments, rates = pieces.table[own], pieces.table_f[own, 0]
        at = np.searchsorted(segments[:, 0], sent, side="right").clip(min=1) - 1
        taken += np.rint(payload_bytes * 8000.0 / rates[at])
        for extra, (of, layer) in zip(real.extra_ns, real.layers, strict=True):
            if of == row:
                taken += extra[cycles] * (segments[at, 3] >> layer & 1)
    whole: Ints = taken.astype(np.int64)
    return whole
