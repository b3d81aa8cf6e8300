"""RQ1 and RQ2 asked of what was measured, as the paper's studies ask them of what is simulated.

The same differences, tests and families as of what is simulated; a repetition stands for a
seed. Repetitions on a testbed are few: from n pairs a sign-flip test gives no p below 2 / 2^n, so
that for m comparisons nothing can be shown below some n, whatever is measured. Every question says
how many that takes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from dwell.model import LinkDisturbance, NodeDisturbance, Problem
from dwell.model.scenario import is_always_on
from dwell.study.chapter import Answer, Chapter, ChapterOutcome, Figure, Table, Unit
from dwell.study.comparison import AIM
from dwell.study.differences import centre, difference_table, shown_as
from dwell.study.family import Contrast, Difference, Family
from dwell.study.intervals import CONFIDENCE
from dwell.study.measured_campaign import MeasuredCampaign
from dwell.study.over_seeds import over_seeds
from dwell.study.pairs import PairedDifference
from dwell.study.sentences import counted, listed, number, points

if TYPE_CHECKING:
    import polars as pl

__all__ = [
    "fault_scenarios",
    "is_steady",
    "main_table",
    "needed_pairs",
    "questions",
    "stress_scenarios",
    "verdict",
]

METRICS = ("violation_rate", "l95_ms", "u_robot", "cost")
#: The policies that place T2 and T3 together, and the one that moves one stage.
TOGETHER, SINGLE = ("dtp", "cusum"), "atp"
#: The placement with T2 on E and T3 on R2, and those that binary reversion knows.
HYBRID, BINARY = "HYB", ("LOC", "SO")

MAIN: Mapping[str, Unit] = {
    "scenario": "text",
    "policy": "text",
    "violation_rate": "percent",
    "l95_ms": "ms",
    "u_robot": "percent",
    "u_edge": "percent",
    "cost": "cost",
    "migrations": "number",
}
HEADINGS = {
    "violation_rate": "V_D",
    "l95_ms": "L95 (ms)",
    "u_robot": "U_r",
    "u_edge": "U_e",
    "cost": "J",
}


def questions(measured: MeasuredCampaign) -> tuple[Chapter, ...]:
    """Return the questions that the runs have anything to say on, answered."""
    return tuple(one for one in (_rq1(measured), _rq2(measured)) if one is not None)


def stress_scenarios(problem: Problem, names: Sequence[str]) -> tuple[str, ...]:
    """Return the scenarios in which nothing but CPUs is disturbed."""
    return tuple(name for name in names if _only(problem, name, NodeDisturbance))


def fault_scenarios(problem: Problem, names: Sequence[str]) -> tuple[str, ...]:
    """Return the scenarios in which links are disturbed, whatever else is."""
    return tuple(
        name
        for name in names
        if any(isinstance(item, LinkDisturbance) for item in problem.scenario(name))
    )


def is_steady(problem: Problem, names: Sequence[str]) -> bool:
    """Whether what is disturbed in scenarios is so from the first cycle to the last."""
    return all(is_always_on(item) for name in names for item in problem.scenario(name))


def _only(problem: Problem, scenario: str, kind: type) -> bool:
    items = problem.scenario(scenario)
    return bool(items) and all(isinstance(item, kind) for item in items)


def needed_pairs(comparisons: int) -> int:
    """Return how many pairs it takes to show any of several comparisons at 5 % (Holm).

    The least p value of n pairs is 2 / 2^n, and Holm's procedure multiplies the smallest of m by m.
    """
    allowed = 1 - CONFIDENCE
    return next(n for n in itertools.count(1) if max(1, comparisons) * 2 / 2**n <= allowed + 1e-12)


def compared(runs: pl.DataFrame, question: str, pairs: Mapping[str, Contrast]) -> dict[str, Family]:
    """Compare all pairs in every metric, by the repetitions that both of a pair have.

    A campaign that was stopped, or that gave runs up, has fewer of some than of others.
    """
    import polars as pl

    found: dict[str, Family] = {}
    for metric in METRICS:
        differences: dict[str, Difference] = {}
        for name, (first, second) in pairs.items():
            sides = [
                runs.filter(*(pl.col(key) == value for key, value in one.items()))
                for one in (first, second)
            ]
            both = set(sides[0]["seed"]) & set(sides[1]["seed"])
            if both:
                shared = runs.filter(pl.col("seed").is_in(sorted(both)))
                one = Family.of_runs(shared, question, metric, {name: (first, second)})
                differences |= one.comparisons
        found[metric] = Family(question, metric, differences)
    return found


# ----------------------------------------------------------------------------------- RQ1


def _rq1(measured: MeasuredCampaign) -> Chapter | None:
    comparison = measured.comparison
    scenarios = stress_scenarios(comparison.problem, comparison.scenarios)
    rules, singles = (_of_family(comparison.policies, names) for names in (TOGETHER, (SINGLE,)))
    if not (scenarios and rules and singles):
        return None
    pairs = _pairs(scenarios, [(rule, single) for rule in rules for single in singles])
    families = compared(comparison.runs, "are T2 and T3 together better than ATP?", pairs)
    if not families["violation_rate"].comparisons:
        return None
    outcome = verdict(families["violation_rate"], rules[0], singles)
    main = _main_table(measured, scenarios, "measured-rq1", "Every policy under CPU stress")
    return Chapter(
        slug="measured-rq1",
        title=(
            "RQ1: Does concurrent T2+T3 placement reduce V_D further than single-stage ATP under "
            "CPU stress?"
        ),
        design=_design(measured, scenarios, families),
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=_metric_findings(families),
        tables=(
            main,
            difference_table(
                families,
                slug="measured-rq1-differences",
                title="Against ATP, repetition by repetition",
                note=SEEDS,
            ),
        ),
        figures=(rates_figure(main, "Missed deadlines under CPU stress"),),
    )


# ----------------------------------------------------------------------------------- RQ2


def _rq2(measured: MeasuredCampaign) -> Chapter | None:
    comparison = measured.comparison
    scenarios = fault_scenarios(comparison.problem, comparison.scenarios)
    there = set(comparison.policies)
    binary = [name for name in BINARY if name in there]
    if not (scenarios and binary and HYBRID in there):
        return None
    rules, singles = (_of_family(comparison.policies, names) for names in (TOGETHER, (SINGLE,)))
    wanted = [(HYBRID, name) for name in binary]
    wanted += [(rule, other) for rule in rules for other in (*binary, *singles)]
    question = "is T3 on R2 better than going back to R1 or staying on E?"
    families = compared(comparison.runs, question, _pairs(scenarios, wanted))
    if not families["violation_rate"].comparisons:
        return None
    outcome = verdict(families["violation_rate"], HYBRID, binary)
    main = _main_table(measured, scenarios, "measured-rq2", "Every policy under network faults")
    return Chapter(
        slug="measured-rq2",
        title=(
            "RQ2: Does routing T3 to R2 during network faults outperform binary R1/E reversion?"
        ),
        design=f"{_design(measured, scenarios, families)} {_binary(measured, scenarios, binary)}",
        answer=outcome.answer,
        verdict=outcome.verdict,
        evidence=outcome.evidence,
        findings=(links_finding(comparison.problem), *_metric_findings(families)),
        tables=(
            main,
            difference_table(
                families,
                slug="measured-rq2-differences",
                title=f"{HYBRID} and the rules against binary reversion, repetition by repetition",
                note=SEEDS,
            ),
        ),
        figures=(rates_figure(main, "Missed deadlines under network faults"),),
    )


def _binary(measured: MeasuredCampaign, scenarios: Sequence[str], binary: Sequence[str]) -> str:
    """Say what stands for binary reversion."""
    if not is_steady(measured.comparison.problem, scenarios):
        return f"{HYBRID} is held against the placements of binary reversion, none of them moving."
    return (
        "The fault lasts from the first cycle to the last, so that binary reversion can do no "
        f"better than the better one of {listed(binary)} does by standing still: {HYBRID} has to "
        "beat both."
    )


# --------------------------------------------------------------------------------- shared

#: What the tables of the studies call seeds.
SEEDS = "A repetition of the campaign takes the place of a seed."


def _of_family(policies: Sequence[str], families: Sequence[str]) -> list[str]:
    """Return the policies of some families, in the order of the families."""
    return [name for kind in families for name in policies if name.partition("+")[0] == kind]


def _pairs(scenarios: Sequence[str], pairs: Sequence[tuple[str, str]]) -> dict[str, Contrast]:
    return {
        f"{scenario}: {first}, {second}": (
            {"scenario": scenario, "policy": first},
            {"scenario": scenario, "policy": second},
        )
        for scenario in scenarios
        for first, second in pairs
    }


def verdict(family: Family, first: str, others: Sequence[str]) -> ChapterOutcome:
    """Say where the first is lower than all others, higher than any, or not told from them.

    Parameters
    ----------
    family : Family
        Of V_D, with comparisons ``SCENARIO: FIRST, OTHER``.
    first : str
    others : sequence of str
    """
    said = family.verdicts
    mine: dict[str, dict[str, str]] = {}
    for name, word in said.items():
        scenario, _, pair = name.rpartition(": ")
        one, _, other = pair.partition(", ")
        if one == first and other in others:
            mine.setdefault(scenario, {})[other] = word
    lower = [name for name, words in mine.items() if set(words.values()) == {"lower"}]
    higher = [name for name, words in mine.items() if "higher" in words.values()]
    answer: Answer
    if not mine:
        answer = "not shown"
    elif len(lower) == len(mine):
        answer = "yes"
    elif lower:
        answer = "in part"
    elif higher:
        answer = "no"
    else:
        answer = "not shown"
    them = listed(others, "and of")
    if lower or higher:
        text = (
            f"V_D of {first} is shown to be lower than that of {them} in "
            f"{counted(len(lower), len(mine), 'scenarios')}, and higher than that of "
            f"{'at least one of them' if len(others) > 1 else them} in {len(higher)}."
        )
    else:
        where = f"of {len(mine)} scenarios" if len(mine) > 1 else "scenario"
        text = (
            f"In {'none' if len(mine) > 1 else 'the one'} {where} V_D of {first} is "
            f"{'' if len(mine) > 1 else 'not '}shown to differ from that of {them}."
        )
    pairs = max((item.n for item in family.comparisons.values()), default=0)
    needed = needed_pairs(len(family.comparisons))
    if pairs < needed:
        text += (
            f" With {pairs} {'repetition' if pairs == 1 else 'repetitions'} nothing can be shown, "
            f"whatever was measured: {len(family.comparisons)} comparisons take {needed}."
        )
    evidence = [
        f"{scenario}, V_D of {first} less that of {other}: {_sized(family, scenario, first, other)}"
        for scenario, words in mine.items()
        for other in words
    ]
    return ChapterOutcome(answer, text, tuple(evidence))


def _sized(family: Family, scenario: str, first: str, other: str) -> str:
    name = f"{scenario}: {first}, {other}"
    item, said = family.comparisons[name], family.verdict(name)
    ends = (item.low, item.high)
    value = centre(family, name)
    size = points(value, interval=ends if item.n > 1 else None)
    alike = ""
    if isinstance(item, PairedDifference) and 0 < item.superiority < 1:
        lower = round(item.superiority * item.n)
        alike = f" (lower in {lower} of {item.n})"
    elif item.n > 1 and value:
        alike = f" ({'lower' if value < 0 else 'higher'} in every repetition)"
    return f"{size}{alike}, {said}."


def _metric_findings(families: Mapping[str, Family]) -> tuple[str, ...]:
    """Say of every metric what is shown."""
    found, nothing = [], []
    for metric, family in families.items():
        verdicts = list(family.verdicts.values())
        counts = {word: verdicts.count(word) for word in ("lower", "higher")}
        each = [f"{word} in {count}" for word, count in counts.items() if count]
        if each:
            said = f"{listed(each)} of {len(verdicts)} comparisons"
            found.append(f"Differences in {shown_as(metric)}: {said}.")
        else:
            nothing.append(shown_as(metric))
    if nothing:
        found.append(f"No difference is shown in {listed(nothing, 'or')}.")
    return tuple(found)


def _design(
    measured: MeasuredCampaign, scenarios: Sequence[str], families: Mapping[str, Family]
) -> str:
    comparisons = families["violation_rate"].comparisons
    repetitions = sorted({item.n for item in comparisons.values()})
    span = f"{repetitions[0]}"
    if len(repetitions) > 1:
        span += f" to {repetitions[-1]}"
    return (
        f"Runs of {number(measured.seconds, 0)} s in {listed(scenarios)}, {span} "
        f"{'repetition' if repetitions == [1] else 'repetitions'} of each pair. V_D, L95, U_r and "
        f"J are compared, each a family of {len(comparisons)} comparisons: sign-flip tests paired "
        f"by repetition, Holm over the family; intervals are 95 % over repetitions. It takes "
        f"{needed_pairs(len(comparisons))} repetitions before any difference can be shown in such "
        "a family."
    )


def _main_table(
    measured: MeasuredCampaign, scenarios: Sequence[str], slug: str, title: str
) -> Table:
    import polars as pl

    runs = measured.comparison.runs.filter(pl.col("scenario").is_in(list(scenarios)))
    return main_table(runs, slug, title)


def main_table(runs: pl.DataFrame, slug: str, title: str) -> Table:
    """Return one row a scenario and policy: what its runs come to."""
    columns = [name for name, unit in MAIN.items() if unit != "text"]
    return Table(
        slug=slug,
        title=title,
        frame=over_seeds(runs, ("scenario", "policy"), columns),
        units={**MAIN, "seeds": "count"},
        headings={**HEADINGS, "seeds": "runs"},
        note="Means over the runs with 95 % intervals.",
    )


def rates_figure(main: Table, title: str) -> Figure:
    """V_D with its interval, by policy and scenario, beside the aim.

    Parameters
    ----------
    main : Table
        With columns ``scenario``, ``policy``, ``violation_rate`` and its limits.
    title : str
    """
    return Figure(
        slug=f"{main.slug}-rates",
        title=title,
        kind="intervals",
        frame=main.frame.select(
            "scenario",
            "policy",
            y="violation_rate",
            y_low="violation_rate_low",
            y_high="violation_rate_high",
        ),
        x="policy",
        y="y",
        series="policy",
        facet="scenario",
        y_label="V_D",
        y_unit="percent",
        line_at=AIM,
        line_label=f"{number(100 * AIM, 0)} %",
        note=main.note,
    )


def links_finding(problem: Problem) -> str:
    """Say which links each placement crosses, and who shares all of them."""
    found = {
        name: tuple(
            dict.fromkeys(
                f"{place[flow.source]}->{place[flow.target]}"
                for flow in problem.pipeline.flows
                if place[flow.source] != place[flow.target]
            )
        )
        for name, place in problem.candidates.items()
    }
    each = "; ".join(f"{name}: {listed(links)}" for name, links in found.items())
    alike = [
        name
        for name in BINARY
        if HYBRID in found and name in found and set(found[name]) == set(found[HYBRID])
    ]
    text = f"Links crossed: {each}."
    if alike:
        text += (
            f" {HYBRID} and {listed(alike)} cross the same ones: what slows those alike cannot "
            "make the one better than the other."
        )
    return text
