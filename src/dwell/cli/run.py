"""`dwell run`: one policy on one realisation, saved and summed up."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterable, Mapping
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
from dwell.model.table_columns import SHARE_OF, USE_OF
from dwell.record.json_documents import read_document

if TYPE_CHECKING:
    from dwell.model import Problem
    from dwell.study.summary import Row

#: Bytes of a run's default name at most; file systems take 255.
LONGEST_NAME = 200
#: Metrics on the terminal by column; `RARE` metrics only if they are not 0.
SHOWN = (
    *("l95_ms", "p50_ms", "p95_ms", "cost", "lost", "in_flight", "longest_misses"),
    *("misses_in_20", "misses_in_100", "aoi_mean_ms", "aoi_p95_ms", "aoi_peak_ms"),
    *("tracking_rms_mm", "tracking_iae_mm", "migrations", "guard_moves"),
)
RARE = {"in_flight", "tracking_rms_mm", "tracking_iae_mm", "guard_moves"}


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
    from dwell.estimators import searched, unplayed

    require_one_length(windows, seconds)
    problem = load_with(cell, settings, traces) if settings else dwell.load(cell, traces=traces)
    problem = searched(problem)
    windows = windows or (300 if seconds is None else windows_of(seconds, problem))
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
        # A run that never moves is its own comparison.
        known = {policy: result} if estimator is None and not guard else {}
        placements = other_placements(problem, realisation, known=known) if counts else {}
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
    from dwell.study.metric import METRICS

    rates = {name: row["violation_rate"] for name, row in placements.items()}
    first, best = problem.initial, min(rates, key=rates.__getitem__)
    texts = {name: METRICS["violation_rate"].text(rate) for name, rate in rates.items()}
    line = f"{texts[first]} if it never moved from {first}"
    return line if best == first else f"{line}; {texts[best]} if always on {best}"


def _numbers(problem: Problem, row: Row) -> str:
    from dwell.study.metric import METRICS, further_columns, metric_of

    values = {name: value for name, value in row.items() if not isinstance(value, str)}

    def listed(template: str, names: Iterable[str]) -> str:
        columns = {name: template.format(candidate=name, resource=name) for name in names}
        texts = (
            f"{name} {metric_of(column).text(values[column])}"
            for name, column in columns.items()
            if values[column] or template == USE_OF
        )
        return ", ".join(texts)

    shown = (name for name in SHOWN if values.get(name, 0) or name not in RARE)
    lines = {METRICS[name].title: METRICS[name].text(values[name]) for name in shown}
    columns = further_columns(problem.pipeline.chains)
    further = [metric_of(column) for column in columns if column in values]
    lines |= {metric.title: metric.text(values[metric.column]) for metric in further}
    lines["windows by placement"] = listed(SHARE_OF, problem.candidates)
    lines["utilisation"] = listed(USE_OF, problem.fabric.resources)
    width = max(map(len, lines))
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in lines.items())
