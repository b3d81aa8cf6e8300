"""The paper's table: what it predicts for the steady scenarios, beside what is simulated.

The predictions and how their words are read are `dwell.study.predictions`'; those about DTP are
held against every adaptive policy, so that it can be seen what a better estimator, and another
rule, change about them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from dwell.model import FrozenDict, Problem
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.comparison import AIM, Comparison
from dwell.study.engine import StudyResult
from dwell.study.family import Family
from dwell.study.intervals import Verdict, under
from dwell.study.over_seeds import over_seeds
from dwell.study.paper.cell import steady_scenarios
from dwell.study.paper.contenders import PAPERS_DTP, believing, statics
from dwell.study.paper.contrasts import Contrast, values
from dwell.study.paper.differences import difference_table, families, shown_as
from dwell.study.paper.rates import rates_figure
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, number, percent
from dwell.study.predictions import PAPER, Prediction, applies, judge_claim, judge_placement
from dwell.study.predictions import Answer as Judged
from dwell.study.study import Contender, Point, Study

__all__ = ["chapter", "verdict"]

CORRECTED = "dtp+corrected"
#: Policies that the predictions about DTP are held against.
ADAPTIVE = (PAPERS_DTP, CORRECTED, "cusum+corrected", "work-function+corrected")
#: Those of them whose rule is the paper's; the answer is about these.
DTP = (PAPERS_DTP, CORRECTED)
#: Policies of the figure of latencies, beside the static placements: more could not be told apart.
SHOWN = ("atp", PAPERS_DTP, CORRECTED)

MAIN: Mapping[str, Unit] = {
    "scenario": "text",
    "policy": "text",
    "violation_rate": "percent",
    "aim": "text",
    "l95_ms": "ms",
    "u_robot": "percent",
    "u_edge": "percent",
    "cost": "cost",
    "migrations": "number",
    "returns": "number",
    "leader": "text",
    "leader_share": "percent",
}
ACTUATOR: Mapping[str, Unit] = {
    "scenario": "text",
    "policy": "text",
    "violation_rate": "percent",
    "longest_misses": "number",
    "misses_in_20": "number",
    "over_5_in_100": "percent",
    "aoi_mean_ms": "ms",
    "aoi_p95_ms": "ms",
    "aoi_peak_ms": "ms",
    "tracking_rms_mm": "number",
    "tracking_iae_mm": "number",
}
HEADINGS = FrozenDict(
    {
        "violation_rate": "V_D",
        "aim": "V_D under 5 %",
        "l95_ms": "L95 (ms)",
        "u_robot": "U_r",
        "u_edge": "U_e",
        "cost": "J",
        "leader": "most windows under",
        "leader_share": "their share",
        "longest_misses": "longest run of misses",
        "misses_in_20": "most misses in 20",
        "over_5_in_100": "stretches of 100 with over 5",
        "aoi_mean_ms": "mean age (ms)",
        "aoi_p95_ms": "age, 95 % of the time (ms)",
        "aoi_peak_ms": "peak age (ms)",
        "tracking_rms_mm": "tracking RMS (mm)",
        "tracking_iae_mm": "tracking mean |e| (mm)",
    }
)


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Hold the paper's table against the simulated cell."""
    study = Study(
        name="table",
        points=(Point({}, problem),),
        scenarios=steady_scenarios(problem),
        contenders=contenders(problem),
        seeds=scale.all_seeds,
        windows=scale.windows,
    )
    return written(runner.run(study))


def contenders(problem: Problem) -> tuple[Contender, ...]:
    """Return who plays."""
    simple = (Contender("atp", "atp"), Contender("latency-first", "latency-first"))
    adaptive = [
        believing(policy, estimator)
        for policy, _, estimator in (name.partition("+") for name in ADAPTIVE)
    ]
    return (*statics(problem), *simple, *adaptive)


def written(result: StudyResult) -> Chapter:
    """Write the chapter of finished runs."""
    study = result.study
    comparison = as_comparison(result)
    predictions = [one for one in PAPER if one.scenario in study.scenarios]
    judged = {
        policy: {
            one.scenario: judge_placement(comparison, one, policy).answer for one in predictions
        }
        for policy in ADAPTIVE
        if applies(comparison)
    }
    aims = {
        policy: {
            scenario: under(comparison.values(scenario, policy, "violation_rate"), AIM)
            for scenario in study.scenarios
        }
        for policy in study.policies
    }
    differences = compared(result)
    outcome = verdict(judged, aims)
    main = main_table(result, aims)
    return Chapter(
        slug="table",
        title="Do the paper's predictions for the steady scenarios hold?",
        design=design(study),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(
            *static_claims(comparison, predictions),
            *differing(differences),
            *actuator_findings(result),
        ),
        tables=(
            predictions_table(comparison, predictions),
            claims_table(comparison, predictions),
            main,
            actuator_table(result),
            difference_table(
                differences, slug="table-differences", title="DTP against the static placements"
            ),
        ),
        figures=(violations_figure(main), shares_figure(result), latencies_figure(result)),
    )


def design(study: Study) -> str:
    """Say what was compared."""
    return (
        f"The steady scenarios ({', '.join(study.scenarios)}), each from the first cycle to the "
        f"last, under {len(study.policies)} policies: the static placements, ATP (our "
        "reconstruction, default thresholds), latency-first, DTP with the static profile (as we "
        "read the paper's) and with the estimator corrected, and cusum and work-function with the "
        f"same. {len(study.seeds)} seeds of {study.windows} windows, the same realisations "
        "for everybody; the unit is the seed, intervals are 95 % intervals over seeds by the "
        "studentised bootstrap. The paper's words are read as conditions fixed before any run "
        "(`dwell.study.predictions`); a condition holds, or fails, only where its interval says "
        "so, a share of the windows also where every single seed has it. "
        "“Under 5 %” is said only where the one-sided 95 % limit of V_D is below 5 %. Differences "
        "between policies are paired by seed (sign-flip test, Holm over all comparisons of a "
        "metric)."
    )


def as_comparison(result: StudyResult) -> Comparison:
    """Return the study's runs as the predictions want them."""
    study = result.study
    return Comparison(
        problem=study.points[0].problem,
        scenarios=study.scenarios,
        policies=study.policies,
        seeds=study.seeds,
        windows=study.windows,
        runs=result.runs,
        costs=result.costs,
        latencies=result.latencies,
        examples={},
        versions=result.versions,
    )


# ------------------------------------------------------------------------------- verdict


def verdict(
    judged: Mapping[str, Mapping[str, Judged]], aims: Mapping[str, Mapping[str, Verdict]]
) -> Outcome:
    """Answer whether the predictions hold, and for whom V_D is under the aim.

    Parameters
    ----------
    judged : mapping of policy to mapping of scenario to answer
        Of the adaptive policies; without any, nothing was predicted for this cell.
    aims : mapping of policy to mapping of scenario to verdict
        Whether V_D is under the aim, of all policies.
    """
    kept = ", ".join(
        f"{policy} in {sum(said == 'under' for said in mine.values())}"
        for policy, mine in aims.items()
        if policy in (*DTP, "cusum+corrected") or policy not in (*ADAPTIVE, "atp", "latency-first")
    )
    scenarios = len(next(iter(aims.values())))
    aim = f"V_D is shown to be under 5 %, of {scenarios} scenarios: {kept}."
    if not judged:
        return Outcome("none asked", "The paper predicts nothing for this cell.", (aim,))
    paper = judged[PAPERS_DTP]
    said = [answer for policy in DTP for answer in judged[policy].values()]
    answer: Answer
    if all(one == "agrees" for one in paper.values()):
        answer = "yes"
    elif any(one in ("agrees", "agrees in part") for one in said):
        answer = "in part"
    elif all(one == "differs" for one in said):
        answer = "no"
    else:
        answer = "not shown"
    better = judged[CORRECTED]
    sentence = (
        "With the static profile DTP settles where the paper predicts in "
        f"{counted(_count(paper, 'agrees'), len(paper), 'scenarios')}, and in part in "
        f"{_count(paper, 'agrees in part')}; with the estimator corrected in "
        f"{_count(better, 'agrees')}, and in part in {_count(better, 'agrees in part')}."
    )
    return Outcome(answer, sentence, (*(_agreement(policy, judged[policy]) for policy in DTP), aim))


def _count(mine: Mapping[str, Judged], word: Judged) -> int:
    return sum(said == word for said in mine.values())


def _agreement(policy: str, mine: Mapping[str, Judged]) -> str:
    """``dtp+profile: as predicted in baseline; in part in step; otherwise in bursts.``."""
    words: Mapping[Judged, str] = {
        "agrees": "as predicted",
        "agrees in part": "in part",
        "differs": "otherwise",
        "open": "undecided",
    }
    named = (
        f"{word} in {listed(scenario for scenario, one in mine.items() if one == said)}"
        for said, word in words.items()
        if _count(mine, said)
    )
    return f"{policy}: {'; '.join(named)}."


# ------------------------------------------------------------------------------ findings


def static_claims(comparison: Comparison, predictions: Sequence[Prediction]) -> tuple[str, ...]:
    """Say which of the paper's words on static placements hold."""
    if not applies(comparison):
        return ()
    said = {
        f"{policy} in {one.scenario}: “{claim.words}”": judge_claim(comparison, one.scenario, claim)
        for one in predictions
        for policy, claims in one.claims.items()
        for claim in claims
    }
    held = sum(answer == "agrees" for answer in said.values())
    text = f"Of the paper's {len(said)} statements on static placements {held} hold"
    for answer, words in (("differs", "not so"), ("open", "left open by the intervals")):
        named = [claim for claim, found in said.items() if found == answer]
        text += f"; {words}: {'; '.join(named)}" if named else ""
    return (f"{text}.",)


def compared(result: StudyResult) -> dict[str, Family]:
    """Compare both DTPs to every static placement, and to each other, in every scenario."""
    study = result.study
    candidates = tuple(study.points[0].problem.candidates)
    pairs: dict[str, Contrast] = {}
    for scenario in study.scenarios:
        for first, others in (
            (PAPERS_DTP, candidates),
            (CORRECTED, (*candidates, PAPERS_DTP)),
        ):
            for other in others:
                pairs[f"{scenario}: {first}, {other}"] = (
                    {"scenario": scenario, "policy": first},
                    {"scenario": scenario, "policy": other},
                )
    question = "DTP against the static placements"
    return families(result.runs, question, ("violation_rate", "cost"), pairs)


def differing(differences: Mapping[str, Family]) -> tuple[str, ...]:
    """Say in how many comparisons DTP was shown to be better, and to be worse."""
    found = []
    for metric, one in differences.items():
        verdicts = one.verdicts
        for policy in DTP:
            mine = {
                name: said
                for name, said in verdicts.items()
                if f": {policy}," in name and not name.endswith(PAPERS_DTP)
            }
            lower = sum(said == "lower" for said in mine.values())
            higher = [name for name, said in mine.items() if said == "higher"]
            beaten = [name.replace(f": {policy},", " by") for name in higher]
            found.append(
                f"{shown_as(metric)} of {policy} is lower than a static placement's in {lower} of "
                f"{len(mine)} comparisons and higher in {len(higher)}"
                + (f" ({'; '.join(beaten)})." if beaten else ".")
            )
    return tuple(found)


def actuator_findings(result: StudyResult) -> tuple[str, ...]:
    """Say how far V_D and the tracking error agree on which policy is best."""
    import numpy as np

    study = result.study
    if "tracking_rms_mm" not in result.runs.columns:
        return ()
    found = []
    for scenario in study.scenarios:
        mine = {
            policy: {
                column: float(
                    np.median(values(result.runs, column, {"scenario": scenario, "policy": policy}))
                )
                for column in ("violation_rate", "tracking_rms_mm")
            }
            for policy in study.policies
        }
        rates = [one["violation_rate"] for one in mine.values()]
        errors = [one["tracking_rms_mm"] for one in mine.values()]
        least = {
            column: min(mine, key=lambda policy, column=column: mine[policy][column])  # type: ignore[misc]
            for column in ("violation_rate", "tracking_rms_mm")
        }
        same = least["violation_rate"] == least["tracking_rms_mm"]
        agreed = (
            f"{least['violation_rate']} is best by both"
            if same
            else f"best by V_D is {least['violation_rate']}, by tracking {least['tracking_rms_mm']}"
        )
        found.append(
            f"In {scenario} V_D goes, over the policies, from {percent(min(rates))} to "
            f"{percent(max(rates))}, the tracking error from {number(min(errors), 2)} to "
            f"{number(max(errors), 2)} mm; {agreed}."
        )
    return tuple(found)


# -------------------------------------------------------------------------------- tables


def main_table(result: StudyResult, aims: Mapping[str, Mapping[str, Verdict]]) -> Table:
    """One row a scenario and policy: what the paper's metrics show."""
    import polars as pl

    candidates = tuple(result.study.points[0].problem.candidates)
    shares = [f"share_{name}" for name in candidates]
    columns = [name for name in MAIN if name in result.runs.columns and MAIN[name] != "text"]
    frame = over_seeds(result.runs, ("scenario", "policy"), [*columns, *shares])
    rows = []
    for row in frame.to_dicts():
        leader = max(candidates, key=lambda name: row[f"share_{name}"])
        rows.append(
            {
                **{name: value for name, value in row.items() if not name.startswith("share_")},
                "aim": aims[row["policy"]][row["scenario"]],
                "leader": leader,
                **{
                    f"leader_share{end}": row[f"share_{leader}{end}"]
                    for end in ("", "_low", "_high")
                },
            }
        )
    return Table(
        slug="table",
        title="Every policy in every steady scenario",
        frame=pl.DataFrame(rows, infer_schema_length=None),
        units=MAIN,
        headings=HEADINGS,
        note=_over(result),
    )


def actuator_table(result: StudyResult) -> Table:
    """One row a scenario and policy: misses in a row, age of information, tracking."""
    units = {name: unit for name, unit in ACTUATOR.items() if name in result.runs.columns}
    columns = [name for name, unit in units.items() if unit != "text"]
    return Table(
        slug="table-actuator",
        title="What the actuator got",
        frame=over_seeds(result.runs, ("scenario", "policy"), columns),
        units=units,
        headings=HEADINGS,
        note=f"{_over(result)} Tracking errors, which may be infinite, by their medians.",
    )


def predictions_table(comparison: Comparison, predictions: Sequence[Prediction]) -> Table:
    """One row a scenario and adaptive policy: the placement predicted, and the one found."""
    import polars as pl

    rows = []
    for one in predictions if applies(comparison) else ():
        for policy in ADAPTIVE:
            found = judge_placement(comparison, one, policy)
            rows.append(
                {
                    "scenario": one.scenario,
                    "policy": policy,
                    "predicted": one.dtp,
                    "reading": one.reading,
                    "leader": found.leader,
                    **_ends("share", found.share),
                    **_ends("lead", found.lead),
                    "answer": found.answer,
                }
            )
    return Table(
        slug="table-predictions",
        title="The placement the paper predicts for DTP, and the one that leads",
        frame=pl.DataFrame(rows, infer_schema_length=None),
        units={
            "scenario": "text",
            "policy": "text",
            "predicted": "text",
            "reading": "text",
            "leader": "text",
            "share": "percent",
            "lead": "percent",
            "answer": "text",
        },
        headings={
            "predicted": "the paper",
            "reading": "read as",
            "leader": "leads",
            "share": "share of the predicted",
            "lead": "lead over the next",
        },
        note=f"Shares of the windows after the warm-up; {_seeds(comparison.seeds)}.",
    )


def claims_table(comparison: Comparison, predictions: Sequence[Prediction]) -> Table:
    """One row a statement of the paper on a static placement."""
    import polars as pl

    rows = [
        {
            "scenario": one.scenario,
            "placement": policy,
            "claim": claim.words,
            "reading": claim.reading,
            "answer": judge_claim(comparison, one.scenario, claim),
        }
        for one in (predictions if applies(comparison) else ())
        for policy, claims in one.claims.items()
        for claim in claims
    ]
    return Table(
        slug="table-claims",
        title="What the paper says of the static placements",
        frame=pl.DataFrame(rows, infer_schema_length=None),
        units=dict.fromkeys(("scenario", "placement", "claim", "reading", "answer"), "text"),
        headings={"claim": "the paper", "reading": "read as"},
        note=f"Open: the interval over {_seeds(comparison.seeds)} allows for either.",
    )


def _ends(name: str, interval: Sequence[float]) -> dict[str, float]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def _seeds(seeds: Sequence[int]) -> str:
    return f"{len(seeds)} seeds" if len(seeds) > 1 else "one seed"


def _over(result: StudyResult) -> str:
    study = result.study
    return (
        f"Mean over {_seeds(study.seeds)} of {study.windows} windows, with its 95 % interval; "
        "without the warm-up."
    )


# ------------------------------------------------------------------------------- figures


def violations_figure(main: Table) -> Figure:
    """V_D with its interval, by policy and scenario."""
    return replace(
        rates_figure(main, "Missed deadlines in the steady scenarios"),
        slug="table-violations",
        log_y=True,
        note=f"{main.note} Against the aim counts the one-sided limit, which the table has.",
    )


def shares_figure(result: StudyResult) -> Figure:
    """Where each adaptive policy spent its windows."""
    import polars as pl

    candidates = tuple(result.study.points[0].problem.candidates)
    shares = [f"share_{name}" for name in candidates]
    adaptive = result.runs.filter(~pl.col("policy").is_in(candidates))
    frame = over_seeds(adaptive, ("scenario", "policy"), shares)
    long = pl.concat(
        frame.select(
            "scenario",
            "policy",
            pl.lit(name).alias("placement"),
            *(pl.col(f"share_{name}{end}").alias(f"y{end}") for end in ("", "_low", "_high")),
        )
        for name in candidates
    )
    return Figure(
        slug="table-shares",
        title="Share of the windows under each placement",
        kind="bars",
        frame=long,
        x="policy",
        y="y",
        series="placement",
        facet="scenario",
        y_label="share of the windows",
        y_unit="percent",
        note=_over(result),
    )


def latencies_figure(result: StudyResult) -> Figure:
    """Distributions of latency, all seeds together."""
    import polars as pl

    problem = result.study.points[0].problem
    names = [*problem.candidates, *SHOWN]
    frame = result.latencies.filter(pl.col("policy").is_in(names)).select(
        "scenario", "policy", pl.col("latency_ms").alias("x"), pl.col("share").alias("y")
    )
    return Figure(
        slug="table-latencies",
        title="Latency of the cycles, and the deadline",
        kind="ecdf",
        frame=frame,
        x="x",
        y="y",
        series="policy",
        facet="scenario",
        x_label="latency (ms)",
        y_label="share of the cycles within",
        y_unit="percent",
        line_at=problem.pipeline.deadline_ms,
        line_label="D",
        note=(
            "All cycles after the warm-up of all seeds together; a curve levels off above 0 where "
            "cycles are lost or later than four deadlines. Where LOC cannot be seen it lies "
            "behind dtp+corrected, which stays there."
        ),
    )
