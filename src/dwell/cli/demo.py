"""`dwell demo`: all policies in all scenarios of an example, as a table and as a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import dwell
from dwell.cli.examples import find_examples
from dwell.cli.options import (
    Json,
    Processes,
    Seconds,
    Windows,
    option,
    require_few,
    windows_of_study,
)
from dwell.cli.output import mark_of, print_json, progress, require_own, working, write_file

if TYPE_CHECKING:
    from dwell.model import Problem
    from dwell.study import Study

#: The study, and the cells that replay measurements, in the folder of examples.
STUDY = "studies/demo.yaml"
REAL = ("real.yaml", "real-5g.yaml")


def demo(
    real: Annotated[
        Path | None, option("FOLDER", "Replay the measurements in this folder.")
    ] = None,
    seeds: Annotated[
        int, option("N", "Seeds 1 to N of every run.", min=1, callback=require_few)
    ] = 20,
    windows: Windows = None,
    seconds: Seconds = None,
    out: Annotated[Path, option("FOLDER", "Folder for report.html.")] = Path("demo-out"),
    examples: Annotated[Path | None, option("FOLDER", "Folder of the example cells.")] = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Compare all policies in all scenarios of an example cell.

    This is the study examples/studies/demo.yaml. Its runs have 150 windows without --windows and
    --seconds.
    """
    from dwell.report import comparison_html, comparison_text
    from dwell.study import compare_study, load_study

    folder = find_examples(examples)
    plan = replace(load_study(folder / STUDY), seeds=tuple(range(1, seeds + 1)))
    cells = [plan.points[0].problem]
    if real is not None:
        cells = [dwell.load(folder / name, traces=real) for name in REAL]
    windows = windows_of_study(windows, seconds, *cells)
    plans = [_on(plan, cell, windows or plan.windows) for cell in cells]
    page = out / "report.html"
    mark = mark_of(str(folder.resolve()), str(real), seeds, windows or plan.windows)
    require_own(page, mark)
    comparisons = []
    for one in plans:
        with progress(f"simulating {one.name}") as shown:
            comparisons.append(compare_study(one, processes=processes, progress=shown))
    if not as_json:
        for comparison in comparisons:
            typer.echo(f"Cell {comparison.problem.name}\n")
            typer.echo(comparison_text(comparison))
    with working("writing the report"):
        write_file(page, comparison_html(*comparisons) + mark)
    if as_json:
        tables = {one.problem.name: one.table().to_dicts() for one in comparisons}
        print_json({"report": page, "comparisons": tables})
    else:
        typer.echo(f"report: {page}")


def _on(study: Study, cell: Problem, windows: int) -> Study:
    """Return the study on a cell; runs are no longer than its traces allow."""
    from dwell.study import Point, longest_run

    return replace(
        study,
        name=cell.name,
        points=(Point({}, cell),),
        scenarios=tuple(cell.scenarios),
        windows=longest_run(cell, windows),
    )
