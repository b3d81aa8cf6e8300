"""References of a realisation in hindsight: every candidate alone, and the clairvoyant's sequences.

The clairvoyant knows what every candidate, simulated alone, costs in every window of the same
realisation. It plans the cheapest sequence of them, once with the dwell of Algorithm 1 and once
without any, and the sequences are simulated. What they cost there counts, not what was promised.

It is no bound. A window that follows one under another candidate does not cost what it costs when
its candidate runs alone: work still queued comes along, and a node that is left alone recovers, so
that taking turns may beat two overloaded nodes. Regret is therefore measured against the cheapest
run of all, candidates alone and sequences, and may be negative.

Whoever knows the future sends orders in time, and has a moved task ready when it is due: the
sequences move at the boundary of the windows they were planned for, without ``order_delay_ms``,
``order_lead_cycles`` or a cold start. (Orders that are given late shift all later windows by the
cycles that they take, and after some tens of migrations the plan is about other cycles than those
it is applied to.) Where ``close_grace_ms`` is set, or releases jitter, windows close after the
release of the first cycle beyond them, and a migration still comes that much late.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.control.windows import seen_l95_ms
from dwell.cost import hamming, price
from dwell.errors import SimulationError
from dwell.estimators import Profile
from dwell.model import FrozenDict, Problem
from dwell.model.window_close import window_close_ns
from dwell.study.clairvoyant import Sequence, clairvoyant, priced
from dwell.study.script import Script
from dwell.study.summary import busiest, mean_of, used_in

if TYPE_CHECKING:
    from dwell.record import Run, TableArrays
    from dwell.sim import Realisation

Floats: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]

CLAIRVOYANT = "clairvoyant"
CLAIRVOYANT_DWELL = "clairvoyant-dwell"

#: How much J of a warm-up window counts in a plan: enough to choose between sequences that are
#: equal after the warm-up.
WARMUP_SHARE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """The runs that regret is measured against.

    Parameters
    ----------
    statics : mapping of str to Run
        Every candidate alone.
    runs : mapping of str to Run
        The sequences, simulated: ``clairvoyant`` (no dwell) and ``clairvoyant-dwell``.
    sequences : mapping of str to Sequence
        As they were planned; candidates by their place in the order.
    costs : mapping of str to float
        Mean J of each static and each sequence (see `mean_cost`).
    promised : mapping of str to float
        The same mean of each sequence as it was planned, over windows of candidates alone.
    """

    statics: Mapping[str, Run]
    runs: Mapping[str, Run]
    sequences: Mapping[str, Sequence]
    costs: Mapping[str, float]
    promised: Mapping[str, float]

    @property
    def name(self) -> str:
        """The static or sequence that costs least; a static where it ties with a sequence."""
        return min(self.costs, key=self.costs.__getitem__)

    @property
    def cost(self) -> float:
        """Least cost: the reference for regret."""
        return self.costs[self.name]

    @property
    def run(self) -> Run:
        """Run that costs least."""
        return self.statics.get(self.name) or self.runs[self.name]

    @property
    def best_static(self) -> str:
        """The best static placement in hindsight."""
        return min(self.statics, key=self.costs.__getitem__)

    @property
    def best_static_cost(self) -> float:
        """Cost of the best static placement."""
        return self.costs[self.best_static]


def play_alone(problem: Problem, realisation: Realisation) -> dict[str, Run]:
    """Simulate every candidate alone, with the estimator ``profile``: shadow jobs would be load.

    Parameters
    ----------
    realisation : Realisation
        Drawn for this problem.
    """
    from dwell.sim import simulate_realisation

    in_time, profile = _in_time(problem), Profile(problem)
    return {
        name: simulate_realisation(in_time, realisation, policy=name, estimator=profile)
        for name in problem.candidates
    }


def references(problem: Problem, realisation: Realisation) -> References:
    """Simulate every candidate alone, plan with what they cost, and simulate the plans.

    All of it with the estimator ``profile``: nobody here needs estimates, and shadow jobs would be
    load.

    Parameters
    ----------
    realisation : Realisation
        Drawn for this problem.

    Raises
    ------
    SimulationError
        If the controller sees no window after the warm-up, or a candidate has the name of a
        sequence.
    """
    from dwell.sim import simulate_realisation

    dwells = {CLAIRVOYANT: 0, CLAIRVOYANT_DWELL: problem.controller.min_dwell}
    names = tuple(problem.candidates)
    if taken := dwells.keys() & set(names):
        raise SimulationError(
            f"candidates.{min(taken)} has the name of a reference; call it something else"
        )
    in_time = _in_time(problem)
    statics = play_alone(problem, realisation)
    costs = {name: mean_cost(run) for name, run in statics.items()}
    alone = np.stack([window_costs(run, problem, realisation) for run in statics.values()], axis=1)
    placements = problem.candidates.values()
    shares = [[hamming(after, before) for after in placements] for before in placements]
    # From the row's candidate to the column's.
    switching = problem.objective.weights.switching * np.array(shares, np.float64)
    windows = statics[names[0]].arrays("windows")
    seen, warmup = ~np.isnan(windows["cost"]), windows["warmup"]
    sequences, runs, promised = {}, {}, {}
    for title, dwell in dwells.items():
        plan = clairvoyant(
            alone,
            switching,
            initial=names.index(problem.initial),
            min_dwell=dwell,
            counts=np.where(warmup, WARMUP_SHARE, 1.0),
            decides=seen,
        )
        script = Script([names[i] for i in plan.choice.tolist()], in_time, realisation)
        sequences[title] = plan
        runs[title] = simulate_realisation(in_time, realisation, policy=script, estimator="profile")
        costs[title] = mean_cost(runs[title])
        promised[title] = float(np.mean(priced(plan.choice, alone, switching)[seen & ~warmup]))
    return References(
        statics=FrozenDict(statics),
        runs=FrozenDict(runs),
        sequences=FrozenDict(sequences),
        costs=FrozenDict(costs),
        promised=FrozenDict(promised),
    )


def regret(run_cost: float, reference_cost: float) -> float:
    """How much more a run costs than the reference, as a share of what that costs.

    Parameters
    ----------
    run_cost, reference_cost : float
        `mean_cost` of a run, and `References.cost` of the same realisation.

    Returns
    -------
    float
        0.1 is a tenth more. Negative where the run costs less than the reference, which is no
        bound.
    """
    return run_cost / reference_cost - 1.0


def few_misses(run: Run, problem: Problem, limit: float = 0.05) -> Mask:
    """Whether a run misses no more than a limit, in every window.

    Parameters
    ----------
    limit : float
        Share of a window's cycles.

    Returns
    -------
    bool array, shape (windows,)
        Windows have W cycles each, after the warm-up, and are the same for all runs of a
        realisation, wherever their own windows begin.
    """
    width, first = problem.window_cycles, problem.warmup_windows * problem.window_cycles
    missed = run.arrays("cycles")["missed"][first : run.last_window_end]
    count = len(missed) // width
    few: Mask = missed[: count * width].reshape(count, width).mean(axis=1) <= limit
    return few


def share_kept(mine: Mask, asked: Mask) -> float:
    """Share of the windows in which the reference misses few cycles and a run does too.

    Parameters
    ----------
    mine, asked : bool array
        `few_misses` of the run, and of the cheapest reference of the same realisation.

    Returns
    -------
    float
        1 where the reference misses more in all of them.
    """
    count = min(len(mine), len(asked))
    asked = asked[:count]
    return float(mine[:count][asked].mean()) if asked.any() else 1.0


def mean_cost(run: Run) -> float:
    """Mean J over the windows after the warm-up, those that the controller did not see left out.

    Raises
    ------
    SimulationError
        If there is none.
    """
    windows = run.arrays("windows")
    warmup = windows["warmup"]
    mean = mean_of(windows["cost"][~warmup])
    if math.isnan(mean):
        raise SimulationError(
            f"of {len(warmup)} windows none is left that is after the warm-up and that the "
            "controller saw; ask for more windows"
        )
    return mean


def window_costs(run: Run, problem: Problem, realisation: Realisation) -> Floats:
    """J of every window of a run that never moves, also of those the controller did not see.

    Such a window has the J that the controller would have seen, had its node been up. Statistics
    leave it out; a sequence that were planned without it would spend an outage anywhere.

    Parameters
    ----------
    problem, realisation
        What it is a run of.

    Returns
    -------
    float64 array, shape (windows,)
    """
    windows = run.arrays("windows")
    costs: Floats = windows["cost"].copy()
    unseen = np.isnan(costs)
    if not unseen.any():
        return costs
    rows = windows["first_cycle"][unseen][:, None] + np.arange(problem.window_cycles)
    latency_ns = run.arrays("cycles")["latency_ns"][rows]
    release_ns = realisation.release_ns
    close_ns = window_close_ns(problem, release_ns[rows[:, -1]], release_ns[rows[:, -1] + 1])
    age_ns = close_ns[:, None] - release_ns[rows]
    l95_ms, _ = seen_l95_ms(latency_ns, age_ns, problem.censor_ms)
    rate = windows["violation_rate"][unseen]
    robot, edge, cloud = (share[unseen] for share in tier_use(windows, problem))
    costs[unseen] = price(l95_ms, rate, robot, edge, cloud, 0.0, problem.objective)
    return costs


def tier_use(windows: TableArrays, problem: Problem) -> tuple[Floats, Floats, Floats]:
    """Utilisation of the busiest of each tier, robot, edge and cloud, in every window."""
    return busiest(used_in(windows, problem), problem)


def _in_time(problem: Problem) -> Problem:
    """Return the same problem with a controller whose orders take effect as windows close.

    It decides once per window, since the sequences have one placement per window.
    """
    settings = replace(
        problem.controller,
        order_delay_ms=0.0,
        order_lead_cycles=0,
        migration="warm",
        decide_cycles=None,
    )
    return replace(problem, controller=settings)
