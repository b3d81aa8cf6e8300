"""What a comparison says, in sentences; every one of them is made from its numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from dwell.model.document import to_document
from dwell.report.wording import (
    Measure,
    listed,
    shown_policy,
    shown_scenario,
    write_interval,
    write_number,
)
from dwell.study import AIM, Comparison, Interval
from dwell.study.intervals import rule_of_three, share_limits
from dwell.study.predictions import PAPER, Judgement, applies, judge_placement

__all__ = [
    "COST",
    "DTP",
    "RATE",
    "Status",
    "cheapest_static",
    "explain",
    "judge_all",
    "limits",
    "question",
    "replayed_files",
    "standing",
    "verdict",
]

Status: TypeAlias = Literal["under", "above", "open", "none seen"]

RATE = Measure("violation_rate", "V_D", "%", 100.0)
COST = Measure("cost", "J", decimals=2)
DTP, ATP = "dtp", "atp"
# Above this share of undone migrations a policy is said to go to and fro.
TO_AND_FRO = 0.5


def standing(comparison: Comparison, scenario: str, policy: str) -> Status:
    """Where a violation rate stands to the aim, by its one-sided 95 % limits over seeds."""
    values = comparison.values(scenario, policy, RATE.column)
    if not values.any():
        return "none seen"
    at_least, at_most = share_limits(values)
    return "under" if at_most < AIM else "above" if at_least > AIM else "open"


def question(comparison: Comparison) -> str:
    """Return what the comparison asks."""
    count = len(comparison.scenarios)
    where = f"in each of {count} scenarios" if count > 1 else "in this scenario"
    return (
        f"Which policy keeps the share of missed deadlines, V_D, under {AIM:.0%} {where} of the "
        f"cell “{comparison.problem.name}”, and at what cost J?"
    )


def verdict(comparison: Comparison) -> list[str]:
    """Return the answer, a few sentences an item."""
    items = [_on_aim(comparison)]
    if DTP in comparison.policies:
        items += [_on_statics(comparison), _on_atp(comparison), _on_predictions(comparison)]
        items.append(_on_estimates(comparison))
    return [item for item in items if item]


def judge_all(comparison: Comparison) -> list[Judgement]:
    """Hold every prediction of the paper that is about this comparison against it."""
    if DTP not in comparison.policies or not applies(comparison):
        return []
    mine = [item for item in PAPER if item.scenario in comparison.scenarios]
    return [judge_placement(comparison, item) for item in mine]


# ------------------------------------------------------------------------------- the verdict


def _on_aim(comparison: Comparison) -> str:
    scenarios, policies = comparison.scenarios, comparison.policies
    good = {
        policy: [s for s in scenarios if standing(comparison, s, policy) in ("under", "none seen")]
        for policy in policies
    }
    everywhere = [policy for policy in policies if len(good[policy]) == len(scenarios)]
    if everywhere:
        names = listed(shown_policy(policy) for policy in everywhere)
        verb = "keeps" if len(everywhere) == 1 else "keep"
        return f"{names} {verb} V_D under {AIM:.0%} in {_all(len(scenarios))}."
    most = max(len(found) for found in good.values())
    text = f"No policy keeps V_D under {AIM:.0%} in {_all(len(scenarios))}."
    if most:
        best = [policy for policy in policies if len(good[policy]) == most]
        missed = [s for s in scenarios if s not in good[best[0]]]
        text += f" {listed(shown_policy(policy) for policy in best)} comes closest, with {most}"
        if len(best) == 1:
            where = listed(f"{shown_scenario(s)} ({_rate(comparison, s, best[0])})" for s in missed)
            text += f" of {len(scenarios)}; it fails, or is not shown to be under, in {where}"
        text += "."
    hopeless = [s for s in scenarios if not any(s in good[policy] for policy in policies)]
    for scenario in hopeless:
        lowest = min(policies, key=lambda p: comparison.values(scenario, p, RATE.column).mean())
        text += (
            f" In {shown_scenario(scenario)} none is shown to be; the lowest is "
            f"{shown_policy(lowest)} with {_rate(comparison, scenario, lowest)}."
        )
    return text


def _on_statics(comparison: Comparison) -> str:
    """Hold DTP against the static placement that is cheapest in each scenario."""
    if not comparison.statics:
        return ""
    gaps: dict[str, Interval] = {}
    for scenario in comparison.scenarios:
        best = cheapest_static(comparison, scenario)
        gaps[scenario] = comparison.difference(scenario, (DTP, best), "cost")
    lead = "Against the static placement that is cheapest in each scenario (known only afterwards)"
    return f"{lead}, DTP {_more_or_less(gaps, 'costs', 'in J')}."


def _on_atp(comparison: Comparison) -> str:
    if ATP not in comparison.policies:
        return ""
    gaps = {
        scenario: comparison.difference(scenario, (DTP, ATP), RATE.column)
        for scenario in comparison.scenarios
    }
    points = {name: Interval(*(100 * end for end in gap)) for name, gap in gaps.items()}
    said = _more_or_less(points, "misses", "points of V_D", decimals=1)
    return f"Against {shown_policy(ATP)}, DTP {said}."


def _on_predictions(comparison: Comparison) -> str:
    judged = judge_all(comparison)
    if not judged:
        return ""
    by_answer = {
        answer: [
            shown_scenario(item.prediction.scenario) for item in judged if item.answer == answer
        ]
        for answer in ("agrees", "agrees in part", "differs", "open")
    }
    words = {
        "agrees": "agrees with the runs",
        "agrees in part": "agrees in part",
        "differs": "differs",
        "open": "is left open",
    }
    found = [f"{words[answer]} in {listed(names)}" for answer, names in by_answer.items() if names]
    return f"The paper's prediction of the placement that dominates under DTP {'; '.join(found)}."


def _on_estimates(comparison: Comparison) -> str:
    """Say how often DTP left a placement and came back, and why."""
    undone, moves, spans = 0.0, 0.0, []
    for scenario in comparison.scenarios:
        mine = comparison.values(scenario, DTP, "migrations")
        undone += comparison.values(scenario, DTP, "returns").sum()
        moves += mine.sum()
        spans.append(mine.mean())
    if not moves:
        return "DTP never migrated after the warm-up."
    windows = comparison.windows - comparison.problem.warmup_windows
    text = (
        f"DTP migrated {_span(spans)} times in a run of {windows} windows, and "
        f"{undone / moves:.0%} of these moves undid the one before."
    )
    if undone / moves < TO_AND_FRO:
        return text
    gap = _widest_gap(comparison)
    text += (
        f" It leaves and returns because its estimator, `{comparison.problem.controller.estimator}`"
        ", prices what is not active"
    )
    if comparison.problem.controller.estimator != "profile":
        return f"{text} differently from what it then measures."
    text += " as if nothing disturbed it"
    if gap is not None:
        text += (
            f": in {shown_scenario(gap.scenario)} it puts {gap.candidate} at J = "
            f"{write_number(gap.estimated, 2)}, which measures {write_number(gap.alone, 2)} when "
            "run alone"
        )
    return f"{text}."


# ------------------------------------------------------------- one prediction, one explanation


def explain(comparison: Comparison, judgement: Judgement) -> list[str]:
    """Return why the runs agree with a prediction or differ, as sentences."""
    prediction = judgement.prediction
    scenario = prediction.scenario
    sentences = [_what_happened(comparison, judgement)]
    if comparison.statics:
        sentences.append(_what_is_cheapest(comparison, judgement))
    moves = comparison.interval(scenario, DTP, "migrations")
    if judgement.answer != "agrees" and moves.value:
        gaps = [
            gap
            for gap in _gaps(comparison, scenario)
            if gap.active - gap.estimated > comparison.problem.controller.min_improvement
        ]
        undone = comparison.interval(scenario, DTP, "returns").value / moves.value
        text = f"It migrated {write_number(moves.value)} times a run"
        text += f", {undone:.0%} of them back to where it had just come from" if undone else ""
        if gaps:
            seen = listed(
                f"{gap.candidate} {write_number(gap.active, 2)} where "
                f"{write_number(gap.estimated, 2)} had been estimated"
                for gap in gaps
            )
            text += f": once active, {seen}"
        sentences.append(f"{text}.")
    return sentences


def _what_happened(comparison: Comparison, judgement: Judgement) -> str:
    scenario, dominant = judgement.prediction.scenario, judgement.prediction.dominant
    names = comparison.problem.candidates
    shares = {name: comparison.interval(scenario, DTP, f"share_{name}") for name in names}
    order = sorted(shares, key=lambda name: -shares[name].value)
    measure = Measure("", "", "%", 100.0)
    seen = listed(f"{name} {write_interval(shares[name], measure)} %" for name in order)
    text = f"Under DTP the windows went to {seen}."
    together = f"{listed(dominant, 'and')} together hold" if len(dominant) > 1 else ""
    if judgement.answer == "agrees in part" and together:
        share = write_interval(judgement.share, measure)
        text += f" {together} {share} %, the most, but {judgement.leader} alone has the largest "
        text += "share." if judgement.leader not in dominant else "part of it."
    return text


def _what_is_cheapest(comparison: Comparison, judgement: Judgement) -> str:
    scenario, dominant = judgement.prediction.scenario, judgement.prediction.dominant
    best = cheapest_static(comparison, scenario)
    others = [name for name in comparison.statics if name != best]
    costs = {name: comparison.interval(scenario, name, "cost") for name in comparison.statics}
    against = listed(f"{name} {write_number(costs[name].value, 2)}" for name in others)
    text = f"Run alone, {best} costs least (J = {write_number(costs[best].value, 2)}"
    text += f"; {against})" if others else ")"
    rivals = [name for name in others if (name in dominant) != (best in dominant)]
    close = [
        name for name in rivals if not comparison.difference(scenario, (name, best), "cost").low > 0
    ]
    if close:
        return f"{text}, which the seeds do not tell from {listed(close, 'or')}."
    if best in dominant:
        mine = "as the prediction has it" if judgement.answer == "agrees" else "as predicted"
        blame = "" if judgement.answer == "agrees" else ": it is the policy that departs"
        return f"{text}, {mine}{blame}."
    return f"{text}: it is this cell that departs from the prediction, whatever the policy."


# ----------------------------------------------------------------------- numbers behind words


@dataclass(frozen=True, slots=True)
class _Gap:
    """J of a candidate in a scenario: as DTP estimated it, as it measured it, and run alone."""

    scenario: str
    candidate: str
    estimated: float
    active: float
    alone: float


def cheapest_static(comparison: Comparison, scenario: str) -> str:
    """Return the static placement with the lowest mean J."""
    return min(
        comparison.statics, key=lambda name: comparison.values(scenario, name, "cost").mean()
    )


def _gaps(comparison: Comparison, scenario: str) -> list[_Gap]:
    """Return estimated and measured J of the candidates that DTP was on."""
    import polars as pl

    mine = comparison.costs.filter((pl.col("scenario") == scenario) & (pl.col("policy") == DTP))
    gaps = []
    for name in comparison.problem.candidates:
        rows = mine.filter(pl.col("candidate") == name)
        estimated, active = (_mean(rows[column]) for column in ("estimated", "measured"))
        alone = math.nan
        if name in comparison.statics:
            alone = float(comparison.values(scenario, name, "cost").mean())
        if not math.isnan(estimated) and not math.isnan(active):
            gaps.append(_Gap(scenario, name, estimated, active, alone))
    return gaps


def _widest_gap(comparison: Comparison) -> _Gap | None:
    gaps = [gap for scenario in comparison.scenarios for gap in _gaps(comparison, scenario)]
    known = [gap for gap in gaps if gap.alone > gap.estimated]
    return max(known, key=lambda gap: gap.alone - gap.estimated, default=None)


def replayed_files(comparison: Comparison) -> list[str]:
    """Return the traces of measurements that the cell replays."""
    return sorted(set(_trace_files(to_document(comparison.problem))))


def _trace_files(value: object) -> Iterable[str]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            if key == "trace" and isinstance(item, Mapping):
                yield str(item["file"])
            else:
                yield from _trace_files(item)
    elif isinstance(value, list):
        for item in value:
            yield from _trace_files(item)


def limits(comparison: Comparison) -> list[str]:
    """Return what the numbers do not say."""
    problem, seeds = comparison.problem, len(comparison.seeds)
    items = [
        "Simulated, not measured on machines: every number follows from the cell file's "
        "assumptions about execution times, links and disturbances.",
        f"Intervals are over {seeds} seeds, by Student's t, each on its own: of twenty 95 % "
        "intervals one is expected to be wrong, and none is widened for being one of many.",
        "Scenarios are what the cell file says, mostly steady: how fast a policy reacts to a "
        "change shows only where one happens.",
    ]
    if ATP in comparison.policies:
        items.append(
            "ATP is our reconstruction from a description in words: its rule has no public "
            "numbers, and its authors' may do better or worse."
        )
    if problem.controller.estimator == "profile" and DTP in comparison.policies:
        items.append(
            "DTP is shown with the estimator `profile` (static profiling), the simplest of the "
            "paper's three. It knows no disturbance, so what is said of DTP here is said of DTP "
            "with that estimator."
        )
    files = replayed_files(comparison)
    if files:
        items.append(
            f"Some processes replay measurements ({listed(files)}). Seeds choose where replay "
            "starts, so that runs of different seeds share rows and their intervals are narrower "
            "than those of new measurements would be."
        )
    rates = [
        comparison.values(scenario, policy, RATE.column)
        for scenario in comparison.scenarios
        for policy in comparison.policies
    ]
    if any(not values.any() for values in rates):
        items.append(
            "Where no run shows a miss, that is all that is said. Without further assumptions "
            f"{seeds} independent runs limit such a rate at {rule_of_three(seeds):.1%} only (the "
            "rule of three)."
        )
    return items


def _mean(values: object) -> float:
    import polars as pl

    if not isinstance(values, pl.Series):
        return math.nan
    mean = values.drop_nulls().drop_nans().mean()
    return float(mean) if isinstance(mean, float) else math.nan


def _rate(comparison: Comparison, scenario: str, policy: str) -> str:
    return f"{write_interval(comparison.interval(scenario, policy, RATE.column), RATE)} %"


def _all(count: int) -> str:
    return (
        "the scenario"
        if count == 1
        else "both scenarios"
        if count == 2
        else (f"all {count} scenarios")
    )


def _span(values: list[float]) -> str:
    low, high = write_number(min(values)), write_number(max(values))
    return low if low == high else f"{low} to {high}"


def _more_or_less(gaps: Mapping[str, Interval], verb: str, unit: str, decimals: int = 2) -> str:
    """Say in which scenarios a difference is above 0, below, or not told by the seeds."""
    more = {name: gap.value for name, gap in gaps.items() if gap.known and gap.low > 0}
    less = {name: -gap.value for name, gap in gaps.items() if gap.known and gap.high < 0}
    open_ = [name for name in gaps if name not in more and name not in less]
    words: list[str] = []
    number: Callable[[float], str] = lambda value: write_number(value, decimals)  # noqa: E731
    for found, word in ((more, "more"), (less, "less")):
        if found:
            names = listed(f"{shown_scenario(s)} ({number(gap)})" for s, gap in found.items())
            words.append(f"{verb} {word} in {names}")
    if open_:
        names = listed(shown_scenario(name) for name in open_)
        words.append(f"cannot be told apart in {names}")
    text = "; it ".join(words)
    return f"{text}; numbers are differences {unit}" if more or less else text
