"""Profile: static profiling, the estimate from data known before the run.

Every candidate has the price of an undisturbed cell that stays on it (`dwell.estimators.prices`):
the means over windows of L95 and V_D as the controller sees them, and the cell's work on each node.

A window adds the foreign load: measured utilisation minus the cell's own work. The estimator
assumes the same foreign load under every candidate. Estimated latencies ignore it: a stressed robot
looks busy here, not slow.

The foreign load of a saturated node is unknown if others use a part of it: they may need more than
they got, and may take all of the node once the cell leaves. The estimator expects this node to be
full under every candidate, with one exception: a candidate that was active in the last unsaturated
window, and not since, keeps the utilisation measured then, because the cell itself filled the node
afterwards. Each kind of accelerator is treated like a node; if a window does not measure it, the
estimates omit it.
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
    """Foreign load of resources in a window.

    Parameters
    ----------
    shares : mapping of str to float
        Foreign share of each measured resource.
    full : mapping of str to mapping
        Saturated resources that others use too, each with its utilisation by candidate in the last
        unsaturated window and after it.
    """

    shares: Mapping[str, float]
    full: Mapping[str, Mapping[str, float]]


class Profile(CellEstimator):
    """Estimates the QoS of each candidate alone and undisturbed, simulated once in the kernel.

    Parameters
    ----------
    samples : int, optional
        Counted cycles per candidate, rounded up to full windows [default: enough for the means,
        see `dwell.estimators.prices`].
    seed : int
        Seed of the simulations; the same for every run, which makes an estimate a fixed number.

    Attributes
    ----------
    l95_ms : mapping of str to float
        Estimated L95 of every candidate, milliseconds; never more than ``problem.censor_ms``.
    uncut_l95_ms : mapping of str to float
        L95 without this bound; infinite if more than 5 % of the cycles are lost.
    violation_rate : mapping of str to float
        Estimated V_D of every candidate.
    own : mapping of str to mapping of str to float
        Share of each resource that the cell's own work uses, by candidate and resource: a node, or
        a kind of its accelerators, as ``E.gpu``.
    prices : mapping of str to Price
        The values above with standard errors and the number of simulated cycles.

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
            # Checked once: only the shares of resources differ between windows.
            known = QoS(price.l95_ms, price.violation_rate, {}, price.uncut_l95_ms)
            metrics = known.l95_ms, known.violation_rate, known.cut_from_ms
            age = None if price.age is None else (price.age[0], 0.0)
            table.append((name, *metrics, age, price.misses, price.price_per_hour))
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
        #: Utilisation of each resource by candidate, in its last unsaturated window and after it.
        self._shown: dict[str, dict[str, float]] = {name: {} for name in self._resources}

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics, the incumbent's too (see `Estimator`)."""
        shares = self.with_work(self.see(observed, incumbent, own), self._work)
        return {
            name: unchecked_qos(
                l95_ms, rate, shares[name], cut_ms, None, age, misses, None, per_hour
            )
            for name, l95_ms, rate, cut_ms, age, misses, per_hour in self._table
        }

    def see(self, observed: QoS, incumbent: str, own: Mapping[str, float]) -> Foreign:
        """Return the foreign load of every resource in a window, and record saturated resources.

        Parameters
        ----------
        observed, incumbent, own
            As in `estimate`.

        Raises
        ------
        MetricError
            If a node's utilisation is missing.
        """
        # Conditions are faster than min() and max(): this runs at the end of every window.
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
            Work of the cell itself under each candidate, shadow jobs included.
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
    """Return the expected execution time of a task, including its scale, milliseconds."""
    process = execution.exec_ms
    if task.scale is None:
        return process.expectation
    scale = pipeline.scales[task.scale]
    if isinstance(process, Trace) and isinstance(scale, Trace) and process.table is scale.table:
        return float((process.values * scale.values).mean())
    return process.expectation * scale.expectation
