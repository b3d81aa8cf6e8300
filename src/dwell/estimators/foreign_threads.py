"""Foreign threads of a node: how many there are beyond those that the cell declares.

Where others leave something of a node, its load says how many there are. A full node hides it;
there the cell's own jobs tell, by how much longer they took than the core time that they received.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import cores_of, cores_on
from dwell.kernels.jobs import NodeJobs, SlowedJobs
from dwell.model.fabric import Node
from dwell.model.pipeline import Execution
from dwell.model.problem import Problem

#: Foreign load is other than declared where it is so many deviations of a window off, and a share
#: of the cores beyond that.
DEVIATIONS, LEAST_SHARE = 4.0, 0.05
#: Windows over which a level is averaged.
WINDOWS = 3


class Level(NamedTuple):
    """Foreign threads beside which jobs ran beyond those of bursts, with the standard error.

    Parameters
    ----------
    is_slowed : bool
        Whether they took something of what most jobs wanted; if not, there may be fewer.
    """

    threads: float
    error: float
    is_slowed: bool


class ForeignThreads:
    """Foreign threads of one node beyond those that are declared.

    Parameters
    ----------
    node : Node
    decisions : float
        Decisions per window.

    Attributes
    ----------
    beyond : float
        How many more there are; negative where there are fewer.
    """

    def __init__(self, node: Node, decisions: float = 1.0) -> None:
        self.node, self._most = node, round(WINDOWS * decisions)
        self._capacity, self._burst_threads = node.capacity, node.burst_threads
        self.beyond = 0.0
        self._mean, self._windows = 0.0, 0

    def __repr__(self) -> str:
        return f"<ForeignThreads of {self.node.name}: {self.beyond:+.2g} beyond the declared>"

    @property
    def threads(self) -> float:
        """Average number, declared ones included."""
        return max(self._burst_threads + self.beyond, 0.0)

    def see(
        self,
        share: float,
        usual: float,
        deviation: float,
        level: Callable[[], Level | None],
        *,
        is_full: bool,
    ) -> bool:
        """Take in what a window showed; returns whether that is a change.

        Parameters
        ----------
        share : float
            Of the node, that others took.
        usual, deviation : float
            Mean and standard deviation of a window's share as declared.
        level : callable
            Says what the cell's jobs tell, if anything; asked where the share does not tell all.
        is_full : bool
            Whether nothing of the node was left, so that there may be more than the share says.
        """
        capacity = self._capacity
        noise = DEVIATIONS * deviation + LEAST_SHARE
        beyond = (share - usual) * capacity
        if abs(beyond) <= noise * capacity and not is_full:
            return self._see(0.0, noise * capacity)
        told = level()
        if told is not None and (is_full or told.is_slowed):
            noise = DEVIATIONS * told.error + LEAST_SHARE * (capacity + told.threads)
            return self._see(told.threads, noise)
        if not is_full:
            return self._see(beyond, noise * capacity)
        least = share * capacity
        if self.threads + LEAST_SHARE * capacity >= least and self.beyond > 0.0:
            return False  # what was known before says more
        # A thread for each core is the fewest that fill it.
        return self._see(max(capacity - self._burst_threads, 0.0), least)

    def _see(self, seen: float, noise: float) -> bool:
        is_jump = abs(seen - self._mean) > noise or (seen == 0.0) != (self._mean == 0.0)
        self._windows = 1 if is_jump else min(self._windows + 1, self._most)
        self._mean += (seen - self._mean) / self._windows
        # What drifts is taken over in steps.
        step = LEAST_SHARE / 2 * (self._capacity + abs(self._mean))
        if not is_jump and abs(self._mean - self.beyond) <= step:
            return False
        self.beyond = self._mean
        return True


class Stretches:
    """Tells from a window's jobs next to how many foreign threads they ran.

    Some jobs leave others room, and take no longer for it: they show only how many threads there
    are at most. The jobs of each task since its last change are compared with their times alone;
    tasks of which most jobs are slowed count, if there are any.

    Parameters
    ----------
    shared : collection of str
        Nodes on which jobs run next to those of other cells. They speak only where all share the
        cores evenly, and the evidence says next to how many threads each job ran.
    """

    def __init__(self, problem: Problem, shared: Collection[str] = ()) -> None:
        self._problem, self._shared = problem, shared
        self._on: dict[str, SlowedJobs] = {}

    def level(self, evidence: Evidence, name: str) -> Level | None:
        """What the jobs on a node say; None where they say nothing.

        Own jobs count if there are enough, else shadow jobs, where these share what own jobs leave
        with foreign threads as equals.
        """
        rows, is_shared = evidence.rows, name in self._shared
        node = self._problem.fabric.nodes[name]
        if is_shared and (
            rows.beside is None or node.scheduler != "fair" or node.quota is not None
        ):
            return None
        shadows = evidence.shadows_share
        told = self._jobs_on(name).level(rows, shadows=shadows, is_shared=is_shared)
        if told is None:
            return None
        threads, error, is_slowed = told
        # Nanoseconds of an instant are none.
        return Level(max(round(threads, 3), 0.0), error, is_slowed)

    def _jobs_on(self, name: str) -> SlowedJobs:
        if name not in self._on:
            node = self._problem.fabric.nodes[name]
            spare = node.spare if node.quota is None else node.capacity
            bursts = 0.0 if node.bursts is None else node.bursts.share
            cores = cores_on(self._problem, node, partial(_turns, node))
            is_fair = node.scheduler == "fair"
            jobs = NodeJobs(cores, is_fair, node.cores, spare, bursts)
            self._on[name] = SlowedJobs(jobs, len(self._problem.pipeline.flows))
        return self._on[name]


def _turns(node: Node, execution: Execution) -> float:
    """Cores that a job asks for; of a fair node all its threads take turns with others."""
    return execution.threads if node.scheduler == "fair" else cores_of(node, execution)
