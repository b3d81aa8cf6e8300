"""Warnings about settings of a cell that are valid but seldom intended.

`warnings_of` checks a cell; `unplayed` and `unpriced` check a scenario against the length of a run
and of the simulations for prices. Each warning names the setting and a remedy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from dwell.cost import price, tier_utilisation
from dwell.display import milliseconds
from dwell.errors import Fault
from dwell.estimators.paths import longest_path, steps_of
from dwell.estimators.profile import Profile, mean_ms
from dwell.estimators.slow_processes import processes_of
from dwell.model.fabric import Link, Node
from dwell.model.objective import TIERS, Objective
from dwell.model.pipeline import Execution, Flow, Task
from dwell.model.placement import Copy
from dwell.model.problem import Problem
from dwell.model.process import Process, Trace
from dwell.model.scenario import LinkDisturbance, NodeDisturbance, acts
from dwell.model.servo import Servo

#: Samples of a process for a percentile or a smallest value.
DRAWS = 10_000
#: Share of an accelerator above which its jobs often wait for each other.
NEARLY_FULL = 0.9
#: Share of J above which a term makes all others negligible.
DOMINANT = 0.95
#: Rate above which a file probably gives bits per second, Mbit/s.
FASTEST_MBPS = 1e6
#: Longest step of a trace's time, in median steps, and its longest span, in periods.
LONGEST_STEP, LONGEST_SPAN = 1_000, 1_000_000


def warnings_of(problem: Problem) -> Iterator[Fault]:
    """Yield a warning for each setting of a cell that is valid but seldom intended."""
    profile = Profile(problem)
    for name, placement in problem.candidates.items():
        over = _over_caps(problem, placement.first, profile.uncut_l95_ms[name])
        members = placement.copies if placement.second is None else ()
        messages = chain(
            *(_overloads(problem, copy) for copy in members),
            *(_slow_stages(problem, copy) for copy in members),
            *(_full_links(problem, copy) for copy in members),
            over,
        )
        yield from (Fault(f"candidates.{name}", message) for message in messages)
    yield from _unused_priorities(problem)
    yield from _fast_links(problem)
    yield from _same_placements(problem)
    yield from _percentages(problem)
    yield from _dominant_terms(problem, profile)
    yield from _false_alarms(problem, profile)
    yield from _helpless_fallbacks(problem)
    yield from _late_releases(problem)
    yield from _odd_traces(problem)
    yield from _stale_commands(problem)
    yield from _short_dwell(problem)
    yield from _rare_sinks(problem)
    yield from _late_offsets(problem)
    yield from _unstable_loops(problem, profile)
    yield from _without_effect(problem)


def unplayed(problem: Problem, scenario: str, windows: int) -> Iterator[Fault]:
    """Yield a warning if no disturbance of a scenario affects the counted windows of a run."""
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
    """Yield a warning if the simulations for prices are too short for a scenario."""
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


def _overloads(problem: Problem, placement: Copy) -> Iterator[str]:
    """Yield nodes that own work overloads, and accelerators that it nearly fills."""
    for name, share in _own_shares(problem, placement).items():
        resource = problem.fabric.resources[name]
        node, kind = problem.fabric.nodes[resource.node], resource.kind
        left = _left_share(problem, node, placement)
        if kind and share > NEARLY_FULL:
            what = "it can never keep pace" if share > 1 else "its jobs wait for each other"
            yield (
                f"its own work takes {share:.0%} of {kind} of {node.name}: {what}; place less "
                f"there, or raise {resource.path}"
            )
        elif not kind and share > left:
            limit, remedy = _limit_and_remedy(node, left)
            yield (
                f"its own work takes {share:.0%} of {limit}: it can never keep pace; place less "
                f"there{remedy}"
            )
        elif not kind and node.scheduler != "fair":
            yield from _wide_jobs(problem, placement, node, left)


def _limit_and_remedy(node: Node, left: float) -> tuple[str, str]:
    """Return the limit of the own work on a node and the remedy, as parts of a message."""
    limit, remedy = f"the cores of {node.name}", ", or give the node more cores"
    if node.quota is not None and node.quota.cpu < node.cores:
        limit = f"the quota of {node.name} ({node.quota.cpu:g} of {node.cores} cores)"
        remedy = f", or raise nodes.{node.name}.quota.cpu"
    if left >= 1:
        return limit, remedy
    takers = {"background": node.background > 0, "bursts": node.bursts is not None}
    return f"{limit}, of which {' and '.join(filter(takers.get, takers))} leave {left:.0%}", ""


def _on_cpu(problem: Problem, node: Node, placement: Copy) -> list[tuple[Task, Execution]]:
    """Return the tasks that a placement has on the cores of a node."""
    tasks = [task for task in problem.pipeline.tasks.values() if placement[task.name] == node.name]
    both = [(task, task.on[node.name]) for task in tasks]
    return [(task, execution) for task, execution in both if execution.accelerator is None]


def _own_shares(problem: Problem, placement: Copy) -> dict[str, float]:
    """Return the share of each resource's capacity that own work needs."""
    work_ms, rates = dict.fromkeys(problem.fabric.resources, 0.0), problem.pipeline.rates
    for task in problem.pipeline.tasks.values():
        execution = task.on[placement[task.name]]
        threads = execution.threads if execution.accelerator is None else 1
        job_ms = mean_ms(problem.pipeline, task, execution) * threads
        work_ms[_resource(task, placement)] += job_ms / rates[task.name]
    period_ms = problem.pipeline.period_ms
    return {
        name: work_ms[name] / (period_ms * resource.capacity)
        for name, resource in problem.fabric.resources.items()
    }


def _left_share(problem: Problem, node: Node, placement: Copy) -> float:
    """Return the largest share of a node's capacity that background and bursts leave free."""
    left, bursts = 1 - node.background / node.capacity, node.bursts
    if bursts is None or bursts.threads == 0:
        return left
    # Most threads of own jobs at once; without `fair` own jobs may have all cores.
    threads = float(node.cores)
    if node.scheduler == "fair":
        on_cpu = _on_cpu(problem, node, placement)
        threads = sum(execution.threads * execution.workers for _, execution in on_cpu)
    beside = min(1.0, threads / node.cores, threads / max(threads + bursts.threads, 1))
    return left * (1 - bursts.share * (1 - beside / node.interference))


def _slow_stages(problem: Problem, placement: Copy) -> Iterator[str]:
    """Yield tasks with too few workers for the time of their jobs."""
    shares, rates = _own_shares(problem, placement), problem.pipeline.rates
    for task in problem.pipeline.tasks.values():
        period_ms = problem.pipeline.period_ms * rates[task.name]
        node = problem.fabric.nodes[placement[task.name]]
        execution = task.on[node.name]
        job_ms = mean_ms(problem.pipeline, task, execution)
        if execution.accelerator is None:
            job_ms *= max(1.0, execution.threads / node.capacity)
        if shares[node.name] <= 1 and job_ms > execution.workers * period_ms:
            yield (
                f"{task.name} takes {job_ms:.4g} ms a job on {node.name}, a job comes every "
                f"{period_ms:.4g} ms, and workers are {execution.workers}: it can never keep "
                f"pace; raise tasks.{task.name}.on.{node.name}.workers"
            )


class _Jobs(NamedTuple):
    """Jobs of a task: cores of each, most jobs at once, and time of each, milliseconds."""

    cores: int
    most: int
    ms: float


def _wide_jobs(problem: Problem, placement: Copy, node: Node, left: float) -> Iterator[str]:
    """Yield a warning if jobs take more than a period because they cannot all run at once."""
    period_ms, jobs, alone_ms = problem.pipeline.period_ms, {}, 0.0
    rates = problem.pipeline.rates
    for task, execution in _on_cpu(problem, node, placement):
        cores = min(execution.threads, node.cores)
        job_ms = mean_ms(problem.pipeline, task, execution) * execution.threads / cores
        ms = job_ms / rates[task.name]
        jobs[task.name] = _Jobs(cores, min(execution.workers, node.cores // cores), ms)
        alone_ms = max(alone_ms, ms / execution.workers)
    # At least this share of the cycles loses no message.
    dropping = (link for _, link in _crossings(problem, placement) if link.retransmit_ms is None)
    arriving = math.prod(1 - link.loss for link in dropping)
    # Background load reduces a quota; without a quota it slows jobs down.
    speed = left if node.quota is None else 1.0
    needed_ms = _needed_ms([*jobs.values()], node.cores) * arriving / speed
    if alone_ms <= period_ms < needed_ms * (1 - 1e-9):
        held = ", ".join(f"{name}: {of.cores}" for name, of in jobs.items())
        yield (
            f"its jobs do not fit side by side on the {node.cores} cores of {node.name} ({held}) "
            f"and take at least {needed_ms:.4g} ms in every {period_ms:.4g} ms: it can never keep "
            "pace; lower their threads, or place less there"
        )


def _needed_ms(jobs: Sequence[_Jobs], cores: int) -> float:
    """Return a lower bound on the time that the jobs of a cycle take on a node without `fair`.

    Give each job a weight, equal for all jobs of a task. At any instant the running jobs hold no
    more than all cores, and at most `most` of them belong to one task. Let M be the largest sum of
    weights of such jobs. While a job runs, for its time h, it adds its weight w to a sum that never
    exceeds M. So the jobs of a cycle take at least (sum of w h) / M, in any order and with any
    preemption. If P is less, the queue grows for ever.

    Any weights give a true bound. Three are tried: the cores of a job, and 1 / the number of such
    jobs that fit on the node, with and without the limit on workers. They are tried on all tasks,
    and on each task together with the tasks that do not fit next to it. On 1,500 random nodes the
    largest bound was on average 99 % of the best possible bound, and at least 78 %.
    """
    apart = [[job for job in jobs if job is one or job.cores + one.cores > cores] for one in jobs]
    bounds = [0.0]
    for chosen in (jobs, *apart):
        # Row i: the largest sums of weights on i cores.
        largest, total = np.zeros((cores + 1, 3)), np.zeros(3)
        for job in chosen:
            weights = np.array([job.cores, 1 / job.most, 1 / (cores // job.cores)])
            total += job.ms * weights
            # Any number of jobs up to `most` is a sum of some of these counts.
            bits = job.most.bit_length() - 1
            for count in (*(1 << bit for bit in range(bits)), job.most + 1 - (1 << bits)):
                held = count * job.cores
                largest[held:] = np.maximum(largest[held:], largest[:-held] + count * weights)
        bounds += (total / largest[-1]).tolist() if chosen else []
    return max(bounds)


def _unused_priorities(problem: Problem) -> Iterator[Fault]:
    """Yield priorities without effect on all the resources that their tasks share with others."""
    tasks, nodes = problem.pipeline.tasks.values(), problem.fabric.nodes.items()
    ordered = {name for name, node in nodes if node.scheduler == "priority"}
    for task in tasks:
        shared = {
            _resource(task, placement): other.name
            for placement in _copies(problem)
            for other in tasks
            if other.priority != task.priority
            and _resource(other, placement) == _resource(task, placement)
        }
        if task.priority != 0 and shared and not ordered & shared.keys():
            resource, neighbour = next(iter(shared.items()))
            yield Fault(
                f"tasks.{task.name}.priority",
                f"has no effect on {resource}, which it shares with {neighbour}: only the CPU of a "
                "node with `scheduler: priority` regards it; set that, or remove it",
            )


def _copies(problem: Problem) -> Iterator[Copy]:
    """Yield the placements of all candidates without replicas."""
    for placement in problem.plain_candidates.values():
        yield placement.first


def _resource(task: Task, placement: Copy) -> str:
    node = placement[task.name]
    return task.on[node].resource(node)


def _crossings(problem: Problem, placement: Copy) -> Iterator[tuple[Flow, Link]]:
    """Yield the flows of a placement that cross a link, with the link."""
    for flow in problem.pipeline.flows:
        name = f"{placement[flow.source]}->{placement[flow.target]}"
        if name in problem.fabric.links:
            yield flow, problem.fabric.links[name]


def _full_links(problem: Problem, placement: Copy) -> Iterator[str]:
    """Yield links that get more data than their rate allows, including repeated messages."""
    sent_bytes = dict.fromkeys(problem.fabric.links, 0.0)
    every = problem.pipeline.message_rates
    for flow, link in _crossings(problem, placement):
        attempts = 1 if link.retransmit_ms is None else 1 / (1 - link.loss)
        sent_bytes[link.name] += attempts * flow.payload_bytes / every[flow.source, flow.target]
    for name, link in problem.fabric.links.items():
        mbps = 8e-3 * sent_bytes[name] / problem.pipeline.period_ms
        if mbps > link.rate_mbps:
            yield (
                f"it sends {mbps:.4g} Mbit/s over {name}, which carries {link.rate_mbps:.4g}: "
                "messages wait ever longer; send less, or raise rate_mbps"
            )


def _fast_links(problem: Problem) -> Iterator[Fault]:
    """Yield rates that are far above the rate of any link."""
    disturbances = chain.from_iterable(problem.parts.scenarios.values())
    for path, item in (*problem.parts.links, *disturbances):
        if isinstance(item, Link | LinkDisturbance) and FASTEST_MBPS < item.rate_mbps < math.inf:
            wrong, right = f"{item.rate_mbps:g}", f"{item.rate_mbps / 1e6:g}"
            message = f"{wrong} Mbit/s is faster than any link; {right} instead of {wrong}?"
            yield Fault(f"{path}.rate_mbps", message)


# ------------------------------------------------------------------------------ the objective


def _same_placements(problem: Problem) -> Iterator[Fault]:
    """Yield candidates with the same placement as an earlier candidate."""
    for (first, one), (second, other) in combinations(problem.candidates.items(), 2):
        if one == other:
            yield Fault(
                f"candidates.{second}",
                f"is the same placement as {first}; drop one of them, or place a task elsewhere",
            )


def _over_caps(problem: Problem, placement: Copy, l95_ms: float) -> Iterator[str]:
    """Yield the caps that a candidate exceeds without disturbances."""
    caps = problem.objective.caps
    never = "it is never eligible while another one is"
    if l95_ms > caps.latency_ms:
        shown_ms = milliseconds(l95_ms)
        yield f"L95 is {shown_ms} ms undisturbed, over the cap of {caps.latency_ms:g} ms: {never}"
    for name, share in _own_shares(problem, placement).items():
        resource = problem.fabric.resources[name]
        if resource.kind and caps.utilisation < share <= 1:
            yield (
                f"its own work takes {share:.0%} of {resource.kind} of {resource.node}, "
                f"over the cap of {caps.utilisation:.0%}: {never}"
            )


def _percentages(problem: Problem) -> Iterator[Fault]:
    """Yield shares above 1 and quotas above all cores, which may be meant as percentages."""
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
    """Yield a term of J that makes all others negligible under every candidate."""
    objective = problem.objective
    terms = {name: _terms(objective, profile, name) for name in problem.candidates}
    weights = {term: getattr(objective.weights, term) or 0.0 for term in ("latency", *_OTHERS)}
    for term, weight in weights.items():
        rest = sum(weights.values()) - weight
        shares = [of[term] / sum(of.values()) for of in terms.values() if any(of.values())]
        if rest == 0 or len(shares) < len(terms) or min(shares) <= DOMINANT:
            continue
        # The term is above its value at its target in every candidate, or its weight dominates.
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
    """Return the expected terms of J of an undisturbed candidate, by the names of weights."""
    used = tier_utilisation(profile.own[candidate], objective)
    # One metric at a time, and 0 for the others.
    l95_ms, rate, robot, edge, cloud = np.diag(
        [profile.l95_ms[candidate], profile.violation_rate[candidate], *used]
    )
    terms = price(l95_ms, rate, robot, edge, cloud, 0.0, objective)
    return dict(zip(("latency", *_OTHERS), terms.tolist(), strict=True))


# ---------------------------------------------------------------------------------- the guard


def _false_alarms(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates under which the guard would fire without a fault.

    The guard fires when the cycle after the newest completed cycle is older than its patience,
    max(D, P) + (g - 1) P. It also fires under a fallback, except just after it has moved the cell
    there. For a chain with a `max_age_ms`, it fires when the newest origin is too old; its age
    grows until the run of the last task after the oldest actuation.
    """
    settings, pipeline = problem.controller, problem.pipeline
    if not settings.fallbacks:
        return
    bound_ms = (problem.guard_patience_ns - pipeline.period_ns) / 1e6
    for name, needed_ms in _tight(problem, profile, None, pipeline.sinks, bound_ms):
        yield Fault(
            "controller.guard_cycles",
            f"{settings.guard_cycles} is tight for {name}: L95 and the way back to the source "
            f"take {needed_ms:.1f} ms, more than {bound_ms:.1f} ms, the guard's patience less "
            "one period: the guard fires without a fault; raise it",
        )
    for chain_name, (patience_ns, _) in problem.chain_patiences.items():
        one = pipeline.chains[chain_name]
        bound_ms = (patience_ns - pipeline.rates[one.target] * pipeline.period_ns) / 1e6
        for name, needed_ms in _tight(problem, profile, chain_name, [one.target], bound_ms):
            yield Fault(
                f"chains.{chain_name}.max_age_ms",
                f"{one.max_age_ms:g} is tight for {name}: L95 of the age and the way back to the "
                f"source take {needed_ms:.1f} ms, more than {bound_ms:.1f} ms, the guard's "
                f"patience less the time between two runs of {one.target}: the guard fires "
                "without a fault; raise it, or controller.guard_cycles",
            )


def _tight(
    problem: Problem, profile: Profile, latency: str | None, ends: Iterable[str], bound_ms: float
) -> Iterator[tuple[str, float]]:
    """Yield candidates whose L95 and way back take longer than the guard waits, and that time.

    `latency` is the chain whose data age counts in L95, or None for the latency of cycles.
    """
    for name, l95_ms in _l95_ms(problem, profile, latency).items():
        needed_ms = l95_ms + _return_ms(problem, name, ends)
        elsewhere = any(fallback != name for fallback in problem.controller.fallbacks)
        if elsewhere and needed_ms > bound_ms:
            yield name, needed_ms


def _l95_ms(problem: Problem, profile: Profile, latency: str | None) -> Mapping[str, float]:
    """Return L95 of each candidate undisturbed: of a chain's age, or of cycles."""
    if latency != problem.objective.latency:
        # Any chain is frequent enough for decisions once per window.
        controller = replace(problem.controller, decide_cycles=problem.window_cycles)
        objective = replace(problem.objective, latency=latency)
        profile = Profile(replace(problem, objective=objective, controller=controller))
    # The bound on an age in J may be below the guard's patience for the chain.
    return profile.l95_ms if latency is None else profile.uncut_l95_ms


def _return_ms(problem: Problem, candidate: str, ends: Iterable[str]) -> float:
    """Return the longest mean delay of the links from some tasks' nodes to a source's node, ms."""
    pipeline, placement = problem.pipeline, problem.candidates[candidate].first
    sources = [placement[task] for task in pipeline.tasks if not pipeline.inputs(task)]
    sinks = [placement[task] for task in ends]
    names = [f"{sink}->{source}" for sink in sinks for source in sources]
    links = problem.fabric.links
    return max((links[name].delay_ms.expectation for name in names if name in links), default=0.0)


def _helpless_fallbacks(problem: Problem) -> Iterator[Fault]:
    """Yield nodes outside the robots that all fallbacks use and no anchored task needs."""
    fallbacks = problem.controller.fallbacks
    if not fallbacks:
        return
    anchors = {next(iter(task.on)) for task in problem.pipeline.tasks.values() if task.anchored}
    needed = [set(problem.candidates[name].first.values()) for name in fallbacks]
    for name in set.intersection(*needed) - anchors - set(problem.fabric.tier("robot")):
        others = [
            c for c, placed in problem.plain_candidates.items() if name not in placed.values()
        ]
        remedy = f"add {others[0]}" if others else "declare a candidate without it, and add that"
        yield Fault(
            "controller.fallbacks",
            f"there is no fallback without {name}: the guard cannot help when {name} dies; "
            f"{remedy}",
        )


# ------------------------------------------------------------------------------- time and loop


def _late_releases(problem: Problem) -> Iterator[Fault]:
    """Yield a release jitter longer than the period: many releases then coincide."""
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


def _odd_traces(problem: Problem) -> Iterator[Fault]:
    """Yield timed traces with instants that are probably wrong or in another unit."""
    period_ms = problem.pipeline.period_ms
    processes = chain.from_iterable(map(partial(processes_of, problem), problem.scenarios.values()))
    traces = (process for _, process, _ in processes if isinstance(process, Trace))
    for table in {id(trace.table): trace.table for trace in traces}.values():
        if table.time_ms is None:
            continue
        # Each group begins at 0, so steps between groups are not positive.
        steps_ms = np.diff(table.time_ms)
        steps_ms = np.sort(steps_ms[steps_ms > 0])
        usual_ms, longest_ms = steps_ms[[(len(steps_ms) - 1) // 2, -1]] if len(steps_ms) else (0, 0)
        span_ms = table.time_ms.max()
        if longest_ms > LONGEST_STEP * usual_ms:
            odd = f"lasts {longest_ms / 1e3:.4g} s, the median row {usual_ms / 1e3:.4g} s"
            yield Fault(table.file, f"one row {odd}; correct its instant")
        elif span_ms > LONGEST_SPAN * period_ms:
            odd = f"{span_ms / 1e3:.4g} s, more than {LONGEST_SPAN:g} periods"
            yield Fault(table.file, f"its rows last {odd}; convert its instants to ms")


def _short_dwell(problem: Problem) -> Iterator[Fault]:
    """Yield a dwell time shorter than the time between two decisions."""
    cycles, every = problem.controller.min_dwell_cycles, problem.decide_cycles
    if 0 < cycles < every:
        yield Fault(
            "controller.min_dwell_cycles",
            f"{cycles} is less than decide_cycles = {every} and counts as {every}, because a move "
            "is decided every decide_cycles only; raise it, lower decide_cycles, or remove it",
        )


def _rare_sinks(problem: Problem) -> Iterator[Fault]:
    """Yield a time between decisions in which the slowest sink may not run."""
    interval, every = problem.pipeline.sink_cycles, problem.decide_cycles
    if every < interval:
        yield Fault(
            "controller.decide_cycles",
            f"{every} is less than the {interval} cycles from one run of the slowest sink to its "
            f"next, so that some decisions see no latency; raise it to {interval}, or remove it",
        )


def _late_offsets(problem: Problem) -> Iterator[Fault]:
    """Yield offsets beyond the deadline of tasks on the way to a sink."""
    pipeline = problem.pipeline
    for name, sinks in pipeline.sink_rates.items():
        offset_ms = pipeline.tasks[name].offset_ms
        if sinks and offset_ms > pipeline.deadline_ms:
            yield Fault(
                f"tasks.{name}.offset_ms",
                f"{offset_ms:g} ms is beyond deadline_ms = {pipeline.deadline_ms:g}: each cycle "
                "with a run of this task misses; lower it, or raise the deadline",
            )


def _stale_commands(problem: Problem) -> Iterator[Fault]:
    """Yield candidates whose latency always exceeds the largest age of commands."""
    pipeline, age_ms = problem.pipeline, problem.live.max_age_ms
    if age_ms is None:
        return
    for candidate, placement in ((c, p.first) for c, p in problem.plain_candidates.items()):
        links = dict(_crossings(problem, placement))
        sent_ms = [
            _shortest(links[flow].delay_ms) if flow in links else 0.0 for flow in pipeline.flows
        ]
        job_ms = []
        for name, task in pipeline.tasks.items():
            scale = 1.0 if task.scale is None else _shortest(pipeline.scales[task.scale])
            job_ms.append(np.array(scale * _shortest(task.on[placement[name]].exec_ms)))
        shortest_ms = float(longest_path(steps_of(pipeline), job_ms, sent_ms))
        if age_ms < shortest_ms:
            yield Fault(
                "live.max_age_ms",
                f"{age_ms:g} is less than the shortest latency of {candidate}, {shortest_ms:.4g} "
                "ms: each of its commands is too old to be applied; raise it",
            )


def _shortest(process: Process) -> float:
    """Return the smallest of `DRAWS` samples of a process."""
    return float(process.marginal(np.random.default_rng(1), DRAWS).min())


def _unstable_loops(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates under which the servo loop is unstable.

    The delay of the loop is the mean latency plus half the time between two commands, the average
    time since a command.
    """
    if problem.servo is None:
        return
    apart_ms = problem.pipeline.due_interval * problem.pipeline.period_ms
    for name, alone in profile.prices.items():
        delay_s = (alone.latency_ms + apart_ms / 2) / 1e3
        most_s = longest_delay_s(problem.servo)
        if delay_s > most_s:
            yield Fault(
                "servo.gain",
                f"under {name} the loop is not stable: its delay, the mean latency and half of "
                f"the {apart_ms:g} ms between commands, is {delay_s * 1e3:.4g} ms, and may be "
                f"{most_s * 1e3:.4g} at most with gain {problem.servo.gain:g}; lower it, or drop "
                "the candidate",
            )


def longest_delay_s(servo: Servo) -> float:
    """Return the delay above which a servo loop is unstable, seconds.

    It is the phase margin of K / s, or of (K + B s) / s², divided by the frequency at which the
    gain is 1.
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
            if not acts(item, problem.fabric):
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
