"""`dwell validate`: what a calibrated cell predicts, beside what its runs measured."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

import dwell
from dwell.calibration.speeds import Usual
from dwell.cli.first_answer import compile_first
from dwell.cli.output import json_text, print_json, progress, write_file
from dwell.errors import RunError
from dwell.record import Run, open_run
from dwell.report.validation_page import validation_html, validation_text
from dwell.study.validation import GOALS, Validation, validate


def validate_runs(
    runs: Sequence[Path],
    cell: Path,
    *,
    out: Path | None,
    seeds: int,
    traces: Path | None,
    calibrated_from: Sequence[Path],
    processes: int | None,
    as_json: bool,
) -> None:
    """Simulate, write the page and the table, and print.

    Raises
    ------
    DwellError
        If a folder is not a run, or a run is not one that the cell can be validated on.
    """
    problem = dwell.load(cell, traces=traces)
    opened = _open(runs)
    ids, usual = _sidecar(cell)
    used = [*ids, *(path.resolve().name for path in calibrated_from)]
    compile_first()
    with progress("simulating") as show:
        validation = validate(
            opened,
            problem,
            seeds=seeds,
            calibrated_from=used,
            usual=usual,
            processes=processes,
            progress=show,
        )
    out = out or Path("validations", problem.name)
    page, table = out / "report.html", out / "validation.json"
    told = _told(validation)
    write_file(page, validation_html(validation))
    write_file(table, json_text(told) + "\n")
    if as_json:
        print_json({"report": page, "table": table, **told})
        return
    typer.echo(validation_text(validation))
    typer.echo(f"report: {page}")


def sidecar_of(cell: Path) -> Path:
    """Return the file beside a calibrated cell that says what it was made from."""
    return cell.with_name(f"{cell.stem}.calibration.json")


def _sidecar(cell: Path) -> tuple[list[str], Usual]:
    """Return the ids, or names, of the runs that a cell was calibrated from, and its speeds."""
    file = sidecar_of(cell)
    if not file.is_file():
        return [], Usual()
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        usual = Usual.of(told)
        # Runs of two campaigns may have the same name; what their stamps carry differs.
        if told.get("ids"):
            return [str(one) for one in told["ids"]], usual
        return [Path(str(name)).name for name in told.get("runs", [])], usual
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise RunError(
            f"{file}: cannot be read ({error}); it says in `runs` from which runs the cell was "
            "calibrated"
        ) from None


def _open(folders: Sequence[Path]) -> dict[str, Run]:
    """Open the runs by the names of their folders; of two of one name, by their whole paths."""
    found: dict[str, Run] = {}
    faults: list[str] = []
    known: set[Path] = set()
    for folder in folders:
        whole = folder.resolve()
        if whole in known:
            faults.append(f"{folder}: named twice")
            continue
        known.add(whole)
        try:
            run = open_run(folder)
        except RunError as error:
            faults.append(str(error))
            continue
        found[whole.name if whole.name not in found else str(whole)] = run
    if faults:
        raise RunError("\n".join(faults))
    return found


def _told(validation: Validation) -> dict[str, Any]:
    return {
        "cell": validation.problem.name,
        "seeds": validation.seeds,
        "verdicts": {goal: validation.verdict(goal) for goal in GOALS},
        "groups": [
            {
                "scenario": group.scenario,
                "policy": group.policy,
                "runs": list(group.runs),
                "minutes": group.minutes,
                "enough": not group.short,
                "windows": group.measured.windows,
                "excluded_windows": group.excluded,
                "verdicts": {goal: group.verdict(goal) for goal in GOALS},
                "dominant": dict(zip(("measured", "predicted"), group.dominant, strict=True)),
                "violation_rate_allowed": list(group.allowed_rates),
            }
            for group in validation.groups
        ],
        "figures": validation.table.to_dicts(),
        "jobs": validation.jobs.to_dicts(),
    }
