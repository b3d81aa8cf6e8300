"""The paper's cell, its scenarios, what is changed about it, and who plays on it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from dwell.model import Episodes, Exponential, FrozenDict, Placement, Problem, Scenario
from dwell.study import Contender, Point, Study, load_study

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

#: One placement is best from the first cycle to the last.
STEADY = (
    "baseline",
    "robot-cpu-stress",
    "edge-cpu-stress",
    "network-impairment",
    "network-impairment-mild",
)
#: The best placement changes while the run goes on, by a timetable of 300 windows.
TIMETABLE = ("step", "drift")
#: It changes at random, from the begin of a run to its end, however long that is.
RANDOM = ("bursts", "flapping", "mixture")
DYNAMIC = (*TIMETABLE, *RANDOM)

#: The controller as the paper prints it; it decides when a window closes.
PRINTED: Mapping[str, Any] = {
    "policy": "dtp",
    "estimator": "profile",
    "min_dwell": 3,
    "shadow_fraction": 0.05,
}
#: DTP as we read the paper's: with the estimator that it calls static profiling.
PAPERS_DTP = "dtp+profile"
#: The two rules whose candidates are varied, with the estimator corrected.
RULES = ("dtp+corrected", "cusum+corrected")


def paper_cell() -> Problem:
    """Return the canonical cell with the dynamic scenarios, controlled as the paper says."""
    cell = load_study(EXAMPLES / "studies" / "dynamic.yaml").points[0].problem
    printed = replace(cell.controller, decide_cycles=cell.window_cycles, **PRINTED)
    return replace(cell, controller=printed)


def by_length(
    names: Iterable[str], windows: int, timetable_windows: int
) -> Iterator[tuple[str, tuple[str, ...], int]]:
    """Part scenarios by the length of their runs; yield a suffix of names, scenarios, windows."""
    scenarios = tuple(names)
    for suffix, timed, length in (("", False, windows), ("-timetable", True, timetable_windows)):
        mine = tuple(name for name in scenarios if (name in TIMETABLE) is timed)
        if mine:
            yield suffix, mine, length


def of_cell(
    name: str,
    cell: Problem,
    scenarios: Iterable[str],
    contenders: Iterable[Contender],
    seeds: tuple[int, ...],
    windows: int,
    *,
    references: bool = False,
) -> Study:
    """Return a study of one cell."""
    point = (Point({}, cell),)
    return Study(
        name, point, tuple(scenarios), tuple(contenders), seeds, windows, references=references
    )


# ------------------------------------------------------------------------------ contenders


def believing(policy: str, estimator: str) -> Contender:
    """Return a policy with an estimator, called ``dtp+corrected``."""
    return Contender(f"{policy}+{estimator}", policy, estimator)


def dtp(name: str, settings: Mapping[str, object]) -> Contender:
    """Return DTP with the estimator corrected and other settings than the cell's."""
    return Contender(name, "dtp", "corrected", settings)


def statics(problem: Problem) -> tuple[Contender, ...]:
    """Return every candidate's placement, which never moves."""
    return tuple(Contender(name, name) for name in problem.candidates)


def rules() -> tuple[Contender, ...]:
    """Return the contenders of `RULES`."""
    return tuple(believing(rule.removesuffix("+corrected"), "corrected") for rule in RULES)


def scores(runs: pl.DataFrame, column: str) -> dict[str, float]:
    """Return the mean over scenarios of the mean over seeds, by policy; less is better."""
    # Every scenario counts alike, however many of its runs there are.
    means = runs.group_by("policy", "scenario", maintain_order=True).agg(pl.mean(column))
    return dict(means.group_by("policy", maintain_order=True).agg(pl.mean(column)).rows())


def best(contenders: Iterable[Contender], score: Mapping[str, float]) -> Contender:
    """Return the contender with the least score, the first of equals."""
    return min(contenders, key=lambda one: score[one.name])


# -------------------------------------------------------------------------------- variants


def with_candidates(problem: Problem, names: Sequence[str]) -> Problem:
    """Return the problem with some of its candidates; it starts on the first where it has to."""
    controller = replace(
        problem.controller,
        initial=problem.initial if problem.initial in names else names[0],
        fallbacks=tuple(name for name in problem.controller.fallbacks if name in names),
    )
    kept = FrozenDict({name: problem.candidates[name] for name in names})
    return replace(problem, candidates=kept, controller=controller)


def with_candidate(problem: Problem, name: str, moves: Mapping[str, str]) -> Problem:
    """Return the problem with one more candidate: the first one, some of its tasks elsewhere."""
    first = next(iter(problem.candidates.values()))
    placement = Placement({**first, **moves})
    return replace(problem, candidates=FrozenDict({**problem.candidates, name: placement}))


def with_scenarios(problem: Problem, scenarios: Mapping[str, Scenario]) -> Problem:
    """Return the problem with other scenarios than its own."""
    return replace(problem, scenarios=FrozenDict(scenarios))


def on_and_off(scenario: Scenario, *, off_s: float, on_s: float, name: str) -> Scenario:
    """Return a steady scenario that comes and goes, all of it together, for exponential times."""
    episodes = Episodes(name, every_s=Exponential(off_s), for_s=Exponential(on_s))
    return tuple(replace(item, episodes=episodes) for item in scenario)
