"""Policies by the names that a cell file and the command line use.

Each policy of ours is declared here, and nowhere else by name. The declarations load without the
classes: these are imported when a policy is made. Another package adds a policy by an entry point
of the group ``dwell.policies``; its class is imported only when that policy is asked for. A class
of a user's own needs no entry: its name is ``package.module:Class``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

from dwell.errors import PolicyError
from dwell.model.bounds import CLASS_PATH
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
            "once the dwell time is over and the improvement large enough.",
        ),
        "atp": PolicyEntry(
            "dwell.policies.atp:ATP",
            "ATP",
            "#e69f00",
            "ATP moves one task to the edge and back, where a threshold on L95 or utilisation is "
            "exceeded and the other side costs less latency, utilisation and switching.",
        ),
        "atp-thresholds": PolicyEntry(
            "dwell.policies.atp_thresholds:ATPThresholds",
            "ATP",
            "#e69f00",
            variant_of="atp",
            estimates=False,
        ),
        "latency-first": PolicyEntry(
            "dwell.policies.latency_first:LatencyFirst",
            "Latency-first",
            "#56b4e9",
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
            "#b8a800",
            "CUSUM adds up what another placement would have saved, window after window, and "
            "moves once that is enough; it has no dwell time.",
        ),
    }
)


#: Those that have a label, a colour and a sentence of their own.
FAMILIES: Mapping[str, PolicyEntry] = MappingProxyType(
    {name: entry for name, entry in REGISTRY.items() if not entry.variant_of}
)


def names() -> tuple[str, ...]:
    """Return the names of all policies: ours, then those of installed packages by name."""
    return names_with(REGISTRY, GROUP)


def by_name(name: str, problem: Problem) -> Policy:
    """Make a policy with the parameters of ``problem.controller``.

    Parameters
    ----------
    name : str
        A policy's name, a candidate's for the placement that never moves, or
        ``package.module:Class`` (see `dwell.model.user_classes`).

    Raises
    ------
    PolicyError
        If there is none of that name (the message lists the known ones), a candidate has it, too,
        the problem has no candidates that the policy could work with, or the package that declares
        the policy, or the class that is named, cannot be imported or made.
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
    """Return whether a policy reads estimates; one that is not of ours is taken to do so."""
    return name not in REGISTRY or REGISTRY[name].estimates


def estimator_of(problem: Problem, policy: MinimalPolicy | str | None = None) -> str:
    """Return the estimator that a cell names, or else the usual one of a policy.

    Parameters
    ----------
    policy : policy, str, or None
        The cell's where None.
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
    """Return the name of the policy of ours whose class is called ``kind``; None where none is."""
    for name, entry in REGISTRY.items():
        if entry.path.partition(":")[2] == kind:
            return name
    return None
