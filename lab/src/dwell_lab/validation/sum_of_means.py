"""The sum-of-means predictor: a cell without variation and without waiting.

Every task takes its mean time on its node, every message its mean delay and the time its bytes
take at the link's rate; the latency of a cycle is the longest path through the pipeline. A node's
quota, and foreign threads that take their share, slow a task down by their mean. A
simulator has to predict better than this simple calculation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from dwell.estimators.paths import longest_path, steps_of
from dwell.model import Problem
from dwell.model.fabric import Link, Node
from dwell.model.number_arrays import Floats
from dwell.model.order_statistic import rank_of
from dwell.model.placement import Placement
from dwell.model.scenario import Disturbance, LinkDisturbance, NodeDisturbance


def sum_of_means(
    problem: Problem, placement: Placement, scenario: str, begin_s: float, end_s: float
) -> float:
    """Latency (ms) that a placement would always have, if it had its mean.

    Parameters
    ----------
    scenario : str
        Disturbances count by the share of the time in which they are on.
    begin_s, end_s : float
        Time that counts, since the first release.

    Returns
    -------
    float
        Messages that are lost are left out, and so are nodes and links that are down.
    """
    items = problem.scenario(scenario)
    pipeline, fabric = problem.pipeline, problem.fabric
    executed: list[Floats] = []
    for name, task in pipeline.tasks.items():
        node = fabric.nodes[placement.first[name]]
        mean_ms = task.on[node.name].exec_ms.expectation
        if task.scale is not None:
            mean_ms *= pipeline.scales[task.scale].expectation
        slower = _slow_down(node, _on(items, node.name, begin_s, end_s))
        executed.append(np.array(mean_ms * slower))
    sent = []
    for flow in pipeline.flows:
        link = fabric.links.get(f"{placement.first[flow.source]}->{placement.first[flow.target]}")
        on = [] if link is None else _on(items, link.name, begin_s, end_s)
        sent.append(0.0 if link is None else _message_ms(link, flow.payload_bytes, on))
    return float(longest_path(steps_of(pipeline), executed, sent))


def sums_of_shares(
    sums_ms: Mapping[str, float], cycles: Mapping[str, int], deadline_ms: float
) -> tuple[float, float]:
    """Return L95 and V_D of cycles under several placements, each with its sum as latency.

    Parameters
    ----------
    sums_ms : mapping of str to float
        By candidate.
    cycles : mapping of str to int
        Measured cycles under each candidate; the predictor knows the placements.

    Returns
    -------
    l95_ms, violation_rate : float
        For a single placement its sum, and 0 or 1.
    """
    names = sorted(cycles, key=lambda name: sums_ms[name])
    counts = np.array([cycles[name] for name in names])
    within = counts.cumsum()
    l95_ms = sums_ms[names[int(np.searchsorted(within, rank_of(95, int(within[-1]))))]]
    late = sum(cycles[name] for name in names if sums_ms[name] > deadline_ms)
    return l95_ms, late / int(within[-1])


def _on(
    items: Iterable[Disturbance], name: str, begin_s: float, end_s: float
) -> list[tuple[Disturbance, float]]:
    """Return what is done to a node or link, with the share of the time in which it is."""
    found: list[tuple[Disturbance, float]] = []
    for item in items:
        overlap = min(item.end_s, end_s) - max(item.at_s, begin_s)
        if item.place != name or item.down or overlap <= 0:
            continue
        share = overlap / (end_s - begin_s)
        if item.episodes is not None:
            on_s, off_s = item.episodes.for_s.expectation, item.episodes.every_s.expectation
            share *= on_s / (on_s + off_s)
        found.append((item, share))
    return found


def _slow_down(node: Node, on: Iterable[tuple[Disturbance, float]]) -> float:
    """Return the mean slow-down of one thread among foreign threads with equal shares."""
    threads = sum(
        share * item.stress_threads for item, share in on if isinstance(item, NodeDisturbance)
    )
    return 1 / min(1.0, node.capacity / (1 + threads + node.burst_threads))


def _message_ms(link: Link, size_bytes: int, on: Iterable[tuple[Disturbance, float]]) -> float:
    mean_ms = link.delay_ms.expectation
    rate_mbps = link.rate_mbps
    for item, share in on:
        if isinstance(item, LinkDisturbance):
            if item.add_delay_ms is not None:
                mean_ms += share * item.add_delay_ms.expectation
            rate_mbps = min(rate_mbps, item.rate_mbps)
    if link.bursts is not None:
        mean_ms += link.bursts.share * link.bursts.add_delay_ms.expectation
    return mean_ms + size_bytes * 8e-3 / rate_mbps
