"""References of a realisation: every candidate alone, and sequences planned beforehand.

Each reference is planned by dynamic programming, once with the dwell of Algorithm 1 and once
without a dwell. The plans are simulated on the same realisation, and the simulated cost counts.

The clairvoyant plans with the J of every window of every candidate that was simulated alone on
this realisation: it knows all random numbers. The oracle plans with expected costs: it knows when
each disturbance is on, and no other random numbers (`dwell.study.oracle`).

Neither is a bound. J of a window depends on the windows before it: queued work moves to another
candidate, and an idle node recovers, so alternating between two overloaded nodes may be better than
either. Regret is relative to the cheapest of the static runs and the clairvoyant's sequences, and
may be negative.

Both move exactly at the planned boundaries, without ``order_delay_ms``, ``order_lead_cycles`` or a
cold start. (Late orders would shift all later windows; after some tens of migrations the plan would
apply to other cycles.) With ``close_grace_ms`` or release jitter, a window ends after the first
release beyond it, and a migration is late by that time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dwell.control.windows import busiest, moved_shares, seen_l95_ms
from dwell.cost import price
from dwell.errors import SimulationError
from dwell.estimators import Profile
from dwell.estimators.registry import resolved
from dwell.model import FrozenDict, Problem
from dwell.model.number_arrays import Floats, Mask
from dwell.model.window_close import window_close_ns
from dwell.policies.registry import estimator_of
from dwell.study.clairvoyant import Sequence, clairvoyant, priced
from dwell.study.oracle import expected_costs
from dwell.study.script import Script, is_up
from dwell.study.summary import mean_of, used_in

if TYPE_CHECKING:
    from dwell.record import Run, TableArrays
    from dwell.sim import Realisation


CLAIRVOYANT = "clairvoyant"
CLAIRVOYANT_DWELL = "clairvoyant-dwell"
ORACLE = "oracle"
ORACLE_DWELL = "oracle-dwell"
REFERENCES = (CLAIRVOYANT, CLAIRVOYANT_DWELL, ORACLE, ORACLE_DWELL)

#: How much J of the warm-up counts in a plan: enough to choose between sequences that are equal
#: after the warm-up.
WARMUP_SHARE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """The runs that regret is measured against.

    Parameters
    ----------
    statics : mapping of str to Run
        Every candidate alone.
    runs : mapping of str to Run
        The sequences of `REFERENCES`, simulated.
    sequences : mapping of str to Sequence
        As they were planned; candidates by their place in the order.
    costs : mapping of str to float
        Mean J of each static and each sequence (see `mean_cost`).
    promised : mapping of str to float
        Mean J of each sequence as it was planned; of the oracle's, expected J.
    """

    statics: Mapping[str, Run]
    runs: Mapping[str, Run]
    sequences: Mapping[str, Sequence]
    costs: Mapping[str, float]
    promised: Mapping[str, float]

    @property
    def name(self) -> str:
        """The cheapest static or clairvoyant sequence; a static if it ties with a sequence."""
        known = (*self.statics, CLAIRVOYANT, CLAIRVOYANT_DWELL)
        return min(known, key=self.costs.__getitem__)

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
    """Simulate every candidate alone, plan the sequences, and simulate them.

    All runs have the estimator ``profile``: no reference needs estimates, and shadow jobs would be
    load.

    Parameters
    ----------
    realisation : Realisation
        Drawn for this problem.

    Raises
    ------
    SimulationError
        If the controller sees no window after the warm-up, or a candidate has the name of a
        reference.
    ProblemError
        If the cell is not supported (see `Problem.require_simple`).
    """
    from dwell.sim import simulate_realisation

    problem.require_simple("references")
    names = tuple(problem.candidates)
    if taken := set(REFERENCES) & set(names):
        raise SimulationError(
            f"candidates.{min(taken)} has the name of a reference; call it something else"
        )
    in_time, width = _in_time(problem), problem.window_cycles
    statics = play_alone(problem, realisation)
    costs = {name: mean_cost(run) for name, run in statics.items()}
    alone = np.stack([window_costs(run, problem, realisation) for run in statics.values()], axis=1)
    decide_cycles = problem.decide_cycles
    least = resolved(problem, estimator_of(problem)).dwell_cycles
    expected = expected_costs(problem, realisation, decide_cycles)
    sequences, runs, promised = {}, {}, {}
    for title, known, cycles, dwell in (
        (CLAIRVOYANT, alone, width, 0),
        (CLAIRVOYANT_DWELL, alone, width, least),
        (ORACLE, expected, decide_cycles, 0),
        (ORACLE_DWELL, expected, decide_cycles, least),
    ):
        plan, promised[title] = planned(problem, realisation, known, cycles, dwell)
        settings = replace(in_time.controller, decide_cycles=cycles)
        decided = replace(in_time, controller=settings)
        script = Script([names[i] for i in plan.choice.tolist()], decided, realisation, cycles)
        sequences[title] = plan
        runs[title] = simulate_realisation(decided, realisation, policy=script, estimator="profile")
        costs[title] = mean_cost(runs[title])
    return References(
        statics=FrozenDict(statics),
        runs=FrozenDict(runs),
        sequences=FrozenDict(sequences),
        costs=FrozenDict(costs),
        promised=FrozenDict(promised),
    )


def planned(
    problem: Problem, realisation: Realisation, costs: Floats, decide_cycles: int, dwell_cycles: int
) -> tuple[Sequence, float]:
    """Plan the cheapest sequence, and return it with its mean J of a window.

    Parameters
    ----------
    costs : float64 array, shape (stretches, candidates)
        J of every stretch between decisions, in windows' J: half of a window has half of its J.
    decide_cycles : int
        Cycles of a stretch; the last one may be shorter.
    dwell_cycles : int
        Cycles that a placement stays at least, before the stretch that a move is decided on.

    Returns
    -------
    Sequence
        A candidate for each stretch.
    float
        Mean over the windows after the warm-up whose close the controller sees.
    """
    switching = problem.objective.weights.switching * moved_shares(problem)
    width = problem.window_cycles
    begin = np.arange(len(costs)) * decide_cycles
    end = np.minimum(begin + decide_cycles, realisation.cycles)
    last_ns, beyond_ns = realisation.release_ns[end - 1], realisation.release_ns[end]
    seen = is_up(problem, realisation, window_close_ns(problem, last_ns, beyond_ns))
    warmup = begin < problem.warmup_windows * width
    plan = clairvoyant(
        costs,
        switching,
        initial=tuple(problem.candidates).index(problem.initial),
        min_dwell=min(-(-dwell_cycles // decide_cycles), len(costs)),
        counts=np.where(warmup, WARMUP_SHARE, 1.0),
        decides=seen,
    )
    counted = seen & ~warmup
    windows = (end - begin)[counted].sum() / width
    return plan, float(priced(plan.choice, costs, switching)[counted].sum() / windows)


def regret(run_cost: float, reference_cost: float) -> float:
    """Relative excess of a run's `mean_cost` over `References.cost` of the same realisation.

    The regret is negative if the run costs less than the reference, which is no bound.
    """
    return run_cost / reference_cost - 1.0


def few_misses(run: Run, problem: Problem, limit: float = 0.05) -> Mask:
    """For every window, whether the run's share of misses is at most a limit.

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
    """Share of the reference's windows with few misses that also have few misses in a run.

    `mine` and `asked` are `few_misses` of the run and of the cheapest reference. The share is 1 if
    the reference has no such window.
    """
    count = min(len(mine), len(asked))
    asked = asked[:count]
    return float(mine[:count][asked].mean()) if asked.any() else 1.0


def mean_cost(run: Run) -> float:
    """Mean J over the windows after the warm-up that the controller saw.

    Raises
    ------
    SimulationError
        If the run has no such window.
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
    """J of every window of a static run, shape (windows,), including unseen windows.

    For a window during an outage of the controller's node, this is the J that the controller would
    have seen. Statistics omit these windows, but a plan needs their costs to choose a placement for
    the outage.
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
        decide_cycles=problem.window_cycles,
    )
    return replace(problem, controller=settings)
