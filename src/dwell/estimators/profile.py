"""Profile: static profiling, the estimate from what is known before the run.

Every candidate has the price that it comes to where the cell stays on it and no scenario disturbs
it (`dwell.estimators.prices`): the means over windows of L95 and V_D as the controller sees them,
and the work of the cell on every node.

What a window adds is the foreign load: utilisation that was seen and is not the cell's own work.
It is expected to stay where it is, whichever candidate runs. Latencies take no notice of it: a
stressed robot looks busy here, not slow.

Of a saturated node that others have a part of, the foreign load cannot be seen: what others got is
only the least that they ask for, and where the cell leaves they may take all of it. Such a node is
expected to be full under every candidate, but under one that was active before and showed less, if
the node has been saturated at every close since: then it was the cell that filled it. A kind of a
node's accelerators is as a node in all this; where a window shows nothing of it, neither do the
estimates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Self

from dwell.cost import SATURATED
from dwell.errors import MetricError
from dwell.estimators.prices import SEED, Price, prices_of
from dwell.estimators.protocol import CellEstimator
from dwell.model.bounds import require
from dwell.model.frozen import FrozenDict
from dwell.model.pipeline import Execution, Pipeline, Task
from dwell.model.problem import Problem
from dwell.model.process import Trace
from dwell.model.qos import QoS, unchecked_qos


class Foreign(NamedTuple):
    """What others took of resources in a window.

    Parameters
    ----------
    shares : mapping of str to float
        Share of each resource that was measured.
    full : mapping of str to mapping
        Resources of which nothing was left and others had a part, with what each showed under the
        candidates that it was seen under since.
    """

    shares: Mapping[str, float]
    full: Mapping[str, Mapping[str, float]]


class Profile(CellEstimator):
    """Estimates QoS as that of every candidate alone, undisturbed, played once in the kernel.

    Parameters
    ----------
    samples : int, optional
        Cycles of each candidate that count, rounded up to whole windows; as many as the means need
        where None (see `dwell.estimators.prices`).
    seed : int
        Seed of what is played; the same for every run, so that an estimate is a fixed number.

    Attributes
    ----------
    l95_ms : mapping of str to float
        Estimated L95 of every candidate, milliseconds; never more than ``problem.censor_ms``.
    uncut_l95_ms : mapping of str to float
        The same without that bound; infinite where more than 5 % of the cycles are lost.
    violation_rate : mapping of str to float
        Estimated V_D of every candidate.
    own : mapping of str to mapping of str to float
        Share of each resource that the cell's own work takes, by candidate and resource: a node, or
        a kind of its accelerators, as ``E.gpu``.
    prices : mapping of str to Price
        All of it, with the standard errors and the number of cycles played.

    Raises
    ------
    ProblemError
        If `samples` or `seed` is out of its range.
    KernelError
        If the compiled kernel cannot be loaded.
    """

    def __init__(self, problem: Problem, samples: int | None = None, seed: int = SEED) -> None:
        if samples is not None:
            require(1 <= samples <= 10_000_000, "samples", samples, "from 1 to 10000000")
        require(seed >= 0, "seed", seed, "a whole number of at least 0")
        self._samples, self._seed = samples, seed
        self.prices = prices = prices_of(problem, seed=seed, cycles=samples)
        self.l95_ms: Mapping[str, float] = _each(prices, "l95_ms")
        self.uncut_l95_ms: Mapping[str, float] = _each(prices, "uncut_l95_ms")
        self.violation_rate: Mapping[str, float] = _each(prices, "violation_rate")
        self.own: Mapping[str, Mapping[str, float]] = _each(prices, "own")
        resources = problem.fabric.resources
        self._resources = tuple(resources)
        self._accelerators = frozenset(name for name, one in resources.items() if one.kind)
        table, work = [], []
        for name, price in prices.items():
            # Once through the checks: what differs from window to window are shares of resources.
            known = QoS(price.l95_ms, price.violation_rate, {}, price.uncut_l95_ms)
            metrics = known.l95_ms, known.violation_rate, known.cut_from_ms
            table.append((name, *metrics))
            work.append((name, tuple(price.own.items())))
        self._table, self._work = tuple(table), tuple(work)
        self.start(problem)

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the estimator with the defaults of its parameters."""
        return cls(problem)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(samples={self._samples}, seed={self._seed})"

    def start(self, problem: Problem) -> None:
        """Forget every window."""
        #: What each resource showed, by the candidate it was last seen under, at its last close
        #: without saturation and at all after it.
        self._shown: dict[str, dict[str, float]] = {name: {} for name in self._resources}

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics, the incumbent's too (see `Estimator`)."""
        shares = self.with_work(self.see(observed, incumbent, own), self._work)
        return {
            name: unchecked_qos(l95_ms, violation_rate, shares[name], cut_from_ms)
            for name, l95_ms, violation_rate, cut_from_ms in self._table
        }

    def see(self, observed: QoS, incumbent: str, own: Mapping[str, float]) -> Foreign:
        """Tell what others took of every resource in a window, and remember what a full one showed.

        Parameters
        ----------
        observed, incumbent, own
            As in `estimate`.

        Raises
        ------
        MetricError
            If a node's utilisation is missing.
        """
        # Conditions and not min() and max(): this runs at the close of every window.
        used = observed.utilisation
        shares, full = {}, {}
        unmeasured = {one for one in self._accelerators if one not in used or one not in own}
        try:
            for node, shown in self._shown.items():
                if node in unmeasured:
                    continue
                busy, mine = used[node], own[node]
                load = busy - mine
                shares[node] = load if load > 0.0 else 0.0
                if busy < SATURATED:
                    shown.clear()
                    shown[incumbent] = busy
                else:
                    shown[incumbent] = 1.0
                    if mine < SATURATED:
                        full[node] = shown
        except KeyError as error:
            what = "own" if error.args[0] in used else "observed.utilisation"
            raise MetricError(
                f"{what} has nothing for node {error.args[0]}; it must hold each of "
                f"{', '.join(one for one in self._resources if one not in self._accelerators)}"
            ) from None
        return Foreign(shares, full)

    def with_work(
        self, foreign: Foreign, work: Iterable[tuple[str, Iterable[tuple[str, float]]]]
    ) -> dict[str, FrozenDict[str, float]]:
        """Estimate the share of every resource that is busy under each candidate.

        Parameters
        ----------
        work : iterable of (candidate, iterable of (resource, share))
            What the cell itself takes under each candidate, shadow jobs included.
        """
        estimated = {}
        for name, takes in work:
            utilisation = {}
            for node, share in takes:
                if node not in foreign.shares:
                    continue
                busy = foreign.shares[node] + share
                utilisation[node] = busy if busy < 1.0 else 1.0
            for node, shown in foreign.full.items():
                utilisation[node] = shown.get(name, 1.0)
            estimated[name] = FrozenDict(utilisation)
        return estimated


def _each(prices: Mapping[str, Price], what: str) -> Mapping[str, Any]:
    return FrozenDict({name: getattr(price, what) for name, price in prices.items()})


def mean_ms(pipeline: Pipeline, task: Task, execution: Execution) -> float:
    """Mean execution time of a task, scale included, without sampling error, milliseconds."""
    process = execution.exec_ms
    if task.scale is None:
        return process.expectation
    scale = pipeline.scales[task.scale]
    if isinstance(process, Trace) and isinstance(scale, Trace) and process.table is scale.table:
        return float((process.values * scale.values).mean())
    return process.expectation * scale.expectation
