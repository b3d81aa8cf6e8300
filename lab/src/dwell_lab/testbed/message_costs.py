"""Costs of the messages between two jobs: CPU time of their workers, and time on their link.

A worker spends CPU time on messages in addition to its stage. Only a part of it delays the cycle:
the worker also reads late messages, answers and cleans up. The fastest undisturbed messages show
this part. Their time consists of the link's delay, the transmission, and the CPU time of sender and
receiver that delays them.
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

#: Quantile of the times of messages that selects undelayed messages.
QUICK = 0.1
#: Number of bytes whose CPU cost equals the fixed cost of sending or receiving a message.
MESSAGE_BYTES = 20_000


class OnTheWay(NamedTuple):
    """Costs of the messages of a cell.

    Parameters
    ----------
    hops : dict of (str, str, str, str) to (float, float)
        CPU time of sender and receiver that delays a message, ms, by source, target, and their
        nodes.
    asked_ms : mapping of (str, str) to float64 array
        Delays of emulated links according to the cell.
    """

    hops: dict[HopName, tuple[float, float]]
    asked_ms: Mapping[Link, Floats]

    def known_ms(self, hop: HopName, problem: Problem) -> float:
        """Return a message's transmission time plus the CPU time that delays it."""
        return _transmission_ms(hop, problem) + sum(self.hops.get(hop, (0.0, 0.0)))


def hops(
    measured: Sequence[Measured],
    messaging_ms: Mapping[SiteName, float],
    problem: Problem,
    asked_ms: Mapping[Link, Floats],
) -> OnTheWay:
    """Return the part of the workers' messaging time that delays messages.

    Parameters
    ----------
    messaging_ms : mapping of (str, str) to float
        CPU time of a worker per job beyond its stage, by task and node.
    asked_ms : mapping of (str, str) to float64 array
        Delays of emulated links according to the cell. The delay of other links is unknown: all
        messaging time is assumed to delay their messages.
    """
    gaps_ms = _gaps(measured, problem, asked_ms)
    whole = {hop: _whole(hop, messaging_ms, problem) for hop in gaps_ms}
    # Within a node messaging is the only time between two jobs.
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
            # Subtract the excess from the sides without a known part, or from both sides.
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
    """Return the time of the fastest messages beyond the link's delay and transmission, ms.

    Within a node it is the counted CPU time of the node between the jobs, if available.
    """
    gaps: dict[HopName, list[float]] = {}
    for one, hop, delay_ms in _undisturbed(measured):
        own_ms, end = 0.0, (hop[1], hop[3])
        if hop[2] != hop[3]:
            asked = asked_ms.get(hop[2:])
            own_ms = -math.inf if asked is None else float(np.quantile(asked, QUICK))
        gap_ms = float(np.quantile(delay_ms, QUICK)) - own_ms - _transmission_ms(hop, problem)
        if hop[2] == hop[3] and end in one.handovers_ms:
            # The start of the next job belongs to that job.
            gap_ms = one.handovers_ms[end] - one.begins_ms.get(end, 0.0)
        gaps.setdefault(hop, []).append(gap_ms)
    return {hop: max(float(np.median(seen)), 0.0) for hop, seen in gaps.items()}


def _whole(
    hop: HopName, messaging_ms: Mapping[SiteName, float], problem: Problem
) -> tuple[float, float]:
    """Return the total CPU time of sender and receiver for a message, ms."""
    source, target, node, to = hop
    return (
        messaging_ms.get((source, node), 0.0) * share(problem, source, source, target),
        messaging_ms.get((target, to), 0.0) * share(problem, target, source, target),
    )


def share(problem: Problem, task: str, source: str, target: str) -> float:
    """Return the share of a flow in a task's messaging, by numbers of messages and bytes.

    A source's stamp counts as an input, and a sink's command as an output.
    """
    inputs, outputs = problem.pipeline.inputs(task), problem.pipeline.outputs(task)
    messages = max(len(inputs), 1) + max(len(outputs), 1)
    sizes = {(flow.source, flow.target): flow.payload_bytes for flow in (*inputs, *outputs)}
    whole = messages * MESSAGE_BYTES + sum(sizes.values())
    return (MESSAGE_BYTES + sizes.get((source, target), 0)) / whole


def floors(measured: Sequence[Measured], known: OnTheWay, problem: Problem) -> dict[Link, float]:
    """Return the time of messages on every emulated link beyond the delay set for it, ms."""
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
    """Return the measured delays of every link, ms; for links that are not emulated."""
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
