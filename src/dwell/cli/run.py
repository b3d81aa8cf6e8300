"""`dwell run`: one policy on one realisation, saved and summed up."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import dwell
from dwell.cli.options import (
    CellArgument,
    Estimator,
    Json,
    Policy,
    Scenario,
    Seconds,
    Seed,
    Traces,
    Windows,
    flag,
    option,
    require_one_length,
    windows_of,
)
from dwell.cli.output import file_name, print_json, warn, working
from dwell.display import milliseconds
from dwell.errors import ExitCode, RunError
from dwell.model.bounds import counted
from dwell.record.json_documents import read_document

if TYPE_CHECKING:
    from dwell.model import Problem
    from dwell.study.summary import Row

#: Bytes of a run's default name at most; file systems take 255.
LONGEST_NAME = 200


def run(
    cell: CellArgument,
    scenario: Scenario = "baseline",
    policy: Policy = None,
    estimator: Estimator = None,
    seed: Seed = 1,
    windows: Windows = None,
    seconds: Seconds = None,
    out: Annotated[
        Path | None,
        option(
            "FOLDER",
            "Where to save the run; runs/CELL-SCENARIO-POLICY-SEED, and what --set says, if "
            "not given.",
        ),
    ] = None,
    traces: Traces = None,
    settings: Annotated[
        list[str] | None,
        option(
            "PATH=VALUE",
            "Another value of the cell, as period_ms=40 or links[0].delay_ms=5; YAML. May be "
            "repeated.",
            "--set",
        ),
    ] = None,
    jobs: Annotated[bool, flag("--jobs", "Keep every job's instants.")] = False,
    guard: Annotated[
        bool, flag("--guard", "Let the robots' guard move to a fallback by itself.")
    ] = False,
    force: Annotated[bool, flag("--force", "Replace another run in the folder.")] = False,
    as_json: Json = False,
) -> None:
    """Simulate a policy on a scenario, save the run, sum it up.

    300 windows, if neither --windows nor --seconds is given.
    """
    from dwell.cellfile.overrides import load_with

    require_one_length(windows, seconds)
    problem = load_with(cell, settings, traces) if settings else dwell.load(cell, traces=traces)
    if seconds is not None:
        windows = windows_of(seconds, problem)
    windows = windows or 300
    from dwell.estimators import unplayed
    from dwell.record import require_free
    from dwell.sim import describe
    from dwell.study.summary import summarise

    policy = policy or problem.controller.policy
    folder = out or default_folder(problem.name, scenario, policy, str(seed), *(settings or ()))
    require_free(folder)
    arguments: dict[str, Any] = {
        "scenario": scenario,
        "policy": policy,
        "estimator": estimator,
        "seed": seed,
        "windows": windows,
        "guard": guard,
    }
    if not force:
        _require_same(folder, describe(problem, **arguments))
    warn(cell, unplayed(problem, scenario, windows))
    with working(f"simulating {counted(windows, 'window')}"):
        realisation = dwell.draw(problem, scenario=scenario, seed=seed, windows=windows)
        result = dwell.simulate_realisation(
            problem, realisation, policy=policy, estimator=estimator, jobs=jobs, guard=guard
        )
        try:
            result.save(folder)
        except RunError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(ExitCode.FAILED) from None
    labels: dict[str, str | int] = {"scenario": scenario, "policy": policy, "seed": seed}
    measured = None
    if not result.windows["warmup"].all():
        measured = summarise(result, problem, labels).row
    if as_json:
        head: dict[str, Any] = {"cell": problem.name, **labels, "run": folder}
        starts = [start._asdict() for start in realisation.trace_starts]
        print_json({**head, "traces": starts, "summary": measured})
    else:
        typer.echo(_summary(problem, labels, windows, measured))
        typer.echo(f"\nsaved to {folder}")


def default_folder(*parts: str) -> Path:
    """Return where a run is saved: its parts are told by their digest where they are long."""
    name = file_name("-".join(parts), more="+=")
    if len(name.encode()) > LONGEST_NAME:
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]
        name = f"{name.encode()[: LONGEST_NAME - 13].decode(errors='ignore')}-{digest}"
    return Path("runs", name)


def _require_same(folder: Path, settings: Mapping[str, Any]) -> None:
    """Raise a RunError where a folder holds another run: other than this one made again."""
    if not (folder / "run.json").is_file():
        return
    # Of whatever version; that of the software makes no other run.
    kept = read_document(folder / "run.json")
    if {**kept, "versions": None} != {**json.loads(json.dumps(settings)), "versions": None}:
        raise RunError(
            f"{folder} holds another run; choose another folder, or say --force to replace it"
        )


def _summary(
    problem: Problem, labels: Mapping[str, str | int], windows: int, row: Row | None
) -> str:
    warmup = problem.warmup_windows
    title = (
        f"{problem.name}, {labels['scenario']}, {labels['policy']}, seed {labels['seed']}: "
        f"{counted(windows, 'window')} of {counted(problem.window_cycles, 'cycle')}"
    )
    if row is None:
        return f"{title}, none after the {warmup} of warm-up: nothing to sum up; ask for more"
    shares = {name: float(row[f"share_{name}"]) for name in problem.candidates}
    used = (f"{name} {row[f'node_{name}']:.0%}" for name in problem.fabric.resources)
    unfinished = f"{row['in_flight']} of {row['cycles']}"
    lines = (
        ("missed deadlines (V_D)", f"{float(row['violation_rate']) * 100:.2f} %"),
        ("L95, mean of windows", f"{milliseconds(float(str(row['l95_ms'])), 2)} ms"),
        ("median latency", _latency(row["p50_ms"])),
        ("95th percentile of all cycles", _latency(row["p95_ms"])),
        ("cost J, mean of windows", f"{row['cost']:.3f}"),
        ("cycles lost", f"{row['lost']} of {row['cycles']}"),
        *([("unfinished at the end", unfinished)] if row["in_flight"] else []),
        ("longest run of misses", f"{row['longest_misses']}"),
        *_control(row),
        ("migrations", f"{row['migrations']}"),
        *([("moves of the guard", f"{row['guard_moves']}")] if row["guard_moves"] else []),
        (
            "windows by placement",
            ", ".join(f"{name} {share:.0%}" for name, share in shares.items() if share),
        ),
        ("utilisation", ", ".join(used)),
    )
    width = max(len(name) for name, _ in lines)
    left_out = f", the first {warmup} (warm-up) left out below" if warmup else ""
    body = "\n".join(f"{name.ljust(width)}  {value}" for name, value in lines)
    return f"{title}{left_out}\n\n{body}"


def _latency(value: object) -> str:
    """``12.34 ms``; infinite where too many cycles never finished."""
    latency_ms = float(str(value))
    return (
        f"{milliseconds(latency_ms, 2)} ms"
        if math.isfinite(latency_ms)
        else "∞: too many never finished"
    )


def _control(row: Row) -> Iterator[tuple[str, str]]:
    """Yield what the actuator got: misses in any K cycles, ages, and how the servo tracked."""
    from dwell.study.summary import STRETCHES

    most = ", ".join(f"{row[f'misses_in_{stretch}']} in {stretch}" for stretch in STRETCHES)
    yield "most misses", f"{most} consecutive cycles"
    ages = (milliseconds(float(str(row[f"aoi_{name}_ms"])), 2) for name in ("mean", "p95", "peak"))
    yield "age at the actuator", "mean {}, p95 {}, peak {} ms".format(*ages)
    if "tracking_rms_mm" in row:
        rms, iae = row["tracking_rms_mm"], row["tracking_iae_mm"]
        yield "tracking error", f"RMS {rms:.2f} mm, mean absolute (IAE / time) {iae:.2f} mm"
