"""`dwell report`: a run, a study or a campaign as a page; figures as files; jobs as a trace."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from dwell.cli.output import print_json, working, write_file, write_report
from dwell.errors import RunError
from dwell.record import open_run
from dwell.report.formatting import listed
from dwell.study.study_folder import is_study, open_study
from dwell.testbed.execution import is_campaign

__all__ = ["ReportRequest", "report_folder"]


@dataclass(frozen=True, slots=True)
class ReportRequest:
    """What was asked for.

    Parameters
    ----------
    folder : Path
        Of a run, a study or a campaign.
    page : Path
        To write.
    trace : Path or None
        File for a run's jobs.
    figures : Path or None
        Folder for figures and tables as files.
    static : bool
        Whether the page is without scripts.
    """

    folder: Path
    page: Path
    trace: Path | None
    figures: Path | None
    static: bool


def report_folder(request: ReportRequest, *, as_json: bool) -> None:
    """Write the page of a run, a study or a campaign, and what else is asked for.

    Raises
    ------
    RunError
        If the folder is none of these, or a trace is asked for and there are no jobs.
    """
    folder = request.folder
    for kind, is_one in (("campaign", is_campaign), ("study", is_study)):
        if request.trace is not None and is_one(folder):
            raise RunError(f"{folder} is a {kind}; name one of its runs for a trace")
    if is_campaign(folder):
        from dwell.cli.campaign import report_campaign

        report_campaign(
            folder, request.page, figures=request.figures, static=request.static, as_json=as_json
        )
    elif is_study(folder):
        _report_study(request, as_json=as_json)
    else:
        _report_run(request, as_json=as_json)


def _report_study(request: ReportRequest, *, as_json: bool) -> None:
    from dwell.report.study_page import study_page

    with working("writing the report"):
        page = study_page(open_study(request.folder))
        write_report(page, request.page, figures=request.figures, static=request.static)
    _print(request, {}, as_json=as_json)


def _report_run(request: ReportRequest, *, as_json: bool) -> None:
    from dwell.report import trace_events
    from dwell.report.run_page import run_page

    run = open_run(request.folder)
    with working("writing the report"):
        events = None if request.trace is None else trace_events(run)
        page = run_page(run)
        write_report(page, request.page, figures=request.figures, static=request.static)
    if request.trace is not None and events is not None:
        write_file(request.trace, json.dumps(events))
    recovered = run.meta.get("recovered", {})
    lost = list(_what_was_lost(recovered))
    told = {"recovered": recovered, "lost": lost} if lost else {}
    _print(request, {"trace": request.trace, **told}, as_json=as_json)


def _what_was_lost(told: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on what is not in a run because something was killed or damaged.

    Parameters
    ----------
    told : mapping
        What its meta say under ``recovered``.
    """
    opened = int(told.get("opened", 1))
    if opened > 1:
        yield f"The controller was started {opened} times while the run went on."
    lost = [
        text
        for name, text in (
            ("torn_bytes", "{} bytes at the journal's end were torn by a kill"),
            ("damaged_bytes", "{} bytes within the journal were damaged"),
        )
        if told.get(name)
        for text in [text.format(told[name])]
    ]
    if lost:
        yield f"{listed(lost)}; what they said is not here."
    if told.get("missing_windows"):
        yield f"Windows missing from the run: {told['missing_windows']}."
    if told and not told.get("sealed", True):
        yield (
            "The run was not closed: it goes on, or its controller was killed. This is what its "
            "journal holds; what came after its last window is not here."
        )


def _print(request: ReportRequest, told: dict[str, Any], *, as_json: bool) -> None:
    figures = {} if request.figures is None else {"figures": request.figures}
    if as_json:
        print_json({"report": request.page, **told, **figures})
        return
    typer.echo(f"report: {request.page}")
    for sentence in told.get("lost", ()):
        typer.echo(f"note: {sentence}")
    if request.trace is not None:
        typer.echo(f"trace: {request.trace} (open it at https://ui.perfetto.dev)")
    if request.figures is not None:
        typer.echo(f"figures: {request.figures}")
