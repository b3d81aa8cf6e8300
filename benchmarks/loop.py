"""Chain and canonical cell over the C++ loop of the peers: CPU time of both, fresh processes.

`learning` is of DTP with `corrected`, undisturbed and in each scenario, with decisions every window
and every quarter of one. The loop is the same in all: the cell's disturbances are not in it.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT, Took, compile_cpp_loop, in_turns, ratios, run_module, run_timed

CHAIN, CANONICAL = "benchmarks/peer-chain.yaml", "examples/canonical.yaml"
PROFILE = Goal(low=0.33)
#: What is played: cell, policy with its estimator, cycles, and which share of the loop's speed.
WORK = {
    "chain": (CHAIN, "ONE", 1_000_000, Goal(low=0.65)),
    "DTP": (CANONICAL, "dtp+profile", 300_000, PROFILE),
    "CUSUM": (CANONICAL, "cusum+profile", 300_000, PROFILE),
    "ATP": (CANONICAL, "atp+profile", 300_000, PROFILE),
    "latency-first": (CANONICAL, "latency-first+profile", 300_000, PROFILE),
    "DTP, corrected": (CANONICAL, "dtp+corrected", 60_000, Goal(low=0.05)),
}
#: Scenarios of `learning`, with the share of the loop's speed at decisions every window.
SCENARIOS = {
    "baseline": Goal(low=0.05),
    "robot-cpu-stress": Goal(low=0.02),
    "edge-cpu-stress": Goal(low=0.02),
    "network-impairment": Goal(low=0.02),
    "network-impairment-mild": Goal(low=0.02),
}
#: Decisions a window, and cycles that are played.
DECISIONS, LEARNING_CYCLES = (1, 4), 30_000
LOOP_CYCLES = 1_000_000


def measure(quick: bool) -> Section:
    """Cycles a second of CPU time over those of the loop."""
    title = "Draw, simulate, windows and decisions, over a C++ loop"
    if shutil.which("g++") is None:
        return Section(title, (), ["skipped: no g++ here"])
    with tempfile.TemporaryDirectory() as folder:
        program = compile_cpp_loop(Path(folder))
        variants: dict[str, Callable[[], Took]] = {name: partial(_ours, name) for name in WORK}
        variants["C++ loop"] = lambda: run_timed([program, str(LOOP_CYCLES)])[1]
        runs = in_turns(variants, 3 if quick else 5)
    loop = [1e9 * run.cpu_s / LOOP_CYCLES for run in runs["C++ loop"]]
    figures = [Figure("C++ loop", loop, "ns/cycle")]
    for name, (_, _, cycles, goal) in WORK.items():
        spent = [1e9 * run.cpu_s / cycles for run in runs[name]]
        figures.append(Figure(name, spent, "ns/cycle"))
        figures.append(Figure(f"{name}, over the loop", ratios(loop, spent), "times", goal))
    notes = [
        "CPU time of a process each; the loop's whole process, ours after a run of 20 windows",
    ]
    return Section(title, figures, notes)


def learning(quick: bool) -> Section:
    """Nanoseconds a cycle of DTP with `corrected`, and cycles a second over those of the loop."""
    title = "DTP with corrected, over a C++ loop"
    if shutil.which("g++") is None:
        return Section(title, (), ["skipped: no g++ here"])
    cycles = LEARNING_CYCLES // 3 if quick else LEARNING_CYCLES
    with tempfile.TemporaryDirectory() as folder:
        program = compile_cpp_loop(Path(folder))
        asked = [(scenario, every) for scenario in SCENARIOS for every in DECISIONS]
        variants: dict[tuple[str, int], Callable[[], Took]] = {
            one: partial(_learning, *one, cycles) for one in asked
        }
        variants["loop", 0] = lambda: run_timed([program, str(LOOP_CYCLES)])[1]
        runs = in_turns(variants, 3 if quick else 5)
    loop = [1e9 * run.cpu_s / LOOP_CYCLES for run in runs["loop", 0]]
    figures = [Figure("C++ loop", loop, "ns/cycle")]
    for scenario, decisions in asked:
        name = f"{scenario}, {decisions} decisions a window"
        spent = [1e9 * run.cpu_s / cycles for run in runs[scenario, decisions]]
        goal = SCENARIOS[scenario] if decisions == 1 else None
        figures.append(Figure(name, spent, "ns/cycle"))
        figures.append(Figure(f"{name}, over the loop", ratios(loop, spent), "times", goal))
    notes = ["CPU time of a process each; ours after a run of 20 windows"]
    return Section(title, figures, notes)


def _ours(name: str) -> Took:
    return Took(**json.loads(run_module("benchmarks.loop", name)[0]))


def _learning(scenario: str, decisions: int, cycles: int) -> Took:
    asked = scenario, str(decisions), str(cycles)
    return Took(**json.loads(run_module("benchmarks.loop", *asked)[0]))


def _run_alone(name: str, decisions: int = 1, cycles: int = 0) -> None:
    import dwell
    from benchmarks.canonical import simulate_in_parts

    cell, policy, most, _ = WORK.get(name, WORK["DTP, corrected"])
    scenario, problem = name if name in SCENARIOS else "baseline", dwell.load(ROOT / cell)
    if decisions > 1:
        every = problem.window_cycles // decisions
        controller = replace(problem.controller, decide_cycles=every, min_dwell=0)
        problem = replace(problem, controller=controller)

    def play(seed: int, windows: int) -> Took:
        laps = simulate_in_parts(problem, scenario, policy=policy, seed=seed, windows=windows)
        return sum(laps, start=Took(0.0, 0.0))

    play(1, 20)
    print(json.dumps(asdict(play(2, (cycles or most) // problem.window_cycles))))


if __name__ == "__main__":
    _run_alone(sys.argv[1], *map(int, sys.argv[2:]))
