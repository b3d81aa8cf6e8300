"""`dwell report`: runs, fleets, studies and campaigns as pages; figures; a run for viewers."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

import typer

import dwell
from dwell.cli.options import Json, argument, flag, option
from dwell.cli.output import (
    mark_of,
    mark_of_run,
    print_json,
    progress,
    require_own,
    working,
    write_file,
    write_report,
)
from dwell.errors import RunError, SimulationError
from dwell.record.run import NO_JOBS

if TYPE_CHECKING:
    from dwell.files import Content
    from dwell.record import Run
    from dwell.report.added import FolderPages
    from dwell.report.page import Page

#: A folder's own page.
PAGE = "report.html"


def report(
    folder: Annotated[Path, argument("FOLDER", "Folder of a run, fleet, study or campaign.")],
    out: Annotated[
        Path | None, option("FILE", "Page to write.", default="FOLDER/report.html")
    ] = None,
    trace: Annotated[
        Path | None,
        option("FILE", "Also write every job as a trace for Perfetto; needs a run with --jobs."),
    ] = None,
    mcap: Annotated[
        Path | None,
        option(
            "FILE", "Also write the tables as an MCAP file for Foxglove, PlotJuggler and others."
        ),
    ] = None,
    figures: Annotated[
        Path | None,
        option("FOLDER", "Also write figures and tables for a paper: PDF, SVG, LaTeX, CSV."),
    ] = None,
    static: Annotated[
        bool, flag("--static", "Write a page without scripts: no tooltips, no menus.")
    ] = False,
    cells: Annotated[
        bool, flag("--cells", "Also write the page of every cell of a fleet.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write the HTML page of a run, fleet, study or campaign."""
    from dwell.model.entry_points import PAGES, added
    from dwell.report.added import FolderPages

    page = out or folder / PAGE
    folders = {name: kind for name, kind in added(PAGES).items() if isinstance(kind, FolderPages)}
    kind = _kind_of(folder, folders)
    for what, wanted in (("a trace", trace), ("an MCAP file", mcap)):
        if wanted is not None and kind != "run":
            raise RunError(f"{folder} is a {kind}; name one of its runs for {what}")
    if cells and kind != "fleet":
        raise RunError(f"{folder} is a {kind}, which has no cells; leave out --cells")
    run = dwell.open_run(folder) if kind == "run" else None
    mark = mark_of(str(folder.resolve())) if run is None else mark_of_run(run)
    if page != folder / PAGE:
        require_own(page, mark)
    if kind in folders:
        folders[kind].write(folder, page, figures=figures, static=static, as_json=as_json)
        return
    extras: dict[str, Any] = {}
    if run is not None:
        if trace is not None and not (run.is_simulated or run.has_jobs):
            # A measured run cannot be made again for it.
            typer.echo(f"note: no {trace}: {NO_JOBS}", err=True)
            trace = None
        extras["trace"] = trace
        if lost := run.losses:
            extras |= {"recovered": run.meta["recovered"], "lost": lost}
        if mcap is not None:
            extras["mcap"] = mcap
    if cells:
        extras["cells"] = _write_cells(folder, static=static)
    with working("writing the report"):
        try:
            document = _page_of(folder, kind, run, page)
        except SimulationError as error:
            raise RunError(f"{folder}: {error}") from None
        files = {} if run is None else _files(run, trace, mcap)
        write_report(document, page, figures=figures, static=static, mark=mark)
        for path, content in files.items():
            write_file(path, content)
    if figures is not None:
        extras["figures"] = figures
    if as_json:
        print_json({"report": page, **extras})
        return
    typer.echo(f"report: {page}")
    for sentence in extras.get("lost", ()):
        typer.echo(f"note: {sentence}")
    if trace is not None:
        typer.echo(f"trace: {trace} (open it at https://ui.perfetto.dev)")
    for what, place in (("mcap", mcap), ("figures", figures)):
        if place is not None:
            typer.echo(f"{what}: {place}")
    if cells:
        typer.echo(f"cells: {folder}/*/{PAGE}")


def _kind_of(folder: Path, folders: Mapping[str, FolderPages]) -> str:
    """Return the kind of a folder: of an upper flat, a study, a fleet, or else a run."""
    from dwell.record.fleet_run import is_fleet
    from dwell.study.study_folder import is_study

    kinds = {name: kind.holds for name, kind in folders.items()}
    kinds |= {"study": is_study, "fleet": is_fleet}
    return next((kind for kind, is_one in kinds.items() if is_one(folder)), "run")


def _page_of(folder: Path, kind: str, run: Run | None, page: Path) -> Page:
    """Return the page of a run, fleet or study."""
    if run is not None:
        from dwell.report.run_page import run_page

        return run_page(run)
    if kind == "fleet":
        from dwell.record import open_fleet
        from dwell.report.fleet_page import fleet_page

        return fleet_page(open_fleet(folder), links=_links(folder, page))
    from dwell.report.study_page import study_page
    from dwell.study.study_folder import open_study

    return study_page(open_study(folder))


def _files(run: Run, trace: Path | None, mcap: Path | None) -> dict[Path, Content]:
    """Return the further files of a run's report, with their contents."""
    files: dict[Path, Content] = {}
    if trace is not None:
        from dwell.report import trace_events

        files[trace] = json.dumps(trace_events(run))
    if mcap is not None:
        from dwell.record.mcap_file import write_mcap

        files[mcap] = partial(write_mcap, run)
    return files


def _write_cells(folder: Path, *, static: bool) -> dict[str, Path]:
    """Write the page of each cell of a fleet next to its run; return the paths by cell."""
    from dwell.record import open_fleet
    from dwell.report.run_page import run_page

    pages: dict[str, Path] = {}
    runs = open_fleet(folder).cells
    with progress("writing the reports of cells") as shown:
        for name, run in runs.items():
            pages[name] = folder / name / PAGE
            mark = mark_of_run(run)
            write_report(run_page(run), pages[name], figures=None, static=static, mark=mark)
            if shown is not None:
                shown(len(pages), len(runs))
    return pages


def _links(folder: Path, page: Path) -> dict[str, str]:
    """Return links from a page to the existing pages of a fleet's cells."""
    known = folder.glob(f"*/{PAGE}")
    return {one.parent.name: quote(os.path.relpath(one, page.parent)) for one in known}
