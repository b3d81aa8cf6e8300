"""`dwell study`: every scenario, policy, point and seed of a study file, in a folder of its own."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer

from dwell.cli.exit_codes import ExitCode
from dwell.cli.first_answer import compile_first
from dwell.cli.options import windows_of
from dwell.cli.output import Progress, aligned, print_json, progress, working
from dwell.report.formatting import Measure, shown_policy, shown_scenario, write_interval
from dwell.study import Interval, Study, StudyResult, load_study, run_study
from dwell.study.over_seeds import over_seeds

# Groups of a point and a scenario that the terminal shows; the tables have all.
SHOWN = 40

RATE = Measure("violation_rate", "V_D", "%", 100.0)
COST = Measure("cost", "J", decimals=2)
MIGRATIONS = Measure("migrations", "migrations")
REGRET = Measure("regret", "regret", "%", 100.0)


def run_study_file(
    file: Path,
    *,
    out: Path | None,
    processes: int | None,
    dask: str | None,
    seeds: int | None,
    windows: int | None,
    seconds: float | None,
    as_json: bool,
) -> None:
    """Run a study, or go on with it, and print what it comes to.

    None is what the study file says, or the default.

    Raises
    ------
    DwellError
        If the file is wrong, the folder holds something else or cannot be written, or the cluster
        is out of reach.
    typer.Exit
        If it was interrupted.
    """
    study = load_study(file)
    if seeds is not None:
        study = replace(study, seeds=tuple(range(1, seeds + 1)))
    if seconds is not None:
        windows = windows_of(seconds, *(point.problem for point in study.points))
    if windows is not None:
        study = replace(study, windows=windows)
    folder = out or Path("studies", re.sub(r"[^\w.-]", "_", study.name))
    if dask is None:
        compile_first()
    with _interruptible(folder, study) as shown:
        result = run_study(
            study,
            folder=folder,
            processes=processes,
            dask=dask,
            progress=shown,
        )
    if as_json:
        with working("intervals"):
            table = result.table([measure.column for measure in _measures(study)]).to_dicts()
        head: dict[str, Any] = {"study": study.name, "folder": folder}
        print_json({**head, "runs": result.runs.height, "table": table})
        return
    with working("intervals"):
        text = study_text(result)
    typer.echo(f"{text}\n\ntables: {folder}")


@contextmanager
def _interruptible(folder: Path, study: Study) -> Iterator[Progress]:
    """Show progress; after Ctrl-C, say what is finished and how to go on."""
    done = 0
    try:
        with progress("simulating", cycles=study.cycles / study.runs) as shown:

            def count(finished: int, total: int) -> None:
                nonlocal done
                done = finished
                if shown is not None:
                    shown(finished, total)

            yield count
    except KeyboardInterrupt:
        typer.echo(
            f"interrupted: {done} of {study.runs} runs are finished and stay in {folder}; the same "
            "command goes on from there",
            err=True,
        )
        raise typer.Exit(ExitCode.INTERRUPTED) from None


def _measures(study: Study) -> tuple[Measure, ...]:
    more = (REGRET,) if study.references else ()
    return (RATE, COST, MIGRATIONS, *more)


def study_text(result: StudyResult) -> str:
    """Return the tables of a study as text: one a point and scenario, as many as a screen takes."""
    study = result.study
    measures = _measures(study)
    groups = len(study.points) * len(study.scenarios)
    keys = (*result.parameters, "scenario")
    # Intervals take time: only of what is shown.
    some = result.runs.head(SHOWN * len(study.policies) * len(study.seeds))
    lines = []
    for labels, mine in some.group_by(keys, maintain_order=True):
        *values, scenario = labels
        at = ", ".join(
            f"{name} = {value}" for name, value in zip(study.parameters, values, strict=True)
        )
        table = over_seeds(mine, ("policy",), [measure.column for measure in measures])
        rows = [
            [shown_policy(row["policy"]), *(_written(row, measure) for measure in measures)]
            for row in table.to_dicts()
        ]
        title = shown_scenario(str(scenario))
        lines += [f"{title} ({at})" if at else title]
        lines += [aligned(["", *(measure.heading for measure in measures)], rows), ""]
    seeds = len(study.seeds)
    lines.append(f"Mean over {seeds} seeds, with its 95 % interval." if seeds > 1 else "One seed.")
    if groups > SHOWN:
        lines.append(f"{SHOWN} of {groups} tables are shown; runs.parquet has all runs.")
    return "\n".join(lines)


def _written(row: dict[str, Any], measure: Measure) -> str:
    ends = (row[f"{measure.column}{end}"] for end in ("", "_low", "_high"))
    known = Interval(*(float("nan") if end is None else end for end in ends))
    return str(write_interval(known, measure))
