"""Comparison of policies: simulates every scenario, policy and seed; intervals over the seeds.

The realisation of a scenario and seed is sampled once, and all policies run on it. The gain of one
policy over another is therefore a paired difference, which cancels the randomness common to both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from dwell.model import Problem
from dwell.model.progress import Progress
from dwell.study.player import Example, Player
from dwell.study.results import StudyRuns
from dwell.study.runner import play_in_memory, results_of
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    from dwell.policies import MinimalPolicy

Contenders: TypeAlias = "Mapping[str, MinimalPolicy | str]"


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class Comparison(StudyRuns):
    """Runs of policies on the same realisations, and the statistics over their seeds.

    Parameters
    ----------
    examples : mapping of (scenario, policy) to Example
        The runs of the first seed.
    """

    examples: Mapping[tuple[str, str], Example]


def compare(
    problem: Problem,
    *,
    scenarios: Sequence[str] | None = None,
    policies: Sequence[str | Contender | MinimalPolicy] | Contenders,
    seeds: Sequence[int],
    windows: int,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Simulate every scenario with every policy and seed.

    Parameters
    ----------
    scenarios : sequence of str, optional
        Default: all scenarios of the problem.
    policies : sequence of str, Contender or policy, or mapping of str to policy or str
        Names (`dtp`, a candidate, ...), contenders, or your own policy objects. Tables name an
        object by its class if `policies` is a sequence, by its key if it is a mapping. With several
        processes an object must pickle, and its class must be in a module.
    seeds : sequence of int
        All different. The result depends on the seeds, not on `processes`.
    windows : int
        Length of every run; more than the problem's warm-up.
    processes : int, optional
        Number of worker processes. Default: one per CPU (see `dwell.study.workers`).
    progress : callable, optional
        Called with the number of finished runs and the number of all runs.

    Raises
    ------
    ProblemError, PolicyError, TraceError
        If a name is unknown, or a trace is too short.
    SimulationError
        If a number is out of its range, two policies have the same name, an object cannot be sent
        to worker processes, or a worker process ended early.
    """
    if isinstance(policies, Mapping):
        contenders = [_contender(problem, policy, name) for name, policy in policies.items()]
    else:
        contenders = [
            one if isinstance(one, Contender) else _contender(problem, one) for one in policies
        ]
    study = Study(
        name=problem.name,
        points=(Point({}, problem),),
        scenarios=tuple(problem.scenarios if scenarios is None else scenarios),
        contenders=tuple(contenders),
        seeds=tuple(seeds),
        windows=windows,
    )
    return compare_study(study, processes=processes, progress=progress)


def compare_study(
    study: Study, *, processes: int | None = None, progress: Progress | None = None
) -> Comparison:
    """Simulate a study without parameters in memory, as `compare` does.

    Raises
    ------
    ProblemError, PolicyError, TraceError, SimulationError
        See `compare`.
    """
    player = Player(study, kept=study.seeds[:1])
    tables, kept = play_in_memory(player, processes=processes, progress=progress)
    examples = {(item.scenario, policy): one for (item, _, policy), one in kept.items()}
    return Comparison(**results_of(study, tables), examples=examples)


def _contender(problem: Problem, policy: MinimalPolicy | str, name: str = "") -> Contender:
    """Return a policy of a comparison; ``cusum+corrected`` names its estimator."""
    if isinstance(policy, str):
        return Contender(name or policy, *problem.policy_and_estimator(policy))
    return Contender(name or type(policy).__name__, policy)
