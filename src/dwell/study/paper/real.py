"""Cells that replay recorded measurements: what was found in the model, held against them.

The unit is the run: a seed chooses where in the recording replay starts. Runs share rows of it, so
that they are not quite independent, and a short recording is no more than one sample of its radio.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from dwell.errors import SimulationError
from dwell.model import Problem
from dwell.study.chapter import Answer, Chapter, Outcome, Table, Unit
from dwell.study.comparison import AIM
from dwell.study.demo import longest_run
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.intervals import under
from dwell.study.over_seeds import over_seeds
from dwell.study.paper.contenders import PAPERS_DTP, believing, statics
from dwell.study.paper.contrasts import Contrast, values
from dwell.study.paper.differences import centre, difference_table, families, shown_as
from dwell.study.paper.rates import rates_figure
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, number, percent
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

__all__ = ["chapter", "verdict"]

DTP, CUSUM = "dtp+corrected", "cusum+corrected"
METRICS = ("violation_rate", "cost", "migrations")

MAIN: Mapping[str, Unit] = {
    "scenario": "text",
    "policy": "text",
    "violation_rate": "percent",
    "aim": "text",
    "l95_ms": "ms",
    "u_robot": "percent",
    "cost": "cost",
    "migrations": "number",
    "aoi_mean_ms": "ms",
}
HEADINGS = {
    "scenario": "cell: scenario",
    "violation_rate": "V_D",
    "aim": "V_D under 5 %",
    "l95_ms": "L95 (ms)",
    "u_robot": "U_r",
    "cost": "J",
    "aoi_mean_ms": "mean age (ms)",
}


def chapter(problems: Sequence[Problem], scale: Scale, runner: Runner) -> Chapter:
    """Play the policies on cells that replay measurements.

    Parameters
    ----------
    problems : sequence of Problem
        At least one, with the same candidates.
    scale : Scale
    runner : Runner

    Raises
    ------
    SimulationError
        If there is none, or they differ in their candidates.
    TraceError
        If a recording does not last for a run.
    """
    if not problems:
        raise SimulationError("problems is empty; give at least one cell that replays measurements")
    if len({tuple(problem.candidates) for problem in problems}) > 1:
        each = "; ".join(f"{one.name}: {', '.join(one.candidates)}" for one in problems)
        raise SimulationError(f"the cells differ in their candidates ({each}); give them apart")
    return written([runner.run(real_study(problem, scale)) for problem in problems])


def real_study(problem: Problem, scale: Scale) -> Study:
    """Return the policies on one cell, for as long as its recordings last."""
    return Study(
        name=f"real-{problem.name.removeprefix('real-')}",
        points=(Point({}, problem),),
        scenarios=tuple(problem.scenarios),
        contenders=(
            *statics(problem),
            Contender("atp", "atp"),
            believing("dtp", "profile", name=PAPERS_DTP),
            believing("dtp", "corrected", name=DTP),
            believing("cusum", "corrected", name=CUSUM),
        ),
        seeds=scale.all_seeds,
        windows=longest_run(problem, scale.windows),
    )


def together(results: Sequence[StudyResult]) -> pl.DataFrame:
    """Put the runs of all cells into one frame; scenarios are called ``cell: scenario``."""
    import polars as pl

    return pl.concat(
        [
            result.runs.with_columns(
                scenario=pl.format(
                    "{}: {}", pl.lit(result.study.points[0].problem.name), pl.col("scenario")
                )
            )
            for result in results
        ],
        how="diagonal",
    )


# ------------------------------------------------------------------------------- verdict


def compared(runs: pl.DataFrame, candidates: Sequence[str]) -> dict[str, Family]:
    """Compare what estimates to what does not, and to standing still."""
    pairs: dict[str, Contrast] = {
        f"{scenario}: {first}, {second}": (
            {"scenario": scenario, "policy": first},
            {"scenario": scenario, "policy": second},
        )
        for scenario in dict.fromkeys(runs["scenario"])
        for first, others in (
            (DTP, (PAPERS_DTP, "atp", *candidates)),
            (CUSUM, (PAPERS_DTP, DTP)),
        )
        for second in others
    }
    return families(runs, "do the findings hold on recorded traces?", METRICS, pairs)


def verdict(found: Mapping[str, Family], kept: Mapping[str, int]) -> Outcome:
    """Say where DTP costs less with the estimator corrected, and who keeps the aim.

    Parameters
    ----------
    found : mapping of metric to Family
        See `compared`.
    kept : mapping of policy to int
        Scenarios in which its V_D is shown to be under 5 %.
    """
    pair = f"{DTP}, {PAPERS_DTP}"
    said = _said(found["cost"], pair)
    lower = [name for name, one in said.items() if one == "lower"]
    higher = [name for name, one in said.items() if one == "higher"]
    answer: Answer
    if len(lower) == len(said):
        answer = "yes"
    elif lower:
        answer = "in part"
    elif higher:
        answer = "no"
    else:
        answer = "not shown"
    sizes = [f"{name} {number(centre(found['cost'], f'{name}: {pair}'), 2)}" for name in lower]
    rates = _said(found["violation_rate"], pair)
    fewer = [name for name, one in rates.items() if one == "lower"]
    text = (
        f"With the estimator corrected in the place of static profiling DTP costs less in "
        f"{counted(len(lower), len(said), 'replayed scenarios')}"
    )
    text += f" and more in {len(higher)}; V_D is lower in {len(fewer)}."
    evidence = [f"J less, by: {', '.join(sizes)}."] if sizes else []
    evidence += [f"J more in {listed(higher)}."] if higher else []
    each = ", ".join(f"{policy} in {count}" for policy, count in kept.items())
    return Outcome(answer, text, (*evidence, f"Shown to be under 5 % misses: {each}."))


def _said(family: Family, pair: str) -> dict[str, str]:
    return {
        name.removesuffix(f": {pair}"): said
        for name, said in family.verdicts.items()
        if name.endswith(f": {pair}")
    }


def aims(runs: pl.DataFrame) -> dict[tuple[str, str], str]:
    """Return whether V_D is under 5 %, by scenario and policy."""
    return {
        (scenario, policy): under(
            values(runs, "violation_rate", {"scenario": scenario, "policy": policy}), AIM
        )
        for scenario in dict.fromkeys(runs["scenario"])
        for policy in dict.fromkeys(runs["policy"])
    }


# ------------------------------------------------------------------------------- chapter


def written(results: Sequence[StudyResult]) -> Chapter:
    """Write the chapter of finished runs."""
    runs = together(results)
    candidates = tuple(results[0].study.points[0].problem.candidates)
    found, said = compared(runs, candidates), aims(runs)
    policies = dict.fromkeys(runs["policy"])
    kept = {
        policy: sum(one == "under" for (_, who), one in said.items() if who == policy)
        for policy in policies
    }
    outcome = verdict(found, kept)
    main = main_table(runs, said)
    return Chapter(
        slug="real",
        title="Do the findings hold where recorded measurements are replayed?",
        design=design(results),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(*pair_findings(found, candidates), *best_findings(runs, candidates)),
        tables=(
            main,
            difference_table(
                found, slug="real-differences", title="Policies on the recorded traces"
            ),
        ),
        figures=(rates_figure(main, "Missed deadlines on the recorded traces"),),
    )


def design(results: Sequence[StudyResult]) -> str:
    """Say what was compared."""
    each = "; ".join(
        f"{result.study.points[0].problem.name}: {listed(result.study.scenarios)}, "
        f"{result.study.windows} windows"
        for result in results
    )
    seeds = len(results[0].study.seeds)
    return (
        f"Cells in which recorded times take the place of drawn ones ({each}), {seeds} runs each. "
        "A seed chooses where in the recording replay starts; all policies replay the same rows. "
        "Runs share rows, and are not quite independent: intervals are, if anything, too narrow, "
        "and they say nothing about other radios. The static placements, ATP (our reconstruction, "
        "default thresholds), DTP with static profiling and with corrected, cusum with corrected. "
        "Sign-flip tests paired by run, Holm over all comparisons of a metric."
    )


def pair_findings(found: Mapping[str, Family], candidates: Sequence[str]) -> tuple[str, ...]:
    """Say how each pair compares in every metric."""
    sentences = []
    pairs = [f"{DTP}, atp", *(f"{DTP}, {name}" for name in candidates)]
    pairs += [f"{CUSUM}, {PAPERS_DTP}", f"{CUSUM}, {DTP}"]
    for pair in pairs:
        said = []
        for metric, family in found.items():
            verdicts = _said(family, pair)
            lower = [name for name, one in verdicts.items() if one == "lower"]
            higher = [name for name, one in verdicts.items() if one == "higher"]
            said.append(f"{shown_as(metric)} lower in {len(lower)}, higher in {len(higher)}")
        total = len(_said(found["cost"], pair))
        first, _, second = pair.partition(", ")
        sentences.append(f"{first} against {second}, of {total} scenarios: {'; '.join(said)}.")
    return tuple(sentences)


def best_findings(runs: pl.DataFrame, candidates: Sequence[str]) -> tuple[str, ...]:
    """Say which static placement misses least in each scenario."""
    import polars as pl

    means = (
        runs.filter(pl.col("policy").is_in(list(candidates)))
        .group_by("scenario", "policy", maintain_order=True)
        .agg(pl.col("violation_rate").mean())
    )
    said = []
    for (scenario,), here in means.group_by("scenario", maintain_order=True):
        rates = dict(here.select("policy", "violation_rate").rows())
        best = min(candidates, key=rates.__getitem__)
        said.append(f"{scenario} {best} ({percent(rates[best])})")
    return (f"The placement that misses least if it never moves: {'; '.join(said)}.",)


def main_table(runs: pl.DataFrame, said: Mapping[tuple[str, str], str]) -> Table:
    """One row a scenario and policy."""
    import polars as pl

    columns = [name for name, unit in MAIN.items() if unit != "text"]
    frame = over_seeds(runs, ("scenario", "policy"), columns)
    judged = [said[row] for row in frame.select("scenario", "policy").rows()]
    return Table(
        slug="real",
        title="Every policy on the recorded traces",
        frame=frame.with_columns(aim=pl.Series(judged, dtype=pl.String)),
        units=MAIN,
        headings=HEADINGS,
        note="Means over runs with 95 % intervals; under 5 % by the one-sided limit.",
    )
