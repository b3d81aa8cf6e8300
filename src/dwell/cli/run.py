"""`dwell run`: one policy on one realisation, saved and summed up."""

from __future__ import annotations

import hashlib
import json
import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict
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
            "Folder for the run.",
            default="runs/CELL-SCENARIO-POLICY-SEED, with the values of --set",
        ),
    ] = None,
    traces: Traces = None,
    settings: Annotated[
        list[str] | None,
        option(
            "PATH=VALUE",
            "Change a value of the cell, such as period_ms=40 or links[0].delay_ms=5 (YAML); may "
            "be repeated.",
            "--set",
        ),
    ] = None,
    jobs: Annotated[bool, flag("--jobs", "Keep the times of every job.")] = False,
    guard: Annotated[
        bool, flag("--guard", "Let the robots' guard move the cell to a fallback.")
    ] = False,
    force: Annotated[bool, flag("--force", "Replace another run in the folder.")] = False,
    as_json: Json = False,
) -> None:
    """Simulate one policy in one scenario, and save the run.

    The run has 300 windows without --windows and --seconds.
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
    from dwell.study.other_placements import PLACEMENTS, other_placements
    from dwell.study.summary import summarise
    from dwell.study.verdict import verdict_of

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
        counts = not result.windows["warmup"].all()
        placements = other_placements(problem, realisation) if counts else {}
        result = result.with_facts(**{PLACEMENTS: placements})
        try:
            result.save(folder)
        except RunError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(ExitCode.FAILED) from None
    labels: dict[str, str | int] = {"scenario": scenario, "policy": policy, "seed": seed}
    measured, verdict = None, None
    if counts:
        measured = summarise(result, problem, labels).row
        verdict = verdict_of(result, problem, float(measured["violation_rate"]))
    if as_json:
        head: dict[str, Any] = {"cell": problem.name, **labels, "run": folder}
        starts = [start._asdict() for start in realisation.trace_starts]
        answer = {"verdict": verdict and asdict(verdict), PLACEMENTS: placements}
        print_json({**head, "traces": starts, "summary": measured, **answer})
        return
    typer.echo(_title(problem, labels, windows, counts))
    if measured is not None:
        typer.echo(f"\n{verdict}\n{_never_moving(placements, problem)}\n")
        typer.echo(_numbers(problem, measured))
    where = shlex.quote(str(folder))
    typer.echo(f"\nsaved; to see it: dwell report {where}, or dwell dash {where}")


def default_folder(*parts: str) -> Path:
    """Return the folder for a run; a digest shortens a long name."""
    name = file_name("-".join(parts), more="+=")
    if len(name.encode()) > LONGEST_NAME:
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]
        name = f"{name.encode()[: LONGEST_NAME - 13].decode(errors='ignore')}-{digest}"
    return Path("runs", name)


def _require_same(folder: Path, settings: Mapping[str, Any]) -> None:
    """Raise a RunError if a folder holds a run with other settings."""
    if not (folder / "run.json").is_file():
        return
    from dwell.study.other_placements import PLACEMENTS

    # Versions and results of other placements are no settings.
    beside = {"versions": None, PLACEMENTS: None}
    kept = read_document(folder / "run.json")
    if {**kept, **beside} != {**json.loads(json.dumps(settings)), **beside}:
        raise RunError(
            f"{folder} holds another run; choose another folder, or replace it with --force"
        )


def _title(
    problem: Problem, labels: Mapping[str, str | int], windows: int, has_counted: bool
) -> str:
    warmup = problem.warmup_windows
    title = (
        f"{problem.name}, {labels['scenario']}, {labels['policy']}, seed {labels['seed']}: "
        f"{counted(windows, 'window')} of {counted(problem.window_cycles, 'cycle')}, "
        f"deadline {milliseconds(problem.pipeline.deadline_ms)} ms"
    )
    if not has_counted:
        return f"{title}, none after the {warmup} of warm-up: nothing to sum up; ask for more"
    return f"{title}\nwithout the first {warmup} (warm-up):" if warmup else title


def _never_moving(placements: Mapping[str, Mapping[str, float]], problem: Problem) -> str:
    """Return the results of the initial placement, and of the best of all that were simulated."""
    rates = {name: row["violation_rate"] for name, row in placements.items()}
    first, best = problem.initial, min(rates, key=rates.__getitem__)
    line = f"{rates[first] * 100:.2f} % if it never moved from {first}"
    return line if best == first else f"{line}; {rates[best] * 100:.2f} % if always on {best}"


def _numbers(problem: Problem, row: Row) -> str:
    shares = {name: float(row[f"share_{name}"]) for name in problem.candidates}
    used = (f"{name} {row[f'node_{name}']:.0%}" for name in problem.fabric.resources)
    unfinished = f"{row['in_flight']} of {row['cycles']}"
    lines = (
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
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in lines)


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
