"""Dynamic scenarios: regret over the reference in hindsight, and which part of it costs what.

Settings are tuned on seeds of their own. The same rules with `Hindsight` are told, one window late,
what every candidate alone showed: their regret is what rule and lag cost, the rest the estimate's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import polars as pl

from dwell.model import AIM, Problem
from dwell.policies import Cusum
from dwell.study import (
    Contender,
    Hindsight,
    Interval,
    Study,
    StudyResult,
    keeps,
    mean_interval,
    played_alike,
    share_interval,
    under,
    windows_behind,
)
from reproduction.cell import (
    DYNAMIC,
    PAPERS_DTP,
    STEADY,
    believing,
    best,
    dtp,
    of_cell,
    scores,
    statics,
)
from reproduction.questions import Run, study_file
from reproduction.scale import Scale, thinned
from reproduction.verdicts import Answer, by_policy, claims, judge, values

TITLE = (
    "In dynamic scenarios, is the cost within 10 % of the reference, V_D under 5 % wherever the "
    "reference's is, with no more migrations than DTP?"
)

DTP, CUSUM = "dtp+corrected", "cusum+corrected"
TUNED_DTP, TUNED_CUSUM = "dtp-tuned+corrected", "cusum-tuned+corrected"
ESCAPE, WORK = "dtp-escape+corrected", "work-function+corrected"
#: What the same rule would make of knowing, one window late, what every candidate cost.
TOLD = {
    name: name.replace("+corrected", "+hindsight") for name in (DTP, CUSUM, TUNED_DTP, TUNED_CUSUM)
}
REFERENCES = ("clairvoyant", "clairvoyant-dwell")
#: What a policy may cost beyond the reference.
OVER_REFERENCE = 0.10
#: Shares of the cycles that are sent through each alternative as well.
FRACTIONS = (0.01, 0.02, 0.05, 0.1)
METRICS = ("regret", "cost", "violation_rate", "share_kept", "migrations", "aoi_mean_ms")


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Measure regret, part it, and hold it against the aim."""
    tuning = run(tuning_study(cell, scale))
    who = contenders(cell, tuning)
    length = (scale.all_seeds, scale.dynamic_windows)
    dynamic = of_cell("dynamic", cell, DYNAMIC, who, *length, references=True)
    steady = replace(dynamic, name="dynamic-steady", scenarios=STEADY, windows=scale.windows)
    runs = pl.concat([run(study).runs for study in (dynamic, steady)])
    fractions = run(fractions_study(cell, scale))
    shadows = run(replace(study_file("shadows"), seeds=scale.some_seeds, windows=scale.windows))
    studies, scenarios = (dynamic, steady), (*DYNAMIC, *STEADY)
    others = (CUSUM, TUNED_CUSUM, WORK, ESCAPE, TUNED_DTP)
    asked = {
        "The estimator corrected lowers DTP's regret": [
            (DTP, f"dtp+{name}") for name in ("profile", "shadow", "scaling")
        ],
        "Another rule lowers DTP's regret": [(other, DTP) for other in others],
    }
    loaded = {
        "Shadow jobs raise V_D": [
            (f"{name} shadows {share:g}", name)
            for name, share in product(cell.candidates, FRACTIONS)
        ]
    }
    shadowed = shadows.study
    verdicts = [
        *aims(runs, tuple(cell.candidates), studies),
        *claims(runs, ("regret",), scenarios, asked, *studies),
        *claims(shadows.runs, ("violation_rate",), shadowed.scenarios, loaded, shadowed),
    ]
    nodes = [f"node_{name}" for name in cell.fabric.nodes]
    return Answer(
        pl.concat(verdicts),
        {
            "The parts of regret": parts(runs, tuple(cell.candidates)),
            "Every contender in every scenario": by_policy(runs, METRICS),
            "Settings on the held-out seeds": by_policy(tuning.runs, ("regret",)),
            "Shares of cycles that are sent through each alternative": by_policy(
                fractions.runs, ("regret",)
            ),
            "Placements with shadow jobs": by_policy(shadows.runs, ("violation_rate", *nodes)),
        },
    )


# --------------------------------------------------------------------------------- studies


def tuning_study(cell: Problem, scale: Scale) -> Study:
    """Return the grid of both rules on held-out seeds."""
    size = max(2, scale.grid // 3)
    grids = ((0.2, 0.4, 0.8), (0.05, 0.15, 0.3), (0.7, 0.95))
    who = [
        Contender(
            f"cusum {threshold:g} {slack:g} {memory:g}",
            Cusum(
                candidates=cell.candidates,
                initial=cell.initial,
                objective=cell.objective,
                threshold=threshold,
                slack=slack,
                memory=memory,
            ),
            "corrected",
        )
        for threshold, slack, memory in product(*(thinned(grid, size) for grid in grids))
    ]
    who += [
        dtp(f"dtp {n} {least:g}", {"controller.min_dwell": n, "controller.min_improvement": least})
        for n, least in product(thinned((0, 1, 3), size), thinned((0.05, 0.2, 0.4), size))
    ]
    length = (scale.held_out, scale.dynamic_windows)
    return of_cell("dynamic-tuning", cell, DYNAMIC, who, *length, references=True)


def contenders(cell: Problem, tuning: StudyResult) -> tuple[Contender, ...]:
    """Return who plays: real estimators, the tuned rules too, and those that are told."""
    score, grid = scores(tuning.runs, "regret"), tuning.study.contenders
    tuned = {
        name: best([one for one in grid if one.name.startswith(rule)], score)
        for name, rule in ((TUNED_DTP, "dtp "), (TUNED_CUSUM, "cusum "))
    }
    real = (
        *(believing("dtp", name) for name in ("profile", "shadow", "scaling", "corrected")),
        dtp(ESCAPE, {"controller.escape": True}),
        *(believing(name, "corrected") for name in ("cusum", "work-function")),
        *(replace(one, name=name) for name, one in tuned.items()),
    )
    told = [
        replace(one, name=TOLD[one.name], estimator=Hindsight()) for one in real if one.name in TOLD
    ]
    return (*statics(cell), *real, *told)


def fractions_study(cell: Problem, scale: Scale) -> Study:
    """Return what more or fewer shadow jobs are worth to a rule."""
    who = [
        Contender(name, policy, "corrected", {"controller.shadow_fraction": share})
        for policy, share in product(("dtp", "cusum"), (0.0, *FRACTIONS))
        for name in (f"{policy}+corrected {share:g}",)
    ]
    length = (scale.some_seeds, scale.dynamic_windows)
    return of_cell("dynamic-fractions", cell, DYNAMIC, who, *length, references=True)


# ----------------------------------------------------------------------------------- aims


def reference_runs(runs: pl.DataFrame, scenario: str, candidates: Sequence[str]) -> pl.DataFrame:
    """Runs of the reference, one a seed: the cheapest candidate or clairvoyant sequence."""
    known = runs.filter(pl.col("policy").is_in((*candidates, *REFERENCES)), scenario=scenario)
    cheapest = known.sort("seed", "cost", maintain_order=True).group_by("seed", maintain_order=True)
    return cheapest.first()


def aims(
    runs: pl.DataFrame, candidates: Sequence[str], studies: Sequence[Study]
) -> list[pl.DataFrame]:
    """Hold each tuned and untuned rule against the three parts of the aim."""
    found = []
    for scenario, name in product((*DYNAMIC, *STEADY), TOLD):
        regret = mean_interval(values(runs, "regret", scenario=scenario, policy=name))
        word = within(regret, OVER_REFERENCE)
        cost = (f"Cost at most {OVER_REFERENCE:.0%} over the reference", scenario, name, "regret")
        found.append(judge(*cost, regret, word, *studies))
        rates = values(runs, "violation_rate", scenario=scenario, policy=name)
        windows = windows_behind(runs.filter(scenario=scenario, policy=name))
        reference = reference_runs(runs, scenario, candidates)
        known = under(reference["violation_rate"].to_list(), AIM, windows=windows_behind(reference))
        word = under(rates, AIM, windows=windows) if known == "under" else "not asked"
        rate = ("V_D under 5 % where the reference's is", scenario, name, "violation_rate")
        found.append(judge(*rate, share_interval(rates, windows=windows), word, *studies))
        for other in (PAPERS_DTP, DTP):
            if other != name:
                here = runs.filter(scenario=scenario)
                moves = (values(here, "migrations", policy=who) for who in (name, other))
                more = mean_interval(np.subtract(*moves))
                word = within(more, 0.0)
                alike = played_alike(here, ({"policy": name}, {"policy": other}))
                if alike and not more.value:
                    more, word = Interval(0.0, np.nan, np.nan), alike
                claim = (f"No more migrations than {other}", scenario, name, "migrations")
                found.append(judge(*claim, more, word, *studies))
    return found


def within(known: Interval, bound: float) -> str:
    """Say whether a number is at most a bound, by its interval."""
    return {True: "met", False: "missed", None: "not shown"}[keeps(known, at_most=bound)]


def parts(runs: pl.DataFrame, candidates: Sequence[str]) -> pl.DataFrame:
    """Part regret into what rule and lag make of it, and what the estimate adds, seed by seed."""
    keys, policy = ("scenario", "seed"), pl.col("policy")
    static = runs.filter(policy.is_in(candidates)).group_by(keys).agg(best_static=pl.min("regret"))
    rule = runs.filter(policy.is_in(TOLD.values())).select(
        *keys,
        policy=policy.replace_strict({told: name for name, told in TOLD.items()}),
        rule_and_lag="regret",
    )
    parted = runs.drop("best_static").join(rule, on=(*keys, "policy"), maintain_order="left")
    parted = parted.join(static, on=keys, maintain_order="left")
    parted = parted.with_columns(estimate=pl.col("regret") - pl.col("rule_and_lag"))
    return by_policy(parted, ("regret", "rule_and_lag", "estimate", "best_static")).drop("seeds")
