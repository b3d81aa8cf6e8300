"""`dwell report`: a saved run as a page, and its jobs as a trace; a campaign as a page."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from dwell.cli.output import print_json, working, write_file
from dwell.errors import RunError
from dwell.record import open_run
from dwell.report import run_html, trace_events
from dwell.report.live_facts import recovery
from dwell.testbed.execution import is_campaign

__all__ = ["report_run"]


def report_run(folder: Path, page: Path, trace: Path | None, *, as_json: bool) -> None:
    """Write the page of a run, and its trace where a file is named for it; or a campaign's page.

    Raises
    ------
    RunError
        If the folder is not a run, or a trace is asked for and the run kept no jobs.
    """
    if is_campaign(folder):
        if trace is not None:
            raise RunError(f"{folder} is a campaign; name one of its runs for a trace")
        from dwell.cli.campaign import report_campaign

        report_campaign(folder, page, as_json=as_json)
        return
    run = open_run(folder)
    with working("writing the report"):
        events = None if trace is None else trace_events(run)
        write_file(page, run_html(run))
    if trace is not None and events is not None:
        write_file(trace, json.dumps(events))
    recovered = run.meta.get("recovered", {})
    lost = list(recovery(recovered))
    if as_json:
        told = {"recovered": recovered, "lost": lost} if lost else {}
        print_json({"report": page, "trace": trace, **told})
        return
    typer.echo(f"report: {page}")
    for sentence in lost:
        typer.echo(f"note: {sentence}")
    if trace is not None:
        typer.echo(f"trace: {trace} (open it at https://ui.perfetto.dev)")
