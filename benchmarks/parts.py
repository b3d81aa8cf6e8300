"""Parts of a study of many tiny runs: what they take on the disk, to write and to read back.

Real runs of one policy and six windows are played and written. The others are copies of them with
further seeds, so that the study is large and the simulation short.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT, run_module

if TYPE_CHECKING:
    from dwell.study import Study

RUNS, QUICK, PLAYED = 100_000, 4_000, 2_000


def measure(quick: bool) -> Section:
    """Disk, time and memory of the parts of 10^5 runs."""
    runs = QUICK if quick else RUNS
    with tempfile.TemporaryDirectory() as folder:
        written = json.loads(run_module("benchmarks.parts", "write", str(runs), folder)[0])
        read = json.loads(run_module("benchmarks.parts", "read", str(runs), folder)[0])
        opened = json.loads(run_module("benchmarks.parts", "open", str(runs), folder)[0])
    goal = None if quick else Goal
    figures = [
        Figure("writing a run, with its row", [written["write_ms"]], "ms", Goal(high=1)),
        Figure("  simulating it", [written["play_ms"]], "ms"),
        Figure("on the disk, tables included", [read["mb"]], "MB", goal and goal(high=100)),
        Figure("parts to tables, CPU time", [read["cpu_s"]], "s", goal and goal(high=10)),
        Figure("  peak memory of the process", [read["peak_gb"]], "GB", goal and goal(high=1)),
        Figure("open the tables, CPU time", [opened["cpu_s"]], "s"),
        Figure("  peak memory of the process", [opened["peak_gb"]], "GB"),
    ]
    notes = [f"{written['parts']} parts", "imports are not in the CPU time"]
    return Section(f"Parts of {runs} runs of 6 windows, one policy", figures, notes)


def study_of(runs: int) -> Study:
    """Return a study of one policy, with as many seeds as runs."""
    import dwell
    from dwell.study import Contender, Point, Study

    problem = dwell.load(ROOT / "examples" / "canonical.yaml")
    small = replace(problem, window_cycles=20, warmup_windows=1)
    return Study(
        name="tiny",
        points=(Point({}, small),),
        scenarios=("baseline",),
        contenders=(Contender("LOC", "LOC"),),
        seeds=tuple(range(1, runs + 1)),
        windows=6,
    )


def write(runs: int, folder: Path) -> dict[str, float]:
    """Play some runs, and write as many parts as all have."""
    from dwell.study.parts import write_parts
    from dwell.study.player import Batch, PlayedBatch, Player
    from dwell.study.runner import open_parts

    study = study_of(runs)
    player, played = Player(study), list[PlayedBatch]()
    player.rehearse()
    begin = time.process_time()
    with open_parts(study, folder) as parts:
        batches = parts.missing(2)
        for batch in batches:
            left: Batch | None = batch
            while left is not None and len(played) * len(batch.items) < PLAYED:
                played.append(player(left))
                left = played[-1].rest
        play_s, begin = time.process_time() - begin, time.process_time()
        summaries = [pair for one in played for pair in one.summaries["LOC"]]
        for batch in batches:
            mine = [
                (0, replace(one, row={**one.row, "seed": item.seed}))
                for item, (_, one) in zip(batch.items, summaries, strict=False)
            ]
            write_parts(folder, parts.digests, PlayedBatch(batch, None, {"LOC": mine}, {}))
        write_s = time.process_time() - begin
    count = len(list((folder / "parts").iterdir()))
    each = {"play_ms": play_s * 1e3 / len(summaries), "write_ms": write_s * 1e3 / runs}
    return {**each, "parts": count}


def read(runs: int, folder: Path) -> dict[str, float]:
    """Make the tables of all parts, as the last step of a study does."""
    from dwell.study import run_study

    study = study_of(runs)
    begin = time.process_time()
    result = run_study(study, folder=folder, processes=1)
    cpu_s = time.process_time() - begin
    assert result.runs.height == runs
    taken = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return {"mb": taken / 1e6, "cpu_s": cpu_s, "peak_gb": _peak_gb()}


def reopen(runs: int, folder: Path) -> dict[str, float]:
    """Open the tables."""
    from dwell.study import open_study

    begin = time.process_time()
    assert open_study(folder).runs.height == runs
    return {"cpu_s": time.process_time() - begin, "peak_gb": _peak_gb()}


def _peak_gb() -> float:
    """Peak memory of this process; Linux counts in units of 1024 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    step = {"write": write, "read": read, "open": reopen}[sys.argv[1]]
    print(json.dumps(step(int(sys.argv[2]), Path(sys.argv[3]) / "study")))
