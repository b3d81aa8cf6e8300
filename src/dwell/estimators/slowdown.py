"""Slowdown of a job on the CPU by foreign threads.

The slowdown is over a job alone on its node, as the profile has it. On a `fair` node a job of k
threads beside s foreign threads runs at min(1, c / (k + s)) of its speed, c being the cores that
the background leaves; on the others at c / (c + s) of what it has alone.
"""

from __future__ import annotations

from dwell.model.fabric import Node


def slowdown(node: Node, job_threads: int, foreign_threads: float) -> float:
    """Return the factor by which a job takes longer; at least 1."""
    if node.scheduler != "fair":
        return (node.cores + foreign_threads) / node.cores
    return max(1.0, (job_threads + foreign_threads) / max(job_threads, node.spare))
