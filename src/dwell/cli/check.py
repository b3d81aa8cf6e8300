"""`dwell check`: every fault of a cell, or what it amounts to before anything is run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

import dwell
from dwell.cli.exit_codes import ExitCode
from dwell.cli.options import CellArgument, Insecure, Json, Keys, Traces
from dwell.cli.output import aligned, print_json
from dwell.display import milliseconds
from dwell.errors import Fault, PolicyError, ProblemError
from dwell.model.bounds import counted

if TYPE_CHECKING:
    from dwell.estimators import Profile
    from dwell.model import Node, Problem

#: Draws of a process that a percentile is taken of, and their seed.
DRAWS, SEED = 10_000, 1


def check(
    cell: CellArgument,
    traces: Traces = None,
    node: Annotated[
        str | None,
        typer.Option(
            help="Check instead that this computer can be that node of the live cell: import and "
            "make its stages and actuators."
        ),
    ] = None,
    keys: Keys = None,
    insecure: Insecure = False,
    as_json: Json = False,
) -> None:
    """Find every fault in a cell, or say what it amounts to.

    Faults go to stderr, one a line as file:line: path: message, and the exit code is 2. Warnings
    go there too, but do not change it.
    """
    try:
        problem = dwell.load(cell, traces=traces)
    except ProblemError as error:
        _refuse(error.faults, str(error), as_json=as_json)
    if node is not None:
        from dwell.cli.check_node import check_node

        if not check_node(problem, cell, node, keys, insecure=insecure, as_json=as_json):
            raise typer.Exit(ExitCode.WRONG)
        return
    if faults := tuple(_class_faults(problem)):
        _refuse(faults, "\n".join(f"{cell}: {fault}" for fault in faults), as_json=as_json)
    from dwell.estimators import Profile

    profile = Profile(problem)
    warnings = tuple(_warnings(problem, profile))
    if as_json:
        rows = [_fault(warning) for warning in warnings]
        print_json({"valid": True, **_contents(problem, profile), "warnings": rows})
    else:
        typer.echo(_summary(problem, profile))
        for warning in warnings:
            typer.echo(f"{cell}: warning: {warning}", err=True)


def _refuse(faults: Iterable[Fault], text: str, *, as_json: bool) -> NoReturn:
    """Print the faults of a cell, and exit."""
    if as_json:
        rows = [_fault(fault) | {"line": fault.line} for fault in faults]
        print_json({"valid": False, "faults": rows})
    else:
        typer.echo(text, err=True)
    raise typer.Exit(ExitCode.WRONG)


def _class_faults(problem: Problem) -> Iterator[Fault]:
    """Yield the faults of the policy and the estimator where these are a user's classes."""
    from dwell.estimators import by_name as make_estimator
    from dwell.model.user_classes import is_class_path
    from dwell.policies import by_name as make_policy

    settings = problem.controller
    try:
        if is_class_path(settings.policy) and settings.policy not in problem.candidates:
            make_policy(settings.policy, problem)
    except PolicyError as error:
        yield Fault("controller.policy", str(error))
    try:
        if is_class_path(settings.estimator):
            make_estimator(settings.estimator, problem)
    except ProblemError as error:
        yield Fault("controller.estimator", str(error))


def _warnings(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield what is allowed in a cell but seldom meant."""
    from dwell.live.lint import lint

    yield from _overloads(problem, profile)
    yield from _slow_stages(problem, profile)
    yield from _full_links(problem)
    yield from _over_caps(problem, profile)
    yield from _false_alarms(problem, profile)
    yield from _late_releases(problem)
    yield from lint(problem)


def _overloads(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates whose own work is more than a node can do."""
    for name, shares in profile.own.items():
        for node, share in shares.items():
            if share > 1:
                limit, remedy = _limit(problem.fabric.nodes[node])
                yield Fault(
                    f"candidates.{name}",
                    f"its own work takes {share:.0%} of {limit} of {node}: it can never keep pace; "
                    f"place less there, or {remedy}",
                )


def _limit(node: Node) -> tuple[str, str]:
    """Return what bounds the work of a node, and how it could do more."""
    quota = node.quota
    if quota is None or quota.cpu >= node.cores:
        return "the cores", "give the node more cores"
    return f"the quota (cpu {quota.cpu:g})", f"raise nodes.{node.name}.quota.cpu"


def _slow_stages(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield stages that take longer for a job than their workers have."""
    from dwell.estimators.profile import mean_ms

    pipeline, nodes = problem.pipeline, problem.fabric.nodes
    for candidate, placement in problem.candidates.items():
        for task in pipeline.tasks.values():
            node, execution = nodes[placement[task.name]], task.on[placement[task.name]]
            if profile.own[candidate][node.name] > 1:
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


def _over_caps(problem: Problem, profile: Profile) -> Iterator[Fault]:
    """Yield candidates that are over the latency cap before anything disturbs them."""
    cap_ms = problem.objective.caps.latency_ms
    for name, l95_ms in profile.uncut_l95_ms.items():
        if l95_ms > cap_ms:
            yield Fault(
                f"candidates.{name}",
                f"L95 is {milliseconds(l95_ms)} ms undisturbed, over the cap of {cap_ms:g} ms: it "
                "is never eligible while another one is",
            )


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
                f"take {milliseconds(needed_ms)} ms of (guard_cycles - 1) periods = "
                f"{milliseconds(bound_ms)} ms, so that the guard fires without a fault; raise it",
            )


def _late_releases(problem: Problem) -> Iterator[Fault]:
    """Yield a jitter of releases that exceeds the period: many then fall on the same instant."""
    import numpy as np

    from dwell.model import Trace

    jitter, period_ms = problem.pipeline.release_jitter_ms, problem.pipeline.period_ms
    rng = np.random.default_rng(SEED)
    draws = jitter.values if isinstance(jitter, Trace) else jitter.marginal(rng, DRAWS)
    p99_ms = float(np.quantile(draws, 0.99))
    if p99_ms > period_ms:
        yield Fault(
            "release_jitter_ms",
            f"its 99th percentile is {p99_ms:.4g} ms, more than the period of {period_ms:.4g} ms: "
            "no cycle is released before the one ahead of it, so that releases gather behind a "
            "late one; lower it",
        )


def _return_ms(problem: Problem, candidate: str) -> float:
    """Longest mean delay from a sink's node back to a source's, where there is a link."""
    pipeline, placement = problem.pipeline, problem.candidates[candidate]
    sources = [placement[task] for task in pipeline.tasks if not pipeline.inputs(task)]
    sinks = [placement[task] for task in pipeline.tasks if not pipeline.outputs(task)]
    names = [f"{sink}->{source}" for sink in sinks for source in sources]
    links = problem.fabric.links
    return max((links[name].delay_ms.expectation for name in names if name in links), default=0.0)


def _fault(fault: Fault) -> dict[str, Any]:
    return {"path": fault.path, "message": fault.message}


def _contents(problem: Problem, profile: Profile) -> dict[str, Any]:
    """Return the contents of the cell as plain values."""
    pipeline = problem.pipeline
    return {
        "name": problem.name,
        "period_ms": pipeline.period_ms,
        "deadline_ms": pipeline.deadline_ms,
        "window_cycles": problem.window_cycles,
        "tasks": {name: list(task.on) for name, task in pipeline.tasks.items()},
        "nodes": {name: node.tier for name, node in problem.fabric.nodes.items()},
        "links": list(problem.fabric.links),
        "scenarios": list(problem.scenarios),
        "candidates": {
            name: {
                "placement": dict(placement),
                "l95_ms": profile.uncut_l95_ms[name],
                "violation_rate": profile.violation_rate[name],
                "own_work": dict(profile.own[name]),
            }
            for name, placement in problem.candidates.items()
        },
    }


def _summary(problem: Problem, profile: Profile) -> str:
    pipeline, nodes = problem.pipeline, problem.fabric.nodes
    movable = [
        f"{name} ({', '.join(task.on)})"
        for name, task in pipeline.tasks.items()
        if not task.anchored
    ]
    head = ["candidate", "L95 (ms)", "V_D (%)", *(f"{node} (%)" for node in nodes)]
    rows = [
        [
            name,
            milliseconds(profile.uncut_l95_ms[name]),
            f"{profile.violation_rate[name] * 100:.1f}",
            *(f"{profile.own[name][node] * 100:.0f}" for node in nodes),
        ]
        for name in problem.candidates
    ]
    return "\n".join(
        (
            f"{problem.name}: no faults",
            f"{counted(len(pipeline.tasks), 'task')}, {counted(len(nodes), 'node')}, "
            f"{counted(len(problem.fabric.links), 'link')}; "
            f"P {pipeline.period_ms:.4g} ms, D {pipeline.deadline_ms:.4g} ms, "
            f"W {counted(problem.window_cycles, 'cycle')}",
            f"can move: {', '.join(movable) or 'nothing'}",
            f"scenarios: {', '.join(problem.scenarios)}",
            "",
            "Undisturbed, without queues: L95, V_D, and the cell's own work on each node",
            aligned(head, rows),
        )
    )
