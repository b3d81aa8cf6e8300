"""`dwell validate`: predictions of a calibrated cell next to measurements of its runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import dwell
from dwell.cli.options import Json, Processes, Traces, argument, option, require_few
from dwell.cli.output import (
    json_text,
    mark_of,
    mark_of_run,
    print_json,
    progress,
    require_own,
    write_file,
)
from dwell.errors import RunError

if TYPE_CHECKING:
    from dwell.record import Run
    from dwell_lab.testbed.speeds import Usual
    from dwell_lab.validation.validation import Validation


def validate(
    runs: Annotated[list[Path], argument("RUN", "Folders of measured runs.")],
    cell: Annotated[Path, option("FILE", "Calibrated cell file (YAML).")],
    out: Annotated[
        Path | None, option("FOLDER", "Folder for page and table.", default="validations/CELL")
    ] = None,
    seeds: Annotated[
        int, option("N", "Seeds 1 to N of every run.", min=2, callback=require_few)
    ] = 20,
    calibrated_from: Annotated[
        list[Path] | None,
        option(
            "RUN",
            "Another run that the cell was calibrated from, in addition to the runs listed in "
            "CELL.calibration.json; may be repeated.",
        ),
    ] = None,
    traces: Traces = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Compare a calibrated cell's predictions with measured runs."""
    from dwell.model.document import to_document
    from dwell_lab.pages.validation_page import validation_html, validation_text
    from dwell_lab.validation.validation import validate as validate_cell

    problem = dwell.load(cell, traces=traces)
    opened = _open(runs)
    ids, usual = _sidecar(cell)
    used = [*ids, *(path.resolve().name for path in calibrated_from or ())]
    out = out or Path("validations", problem.name)
    page, table = out / "report.html", out / "validation.json"
    marks = sorted(map(mark_of_run, opened.values()))
    mark = mark_of(to_document(problem), marks, sorted(used), seeds)
    require_own(page, mark)
    with progress("simulating") as show:
        validation = validate_cell(
            opened,
            problem,
            seeds=seeds,
            calibrated_from=used,
            usual=usual,
            processes=processes,
            progress=show,
        )
    document = _document(validation)
    write_file(page, validation_html(validation) + mark)
    write_file(table, json_text(document) + "\n")
    if as_json:
        print_json({"report": page, "table": table, **document})
        return
    typer.echo(validation_text(validation))
    typer.echo(f"report: {page}")


def _sidecar(cell: Path) -> tuple[list[str], Usual]:
    """Return the ids or names of a cell's calibration runs, and the speeds of the calibration."""
    from dwell_lab.testbed.speeds import Usual

    file = cell.with_name(f"{cell.stem}.calibration.json")
    if not file.is_file():
        return [], Usual()
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        usual = Usual.of(document)
        # Prefer ids: runs of two campaigns may have the same name.
        if document.get("ids"):
            return [str(run_id) for run_id in document["ids"]], usual
        return [Path(str(name)).name for name in document.get("runs", [])], usual
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise RunError(
            f"{file}: cannot be read ({error}); its key `runs` lists the runs that the cell was "
            "calibrated from"
        ) from None


def _open(folders: Sequence[Path]) -> dict[str, Run]:
    """Open the runs; keys are folder names, or the full path if the name is already used."""
    runs: dict[str, Run] = {}
    faults: list[str] = []
    known: set[Path] = set()
    for folder in folders:
        whole = folder.resolve()
        if whole in known:
            faults.append(f"{folder}: named twice")
            continue
        known.add(whole)
        try:
            run = dwell.open_run(folder)
        except RunError as error:
            faults.append(str(error))
            continue
        runs[whole.name if whole.name not in runs else str(whole)] = run
    if faults:
        raise RunError("\n".join(faults))
    return runs


def _document(validation: Validation) -> dict[str, Any]:
    from dwell_lab.validation.validation import GOALS

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
        "moves": validation.moves.to_dicts(),
    }
