"""A small live run, made of its tables: no process runs."""

from __future__ import annotations

from typing import Any

import polars as pl

from dwell import Run
from dwell.model.document import to_document
from tests.cells.small import make_problem

PERIOD_NS = 33_000_000
#: Of 6 windows of 10 cycles, with two lead cycles before the fourth, and what moved it.
PLACED = ("LOC", "LOC", "SO", "LOC", "LOC", "LOC")


#: Busy threads on the edge, about the third window.
PLAYED = [{"node": "E", "stress_threads": 2, "at_s": 0.66, "for_s": 0.36}]
#: What an arm has measured of its error.
TRACKING = {
    "begin_s": 0.0,
    "step_s": 0.33,
    "rms_mm": [None, 3.0, 4.0, 1.0, 1.0, 1.0],
    "rms_px": [None, 6.0, 8.0, 2.0, 2.0, 2.0],
}


def live_run(**meta: Any) -> Run:
    """Return a run: a migration after the second window, a guard's move before the fourth."""
    rows: list[tuple[int, int, str, int, bool]] = []
    for window, placement in enumerate(PLACED):
        lead = [True, True] if window == 3 else []
        for is_lead in [*lead, *([False] * 10)]:
            cycle = len(rows)
            rows.append((cycle, cycle * PERIOD_NS, placement, window, is_lead))
    lost = {32}
    cycles = pl.DataFrame(
        {
            "cycle": [row[0] for row in rows],
            "release_ns": [row[1] for row in rows],
            "placement": pl.Series([row[2] for row in rows], dtype=pl.Enum(["LOC", "SO", "HYB"])),
            "latency_ns": [None if row[0] in lost else 20_000_000 for row in rows],
            "missed": [row[0] in lost for row in rows],
            "outcome": ["dropped" if row[0] in lost else "done" for row in rows],
            "compute_ns": [None if row[0] in lost else 15_000_000 for row in rows],
            "queue_ns": [None if row[0] in lost else 1_000_000 for row in rows],
            "network_ns": [None if row[0] in lost else 4_000_000 for row in rows],
            "lead": [row[4] for row in rows],
            "heard": [row[0] != 32 for row in rows],
            "actuated": [row[0] not in (32, 33) for row in rows],
        }
    )
    first = [next(r[0] for r in rows if r[3] == w and not r[4]) for w in range(len(PLACED))]
    count = len(PLACED)
    windows = pl.DataFrame(
        {
            "window": list(range(count)),
            "first_cycle": first,
            "warmup": [True, *[False] * (count - 1)],
            "placement": pl.Series(list(PLACED), dtype=pl.Enum(["LOC", "SO", "HYB"])),
            "mixed": [False] * count,
            "l95_ms": [20.0] * count,
            "violation_rate": [0.0, 0.0, 0.0, 0.1, 0.0, 0.0],
            "seen_l95_ms": [20.0] * count,
            "seen_violation_rate": [0.0] * count,
            "u_R1": [0.5] * count,
            "u_E": [0.3] * count,
            "u_R2": [0.5] * count,
            "cost": [1.0] * count,
            "lead": [0, 0, 0, 2, 0, 0],
            "heard": [10, 10, 10, 9, 10, 10],
            "bound_ms": [1.25, 1.5, 1.0, None, 1.0, 1.0],
            "unproven": [False, False, False, True, False, False],
        }
    )
    decided = [
        (0, 9, "LOC", "LOC", False, "hold", 1.0, 1.2),
        (1, 19, "LOC", "SO", True, "migrate", 1.3, 1.1),
        (3, 31, "SO", "LOC", True, "guard", None, None),
        (3, 41, "LOC", "LOC", False, "hold", 1.0, 1.2),
    ]
    names = (
        *("window", "last_cycle", "incumbent", "placement", "migrated", "reason"),
        *("j_LOC", "j_SO"),
    )
    decisions = pl.DataFrame(
        {name: [row[i] for row in decided] for i, name in enumerate(names)}
    ).with_columns(j_HYB=pl.lit(1.5))
    told = {
        "kind": "live",
        "scenario": "live",
        "policy": "DTP(initial='LOC')",
        "estimator": "Corrected",
        "problem": to_document(make_problem()),
        "versions": {},
        "recovered": {"sealed": True, "opened": 1, "torn_bytes": 0, "damaged_bytes": 0},
    }
    return Run({**told, **meta}, {"cycles": cycles, "windows": windows, "decisions": decisions})
