"""`dwell run`: one policy on one realisation, saved and summed up."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

import dwell
from dwell.cli.output import print_json, working
from dwell.errors import RunError
from dwell.model import Problem
from dwell.record import require_free
from dwell.sim import describe
from dwell.study.summary import STRETCHES, Row, summarise


def run_cell(
    problem: Problem,
    *,
    scenario: str,
    policy: str | None,
    estimator: str | None,
    seed: int,
    windows: int,
    out: Path | None,
    jobs: bool,
    guard: bool,
    force: bool,
    how: str | None,
    as_json: bool,
) -> bool:
    """Simulate, save and print; None is what the cell says, or the default folder.

    Parameters
    ----------
    how : str or None
        How it is played, where that is worth a word (see `dwell.cli.first_answer`).

    Returns
    -------
    bool
        Whether the run could be saved.

    Raises
    ------
    DwellError
        If anything named is unknown, or the folder holds something else than a run.
    """
    policy = policy or problem.controller.policy
    folder = out or _folder(problem, scenario, policy, seed)
    require_free(folder)
    asked: dict[str, Any] = {
        "scenario": scenario,
        "policy": policy,
        "estimator": estimator,
        "seed": seed,
        "windows": windows,
        "guard": guard,
    }
    if not force:
        _require_same(folder, describe(problem, **asked))
    said = f" ({how})" if how else ""
    with working(f"simulating {windows} windows{said}"):
        result = dwell.simulate(problem, **asked, jobs=jobs)
        try:
            result.save(folder)
        except RunError as error:
            typer.echo(f"error: {error}", err=True)
            return False
    labels: dict[str, str | int] = {"scenario": scenario, "policy": policy, "seed": seed}
    measured = None
    if not result.windows["warmup"].all():
        measured = summarise(result, problem, labels).row
    if as_json:
        head: dict[str, Any] = {"cell": problem.name, **labels, "run": folder}
        print_json({**head, "summary": measured})
    else:
        typer.echo(_summary(problem, labels, windows, measured))
        typer.echo(f"\nsaved to {folder}")
    return True


def _require_same(folder: Path, asked: Mapping[str, Any]) -> None:
    """Raise a RunError where a folder holds another run: other than this one made again."""
    if not (folder / "run.json").is_file():
        return
    kept = dwell.open_run(folder).meta
    # Versions of software make no other run.
    if {**kept, "versions": None} != {**json.loads(json.dumps(asked)), "versions": None}:
        raise RunError(
            f"{folder} holds another run; choose another folder, or say --force to replace it"
        )


def _folder(problem: Problem, scenario: str, policy: str, seed: int) -> Path:
    """Return the folder of a run that names none; a name may hold what a file name may not."""
    name = f"{problem.name}-{scenario}-{policy}-{seed}"
    return Path("runs", re.sub(r"[^\w.+-]", "_", name))


def _summary(
    problem: Problem, labels: Mapping[str, str | int], windows: int, row: Row | None
) -> str:
    warmup = problem.warmup_windows
    title = (
        f"{problem.name}, {labels['scenario']}, {labels['policy']}, seed {labels['seed']}: "
        f"{windows} windows of {problem.window_cycles} cycles"
    )
    if row is None:
        return f"{title}, none after the {warmup} of warm-up: nothing to sum up; ask for more"
    shares = (f"{name} {row[f'share_{name}']:.0%}" for name in problem.candidates)
    used = (f"{node} {row[f'node_{node}']:.0%}" for node in problem.fabric.nodes)
    lines = (
        ("missed deadlines (V_D)", f"{float(row['violation_rate']) * 100:.2f} %"),
        ("L95, mean of windows", f"{row['l95_ms']:.2f} ms"),
        ("median latency", _latency(row["p50_ms"])),
        ("95th percentile of all cycles", _latency(row["p95_ms"])),
        ("cost J, mean of windows", f"{row['cost']:.3f}"),
        ("cycles lost", f"{row['lost']} of {row['cycles']}"),
        *_unfinished(row),
        ("longest run of misses", f"{row['longest_misses']}"),
        *_control(row),
        ("migrations", f"{row['migrations']}"),
        *([("moves of the guard", f"{row['guard_moves']}")] if row["guard_moves"] else []),
        ("windows by placement", ", ".join(shares)),
        ("utilisation", ", ".join(used)),
    )
    width = max(len(name) for name, _ in lines)
    left_out = f", the first {warmup} (warm-up) left out below" if warmup else ""
    body = "\n".join(f"{name.ljust(width)}  {value}" for name, value in lines)
    return f"{title}{left_out}\n\n{body}"


def _latency(value: object) -> str:
    """``12.34 ms``; infinite where too many cycles never finished."""
    latency_ms = float(str(value))
    return f"{latency_ms:.2f} ms" if math.isfinite(latency_ms) else "∞: too many never finished"


def _unfinished(row: Row) -> Iterator[tuple[str, str]]:
    """Yield how many cycles were still on their way when the run ended, where any were."""
    if row["in_flight"]:
        yield "unfinished at the end", f"{row['in_flight']} of {row['cycles']}"


def _control(row: Row) -> Iterator[tuple[str, str]]:
    """Yield what the actuator got: misses in any K cycles, ages, and how the servo tracked."""
    most = ", ".join(f"{row[f'misses_in_{stretch}']} in {stretch}" for stretch in STRETCHES)
    yield "most misses", f"{most} consecutive cycles"
    ages = (row[f"aoi_{name}_ms"] for name in ("mean", "p95", "peak"))
    yield "age at the actuator", "mean {:.2f}, p95 {:.2f}, peak {:.2f} ms".format(*ages)
    if "tracking_rms_mm" in row:
        rms, iae = row["tracking_rms_mm"], row["tracking_iae_mm"]
        yield "tracking error", f"RMS {rms:.2f} mm, mean absolute (IAE / time) {iae:.2f} mm"
