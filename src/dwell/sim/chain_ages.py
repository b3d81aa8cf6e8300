"""Data ages of chains, from the log of jobs and of the values that they got."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.arrays import CellArrays, JobLogs, flow_rows
from dwell.kernels.codes import CycleOutcome
from dwell.kernels.realisation import Realisation
from dwell.model import Chain, Pipeline
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import rank_of

#: Origin of a job that descends from no cycle.
NO_ORIGIN = np.iinfo(np.int64).max
#: Age of a cycle without an actuation.
NO_AGE = -1


def chain_ages_ns(
    pipeline: Pipeline, chain: Chain, realisation: Realisation, arrays: CellArrays
) -> Ints:
    """Return the data age at the actuation of each cycle, `NO_AGE` without one.

    docs/background/simulator.md defines ages, under "Chains".

    Parameters
    ----------
    arrays : CellArrays
        With a log of all jobs, after the simulation.
    """
    logs = arrays.logs()
    row = list(pipeline.tasks).index(chain.target)
    done = np.flatnonzero(logs.outcomes[0, :, row] == CycleOutcome.DONE)
    end_ns = logs.jobs["end_ns"][0, done, row]
    in_order = np.lexsort((done, end_ns))
    done, end_ns = done[in_order], end_ns[in_order]
    known = _last_known(_Descent(pipeline, chain.source, logs).origins(chain.target)[done])
    ages = np.full(realisation.cycles, NO_AGE)
    ages[done] = end_ns - realisation.release_ns[known]
    return ages


def _last_known(origins: Ints) -> Ints:
    """Replace each missing origin by the last one before it, or else by cycle 0."""
    known = origins != NO_ORIGIN
    last = np.maximum.accumulate(np.where(known, np.arange(len(origins)), -1))
    return np.where(last < 0, 0, origins[np.maximum(last, 0)])


class _Descent:
    """The oldest cycles of a task from which jobs descend."""

    def __init__(self, pipeline: Pipeline, source: str, logs: JobLogs) -> None:
        self.pipeline, self.source = pipeline, source
        taken = logs.taken[0]
        self.taken = taken[:, flow_rows(pipeline)] if taken.shape[1] else taken
        self.cycles = np.arange(logs.jobs.shape[1])
        self.known: dict[str, Ints] = {}

    def origins(self, task: str) -> Ints:
        """Return the oldest origin of a task's job in each cycle; NO_ORIGIN for none."""
        if task not in self.known:
            self.known[task] = self._origins(task)
        return self.known[task]

    def _origins(self, task: str) -> Ints:
        if task == self.source:
            return self.cycles
        oldest = np.full(len(self.cycles), NO_ORIGIN)
        for i, flow in enumerate(self.pipeline.flows):
            if flow.target != task:
                continue
            origins = self.origins(flow.source)
            if flow.sampled:
                values = self.taken[:, i]
                origins = np.where(values >= 0, origins[np.maximum(values, 0)], NO_ORIGIN)
            oldest = np.minimum(oldest, origins)
        return oldest


def age_l95_ms(ages_ns: Ints) -> Floats:
    """Return L95 of the ages in each window, ms; infinite for a window without actuations."""
    is_known = ages_ns != NO_AGE
    count = is_known.sum(axis=1)
    ordered = np.sort(np.where(is_known, ages_ns / 1e6, np.inf), axis=1)
    rank = np.maximum(rank_of(95, count), 1)
    l95: Floats = np.take_along_axis(ordered, rank[:, None] - 1, axis=1)[:, 0]
    return l95


def age_missed(ages_ns: Ints, max_age_ms: float) -> Floats:
    """Return the share of each window's actuations with a larger age; 1 without actuations."""
    is_known = ages_ns != NO_AGE
    count = is_known.sum(axis=1)
    over: NDArray[np.bool_] = is_known & (ages_ns > max_age_ms * 1e6)
    share: Floats = np.where(count > 0, over.sum(axis=1) / np.maximum(count, 1), 1.0)
    return share
