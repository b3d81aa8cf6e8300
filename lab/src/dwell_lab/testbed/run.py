"""One run on a testbed: checks, creates, runs, records and removes everything."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.estimators import registry as estimators
from dwell.live.host.hosting import clock_of
from dwell.live.local.playing import (
    Played,
    begun,
    interruptible,
    longest_run,
    make_folder,
    play_on,
    require_run,
)
from dwell.live.local.testbed import MARK, STARTING
from dwell.live.local.timeline import timeline_of
from dwell.model import Problem
from dwell.policies.registry import by_name, estimator_of
from dwell.record import Run, moves, open_run
from dwell_lab.testbed.doctor import examine
from dwell_lab.testbed.netns_testbed import NetnsTestbed
from dwell_lab.testbed.pressure import Rule, Span, judged
from dwell_lab.testbed.sampling import Sampler

#: Limits that decide which windows are excluded, and which runs have failed.
RULE = Rule()
#: Time for a controller's last window, beyond its grace.
LAST_S = 0.5


def length_s(problem: Problem, windows: int) -> float:
    """Return the duration of a run with some windows, including the warm-up, in seconds.

    Every migration delays the next window: a run with migrations has fewer windows.
    """
    cycles_ms = problem.cycles_of(windows) * problem.pipeline.period_ms
    return (cycles_ms + problem.controller.close_grace_ms) / 1e3 + LAST_S


def require_machine(problem: Problem) -> None:
    """Raise a LiveError if this machine cannot run a cell; it lists all causes and remedies."""
    missing = [one for one in examine([problem]) if one.needed and not one.ok]
    if missing:
        reasons = "; ".join(f"{one.name}: {one.found}; {one.remedy}" for one in missing)
        raise LiveError(f"this machine cannot run the testbed: {reasons}")


def run_once(
    problem: Problem,
    *,
    scenario: str,
    policy: str | None,
    seconds: float,
    seed: int,
    out: Path,
    name: str,
    jobs: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> Path:
    """Run a cell on a new testbed, and return the folder of its run.

    On an interrupt it removes the testbed, and completes the record of the partial run.

    Parameters
    ----------
    policy : str or None
        A policy or a candidate; None: the cell's policy.
    seconds : float
        Duration from the first release, including the warm-up.
    seed : int
        Seed of the scenario's realisation, and of delays and losses.
    out : Path
        Folder for states, logs and the run; the folder of an earlier run is replaced.
    name : str
        Name of the testbed, unique on this machine.
    jobs : bool
        Whether the run records its jobs.
    tell : callable
        Receives progress as lines of text.

    Returns
    -------
    Path
        Folder of the run. If the machine was the bottleneck, ``pressure`` of its metadata contains
        ``failed``.

    Raises
    ------
    DwellError
        Before any change, if the cell, the scenario or the policy cannot run here; later, if the
        cell does not start, or has written no run.
    """
    if policy is not None:
        problem = problem.under(policy)
    estimator = estimator_of(problem)
    by_name(problem.controller.policy, estimators.resolved(problem, estimator))
    timeline = timeline_of(problem, scenario, seed=seed, seconds=seconds, outages=True)
    arguments = ["--jobs"] if jobs else []
    testbed = NetnsTestbed(problem, out, name=name, seed=seed, more=arguments)
    require_machine(problem)
    estimators.by_name(estimator, problem)
    played = Played(problem, scenario, seed, timeline)
    samplers: list[Sampler] = []
    try:
        with interruptible():
            try:
                # Claim first: a running testbed may use the folder that `make_folder` replaces.
                testbed.claim()
                make_folder(out, MARK, "a testbed's")
                tell("starting the cell")
                testbed.start()
                tell(f"playing {scenario} for {seconds:g} s")
                _play(testbed, seconds, played, samplers)
            finally:
                testbed.stop()
    except KeyboardInterrupt:
        # Without a sampler the run has not begun; the folder may contain an old run.
        folder = longest_run(out / "runs") if samplers else None
        if folder is not None:
            _seal(folder, testbed, played, samplers, interrupted=True)
            tell(f"interrupted; run: {folder}")
        raise
    folder = require_run(out)
    _seal(folder, testbed, played, samplers, interrupted=False)
    shutil.rmtree(out / STARTING, ignore_errors=True)
    return folder


def _play(
    testbed: NetnsTestbed,
    seconds: float,
    played: Played,
    samplers: list[Sampler],
) -> None:
    clock = clock_of(played.problem)
    links = {"-".join(link.nodes): link for link in testbed.links.values()}
    with Sampler(
        testbed.cpus, testbed.used_ns, testbed.switches, links, clock, RULE, testbed.probing
    ) as sampler:
        samplers.append(sampler)
        play_on(testbed, played, seconds)
    testbed.processes.stop_controller()


def _seal(
    folder: Path,
    testbed: NetnsTestbed,
    played: Played,
    samplers: Sequence[Sampler],
    *,
    interrupted: bool,
) -> None:
    """Add the disturbances, the testbed and the machine's pressure to the record of a run."""
    more: dict[str, Any] = {"testbed": testbed.facts()}
    if interrupted:
        more["interrupted"] = True
    if samplers:
        sampler = samplers[0]
        spans = spans_of(open_run(folder), played)
        pressure = judged(sampler.samples, spans, RULE)
        more["pressure"] = {**pressure, "trouble": sampler.trouble} if sampler.trouble else pressure
        more["links"], more["wakes_hz"] = sampler.links(), sampler.wakes_hz
    played.note(folder, **more)


def spans_of(run: Run, played: Played) -> list[Span]:
    """Return the time spans of a run's windows, with the nodes that were stressed throughout."""
    span = begun(run)
    if span is None:
        return []
    origin_ns, _ = span
    problem = played.problem
    period_ns = problem.pipeline.period_ns
    release_ns = run.cycles["release_ns"].to_list()
    first = run.cycles["cycle"][0]
    spans = []
    for window in run.windows.select("window", "first_cycle", "warmup").iter_rows(named=True):
        row = window["first_cycle"] - first
        last = min(row + problem.window_cycles, len(release_ns)) - 1
        begin_ns = origin_ns + release_ns[row]
        end_ns = origin_ns + release_ns[last] + period_ns
        stressed = _stressed(played, begin_ns, end_ns)
        spans.append(Span(window["window"], begin_ns, end_ns, window["warmup"], stressed))
    return spans


def _stressed(played: Played, begin_ns: int, end_ns: int) -> dict[str, float]:
    """Return the capacity of nodes that always had at least one stress thread per core."""
    return {
        name: node.capacity
        for name, node in played.problem.fabric.nodes.items()
        if played.least_threads(name, begin_ns, end_ns) >= node.cores
    }


def summary(run: Run) -> dict[str, Any]:
    """Return summary numbers of a run after its warm-up."""
    windows = run.windows.filter(~run.windows["warmup"])
    pressure = run.meta.get("pressure") or {}
    excluded = set(pressure.get("excluded", ()))
    kept = windows.filter(~windows["window"].is_in(sorted(excluded)))
    means = kept.mean().row(0, named=True)
    return {
        "windows": windows.height,
        "excluded": len(excluded),
        "l95_ms": means["l95_ms"],
        "violation_rate": means["violation_rate"],
        "utilisation": {
            name: means[f"u_{name}"]
            for name, one in run.problem.fabric.resources.items()
            if not one.kind or means.get(f"u_{name}") is not None
        },
        "migrations": sum(not move.by_guard for move in moves(run)),
    }
