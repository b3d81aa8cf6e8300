"""Contenders in words: what each policy does, and what each estimator believes."""

from __future__ import annotations

from collections.abc import Iterable

from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import Problem
from dwell.report.formatting import OURS, shown_contender
from dwell.report.palette import FAMILIES, Palette, contended

#: By what stands in brackets behind a policy.
BELIEFS = {
    **{name: estimator.sentence for name, estimator in ESTIMATORS.items()},
    "hindsight": "is told, one window late, what every placement would have cost: what the rule "
    "does with estimates that are right.",
}
#: By what stands with a hyphen behind a policy.
VARIANTS = {
    "thresholds": "by the thresholds alone, without a cost.",
    "tuned": "with settings that were chosen on seeds that nothing else is done on.",
    "escape": "with the escape: it may move before the dwell time is over, where the placement it "
    "is on is over a cap.",
    "dwell": "under the dwell time of Algorithm 1.",
}


def palette_of(problem: Problem, names: Iterable[str]) -> Palette:
    """Return how several contenders are drawn, by their names.

    Where any of them says what it believes, the others are drawn as who believes what the cell
    says: ``dtp`` is then another line than ``dtp+corrected``.
    """
    names = list(dict.fromkeys(names))
    known = {name: contended(name) for name in names if name not in problem.candidates}
    told = dict(zip(names, names, strict=True))
    if any(one.belief for one in known.values() if one is not None):
        for name, one in known.items():
            if one is not None and not (one.variant or one.belief or one.rest):
                told[name] = f"{name}+{problem.controller.estimator}"
    palette = Palette.of(problem.candidates, told.values())
    styles = {name: palette.policies[shown] for name, shown in told.items()}
    return Palette(palette.placements, styles)


def describe_contenders(problem: Problem, names: Iterable[str]) -> dict[str, str]:
    """Say what each of several contenders is.

    Parameters
    ----------
    names : iterable of str
        As in tables; those that nothing is known of are left out.

    Returns
    -------
    dict of str to str
        Every policy and every estimator once, by the name that is shown.
    """
    names = list(dict.fromkeys(names))
    found: dict[str, str] = {}
    statics = [name for name in problem.candidates if name in names]
    if statics:
        found[", ".join(statics)] = "Placements; as policies these never move."
    known = [one for one in map(contended, names) if one is not None]
    for family, policy in FAMILIES.items():
        if any(one.family == family for one in known):
            remark = f" {OURS}" if family == "atp" else ""
            found[shown_contender(family)] = f"{policy.sentence}{remark}"
    said = {part for one in known for part in (one.variant, one.belief)}
    for name, text in (*BELIEFS.items(), *VARIANTS.items()):
        if name in said:
            found[f"… ({name})" if name in BELIEFS else f"…-{name}"] = text
    return found
