"""`dwell dash`: the page of a live cell, or of a recorded run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dwell.cli.options import Insecure, Keys

#: Where a page is served where nobody says.
PORT = 8780
CELL = Path("cell.yaml")


def dash(
    shown: Annotated[
        Path | None,
        typer.Argument(
            metavar="CELL|RUN",
            help="Cell file of a cell that runs, or the folder of a run; ./cell.yaml if not given.",
        ),
    ] = None,
    beside: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="Another run, to be shown on the same time line."),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65_535, metavar="P", help="Of loopback; 0 takes a free one.")
    ] = PORT,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Whether to open it in a browser.")
    ] = True,
    control: Annotated[
        bool,
        typer.Option(
            "--control", help="Let the page pin and drain; with keys, it takes an operator's."
        ),
    ] = False,
    keys: Keys = None,
    insecure: Insecure = False,
) -> None:
    """Show a live cell, or a recorded run, on a page in the browser of this computer."""
    from dwell.dash.pages import show_cell, show_run

    def say(line: str) -> None:
        typer.echo(line, err=True)

    where = shown or CELL
    if where.is_dir():
        if control:
            raise typer.BadParameter("--control: a recorded run cannot be acted on")
        show_run(where, beside, port=port, browser=browser, say=say)
        return
    if beside is not None:
        raise typer.BadParameter("--beside: a run stands beside a run, not beside a live cell")
    if shown is None and not where.is_file():
        raise typer.BadParameter("there is no cell.yaml here; name a cell file, or a run's folder")
    from dwell.live.security import environment

    settings = environment(keys, insecure=insecure)
    show_cell(where, settings, port=port, browser=browser, control=control, say=say)
