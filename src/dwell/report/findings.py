"""What a comparison says, in sentences; every one of them is made from its numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from dwell.model.document import to_document
from dwell.report.formatting import (
    Measure,
    listed,
    percent,
    shown_policy,
    shown_scenario,
    write_interval,
    write_number,
)
from dwell.report.palette import contended
from dwell.study import AIM, Comparison, Interval
from dwell.study.family import cannot_tell
from dwell.study.intervals import Verdict, rule_of_three, under
from dwell.study.predictions import PAPER, Judgement, applies, judge_placement

__all__ = [
    "COST",
    "DTP",
    "RATE",
    "Belief",
    "Status",
    "beliefs",
    "cheapest_static",
    "explain",
    "judge_all",
    "limits",
    "question",
    "replayed_files",
    "standing",
    "verdict",
]

Status: TypeAlias = Literal["under", "above", "open", "no miss"]

RATE = Measure("violation_rate", "V_D", "%", 100.0)
COST = Measure("cost", "J", decimals=2)
DTP, ATP = "dtp", "atp"
# Above this share of undone migrations a policy is said to go to and fro.
TO_AND_FRO = 0.5


def standing(comparison: Comparison, scenario: str, policy: str) -> Status:
    """Where a violation rate stands to the aim, by its one-sided 95 % limits over seeds.

    "No miss" is an open case too: none was seen, in too few runs to limit the rate at the aim.
    """
    values = comparison.values(scenario, policy, RATE.column)
    shown: dict[Verdict, Status] = {
        "under": "under",
        "over": "above",
        "not shown": "open" if values.any() else "no miss",
    }
    return shown[under(values, AIM)]


def question(comparison: Comparison) -> str:
    """Return what the comparison asks."""
    count = len(comparison.scenarios)
    where = f"in each of {count} scenarios" if count > 1 else "in this scenario"
    return (
        f"Which policy keeps the share of missed deadlines, V_D, under {percent(AIM)} {where} "
        f"of the cell “{comparison.problem.name}”, and at what cost J?"
    )


def verdict(comparison: Comparison) -> list[str]:
    """Return the answer, a few sentences an item."""
    items = [_on_aim(comparison)]
    if DTP in comparison.policies:
        items += [_on_statics(comparison), _on_atp(comparison), _on_predictions(comparison)]
        items.append(_on_estimates(comparison))
        items += _on_beliefs(comparison)
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
    found = {
        policy: {scenario: standing(comparison, scenario, policy) for scenario in scenarios}
        for policy in policies
    }
    good = {policy: [s for s in scenarios if found[policy][s] == "under"] for policy in policies}
    everywhere = [policy for policy in policies if len(good[policy]) == len(scenarios)]
    aim, all_ = percent(AIM), _all(len(scenarios))
    if everywhere:
        verb = "keeps" if len(everywhere) == 1 else "keep"
        names = listed(map(shown_policy, everywhere))
        return f"{names} {verb} V_D under {aim} in {all_}.{_on_no_miss(comparison)}"
    failed = all("above" in standings.values() for standings in found.values())
    text = f"No policy {'keeps' if failed else 'is shown to keep'} V_D under {aim} in {all_}."
    most = max(len(found) for found in good.values())
    best = [policy for policy in policies if len(good[policy]) == most]
    if most and len(best) == 1:
        missed = [
            f"{shown_scenario(s)}, {_rate(comparison, s, best[0])}"
            for s in scenarios
            if s not in good[best[0]]
        ]
        text += f" {shown_policy(best[0])} does in {most} of {len(scenarios)} (not in "
        text += f"{'; '.join(missed)}), more than any other."
    elif most:
        text += f" {listed(map(shown_policy, best))} do in {most} of {len(scenarios)}."
    hopeless = []
    for scenario in scenarios:
        if not any(scenario in good[policy] for policy in policies):
            lowest = min(policies, key=lambda p: comparison.values(scenario, p, RATE.column).mean())
            low = _rate(comparison, scenario, lowest)
            hopeless.append(f"{shown_scenario(scenario)} ({shown_policy(lowest)}, {low})")
    if hopeless:
        text += f" None is shown to in {listed(hopeless)}; in brackets the lowest V_D there."
    return text + _on_no_miss(comparison)


def _on_no_miss(comparison: Comparison) -> str:
    """Say how rates are counted that no run showed a miss of."""
    found = [
        standing(comparison, scenario, policy)
        for scenario in comparison.scenarios
        for policy in comparison.policies
    ]
    if "no miss" not in found:
        return ""
    limit = percent(rule_of_three(len(comparison.seeds)), 1)
    return (
        " Where no run shows a miss, V_D is not said to be under it: without further assumptions "
        f"{len(comparison.seeds)} independent runs limit it at {limit} only."
    )


def _on_statics(comparison: Comparison) -> str:
    """Hold DTP against the static placement that is cheapest in each scenario."""
    if not comparison.statics:
        return ""
    gaps = {
        scenario: comparison.difference(
            scenario, (DTP, cheapest_static(comparison, scenario)), COST.column
        )
        for scenario in comparison.scenarios
    }
    said = _higher_or_lower(comparison, gaps, decimals=2)
    return (
        "Against the static placement that is cheapest in each scenario, which is known only "
        f"afterwards, the cost J of DTP{said}."
    )


def _on_atp(comparison: Comparison) -> str:
    if ATP not in comparison.policies:
        return ""
    gaps = {
        scenario: comparison.difference(scenario, (DTP, ATP), RATE.column)
        for scenario in comparison.scenarios
    }
    points = {name: Interval(*(100 * end for end in gap)) for name, gap in gaps.items()}
    said = _higher_or_lower(comparison, points, decimals=1, unit=" points")
    return f"Against {shown_policy(ATP)}, V_D of DTP{said}."


def _on_beliefs(comparison: Comparison) -> list[str]:
    """Hold contenders with an estimator of their own against DTP with that of the cell."""
    found = []
    for name in comparison.policies:
        known = contended(name)
        if known is None or not known.belief:
            continue
        gaps = {
            scenario: comparison.difference(scenario, (name, DTP), COST.column)
            for scenario in comparison.scenarios
        }
        said = _higher_or_lower(comparison, gaps, decimals=2)
        found.append(f"Against DTP, the cost J of {shown_policy(name)}{said}.")
    return found


def _on_predictions(comparison: Comparison) -> str:
    words = {
        "agrees": "agree with it",
        "agrees in part": "agree in part",
        "differs": "differ",
        "open": "leave it open",
    }
    judged = judge_all(comparison)
    found = []
    for answer, verb in words.items():
        names = [
            shown_scenario(item.prediction.scenario) for item in judged if item.answer == answer
        ]
        if names:
            found.append(f"{verb} in {listed(names)}")
    if not found:
        return ""
    return f"The paper predicts which placement dominates under DTP: the runs {listed(found)}."


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
    share = float(undone / moves)
    text = (
        f"DTP migrated {_span(spans)} times in a run of {windows} windows, and {percent(share)} of "
        "these moves undid the one before."
    )
    belief = _widest_gap(comparison)
    if share < TO_AND_FRO or belief is None:
        return text
    estimator = comparison.problem.controller.estimator
    blind = " as if nothing disturbed it" if estimator == "profile" else ""
    return (
        f"{text} It leaves and returns because its estimator, `{estimator}`, prices what is not "
        f"active{blind}: in {shown_scenario(belief.scenario)} it puts {belief.candidate} at J = "
        f"{write_number(belief.estimated, 2)}, and run alone {belief.candidate} measures "
        f"{write_number(belief.alone, 2)}."
    )


# ------------------------------------------------------------- one prediction, one explanation


def explain(comparison: Comparison, judgement: Judgement) -> list[str]:
    """Return why the runs agree with a prediction or differ, as sentences."""
    sentences = [_what_happened(comparison, judgement)]
    if comparison.statics:
        sentences.append(_what_is_cheapest(comparison, judgement))
    if judgement.answer != "agrees":
        sentences.append(_what_was_believed(comparison, judgement.prediction.scenario))
    return [sentence for sentence in sentences if sentence]


def _what_happened(comparison: Comparison, judgement: Judgement) -> str:
    scenario, dominant = judgement.prediction.scenario, judgement.prediction.dominant
    names = comparison.problem.candidates
    shares = {name: comparison.interval(scenario, DTP, f"share_{name}") for name in names}
    order = sorted(shares, key=lambda name: -shares[name].value)
    measure = Measure("", "", "%", 100.0)
    seen = listed(
        f"{write_interval(shares[name], measure)} %{' of the windows' if i == 0 else ''} on {name}"
        for i, name in enumerate(order)
    )
    text = f"DTP spent {seen}."
    if judgement.answer == "agrees in part" and len(dominant) > 1:
        share = write_interval(judgement.share, measure)
        text += f" {listed(dominant)} together have {share} %, the most"
        if judgement.leader not in dominant:
            text += f", but no placement alone has more than {judgement.leader}"
        text += "."
    return text


def _what_is_cheapest(comparison: Comparison, judgement: Judgement) -> str:
    """Tell whether the cell itself is as predicted, or the policy departs from it."""
    scenario, dominant = judgement.prediction.scenario, judgement.prediction.dominant
    best = cheapest_static(comparison, scenario)
    costs = {name: comparison.interval(scenario, name, "cost") for name in comparison.statics}
    others = sorted((name for name in costs if name != best), key=lambda name: costs[name].value)
    against = ", ".join(f"{name} {write_number(costs[name].value, 2)}" for name in others)
    text = f"Run alone, {best} costs least (J = {write_number(costs[best].value, 2)}"
    text += f"; {against})" if others else ")"
    close = [
        name
        for name in others
        if (name in dominant) != (best in dominant)
        and not comparison.difference(scenario, (name, best), "cost").low > 0
    ]
    if close:
        return f"{text}, which these seeds cannot tell from {listed(close, 'or')}."
    if best not in dominant:
        return f"{text}: on this cell the predicted placement is not the cheapest to begin with."
    if judgement.answer == "agrees":
        return f"{text}."
    return f"{text}, so the prediction fits the cell; it is the policy that departs from it."


def _what_was_believed(comparison: Comparison, scenario: str) -> str:
    """Tell how often the policy moved, and how far its estimates were from what followed."""
    moves = comparison.interval(scenario, DTP, "migrations").value
    if not moves:
        return "It never migrated after the warm-up."
    undone = comparison.interval(scenario, DTP, "returns").value / moves
    text = f"It migrated {write_number(moves)} times a run"
    if undone:
        text += f", {percent(undone)} of them straight back"
    least = comparison.problem.controller.min_improvement
    told = beliefs(comparison, scenario, DTP)
    wrong = [belief for belief in told if belief.active - belief.estimated > least]
    if wrong:
        seen = listed(
            f"{belief.candidate} {write_number(belief.active, 2)} (estimated "
            f"{write_number(belief.estimated, 2)})"
            for belief in wrong
        )
        text += f", because placements measured more once active than had been estimated: {seen}"
    return f"{text}."


# ----------------------------------------------------------------------- numbers behind words


@dataclass(frozen=True, slots=True)
class Belief:
    """J of a candidate under a policy, mean over seeds; NaN where it never came to that.

    Parameters
    ----------
    scenario, candidate : str
    estimated : float
        While another was active.
    active : float
        Measured while it was.
    alone : float
        Measured of the static placement.
    """

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


def beliefs(comparison: Comparison, scenario: str, policy: str) -> list[Belief]:
    """Return what a policy was told of every candidate in a scenario, and what was measured."""
    import polars as pl

    mine = comparison.costs.filter((pl.col("scenario") == scenario) & (pl.col("policy") == policy))
    found = []
    for name in comparison.problem.candidates:
        means = mine.filter(pl.col("candidate") == name).select("estimated", "measured").mean()
        estimated, active = (math.nan if mean is None else float(mean) for mean in means.row(0))
        alone = math.nan
        if name in comparison.statics:
            alone = float(comparison.values(scenario, name, COST.column).mean())
        found.append(Belief(scenario, name, estimated, active, alone))
    return found


def _widest_gap(comparison: Comparison) -> Belief | None:
    """Return the candidate that DTP was on at some time and was told the most wrongly of."""
    known = [
        belief
        for scenario in comparison.scenarios
        for belief in beliefs(comparison, scenario, DTP)
        if belief.active > belief.estimated and belief.alone > belief.estimated
    ]
    return max(known, key=lambda belief: belief.alone - belief.estimated, default=None)


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
        f"Intervals are over {seeds} seeds, by the studentised bootstrap, each on its own: of "
        "twenty 95 % intervals one is expected to be wrong, and none is widened for being one of "
        "many.",
        "Scenarios are what the cell file says, mostly steady: how fast a policy reacts to a "
        "change shows only where one happens.",
    ]
    if ATP in comparison.policies:
        items.append("ATP is our reconstruction: its authors' may do better or worse.")
    if problem.controller.estimator == "profile" and DTP in comparison.policies:
        items.append(
            "DTP without brackets has the estimator `profile` (static profiling), the simplest of "
            "the paper's three. It knows no disturbance, so what is said of DTP here is said of "
            "DTP with that estimator."
        )
    files = replayed_files(comparison)
    if files:
        items.append(
            f"Some processes replay measurements ({listed(files)}). Seeds choose where replay "
            "starts, so that runs of different seeds share rows and their intervals are narrower "
            "than those of new measurements would be."
        )
    return items


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
    low, high = write_number(min(values), 0), write_number(max(values), 0)
    return low if low == high else f"{low} to {high}"


def _gap(gap: float, decimals: int) -> str:
    """Write a difference above 0, which is not to be read as none."""
    least = 10.0**-decimals
    return write_number(gap, decimals) if gap >= least / 2 else f"less than {least:.{decimals}f}"


def _higher_or_lower(
    comparison: Comparison, gaps: Mapping[str, Interval], decimals: int, unit: str = ""
) -> str:
    """Say in which scenarios a difference is above 0, below, or not told by the seeds."""
    word = cannot_tell(len(comparison.seeds))
    if word:
        return f": {word}"
    higher = {name: gap.value for name, gap in gaps.items() if gap.known and gap.low > 0}
    lower = {name: -gap.value for name, gap in gaps.items() if gap.known and gap.high < 0}
    words = []
    for found, word in ((higher, "higher"), (lower, "lower")):
        if found:
            where = listed(
                f"{_gap(gap, decimals)}{unit if i == 0 else ''} in {shown_scenario(name)}"
                for i, (name, gap) in enumerate(found.items())
            )
            words.append(f"{word} by {where}")
    equal = [name for name, gap in gaps.items() if gap.low == gap.high == 0]
    level = [name for name in gaps if name not in (*higher, *lower, *equal)]
    for names, word in ((equal, "the same"), (level, "not told apart")):
        if names:
            words.append(f"{word} in {listed(map(shown_scenario, names))}")
    return f" is {'; '.join(words)}"
