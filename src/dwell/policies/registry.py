"""Policies by the names that a cell file and the command line use.

This is the only place that names Dwell's own policies. A policy's class is imported when the policy
is made. Another package adds a policy with an entry point of the group ``dwell.policies``. A user's
own class needs no entry: its name is ``package.module:Class``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

from dwell.errors import PolicyError
from dwell.model.bounds import CLASS_PATH
from dwell.model.controller_settings import REPLICATE
from dwell.model.entry_points import class_at, class_named, names_with
from dwell.model.semantics import nearest_of
from dwell.model.user_classes import make_user_class

if TYPE_CHECKING:
    from dwell.model.problem import Problem
    from dwell.policies.protocol import MinimalPolicy, Policy

#: The policy that every candidate's name means.
STATIC = "dwell.policies.static:Static"
#: Group of the entry points by which other packages add policies.
GROUP = "dwell.policies"


@dataclass(frozen=True, slots=True)
class PolicyEntry:
    """A policy of ours.

    Parameters
    ----------
    path : str
        ``module:Class``; the class has a ``from_problem``.
    label : str
        The name in tables and figures.
    colour : str
        Colour of its lines: ``#rrggbb``, the same on light and dark pages, or ``ink`` or
        ``muted``, which a page gives values to.
    sentence : str
        The policy in a sentence, for the legend of a report; empty for a variant of another policy.
    variant_of : str
        The policy whose label, colour and sentence it shares; empty where it has its own.
    estimates : bool
        Whether the policy reads the estimates of candidates that do not run.
    """

    path: str
    label: str
    colour: str
    sentence: str = ""
    variant_of: str = ""
    estimates: bool = True


#: The policies of ours by name, in the order in which messages list them.
REGISTRY: Mapping[str, PolicyEntry] = MappingProxyType(
    {
        "dtp": PolicyEntry(
            "dwell.policies.dtp:DTP",
            "DTP",
            "ink",
            "DTP is the paper's Algorithm 1: it moves to the placement with the lowest estimated J "
            "after the dwell time, if the improvement is large enough.",
        ),
        "atp": PolicyEntry(
            "dwell.policies.atp:ATP",
            "ATP",
            "#998a4c",
            "ATP moves one task to the edge and back, if a threshold on L95 or utilisation is "
            "exceeded and the other side costs less latency, utilisation and switching.",
        ),
        "atp-thresholds": PolicyEntry(
            "dwell.policies.atp_thresholds:ATPThresholds",
            "ATP",
            "#998a4c",
            variant_of="atp",
            estimates=False,
        ),
        "latency-first": PolicyEntry(
            "dwell.policies.latency_first:LatencyFirst",
            "Latency-first",
            "#007fff",
            "Latency-first takes the placement with the lowest estimated L95, always.",
        ),
        "work-function": PolicyEntry(
            "dwell.policies.work_function:WorkFunction",
            "Work-function",
            "muted",
            "Work-function follows the optimum in hindsight over all windows so far, one "
            "window late.",
        ),
        "cusum": PolicyEntry(
            "dwell.policies.cusum:Cusum",
            "CUSUM",
            "#7f6040",
            "CUSUM adds up the savings of another placement over windows, and moves when the sum "
            "exceeds a threshold; it has no dwell time.",
        ),
        REPLICATE: PolicyEntry(
            "dwell.policies.replicate:Replicate",
            "Replicate",
            "#b35900",
            "Replicate adds a second copy of each cycle to the placement of another policy (DTP), "
            "if the copy saves more J than it costs.",
        ),
    }
)


#: The policies that have their own label, colour and sentence.
FAMILIES: Mapping[str, PolicyEntry] = MappingProxyType(
    {name: entry for name, entry in REGISTRY.items() if not entry.variant_of}
)


def names() -> tuple[str, ...]:
    """Return the names of all policies: Dwell's, then other packages' in alphabetical order."""
    return names_with(REGISTRY, GROUP)


def by_name(name: str, problem: Problem) -> Policy:
    """Make a policy with the parameters of ``problem.controller``.

    `name` is a policy, a candidate (for the placement that never moves), or
    ``package.module:Class`` (see `dwell.model.user_classes`). Raises PolicyError if the name is
    unknown (the message lists the known names) or names both a policy and a candidate, if the
    policy does not support the problem's candidates, or if the class cannot be imported or made.
    """
    if name in REGISTRY and name in problem.candidates:
        raise PolicyError(f"{name!r} is a policy's name and a candidate's; rename the candidate")
    if name in problem.candidates:
        static = class_at(STATIC)
        return cast(
            "Policy",
            static(candidates=problem.candidates, initial=name, objective=problem.objective),
        )
    if CLASS_PATH.holds(name):
        return cast("Policy", make_user_class(name, problem, "decide", "policy", PolicyError))
    path = REGISTRY[name].path if name in REGISTRY else None
    kind = class_named(name, path, GROUP, "policy", PolicyError)
    if kind is None:
        known = [*names(), *problem.candidates]
        raise PolicyError(f"unknown policy {name!r}; {nearest_of(name, known, 'policies')}")
    make = getattr(kind, "from_problem", None)
    return cast("Policy", kind() if make is None else make(problem))


def estimates(name: str) -> bool:
    """Return whether a policy reads estimates; True for policies from outside Dwell."""
    return name not in REGISTRY or REGISTRY[name].estimates


def estimator_of(problem: Problem, policy: MinimalPolicy | str | None = None) -> str:
    """Return the estimator that a cell names, or else the usual estimator of a policy.

    Without `policy`, use the cell's policy.
    """
    from dwell.policies.protocol import Proposer

    if problem.controller.estimator is not None:
        return problem.controller.estimator
    given = policy or problem.controller.policy
    kind: type = Proposer
    if not isinstance(given, str):
        kind = type(given)
    elif given in problem.candidates:
        kind = class_at(STATIC)
    elif given in REGISTRY:
        kind = class_at(REGISTRY[given].path)
    return (kind if issubclass(kind, Proposer) else Proposer).usual_estimator


def name_of_class(kind: str) -> str | None:
    """Return the name of Dwell's policy with the class name ``kind``, or None."""
    for name, entry in REGISTRY.items():
        if entry.path.partition(":")[2] == kind:
            return name
    return None
