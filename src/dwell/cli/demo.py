"""`dwell demo`: all policies in all scenarios of an example, as a table and as a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    require_one_length,
    windows_of,
)
from dwell.cli.output import mark_of, print_json, progress, require_own, working, write_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    import polars as pl

    from dwell.study import Comparison, StudyResult


def demo(
    real: Annotated[
        Path | None, option("FOLDER", "Replay the measurements in this folder instead.")
    ] = None,
    seeds: Annotated[
        int, option("N", "Seeds 1 to N of every run.", min=1, callback=require_few)
    ] = 20,
    windows: Windows = None,
    seconds: Seconds = None,
    out: Annotated[Path, option("FOLDER", "Where report.html goes.")] = Path("demo-out"),
    examples: Annotated[
        Path | None, option("FOLDER", "Where the example cells are, if not found.")
    ] = None,
    processes: Processes = None,
    as_json: Json = False,
) -> None:
    """Compare all policies in all scenarios of an example, and write the report.

    Runs are 150 windows long, if neither --windows nor --seconds is given.
    """
    from dwell.report import comparison_html, comparison_text
    from dwell.study import canonical_demo, real_demo, stored_deadlines, tenants_demo
    from dwell.study.demo import CANONICAL, REAL, WINDOWS

    require_one_length(windows, seconds)
    folder = find_examples(examples)
    if seconds is not None:
        cells = (CANONICAL,) if real is None else REAL
        windows = windows_of(seconds, *(dwell.load(folder / name, traces=real) for name in cells))
    windows, page = windows or WINDOWS, out / "report.html"
    mark = mark_of(str(folder.resolve()), str(real), seeds, windows)
    require_own(page, mark)
    with progress("simulating") as shown:
        plan: dict[str, Any] = {"seeds": seeds, "windows": windows}
        plan |= {"processes": processes, "progress": shown}
        comparisons: Sequence[Comparison]
        tenants: StudyResult | None = None
        deadlines: pl.DataFrame | None = None
        if real is None:
            deadlines = stored_deadlines(folder)
            comparisons = [canonical_demo(folder, **plan)]
            tenants = tenants_demo(folder, **plan)
        else:
            comparisons = real_demo(folder, real, **plan)
    if not as_json:
        for comparison in comparisons:
            typer.echo(f"Cell {comparison.problem.name}\n")
            typer.echo(comparison_text(comparison))
    with working("writing the report"):
        html = comparison_html(*comparisons, tenants=tenants, deadlines=deadlines)
        write_file(page, html + mark)
    if as_json:
        tables = {one.problem.name: one.table().to_dicts() for one in comparisons}
        print_json({"report": page, "comparisons": tables})
    else:
        typer.echo(f"report: {page}")
