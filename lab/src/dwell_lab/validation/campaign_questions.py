"""RQ1 and RQ2 for measured runs, as `reproduction` answers them for simulated runs.

Differences, tests and families are the same; a repetition replaces a seed. Repetitions on a testbed
are few: a sign-flip test of n pairs gives no p below 2 / 2^n. With m comparisons and few pairs no
result can be significant. Each row has its smallest possible p.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from dwell.model import LinkDisturbance, NodeDisturbance, Problem
from dwell.study.family import Contrast, Difference, Family
from dwell_lab.validation.measured_campaign import MeasuredCampaign

if TYPE_CHECKING:
    import polars as pl

Answer: TypeAlias = Literal["yes", "no", "in part", "not shown"]

METRICS = ("violation_rate", "l95_ms", "u_robot", "cost")
#: The policies that place T2 and T3 together, and the policy that moves one stage.
TOGETHER, SINGLE = ("dtp", "cusum"), "atp"
#: The placement with T2 on E and T3 on R2, and the placements of binary reversion.
HYBRID, BINARY = "HYB", ("LOC", "SO")
RQ1 = (
    "RQ1: Does concurrent T2+T3 placement reduce V_D further than single-stage ATP under CPU "
    "stress?"
)
RQ2 = "RQ2: Does routing T3 to R2 during network faults outperform binary R1/E reversion?"


class CampaignQuestion(NamedTuple):
    """A question, and the comparisons that answer it.

    Parameters
    ----------
    answer : {"yes", "no", "in part", "not shown"}
        By V_D of the first policy: "yes" if it is lower than all others in every scenario, "in
        part" if in some, "no" if it is higher in some and lower in none.
    table : DataFrame
        One row per comparison and metric: ``scenario``, ``first``, ``second``, ``metric``, ``n``
        (repetitions), ``effect`` (the first less the second) with ``low`` and ``high``, ``p``
        (Holm's), ``p_least`` and ``word``.
    """

    title: str
    answer: Answer
    table: pl.DataFrame


def questions(measured: MeasuredCampaign) -> tuple[CampaignQuestion, ...]:
    """Return the questions that the runs can answer, with their answers."""
    comparison = measured.comparison
    problem, policies = comparison.problem, comparison.policies
    rules, singles = (_of_family(policies, names) for names in (TOGETHER, (SINGLE,)))
    binary = [name for name in BINARY if name in policies]
    answered = []
    if rules and singles:
        scenarios = stress_scenarios(problem, comparison.scenarios)
        pairs = list(product(rules, singles))
        answered.append(_answered(comparison.runs, RQ1, scenarios, pairs, (rules[0], singles)))
    if binary and HYBRID in policies:
        scenarios = fault_scenarios(problem, comparison.scenarios)
        pairs = [*product([HYBRID], binary), *product(rules, (*binary, *singles))]
        answered.append(_answered(comparison.runs, RQ2, scenarios, pairs, (HYBRID, binary)))
    return tuple(question for question in answered if question.table.height)


def stress_scenarios(problem: Problem, names: Sequence[str]) -> tuple[str, ...]:
    """Return the scenarios that disturb CPUs only."""
    return tuple(
        name
        for name in names
        if problem.scenario(name)
        and all(isinstance(item, NodeDisturbance) for item in problem.scenario(name))
    )


def fault_scenarios(problem: Problem, names: Sequence[str]) -> tuple[str, ...]:
    """Return the scenarios in which links are disturbed, whatever else is."""
    return tuple(
        name
        for name in names
        if any(isinstance(item, LinkDisturbance) for item in problem.scenario(name))
    )


def compared(
    runs: pl.DataFrame, question: str, metric: str, pairs: Mapping[str, Contrast]
) -> Family:
    """Compare all pairs in a metric, by the repetitions that both of a pair have.

    A campaign that was stopped, or that gave runs up, has fewer of some than of others.
    """
    import polars as pl

    differences: dict[str, Difference] = {}
    for name, pair in pairs.items():
        first, second = (
            set(runs.filter(*(pl.col(key) == value for key, value in labels.items()))["seed"])
            for labels in pair
        )
        if both := first & second:
            shared = runs.filter(pl.col("seed").is_in(sorted(both)))
            differences |= Family.of_runs(shared, question, metric, {name: pair}).comparisons
    return Family(question, metric, differences)


def _answered(
    runs: pl.DataFrame,
    title: str,
    scenarios: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    subject: tuple[str, Sequence[str]],
) -> CampaignQuestion:
    """Compare pairs in every scenario and metric; the answer is about `subject`, and its others."""
    import polars as pl

    names = {
        f"{scenario}: {first}, {second}": (scenario, first, second)
        for scenario in scenarios
        for first, second in pairs
    }
    contrasts: dict[str, Contrast] = {
        name: ({"scenario": scenario, "policy": first}, {"scenario": scenario, "policy": second})
        for name, (scenario, first, second) in names.items()
    }
    schema = dict.fromkeys(("scenario", "first", "second"), pl.String)
    renamed = {"effect": "difference", "p": "p_holm", "word": "verdict"}
    columns = ("metric", "n", "effect", "low", "high", "p", "p_least", "word")
    parts = []
    for metric in METRICS:
        rows = compared(runs, title, metric, contrasts).table()
        labels = [names[name] for name in rows["comparison"]]
        parts.append(
            pl.DataFrame(labels, schema=schema, orient="row").hstack(
                rows.select(pl.col(renamed.get(name, name)).alias(name) for name in columns)
            )
        )
    table = pl.concat(parts, how="vertical_relaxed")
    return CampaignQuestion(title, answer_of(table, *subject), table)


def answer_of(table: pl.DataFrame, first: str, others: Sequence[str]) -> Answer:
    """Return the answer by the V_D of `first` against all others."""
    words: dict[str, set[str]] = {}
    for row in table.filter(metric="violation_rate", first=first).iter_rows(named=True):
        if row["second"] in others:
            words.setdefault(row["scenario"], set()).add(row["word"])
    lower = sum(shown == {"lower"} for shown in words.values())
    if lower:
        return "yes" if lower == len(words) else "in part"
    return "no" if any("higher" in shown for shown in words.values()) else "not shown"


def _of_family(policies: Sequence[str], families: Sequence[str]) -> list[str]:
    """Return the policies of some families, in the order of the families."""
    return [name for kind in families for name in policies if name.partition("+")[0] == kind]
