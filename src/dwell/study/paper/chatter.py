"""Hamming penalty against threshold hysteresis: which of them keeps DTP calmer (RQ3).

What the penalty can do follows from the rule. A move from π to π' asks for an improvement of more
than Δ_min, and the estimate of π' carries α_S · S(π, π'). Let J stand for costs without switching.

* **N_min ≥ 1.** The incumbent's own switching term, that of the move which led to it, is there in
  the one window after that move, which lies within the dwell. So it never counts: DTP moves to the
  π' with the least J(π') + α_S · S(π, π') where J(π) - J(π') > Δ_min + α_S · S(π, π'). The penalty
  is a threshold of each pair. Where all pairs are equally far apart, as always with two
  candidates, no run can tell it from a larger Δ_min.
* **N_min = 0.** In the window after a move from ρ to π, staying at π costs α_S · S(π, ρ) more. The
  improvement asked for then is not Δ_min + α_S · S(π, π') but the larger of α_S · S(π, π') and
  Δ_min + α_S · (S(π, π') - S(π, ρ)); to go straight back to ρ it is the larger of α_S · S(π, ρ)
  and Δ_min. Right after a move, when chatter begins, the penalty is weaker than the threshold of
  the same height, and may be no more than Δ_min.
* **The choice.** With three placements or more, the penalty prefers a near placement to a far one
  that is better by less than α_S times the difference of their distances.

Experiments therefore match the mean threshold: α_S > 0 beside α_S = 0 with Δ_min raised by α_S
times the mean distance of two candidates. Chatter is counted in migrations, in returns (moves that
undo the one before) and in tasks moved; what calm costs, in V_D and in J without switching.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from dwell.cellfile.study_paths import with_settings
from dwell.cost import hamming
from dwell.model import FrozenDict, Placement, Problem
from dwell.study.chapter import Answer, Chapter, Figure, Outcome, Table, Unit
from dwell.study.engine import StudyResult
from dwell.study.family import Comparative, Family
from dwell.study.intervals import mean_interval
from dwell.study.over_seeds import over_seeds
from dwell.study.paper.cell import RANDOM, present
from dwell.study.paper.contenders import believing
from dwell.study.paper.contrasts import Contrast, values
from dwell.study.paper.differences import centre, difference_table, families
from dwell.study.paper.running import Runner, Scale
from dwell.study.paper.sentences import counted, listed, number
from dwell.study.study import Contender, Point, Study

if TYPE_CHECKING:
    import polars as pl

__all__ = ["chapter", "mean_distance", "verdict"]

SCENARIOS = ("baseline", *RANDOM)
ESTIMATORS = ("profile", "corrected")
DWELLS = (0, 3)
#: α_S of the penalty; the cell's is among them.
STRENGTHS = (0.2, 0.4, 0.8)
FEW_STRENGTHS = (0.2, 0.8)
#: What runs are judged by. J without switching and the tasks moved follow from two prices of a
#: move, this one and the contender's own, which must differ.
JUDGED_BY = 1.0
#: With two candidates, the rules are compared at this α_S.
OF_TWO = 0.2

PENALTY, THRESHOLD = "penalty", "threshold"
CALM: Mapping[str, str] = {
    "migrations": "migrations",
    "returns": "returns",
    "moved": "tasks moved",
}
PRICE: Mapping[str, str] = {"violation_rate": "V_D", "j_still": "J without switching"}
METRICS: Mapping[str, str] = {**CALM, **PRICE}
UNITS: Mapping[str, Unit] = {
    "migrations": "number",
    "returns": "number",
    "moved": "number",
    "violation_rate": "percent",
    "j_still": "cost",
}
#: Migrations that differ by less than this share are the same to any reader.
EQUIVALENT = 0.1


def chapter(problem: Problem, scale: Scale, runner: Runner) -> Chapter:
    """Compare the penalty to a threshold of the same mean."""
    result = runner.run(
        Study(
            name="chatter",
            points=(Point({}, judging(problem)),),
            scenarios=present(problem, SCENARIOS),
            contenders=contenders(problem, FEW_STRENGTHS if scale.coarse else STRENGTHS),
            seeds=scale.all_seeds,
            windows=scale.windows,
        )
    )
    two = of_two(problem)
    check = runner.run(
        Study(
            name="chatter-two",
            points=(Point({}, judging(two)),),
            scenarios=present(problem, SCENARIOS),
            contenders=contenders(two, (OF_TWO,)),
            seeds=scale.some_seeds,
            windows=scale.windows,
        )
    )
    return written(result, check)


def judging(problem: Problem) -> Problem:
    """Return the problem with the price of a move that runs are judged by."""
    return with_settings(problem, {"objective.weights.switching": JUDGED_BY})


def of_two(problem: Problem) -> Problem:
    """Return the problem with the two candidates that are farthest apart."""
    first, second = max(
        itertools.combinations(problem.candidates, 2),
        key=lambda pair: hamming(*(problem.candidates[name] for name in pair)),
    )
    chosen = {name: problem.candidates[name] for name in (first, second)}
    settings = replace(
        problem.controller,
        initial=first,
        fallbacks=tuple(name for name in problem.controller.fallbacks if name in chosen),
    )
    return replace(problem, candidates=FrozenDict(chosen), controller=settings)


def mean_distance(candidates: Mapping[str, Placement]) -> float:
    """Mean share of tasks that change node, over all pairs of candidates."""
    pairs = list(itertools.combinations(candidates.values(), 2))
    return sum(hamming(one, other) for one, other in pairs) / len(pairs)


def contenders(problem: Problem, strengths: Sequence[float] = STRENGTHS) -> tuple[Contender, ...]:
    """Return both rules at every strength, dwell and estimator, and DTP with neither."""
    least = problem.controller.min_improvement
    distance = mean_distance(problem.candidates)
    found = []
    for estimator, dwell in itertools.product(ESTIMATORS, DWELLS):
        found.append(_ruled(estimator, dwell, "neither", 0.0, 0.0, least))
        for strength in strengths:
            found.append(_ruled(estimator, dwell, PENALTY, strength, strength, least))
            raised = least + strength * distance
            found.append(_ruled(estimator, dwell, THRESHOLD, strength, 0.0, raised))
    return tuple(found)


def _ruled(
    estimator: str, dwell: int, rule: str, strength: float, switching: float, least: float
) -> Contender:
    settings = {
        "controller.min_dwell": dwell,
        "controller.min_improvement": least,
        "objective.weights.switching": switching,
    }
    return believing("dtp", estimator, settings, name=named(estimator, dwell, rule, strength))


def named(estimator: str, dwell: int, rule: str, strength: float) -> str:
    """Name of a contender."""
    return f"{estimator}, N_min = {dwell}, {rule} {strength:g}"


# ------------------------------------------------------------------------------- reading


def with_moves(result: StudyResult) -> pl.DataFrame:
    """Return the runs with the tasks that they moved, and their J without switching.

    J by the price of a move p is J without it, plus p times the mean share of tasks moved; it is
    known for two prices: the contender's own (the table of costs) and that which runs are judged
    by.
    """
    import polars as pl

    keys = ["scenario", "policy", "seed"]
    own = (
        result.costs.group_by(keys)
        .agg(
            ((pl.col("measured").fill_null(0.0) * pl.col("windows")).sum()).alias("own"),
            pl.col("windows").sum().alias("of"),
        )
        .select(*keys, pl.col("own") / pl.col("of"))
    )
    prices = {
        one.name: float(str(one.settings["objective.weights.switching"]))
        for one in result.study.contenders
    }
    tasks = len(result.study.points[0].problem.pipeline.tasks)
    runs = result.runs.join(own, on=keys, how="left", maintain_order="left")
    price = pl.col("policy").replace_strict(prices, return_dtype=pl.Float64)
    moved = (pl.col("cost") - pl.col("own")) / (JUDGED_BY - price)
    return runs.with_columns(
        # Whole, but for rounding.
        (moved * pl.col("windows") * tasks).round(6).alias("moved"),
        (pl.col("cost") - JUDGED_BY * moved).alias("j_still"),
    ).drop("own")


def strengths_of(study: Study) -> tuple[float, ...]:
    """Return α_S of the contenders with a penalty, ascending."""
    found = {
        float(str(one.settings["objective.weights.switching"]))
        for one in study.contenders
        if PENALTY in one.name
    }
    return tuple(sorted(found))


def places(study: Study) -> list[tuple[str, str, int, float]]:
    """Return every scenario, estimator, dwell and strength."""
    return list(itertools.product(study.scenarios, ESTIMATORS, DWELLS, strengths_of(study)))


def label(place: tuple[str, str, int, float]) -> str:
    """Name of a comparison."""
    scenario, estimator, dwell, strength = place
    return f"{scenario}: {estimator}, N_min = {dwell}, α_S = {strength:g}"


def compared(runs: pl.DataFrame, study: Study) -> dict[str, Family]:
    """Compare the penalty to the threshold in every place, by every metric."""
    pairs: dict[str, Contrast] = {}
    for place in places(study):
        scenario, estimator, dwell, strength = place
        first, second = (
            {"scenario": scenario, "policy": named(estimator, dwell, rule, strength)}
            for rule in (PENALTY, THRESHOLD)
        )
        pairs[label(place)] = (first, second)
    question = "the penalty against a threshold of the same mean"
    return families(runs, question, tuple(METRICS), pairs)


def identical(check: StudyResult, dwell: int) -> tuple[int, int]:
    """Count the pairs of runs with two candidates, and those that are the same in every number."""
    import polars as pl

    runs = with_moves(check).drop("cost")
    same = total = 0
    for scenario, estimator in itertools.product(check.study.scenarios, ESTIMATORS):
        first, second = (
            runs.filter(
                (pl.col("scenario") == scenario)
                & (pl.col("policy") == named(estimator, dwell, rule, OF_TWO))
            ).sort("seed")
            for rule in (PENALTY, THRESHOLD)
        )
        for one, other in zip(
            first.drop("policy", "j_still").rows(),
            second.drop("policy", "j_still").rows(),
            strict=True,
        ):
            total += 1
            same += one == other
    return same, total


# ------------------------------------------------------------------------------- verdict


@dataclass(frozen=True, slots=True)
class Seen:
    """What was shown where the two rules were compared: one place, all metrics.

    Parameters
    ----------
    dwell : int
        N_min there.
    said : mapping of str to verdict
        Of the penalty, by metric.
    """

    dwell: int
    said: Mapping[str, Comparative]

    def _any(self, word: Comparative, metrics: Iterable[str]) -> bool:
        return any(self.said[name] == word for name in metrics)

    @property
    def calmer(self) -> bool:
        """Whether the penalty keeps calmer, for nothing."""
        return self._any("lower", CALM) and not self._any("higher", METRICS)

    @property
    def rougher(self) -> bool:
        """Whether it keeps less calm, for nothing."""
        return self._any("higher", CALM) and not self._any("lower", METRICS)

    @property
    def alike(self) -> bool:
        """Whether nothing was shown."""
        return not {"lower", "higher"} & set(self.said.values())


def verdict(seen: Sequence[Seen], *, equivalent: bool) -> Outcome:
    """Answer whether the penalty suppresses chatter more finely than the threshold.

    Parameters
    ----------
    seen : sequence of Seen
        One a place.
    equivalent : bool
        Whether migrations are shown to be the same, within `EQUIVALENT`, in every place.
    """
    total = len(seen)
    calmer = sum(one.calmer for one in seen)
    rougher = sum(one.rougher for one in seen)
    alike = sum(one.alike for one in seen)
    answer: Answer
    if calmer and not rougher:
        answer = "yes" if 2 * calmer >= total else "in part"
    elif calmer:
        answer = "in part"
    elif rougher or equivalent:
        answer = "no"
    else:
        answer = "not shown"
    sentence = (
        "Beside a threshold of the same mean, the Hamming penalty is calmer at no price in "
        f"{counted(calmer, total, 'comparisons')}, less calm for nothing in {rougher}, and trades "
        f"one for the other in {total - calmer - rougher - alike}; in {alike} nothing is shown."
    )
    if equivalent:
        sentence += f" Migrations agree within {number(100 * EQUIVALENT, 0)} % everywhere."
    evidence = []
    for dwell in sorted({one.dwell for one in seen}):
        mine = [one for one in seen if one.dwell == dwell]
        counts = "; ".join(
            f"{CALM[name]} fewer in {_count(mine, name, 'lower')}, more in "
            f"{_count(mine, name, 'higher')}"
            for name in CALM
        )
        evidence.append(
            f"With the penalty and N_min = {dwell}, of {len(mine)} comparisons: {counts}."
        )
    return Outcome(answer, sentence, tuple(evidence))


def _count(seen: Iterable[Seen], metric: str, word: Comparative) -> int:
    return sum(one.said[metric] == word for one in seen)


def same_migrations(one: Family, runs: pl.DataFrame, study: Study) -> bool:
    """Whether the intervals of all differences in migrations are within `EQUIVALENT`."""
    for place in places(study):
        scenario, estimator, dwell, strength = place
        usual = values(
            runs,
            "migrations",
            {"scenario": scenario, "policy": named(estimator, dwell, THRESHOLD, strength)},
        ).mean()
        item = one.comparisons[label(place)]
        bound = EQUIVALENT * float(usual)
        if not (item.low >= -bound and item.high <= bound):
            return False
    return True


# ------------------------------------------------------------------------------- chapter


def written(result: StudyResult, check: StudyResult) -> Chapter:
    """Write the chapter of finished runs."""
    study = result.study
    runs = with_moves(result)
    differences = compared(runs, study)
    verdicts = {metric: one.verdicts for metric, one in differences.items()}
    seen = [
        Seen(place[2], {metric: verdicts[metric][label(place)] for metric in METRICS})
        for place in places(study)
    ]
    equivalent = same_migrations(differences["migrations"], runs, study)
    outcome = verdict(seen, equivalent=equivalent)
    numbers = numbers_table(runs, study)
    return Chapter(
        slug="chatter",
        title=(
            "RQ3: Does the Hamming-distance penalty suppress chatter more finely than a threshold?"
        ),
        design=design(study),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(*two_found(check), *shown(differences)),
        tables=(
            numbers,
            *(
                difference_table(
                    {metric: differences[metric] for metric in metrics},
                    slug=f"chatter-{what}",
                    title=f"{title}: the penalty, less a threshold of the same mean",
                )
                for what, title, metrics in (("calm", "Calm", CALM), ("price", "Its price", PRICE))
            ),
        ),
        figures=(
            strengths_figure(numbers, "migrations"),
            strengths_figure(numbers, "moved"),
            frontier_figure(runs, study),
        ),
    )


def design(study: Study) -> str:
    """Say what was compared, and what could be known before."""
    problem = study.points[0].problem
    distance = mean_distance(problem.candidates)
    least = problem.controller.min_improvement
    strengths = listed(f"{one:g}" for one in strengths_of(study))
    return (
        "By the rule alone: with N_min ≥ 1 the incumbent's own switching term falls into the "
        "dwell, so that the penalty is one more threshold, Δ_min + α_S · S(π, π'), of each pair. "
        "Between two candidates, or at equal distances, it cannot be told from a larger Δ_min. It "
        "can differ in two ways: pairs at different distances have different thresholds, so that "
        "near placements are preferred to far ones; and with N_min = 0, in the window after a "
        "move, staying carries the price of having come, so that going straight back asks for the "
        "larger of α_S · S and Δ_min, not for their sum. "
        f"Compared are α_S of {strengths} with Δ_min = {least:g}, "
        f"and α_S = 0 with Δ_min raised by α_S · {number(distance, 3)}, the mean distance of two "
        f"candidates; N_min of {listed(str(one) for one in DWELLS)}; estimators "
        f"{listed(ESTIMATORS)}; scenarios {listed(study.scenarios)}; {len(study.seeds)} seeds of "
        f"{study.windows} windows. Migrations, returns, tasks moved, V_D and J without switching, "
        "paired by seed (sign-flip test, Holm over all "
        f"{len(places(study))} comparisons of a metric). Calmer at no price: fewer of one of the "
        "first three, more of none, and neither V_D nor J shown to be higher."
    )


def two_found(check: StudyResult) -> tuple[str, ...]:
    """Say how the rules compare with two candidates, where the analysis leaves no choice."""
    names = listed(check.study.points[0].problem.candidates)
    found = []
    for dwell in DWELLS:
        same, total = identical(check, dwell)
        expected = ", as the rule implies" if dwell >= 1 and same == total else ""
        found.append(
            f"With two candidates ({names}) and N_min = {dwell}, the two rules give the same run, "
            f"number by number, in {same} of {total} pairs{expected}."
        )
    return tuple(found)


def shown(differences: Mapping[str, Family]) -> tuple[str, ...]:
    """Say in which direction each metric was shown to differ, and where."""
    found = []
    for metric, one in differences.items():
        verdicts = one.verdicts
        parts = []
        for word in ("lower", "higher"):
            named_ = [name for name, said in verdicts.items() if said == word]
            widest = max(named_, key=lambda name: abs(centre(one, name)), default=None)
            text = f"{word} in {len(named_)}"
            if widest is not None:
                factor = 100 if metric == "violation_rate" else 1
                unit = " points" if metric == "violation_rate" else ""
                size = number(factor * abs(centre(one, widest)), 2)
                text += f" (most in {widest}: by {size}{unit})"
            parts.append(text)
        found.append(
            f"{METRICS[metric]}: with the penalty {' and '.join(parts)} of {len(verdicts)} "
            "comparisons."
        )
    return tuple(found)


def numbers_table(runs: pl.DataFrame, study: Study) -> Table:
    """One row a scenario, estimator, dwell, rule and strength."""
    import polars as pl

    frame = over_seeds(runs, ("scenario", "policy"), tuple(METRICS))
    parts = pl.DataFrame(
        [
            {
                "policy": named(estimator, dwell, rule, strength),
                "estimator": estimator,
                "min_dwell": dwell,
                "rule": rule,
                "strength": strength,
            }
            for estimator, dwell in itertools.product(ESTIMATORS, DWELLS)
            for rule, strengths in (
                ("neither", (0.0,)),
                (PENALTY, strengths_of(study)),
                (THRESHOLD, strengths_of(study)),
            )
            for strength in strengths
        ]
    )
    return Table(
        slug="chatter",
        title="Chatter and its price under both rules",
        frame=frame.join(parts, on="policy", how="left", maintain_order="left"),
        units={
            "scenario": "text",
            "estimator": "text",
            "min_dwell": "count",
            "rule": "text",
            "strength": "number",
            **UNITS,
        },
        headings={
            "min_dwell": "N_min",
            "strength": "α_S, or its mean in Δ_min",
            "violation_rate": "V_D",
            "moved": "tasks moved",
            "j_still": "J without switching",
        },
        note=(
            f"Mean over {len(study.seeds)} seeds of {study.windows} windows with its 95 % interval."
        ),
    )


def _panels(numbers: Table) -> pl.DataFrame:
    """Return the rows with `corrected` and a rule, and the panel of each."""
    import polars as pl

    frame = numbers.frame.filter(
        (pl.col("estimator") == "corrected") & (pl.col("rule") != "neither")
    )
    panel = pl.format("{}, N_min = {}", "scenario", "min_dwell").alias("panel")
    return frame.with_columns(panel)


def strengths_figure(numbers: Table, metric: str) -> Figure:
    """Return a metric of calm over the strength of both rules."""
    import polars as pl

    return Figure(
        slug=f"chatter-{metric}",
        title=f"{METRICS[metric].capitalize()} under both rules",
        kind="lines",
        frame=_panels(numbers).select(
            "panel",
            "rule",
            pl.col("strength").alias("x"),
            *(pl.col(f"{metric}{end}").alias(f"y{end}") for end in ("", "_low", "_high")),
        ),
        x="x",
        y="y",
        series="rule",
        facet="panel",
        x_label="α_S, or its mean in Δ_min",
        y_label=METRICS[metric],
        log_x=True,
        note=f"Estimator corrected. {numbers.note}",
    )


def frontier_figure(runs: pl.DataFrame, study: Study) -> Figure:
    """J without switching over migrations: which rule buys more calm for the same price."""
    import polars as pl

    rows = []
    for scenario, dwell, rule, strength in itertools.product(
        study.scenarios, DWELLS, (PENALTY, THRESHOLD), strengths_of(study)
    ):
        mine, usual = (
            {"scenario": scenario, "policy": named("corrected", dwell, *one)}
            for one in ((rule, strength), ("neither", 0.0))
        )
        gained = mean_interval(values(runs, "j_still", mine) - values(runs, "j_still", usual))
        rows.append(
            {
                "panel": f"{scenario}, N_min = {dwell}",
                "rule": rule,
                "x": float(values(runs, "migrations", mine).mean()),
                "y": gained.value,
                "y_low": gained.low,
                "y_high": gained.high,
            }
        )
    return Figure(
        slug="chatter-frontier",
        title="What calm costs",
        kind="lines",
        frame=pl.DataFrame(rows).fill_nan(None).sort("panel", "rule", "x", maintain_order=True),
        x="x",
        y="y",
        series="rule",
        facet="panel",
        x_label="migrations",
        y_label="J without switching, less that with neither rule",
        y_unit="cost",
        note=(
            "One point a strength: further left is calmer, further down cheaper; the lower line "
            f"is the better rule. Estimator corrected; {len(study.seeds)} seeds, paired, with the "
            "95 % interval of the mean."
        ),
    )
