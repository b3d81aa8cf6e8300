"""`dwell demo`: all policies in all scenarios of an example, as a table and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from dwell.cellfile import load
from dwell.cli.examples import find_examples
from dwell.cli.first_answer import compile_first
from dwell.cli.options import windows_of
from dwell.cli.output import print_json, progress, working, write_file
from dwell.report import comparison_html, comparison_text
from dwell.study import Comparison, StudyResult, canonical_demo, real_demo, tenants_demo
from dwell.study.demo import CANONICAL, REAL, WINDOWS


def run_demo(
    real: Path | None,
    *,
    seeds: int,
    windows: int | None,
    seconds: float | None,
    out: Path,
    examples: Path | None,
    processes: int | None,
    as_json: bool,
) -> None:
    """Compare, print the tables, write the page.

    Parameters
    ----------
    real : Path or None
        Folder with the measurements to replay; None takes the canonical cell.
    seeds, processes
        See `dwell.study.canonical_demo`.
    windows : int, optional
        Length of every run; 150 if neither it nor `seconds` is given.
    seconds : float, optional
        The length in seconds instead.
    out : Path
        Folder for ``report.html``.
    examples : Path or None
        Folder with the cells; None looks for it.
    as_json : bool
        Print the tables as JSON.
    """
    folder = find_examples(examples)
    if seconds is not None:
        cells = (CANONICAL,) if real is None else REAL
        windows = windows_of(seconds, *(load(folder / name, traces=real) for name in cells))
    windows = windows or WINDOWS
    compile_first()
    with progress("simulating") as shown:
        comparisons: Sequence[Comparison]
        tenants: StudyResult | None = None
        if real is None:
            comparisons = [
                canonical_demo(
                    folder, seeds=seeds, windows=windows, processes=processes, progress=shown
                )
            ]
            tenants = tenants_demo(
                folder, seeds=seeds, windows=windows, processes=processes, progress=shown
            )
        else:
            comparisons = real_demo(
                folder, real, seeds=seeds, windows=windows, processes=processes, progress=shown
            )
    page = out / "report.html"
    if not as_json:
        for comparison in comparisons:
            typer.echo(f"Cell {comparison.problem.name}\n")
            typer.echo(comparison_text(comparison))
    with working("writing the report"):
        write_file(page, comparison_html(*comparisons, tenants=tenants))
    if as_json:
        tables = {one.problem.name: one.table().to_dicts() for one in comparisons}
        print_json({"report": page, "comparisons": tables})
    else:
        typer.echo(f"report: {page}")
