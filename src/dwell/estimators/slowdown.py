"""Slowdown of a job on the CPU by foreign threads.

The slowdown is relative to a job alone on its node, as in the profile. With s foreign threads a job
of k threads takes (k + s) / max(k, c) times as long on a `fair` node, at least 1; c is the number
of cores that the background leaves. With another scheduler it takes (n + s) / n times as long on a
node of n cores.
"""

from __future__ import annotations

from dwell.model.fabric import Node


def slowdown(node: Node, job_threads: int, foreign_threads: float) -> float:
    """Return the factor by which a job takes longer; at least 1."""
    if node.scheduler != "fair":
        return (node.cores + foreign_threads) / node.cores
    return max(1.0, (job_threads + foreign_threads) / max(job_threads, node.spare))
