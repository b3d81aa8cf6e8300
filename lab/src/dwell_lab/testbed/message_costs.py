"""Costs of the messages between two jobs: CPU time of their workers, time on their link.

A worker spends more CPU time on a job than its stage takes: on messages. Not all of that lies on
the way of the cycle: it also reads what is late, answers, and puts away. How much does is seen
where nothing hinders it: a message that came quickest took its link's own delay, its transmission,
and of the CPU time that its sender and its receiver spend on messages what is left of the time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from dwell.model import Problem
from dwell.model.number_arrays import Floats
from dwell_lab.testbed.measured import LEAST_JOBS, Measured, SiteName

#: Source, target, and the nodes of both.
HopName: TypeAlias = tuple[str, str, str, str]
Link: TypeAlias = tuple[str, str]

#: Quantile of a message's time at which nothing but itself has had a part in it.
QUICK = 0.1
#: Bytes that cost as much CPU as sending or receiving a message at all.
MESSAGE_BYTES = 20_000


class OnTheWay(NamedTuple):
    """Costs of the messages of a cell.

    Parameters
    ----------
    hops : dict of (str, str, str, str) to (float, float)
        CPU time of sender and receiver that lies on a message's way, ms, by source, target, and
        the nodes of both.
    asked_ms : mapping of (str, str) to float64 array
        Delays that the cell asks of links that are emulated.
    """

    hops: dict[HopName, tuple[float, float]]
    asked_ms: Mapping[Link, Floats]

    def known_ms(self, hop: HopName, problem: Problem) -> float:
        """Transmission of a message, and the CPU time on its way."""
        return _transmission_ms(hop, problem) + sum(self.hops.get(hop, (0.0, 0.0)))


def hops(
    measured: Sequence[Measured],
    messaging_ms: Mapping[SiteName, float],
    problem: Problem,
    asked_ms: Mapping[Link, Floats],
) -> OnTheWay:
    """Find the part of the workers' messaging that lies on the way of messages.

    Parameters
    ----------
    messaging_ms : mapping of (str, str) to float
        CPU time that a worker takes for a job besides its stage, by task and node.
    asked_ms : mapping of (str, str) to float64 array
        Delays that the cell asks of links that are emulated. Of others, whose own delay nobody
        knows, all of the messaging is taken to lie on the way.
    """
    gaps_ms = _gaps(measured, problem, asked_ms)
    whole = {hop: _whole(hop, messaging_ms, problem) for hop in gaps_ms}
    # On one node there is nothing else between two jobs.
    parts: dict[tuple[str, str], list[float]] = {}
    for hop, gap_ms in gaps_ms.items():
        source, target, node, to = hop
        if node == to and sum(whole[hop]) > 0:
            part = gap_ms / sum(whole[hop])
            parts.setdefault((source, node), []).append(part)
            parts.setdefault((target, to), []).append(part)
    found = {}
    for hop, gap_ms in gaps_ms.items():
        source, target, node, to = hop
        known = [parts.get((source, node)), parts.get((target, to))]
        sides_ms = np.array(whole[hop]) * [np.mean(of) if of else 1.0 for of in known]
        over_ms = float(sides_ms.sum()) - gap_ms
        if over_ms > 0:
            # The side of which nothing is known spends so much less on the way; or both do.
            is_open = np.array([of is None for of in known])
            spends = np.where(is_open, sides_ms, 0.0)
            spends = spends if spends.sum() > over_ms else sides_ms
            sides_ms = sides_ms - over_ms * spends / spends.sum()
        sender_ms, receiver_ms = sides_ms.tolist()
        found[hop] = sender_ms, receiver_ms
    return OnTheWay(found, asked_ms)


def _gaps(
    measured: Sequence[Measured], problem: Problem, asked_ms: Mapping[Link, Floats]
) -> dict[HopName, float]:
    """Time of the quickest messages beyond their link's delay and transmission, ms.

    On one node it is what the node took meanwhile, where something counts it.
    """
    gaps: dict[HopName, list[float]] = {}
    for one, hop, delay_ms in _undisturbed(measured):
        own_ms, end = 0.0, (hop[1], hop[3])
        if hop[2] != hop[3]:
            asked = asked_ms.get(hop[2:])
            own_ms = -math.inf if asked is None else float(np.quantile(asked, QUICK))
        gap_ms = float(np.quantile(delay_ms, QUICK)) - own_ms - _transmission_ms(hop, problem)
        if hop[2] == hop[3] and end in one.handovers_ms:
            # The start of the next job is that job's own.
            gap_ms = one.handovers_ms[end] - one.begins_ms.get(end, 0.0)
        gaps.setdefault(hop, []).append(gap_ms)
    return {hop: max(float(np.median(seen)), 0.0) for hop, seen in gaps.items()}


def _whole(
    hop: HopName, messaging_ms: Mapping[SiteName, float], problem: Problem
) -> tuple[float, float]:
    """CPU time that sender and receiver spend on a message, on its way or not, ms."""
    source, target, node, to = hop
    return (
        messaging_ms.get((source, node), 0.0) * share(problem, source, source, target),
        messaging_ms.get((target, to), 0.0) * share(problem, target, source, target),
    )


def share(problem: Problem, task: str, source: str, target: str) -> float:
    """Share of a task's messaging that one of its flows is, by messages and by bytes.

    A source's stamp, and a sink's command, are flows from and to ``""``.
    """
    inputs, outputs = problem.pipeline.inputs(task), problem.pipeline.outputs(task)
    messages = max(len(inputs), 1) + max(len(outputs), 1)
    sizes = {(flow.source, flow.target): flow.payload_bytes for flow in (*inputs, *outputs)}
    whole = messages * MESSAGE_BYTES + sum(sizes.values())
    return (MESSAGE_BYTES + sizes.get((source, target), 0)) / whole


def floors(measured: Sequence[Measured], known: OnTheWay, problem: Problem) -> dict[Link, float]:
    """Time that the messages of every emulated link take beyond the delay asked of it, ms."""
    over: dict[Link, list[float]] = {}
    for _, hop, delay_ms in _undisturbed(measured):
        asked = known.asked_ms.get(hop[2:])
        if asked is not None:
            quick_ms = float(np.quantile(delay_ms, QUICK) - np.quantile(asked, QUICK))
            over.setdefault(hop[2:], []).append(quick_ms - known.known_ms(hop, problem))
    return {link: max(float(np.median(values)), 0.0) for link, values in over.items()}


def own_delays(
    measured: Sequence[Measured], known: OnTheWay, problem: Problem
) -> dict[Link, Floats]:
    """Delays of every link as they were measured, ms, for links that nobody emulates."""
    delays: dict[Link, list[Floats]] = {}
    for _, hop, delay_ms in _undisturbed(measured):
        if "->".join(hop[2:]) in problem.fabric.links:
            own_ms = delay_ms - known.known_ms(hop, problem)
            delays.setdefault(hop[2:], []).append(np.maximum(own_ms, 0.0))
    return {link: np.concatenate(values) for link, values in delays.items()}


def _undisturbed(measured: Sequence[Measured]) -> Iterator[tuple[Measured, HopName, Floats]]:
    for one in measured:
        for hop, delay_ms in one.delays_ms.items():
            hindered = set(hop[2:]) & one.disturbed.nodes or hop[2:] in one.disturbed.links
            if not hindered and len(delay_ms) >= LEAST_JOBS:
                yield one, hop, delay_ms


def _transmission_ms(hop: HopName, problem: Problem) -> float:
    source, target, node, to = hop
    link = problem.fabric.links.get(f"{node}->{to}")
    (flow,) = (f for f in problem.pipeline.flows if (f.source, f.target) == (source, target))
    return 0.0 if link is None else flow.payload_bytes * 8 / (link.rate_mbps * 1e3)
