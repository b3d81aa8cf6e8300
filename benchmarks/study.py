"""A study of hours: draw, play, sum up and write, on two cores; the workers start cold."""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT, run_module

# A worker of the study imports this module: what it does not need is imported where it is used.
if TYPE_CHECKING:
    from dwell.study import Study

STUDY = ROOT / "benchmarks" / "study.yaml"
CORES = 2
QUICK = 4
START = Goal(high=1.3)


def measure(quick: bool) -> Section:
    """Seconds of a study of 4 scenarios, 6 policies and 30 seeds of one hour."""
    arguments = [str(QUICK)] if quick else []
    said = [
        json.loads(run_module("benchmarks.study", *arguments)[0]) for _ in range(1 if quick else 2)
    ]
    cycles = said[0]["cycles"]
    goal = None if quick else Goal(high=60)
    figures = [
        Figure("elapsed", [one["wall_s"] for one in said], "s", goal),
        Figure("  CPU time a core", [one["cpu_s"] / CORES for one in said], "s", goal),
        Figure("  cycles a second, elapsed", [cycles / one["wall_s"] for one in said], "cycles/s"),
        Figure(
            "  cycles a second of CPU time, both cores",
            [CORES * cycles / one["cpu_s"] for one in said],
            "cycles/s",
        ),
        Figure("  of the CPU time: the process that asks", [one["own_s"] for one in said], "s"),
        Figure("again, with all parts there", [one["again_s"] for one in said], "s"),
        Figure(
            "a cycle, one process, CPU time",
            [one["cycle_ns"] for one in said],
            "ns",
            None if quick else Goal(high=500),
        ),
        Figure("  of it summaries", [100 * one["summed_up"] for one in said], "%"),
        Figure("start of a worker, CPU time", [one["start_s"] for one in said], "s", START),
    ]
    share = sum(one["cpu_s"] for one in said) / sum(one["wall_s"] for one in said) / CORES
    busy = "" if share > 0.9 else ": others used them, or they waited"
    notes = [
        f"{cycles / 1e6:.1f} million cycles in {said[0]['runs']} runs, each summed up",
        f"{share:.0%} of the elapsed time of {CORES} cores was CPU time{busy}",
        "processes and imports included",
    ]
    return Section(f"Study of one hour, {CORES} processes", figures, notes)


def _run_alone(seeds: int | None) -> None:
    from dwell.study import load_study, run_study

    if hasattr(os, "sched_setaffinity"):
        # The parent is pinned to one core.
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    study = load_study(STUDY)
    if seeds is not None:
        study = replace(study, seeds=study.seeds[:seeds])
    with tempfile.TemporaryDirectory() as folder:
        before, begin = _spent(), time.perf_counter()
        result = run_study(study, folder=Path(folder) / "study", processes=CORES)
        middle, spent = time.perf_counter(), _spent()
        run_study(study, folder=Path(folder) / "study", processes=CORES)
        end = time.perf_counter()
    own, children = (after - was for after, was in zip(spent, before, strict=True))
    cycle_ns, summed_up = _in_one_process(study)
    print(
        json.dumps(
            {
                "cycles": study.cycles,
                "runs": result.runs.height,
                "wall_s": middle - begin,
                "cpu_s": own + children,
                "own_s": own,
                "again_s": end - middle,
                "cycle_ns": cycle_ns,
                "summed_up": summed_up,
                "start_s": _start_s(study),
            }
        )
    )


def _in_one_process(study: Study) -> tuple[float, float]:
    """CPU time a cycle of the first seed's runs, ns, and the summaries' share of it."""
    import dwell
    from dwell.study.summary import summarise

    problem = study.points[0].problem
    begin, summed_s = time.process_time(), 0.0
    for scenario in study.scenarios:
        realisation = dwell.draw(
            problem, scenario=scenario, seed=study.seeds[0], windows=study.windows
        )
        for policy in study.policies:
            run = dwell.simulate_realisation(problem, realisation, policy=policy)
            played = time.process_time()
            summarise(run, problem, {})
            summed_s += time.process_time() - played
    took_s = time.process_time() - begin
    return took_s * 1e9 * len(study.seeds) / study.cycles, summed_s / took_s


def _start_s(study: Study) -> float:
    """CPU time of a worker that has next to nothing to do."""
    from dwell.study import run_study

    tiny = replace(study, windows=20, seeds=study.seeds[:1])
    _, before = _spent()
    run_study(tiny, processes=CORES)
    return (_spent()[1] - before) / CORES


def _spent() -> tuple[float, float]:
    """CPU time of this process, and of those it started and that have ended."""
    both = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    own, children = (resource.getrusage(who) for who in both)
    return own.ru_utime + own.ru_stime, children.ru_utime + children.ru_stime


if __name__ == "__main__":
    _run_alone(int(sys.argv[1]) if len(sys.argv) > 1 else None)
