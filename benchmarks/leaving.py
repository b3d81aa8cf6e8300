"""How soon the live example leaves a link that is impaired: fresh runs, one fault each.

The link between the robots is slowed at a random instant of a window. Cycles are counted from the
first one that the fault delays to the first one that is released on another placement.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from random import Random
from typing import Any

import polars as pl
import yaml

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT
from dwell.model.document import to_document

EXAMPLE = ROOT / "examples" / "live" / "cell.yaml"
#: When the link is slowed at the earliest, and how long a run observes it.
SETTLED_S, OBSERVED_S = 7.0, 5.0
#: Where no cycle was placed elsewhere within the run.
NEVER = float("inf")


def measure(quick: bool) -> Section:
    """Impair the link in fresh runs that decide once and four times per window, in turns."""
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    draw, times = Random(1), 3 if quick else 20
    document: dict[str, Any] = to_document(dwell.load(EXAMPLE))
    window: int = document["window_cycles"]
    found: dict[int, list[float]] = {window: [], window // 4: []}
    for _ in range(times):
        at_s = SETTLED_S + draw.random() * window * document["period_ms"] / 1e3
        for every, cycles in found.items():
            cycles.append(_cycles_until_it_left(document, every, at_s))
    figures = [
        Figure(
            f"every {every} cycles: from the first delayed cycle to the first elsewhere",
            cycles,
            "cycles",
            Goal(high=15) if every < window else None,
        )
        for every, cycles in found.items()
    ]
    notes = [f"{times} runs each; windows of {window} cycles of {document['period_ms']} ms"]
    return Section("A live cell leaves a slow link", figures, notes)


def _cycles_until_it_left(document: dict[str, Any], every: int, at_s: float) -> float:
    """Play one run; returns the cycles, infinite where it did not leave."""
    slow = {"at_s": at_s, "link": "R1->R2", "both_ways": True, "add_delay_ms": 60}
    settings = {"decide_cycles": every, "min_dwell": 0, "policy": "dtp", "estimator": "corrected"}
    changed = {
        **document,
        "scenarios": {"slow": [slow]},
        "controller": {**document["controller"], **settings},
    }
    changed["live"] = {name: of for name, of in document["live"].items() if name != "hosts"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(changed, sort_keys=False), encoding="utf-8")
        words = ["live", "run", str(path), "--seconds", str(at_s + OBSERVED_S), "--json"]
        words += ["--out", str(Path(folder) / "out")]
        before = os.environ.get("PYTHONPATH", "")
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(EXAMPLE.parent), before])}
        told = subprocess.run(
            [sys.executable, "-m", "dwell", *words],
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        )
        return _counted(dwell.open_run(json.loads(told.stdout)["run"]), round(at_s * 1e9))


def _counted(run: dwell.Run, at_ns: int) -> float:
    deadline_ns = dwell.load(EXAMPLE).pipeline.deadline_ns
    # Of a cycle that was replaced or lost no latency is known.
    late = pl.col("latency_ns").fill_null(deadline_ns + 1) > deadline_ns
    after = run.cycles.filter(pl.col("release_ns") > at_ns - deadline_ns)
    delayed = after.filter(late)["number"].min()
    left = after.filter(pl.col("placement").cast(pl.String) != "LOC")["number"].min()
    if not isinstance(delayed, int) or not isinstance(left, int):
        return NEVER
    return left - delayed
