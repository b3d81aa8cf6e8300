"""Algorithm 1 once more, line by line and as slowly as it reads, to test DTP against.

It shares no code with the package: J, the Hamming distance and the caps are written out again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dwell.model import Objective, QoS

Nodes = Mapping[str, "str | tuple[str, str]"]


@dataclass
class Row:
    """A decision; `dwell` counts decisions since the last move, `run` cycles."""

    placement: str
    migrated: bool
    reason: str
    dwell: int
    run: int
    delta_j: float
    costs: dict[str, float]


def switching(now: Nodes, before: Nodes) -> float:
    """Equation 6."""

    def nodes(of: str | tuple[str, str]) -> set[str]:
        return {of} if isinstance(of, str) else set(of)

    return len([v for v in now if nodes(now[v]) != nodes(before[v])]) / len(now)


def price(q: QoS, now: Nodes, before: Nodes, objective: Objective) -> float:
    """Equation 7."""

    def used(*tiers: str) -> float:
        of_nodes = [q.utilisation[n] for n, t in objective.tiers.items() if t in tiers]
        counted = [n for n, t in objective.accelerators.items() if t in tiers]
        return max([*of_nodes, *[q.utilisation[n] for n in counted if n in q.utilisation], 0.0])

    a, bar = objective.weights, objective.targets
    total = a.latency * (q.l95_ms / bar.latency_ms)
    total += a.violations * q.violation_rate
    total += a.robot * (used("robot") / bar.robot)
    total += a.edge * (used("edge", "cloud") / bar.edge)
    return total + a.switching * switching(now, before)


def doubt(one: QoS, other: QoS, objective: Objective) -> float:
    """One standard error of a difference of J."""
    a, bar = objective.weights, objective.targets

    def of(q: QoS) -> float:
        l95_ms, rate = q.error or (0.0, 0.0)
        return a.latency * (l95_ms / bar.latency_ms) + a.violations * rate

    return math.sqrt(of(one) * of(one) + of(other) * of(other))


def worst(q: QoS, objective: Objective) -> float:
    """Largest value / cap - 1; a node that is full to 0.995 counts as full."""
    used = [max(u, 1.0) if u >= 0.995 else u for u in q.utilisation.values()]
    shares = [u / objective.caps.utilisation for u in used]
    l95_ms = q.l95_ms if q.cut_from_ms is None else q.cut_from_ms
    latency = 0 if objective.caps.latency_ms == math.inf else l95_ms / objective.caps.latency_ms
    return max([latency, *shares]) - 1


def algorithm_1(
    windows: Sequence[Mapping[str, QoS]],
    candidates: Mapping[str, Nodes],
    initial: str,
    objective: Objective,
    N_min: int,
    Delta_min: float,
    *,
    W: int = 1,
    d: int = 1,
    least_cycles: int = 0,
) -> list[Row]:
    """Return every decision; its metrics are given for every candidate.

    A placement may be left when max(N_min W, `least_cycles`) + d cycles have run under it, d being
    the cycles between two decisions; where d is W this is N_min windows and one.
    """
    pi = [initial, initial]  # placements k - 2 and k - 1
    n_d = 0
    cycles_run = 0
    rows = []
    for shown in windows:
        before, now = pi[-2:]
        J_now = price(shown[now], candidates[now], candidates[before], objective)
        J_of = {c: price(shown[c], candidates[c], candidates[now], objective) for c in candidates}
        cycles_run += d
        if cycles_run < max(N_min * W, least_cycles) + d:
            n_d += 1
            pi.append(now)
            rows.append(Row(now, False, "dwell", n_d, cycles_run, math.nan, J_of))
            continue
        allowed = [c for c in candidates if worst(shown[c], objective) <= 0]
        infeasible = not allowed
        if infeasible:
            least = min(worst(shown[c], objective) for c in candidates)
            allowed = [c for c in candidates if worst(shown[c], objective) <= least + 1e-6]
        lowest = min(J_of[c] for c in allowed)
        ties = [c for c in allowed if J_of[c] == lowest]
        star = now if now in ties else ties[0]
        Delta = J_now - J_of[star]
        least = Delta_min + doubt(shown[now], shown[star], objective)
        migrates = star != now and Delta - least > 1e-9
        if migrates:
            n_d = cycles_run = 0
            pi.append(star)
            left_out = any(J_of[c] < lowest for c in candidates if c not in allowed)
            reason = "infeasible" if infeasible else "capped" if left_out else "migrate"
        else:
            n_d += 1
            pi.append(now)
            reason = "infeasible" if infeasible else "hold"
        rows.append(Row(pi[-1], migrates, reason, n_d, cycles_run, Delta, J_of))
    return rows
