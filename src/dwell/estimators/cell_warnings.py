"""Settings of a cell that are allowed and seldom meant.

`warnings_of` judges a cell by itself, without anything played, and `unplayed` a scenario by the
length of a run. Each says which setting it is, and what to do about it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations

import numpy as np

from dwell.cost import price, tier_utilisation
from dwell.display import milliseconds
from dwell.errors import Fault
from dwell.estimators.profile import Profile, mean_ms
from dwell.model.fabric import Node
from dwell.model.objective import TIERS, Objective
from dwell.model.pipeline import Execution, Task
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.process import Trace
from dwell.model.scenario import Disturbance, NodeDisturbance
from dwell.model.servo import Servo

#: Draws of a process that a percentile, or a mean of latencies, is taken of.
DRAWS = 10_000
#: Share of an accelerator from which on its jobs wait for each other often.
NEARLY_FULL = 0.9
#: Share of J from which on one term leaves nothing to the others.
DOMINANT = 0.95


def warnings_of(problem: Problem, profile: Profile | None = None) -> Iterator[Fault]:
    """Yield what is allowed in a cell but seldom meant.

    Parameters
    ----------
    profile : Profile, optional
        Of the problem; made where None.
    """
    profile = profile or Profile(problem)
    yield from _overloads(problem)
    yield from _slow_stages(problem)
    yield from _starved_stages(problem)
    yield from _full_links(problem)
    yield from _same_placements(problem)
    yield from _over_caps(problem, profile)
    yield from _percentages(problem)
    yield from _dominant_terms(problem, profile)
    yield from _false_alarms(problem, profile)
    yield from _helpless_fallbacks(problem)
    yield from _late_releases(problem)
    yield from _unstable_loops(problem, profile)
    yield from _without_effect(problem)


def unplayed(problem: Problem, scenario: str, windows: int) -> Iterator[Fault]:
    """Yield a warning where nothing of a scenario falls into the windows of a run that count."""
    items = problem.scenario(scenario)
    window_s = problem.window_ms / 1e3
    begin_s, end_s = problem.warmup_windows * window_s, windows * window_s
    if not items or any(item.at_s < end_s and item.end_s > begin_s for item in items):
        return
    first_s = min(item.at_s for item in items)
    when = f"begins at {first_s:g} s" if first_s >= end_s else "is over before the warm-up is"
    yield Fault(
        f"scenarios.{scenario}",
        f"{when}, and the run counts from {begin_s:g} to {end_s:g} s: nothing of it is played; "
        "ask for another number of windows, or change its at_s",
    )


def unpriced(problem: Problem, scenario: str, cycles: int) -> Iterator[Fault]:
    """Yield a warning if prices simulate less than a scenario needs to show all it does."""
    until_s = cycles * problem.pipeline.period_ms / 1e3
    for item in problem.scenario(scenario):
        if item.at_s >= until_s or until_s < item.end_s < math.inf:
            when = f"begins at {item.at_s:g} s"
            if item.at_s < until_s:
                when = f"ends at {item.end_s:g} s"
            yield Fault(
                f"scenarios.{scenario}",
                f"the disturbance of {item.place} {when}, and prices simulate {until_s:.4g} s at "
                "most: `dwell run --windows` simulates more",
            )


# ------------------------------------------------------------------------------- keeping pace


def _overloads(problem: Problem) -> Iterator[Fault]:
    """Yield candidates whose own work is more than a node can do, or than an accelerator nearly."""
    nodes = problem.fabric.nodes
    for name, placement in problem.candidates.items():
        for node in nodes.values():
            share = _own_share(problem, node, placement)
            left = _left_share(problem, node, placement)
            if share > left:
                yield Fault(
                    f"candidates.{name}",
                    f"its own work takes {share:.0%} of {_limit(node, left)}: it can never keep "
                    f"pace; {_remedy(node, left)}",
                )
        for (where, kind), share in _accelerator_shares(problem, placement).items():
            if share > NEARLY_FULL:
                what = "it can never keep pace" if share > 1 else "its jobs wait for each other"
                yield Fault(
                    f"candidates.{name}",
                    f"its own work takes {share:.0%} of {kind} of {where}: {what}; place less "
                    f"there, or raise nodes.{where}.accelerators.{kind}",
                )


def _limit(node: Node, left: float) -> str:
    """What the own work on a node must not exceed, as messages have it."""
    has = f"the cores of {node.name}"
    if node.quota is not None and node.quota.cpu < node.cores:
        has = f"the quota of {node.name} ({node.quota.cpu:g} of {node.cores} cores)"
    if left >= 1:
        return has
    takers = {"background": node.background > 0, "bursts": node.bursts is not None}
    return f"{has}, of which {' and '.join(filter(takers.get, takers))} leave {left:.0%}"


def _remedy(node: Node, left: float) -> str:
    if left < 1:
        return "place less there"
    if node.quota is not None and node.quota.cpu < node.cores:
        return f"place less there, or raise nodes.{node.name}.quota.cpu"
    return "place less there, or give the node more cores"


def _on_cpu(problem: Problem, node: Node, placement: Placement) -> list[tuple[Task, Execution]]:
    """Return the stages that a placement has on the cores of a node."""
    tasks = [task for task in problem.pipeline.tasks.values() if placement[task.name] == node.name]
    both = [(task, task.on[node.name]) for task in tasks]
    return [(task, execution) for task, execution in both if execution.accelerator is None]


def _own_share(problem: Problem, node: Node, placement: Placement) -> float:
    """Share of a node's capacity that its own work asks for."""
    work_ms = 0.0
    for task, execution in _on_cpu(problem, node, placement):
        work_ms += mean_ms(problem.pipeline, task, execution) * execution.threads
    return work_ms / (problem.pipeline.period_ms * node.capacity)


def _left_share(problem: Problem, node: Node, placement: Placement) -> float:
    """Share of a node's capacity that background and bursts leave to its own work at most."""
    left, bursts = 1 - node.background / node.capacity, node.bursts
    if bursts is None or bursts.threads == 0:
        return left
    # All that its workers can have running beside the bursts; others than `fair` give all cores.
    threads = float(node.cores)
    if node.scheduler == "fair":
        on_cpu = _on_cpu(problem, node, placement)
        threads = sum(execution.threads * execution.workers for _, execution in on_cpu)
    beside = min(1.0, threads / node.cores, threads / max(threads + bursts.threads, 1))
    return left * (1 - bursts.share * (1 - beside / node.interference))


def _accelerator_shares(problem: Problem, placement: Placement) -> dict[tuple[str, str], float]:
    """Share of each accelerator that own work asks for, by node and kind."""
    work_ms: dict[tuple[str, str], float] = {}
    for task in problem.pipeline.tasks.values():
        node = placement[task.name]
        execution = task.on[node]
        if execution.accelerator is not None:
            place = node, execution.accelerator
            work_ms[place] = work_ms.get(place, 0.0) + mean_ms(problem.pipeline, task, execution)
    period_ms, nodes = problem.pipeline.period_ms, problem.fabric.nodes
    return {
        (node, kind): work / (period_ms * nodes[node].accelerators[kind])
        for (node, kind), work in work_ms.items()
    }


def _slow_stages(problem: Problem) -> Iterator[Fault]:
    """Yield stages that take longer for a job than their workers have."""
    pipeline, nodes = problem.pipeline, problem.fabric.nodes
    for candidate, placement in problem.candidates.items():
        for task in pipeline.tasks.values():
            node, execution = nodes[placement[task.name]], task.on[placement[task.name]]
            if _own_share(problem, node, placement) > 1:
                continue
            job_ms = mean_ms(pipeline, task, execution)
            if execution.accelerator is None:
                cpu = node.cores if node.quota is None else min(node.cores, node.quota.cpu)
                job_ms *= max(1.0, execution.threads / cpu)
            if job_ms > execution.workers * pipeline.period_ms:
                yield Fault(
                    f"candidates.{candidate}",
                    f"{task.name} takes {job_ms:.4g} ms a job on {node.name}, a job comes every "
                    f"{pipeline.period_ms:.4g} ms, and workers are {execution.workers}: it can "
                    f"never keep pace; raise tasks.{task.name}.on.{node.name}.workers",
                )


def _starved_stages(problem: Problem) -> Iterator[Fault]:
    """Yield stages that those of a higher priority leave no core to."""
    pipeline, nodes = problem.pipeline, problem.fabric.nodes
    for candidate, placement in problem.candidates.items():
        for node in (one for one in nodes.values() if one.scheduler == "priority"):
            tasks = [task for task, _ in _on_cpu(problem, node, placement)]
            for task in tasks:
                above = [other for other in tasks if other.priority > task.priority]
                held = 0.0
                for other in above:
                    execution = other.on[node.name]
                    threads = min(execution.threads, node.cores)
                    job_ms = mean_ms(pipeline, other, execution) * execution.threads / threads
                    busy = min(job_ms / pipeline.period_ms, execution.workers)
                    held += busy * threads / node.cores
                if held >= 1:
                    names = ", ".join(other.name for other in above)
                    yield Fault(
                        f"candidates.{candidate}",
                        f"{task.name} is never done: {names} of a higher priority take all of "
                        f"{node.name}; place less there, or change tasks.{task.name}.priority",
                    )


def _full_links(problem: Problem) -> Iterator[Fault]:
    """Yield candidates that send more over a link than it carries, repetitions included."""
    pipeline, links = problem.pipeline, problem.fabric.links
    for candidate, placement in problem.candidates.items():
        sent_bytes = dict.fromkeys(links, 0.0)
        for flow in pipeline.flows:
            name = f"{placement[flow.source]}->{placement[flow.target]}"
            if name in links:
                link = links[name]
                attempts = 1 if link.retransmit_ms is None else 1 / (1 - link.loss)
                sent_bytes[name] += attempts * flow.payload_bytes
        for name, count in sent_bytes.items():
            mbps = 8e-3 * count / pipeline.period_ms
            if mbps > links[name].rate_mbps:
                yield Fault(
                    f"candidates.{candidate}",
                    f"it sends {mbps:.4g} Mbit/s over {name}, which carries "
                    f"{links[name].rate_mbps:.4g}: messages wait ever longer; send less, or "
                    "raise rate_mbps",
                )


# ------------------------------------------------------------------------------ the objective


def _same_placements(problem: Problem) -> Iterator[Fault]:
    """Yield candidates that are the placement of another one."""
    for (first, one), (second, other) in combinations(problem.candidates.items(), 2):
        if one == other:
            yield Fault(
                f"candidates.{second}",
                f"is the same placement as {first}; drop one of them, or place a task elsewhere",
            )


def _over_caps(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates that are over a cap before anything disturbs them."""
    cap_ms, cap = problem.objective.caps.latency_ms, problem.objective.caps.utilisation
    for name, l95_ms in profile.uncut_l95_ms.items():
        if l95_ms > cap_ms:
            yield Fault(
                f"candidates.{name}",
                f"L95 is {milliseconds(l95_ms)} ms undisturbed, over the cap of {cap_ms:g} ms: it "
                "is never eligible while another one is",
            )
    for name, placement in problem.candidates.items():
        for (node, kind), share in _accelerator_shares(problem, placement).items():
            if cap < share <= 1:
                yield Fault(
                    f"candidates.{name}",
                    f"its own work takes {share:.0%} of {kind} of {node}, over the cap of "
                    f"{cap:.0%}: it is never eligible while another one is",
                )


def _percentages(problem: Problem) -> Iterator[Fault]:
    """Yield shares above 1, as of who means percent."""
    caps, targets = problem.objective.caps, problem.objective.targets
    shares = {
        "objective.caps.utilisation": caps.utilisation,
        **{f"objective.targets.{tier}": getattr(targets, tier) for tier in TIERS},
    }
    for path, share in shares.items():
        if share is not None and 1 < share < math.inf:
            yield Fault(
                path,
                f"{share:g} is more than all cores, which no utilisation exceeds; it is a share, "
                f"{share / 100:g} instead of {share:g}?",
            )
    for name, node in problem.fabric.nodes.items():
        if node.quota is not None and node.quota.cpu > node.cores:
            cpu = node.quota.cpu
            yield Fault(
                f"nodes.{name}.quota.cpu",
                f"{cpu:g} is more than all cores, {node.cores}: the quota never applies; it is in "
                f"cores, {cpu / 100:g} instead of {cpu:g}?",
            )


def _dominant_terms(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield a term of J that leaves nothing to the others, whichever candidate is active."""
    objective = problem.objective
    terms = {name: _terms(objective, profile, name) for name in problem.candidates}
    weights = {term: getattr(objective.weights, term) or 0.0 for term in ("latency", *_OTHERS)}
    for term, weight in weights.items():
        rest = sum(weights.values()) - weight
        shares = [of[term] / sum(of.values()) for of in terms.values() if any(of.values())]
        if rest == 0 or len(shares) < len(terms) or min(shares) <= DOMINANT:
            continue
        # Above what it is at its target in every candidate, or by its weight alone.
        if min(of[term] for of in terms.values()) > weight or weight > DOMINANT * (weight + rest):
            target = (
                "" if term == "violations" else f", or raise targets.{_TARGETS.get(term, term)}"
            )
            yield Fault(
                f"objective.weights.{term}",
                f"its term is {min(shares):.1%} of J or more in every candidate: the others hardly "
                f"count; lower it{target}",
            )


_OTHERS = ("violations", "robot", "edge", "cloud")
_TARGETS = {"latency": "latency_ms"}


def _terms(objective: Objective, profile: Profile, candidate: str) -> dict[str, float]:
    """Terms of J of a candidate as it is expected undisturbed, by their weights' names."""
    used = tier_utilisation(profile.own[candidate], objective)
    # One metric at a time, and 0 for the others.
    l95_ms, rate, robot, edge, cloud = np.diag(
        [profile.l95_ms[candidate], profile.violation_rate[candidate], *used]
    )
    terms = price(l95_ms, rate, robot, edge, cloud, 0.0, objective)
    return dict(zip(("latency", *_OTHERS), terms.tolist(), strict=True))


# ---------------------------------------------------------------------------------- the guard


def _false_alarms(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates under which the guard would fire although nothing is wrong.

    It fires when the cycle after the newest completed one is older than `guard_cycles` periods,
    under a fallback, too, unless it has moved the cell there just now.
    """
    settings = problem.controller
    if not settings.fallbacks:
        return
    bound_ms = (settings.guard_cycles - 1) * problem.pipeline.period_ms
    for name, l95_ms in profile.l95_ms.items():
        needed_ms = l95_ms + _return_ms(problem, name)
        elsewhere = any(fallback != name for fallback in settings.fallbacks)
        if elsewhere and needed_ms > bound_ms:
            yield Fault(
                "controller.guard_cycles",
                f"{settings.guard_cycles} is tight for {name}: L95 and the way back to the source "
                f"take {needed_ms:.1f} ms of (guard_cycles - 1) periods = {bound_ms:.1f} ms, so "
                "that the guard fires without a fault; raise it",
            )


def _return_ms(problem: Problem, candidate: str) -> float:
    """Longest mean delay from a sink's node back to a source's, where there is a link."""
    pipeline, placement = problem.pipeline, problem.candidates[candidate]
    sources = [placement[task] for task in pipeline.tasks if not pipeline.inputs(task)]
    sinks = [placement[task] for task in pipeline.tasks if not pipeline.outputs(task)]
    names = [f"{sink}->{source}" for sink in sinks for source in sources]
    links = problem.fabric.links
    return max((links[name].delay_ms.expectation for name in names if name in links), default=0.0)


def _helpless_fallbacks(problem: Problem) -> Iterator[Fault]:
    """Yield nodes off the robots that every fallback needs, though the cell might do without."""
    fallbacks = problem.controller.fallbacks
    if not fallbacks:
        return
    anchors = {next(iter(task.on)) for task in problem.pipeline.tasks.values() if task.anchored}
    needed = [set(problem.candidates[name].values()) for name in fallbacks]
    for name in set.intersection(*needed) - anchors - set(problem.fabric.tier("robot")):
        others = [c for c, placed in problem.candidates.items() if name not in placed.values()]
        remedy = f"add {others[0]}" if others else "declare a candidate without it, and add that"
        yield Fault(
            "controller.fallbacks",
            f"there is no fallback without {name}: the guard cannot help when {name} dies; "
            f"{remedy}",
        )


# ------------------------------------------------------------------------------- time and loop


def _late_releases(problem: Problem) -> Iterator[Fault]:
    """Yield a jitter of releases that exceeds the period: many then fall on the same instant."""
    jitter, period_ms = problem.pipeline.release_jitter_ms, problem.pipeline.period_ms
    rng = np.random.default_rng(1)
    draws = jitter.values if isinstance(jitter, Trace) else jitter.marginal(rng, DRAWS)
    p99_ms = float(np.quantile(draws, 0.99))
    if p99_ms > period_ms:
        yield Fault(
            "release_jitter_ms",
            f"its 99th percentile is {p99_ms:.4g} ms, more than the period of {period_ms:.4g} ms: "
            "no cycle is released before the one ahead of it, so that releases gather behind a "
            "late one; lower it",
        )


def _unstable_loops(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates under which the servo loop swings ever farther.

    The delay of the loop is the mean latency and half a period, for which a command is held in the
    mean.
    """
    if problem.servo is None:
        return
    for name, alone in profile.prices.items():
        delay_s = (alone.latency_ms + problem.pipeline.period_ms / 2) / 1e3
        most_s = longest_delay_s(problem.servo)
        if delay_s > most_s:
            yield Fault(
                "servo.gain",
                f"under {name} the loop is not stable: its delay, the mean latency and half a "
                f"period, is {delay_s * 1e3:.4g} ms, and may be {most_s * 1e3:.4g} at most with "
                f"gain {problem.servo.gain:g}; lower it, or drop the candidate",
            )


def longest_delay_s(servo: Servo) -> float:
    """Delay from which on a servo loop is not stable, seconds.

    The phase margin of K / s, or of (K + B s) / s², over the frequency at which the gain is 1.
    """
    gain, damping = servo.gain, servo.damping
    if servo.plant == "integrator":
        return math.pi / 2 / gain
    square = damping * damping
    omega = math.sqrt((square + math.hypot(square, 2 * gain)) / 2)
    return math.atan2(damping * omega, gain) / omega


# -------------------------------------------------------------------------------- disturbances


def _without_effect(problem: Problem) -> Iterator[Fault]:
    """Yield disturbances and bursts that change nothing."""
    for name, items in problem.scenarios.items():
        for index, item in enumerate(items):
            if not _does_something(problem, item):
                keys = "stress_threads or down"
                if not isinstance(item, NodeDisturbance):
                    keys = "add_delay_ms, loss, a rate_mbps below the link's, or down"
                yield Fault(
                    f"scenarios.{name}[{index}]",
                    f"does nothing to {item.place}; give it {keys}, or remove it",
                )
    for name, node in problem.fabric.nodes.items():
        if node.bursts is not None and node.bursts.threads == 0:
            yield Fault(f"nodes.{name}.bursts", "do nothing; give them threads, or remove them")
    for index, link in enumerate(problem.fabric.links.values()):
        if link.bursts is not None and link.bursts.add_delay_ms.expectation == 0:
            yield Fault(
                f"links[{index}].bursts", "do nothing; give them add_delay_ms, or remove them"
            )


def _does_something(problem: Problem, item: Disturbance) -> bool:
    """Whether a disturbance changes anything while it is on."""
    if item.down:
        return True
    if isinstance(item, NodeDisturbance):
        return item.stress_threads > 0
    delays = item.add_delay_ms is not None and item.add_delay_ms.expectation > 0
    slows = item.rate_mbps < problem.fabric.links[item.link].rate_mbps
    return delays or slows or item.loss > 0
