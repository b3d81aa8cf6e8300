"""`dwell dash`: the page of a live cell, of a recorded run, or of a fleet's runs."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dwell.cli.options import (
    Insecure,
    Keys,
    argument,
    flag,
    option,
)
from dwell.live.commands.log_format import LogFormat, Logs, begin_log

if TYPE_CHECKING:
    from dwell.dash.server import Dash

#: Default port of the page.
PORT = 8780
CELL = Path("cell.yaml")
#: At least 128 bits in base64, with characters that need no escapes in headers, cookies and URLs.
TOKEN = re.compile(r"[A-Za-z0-9_-]{22,200}")


def dash(
    shown: Annotated[
        Path | None,
        argument(
            "CELL|RUN|FLEET|FOLDER",
            "Cell file of a live cell, or folder of a run, of a fleet's runs or of several runs "
            "[default: ./cell.yaml]",
        ),
    ] = None,
    beside: Annotated[
        Path | None, option("RUN", "Another run, shown on the same time line.")
    ] = None,
    port: Annotated[int, option("P", "Local port; 0 takes a free one.", min=0, max=65_535)] = PORT,
    no_browser: Annotated[
        bool, flag("--no-browser", "Print the address; open no browser.")
    ] = False,
    control: Annotated[
        bool, flag("--control", "Let the page pin and drain; with keys, it needs an operator's.")
    ] = False,
    mcap: Annotated[
        Path | None,
        option(
            "FILE",
            "Also record the live cell to an MCAP file for Foxglove, PlotJuggler and others.",
        ),
    ] = None,
    token: Annotated[
        Path | None,
        option("FILE", "File with the page's token, for Prometheus; made if it is missing."),
    ] = None,
    keys: Keys = None,
    insecure: Insecure = False,
    log_format: Logs = LogFormat.TEXT,
) -> None:
    """Show a live cell or recorded runs in the browser."""
    from dwell.dash.pages import live_page, recorded_page
    from dwell.live.log import say
    from dwell.record import is_fleet

    begin_log(log_format, "dash")
    kept = None if token is None else _kept(token)
    where = shown or CELL
    if where.is_dir():
        fleet = is_fleet(where)
        if control:
            raise typer.BadParameter("--control: recorded runs cannot be acted on")
        if mcap is not None:
            run = where / "CELL" if fleet else where
            raise typer.BadParameter(f"--mcap: dwell report {run} --mcap {mcap} writes a run's")
        if fleet and beside is not None:
            raise typer.BadParameter(
                f"--beside: {where} is a fleet, which is shown alone; name two of its runs instead"
            )
        page: AbstractContextManager[Dash] = nullcontext(recorded_page(where, beside))
    elif beside is not None:
        raise typer.BadParameter("--beside: needs a recorded run, not a live cell")
    elif shown is None and not where.is_file():
        raise typer.BadParameter("no cell.yaml here; name a cell file or the folder of a run")
    else:
        from dwell.live.host.security import environment

        page = live_page(where, environment(keys, insecure=insecure), control=control, mcap=mcap)
    from dwell.dash.serving import serve

    with page as served:
        serve(served, port, browser=not no_browser, say=say, token=kept)


def _kept(file: Path) -> str:
    """Return the token in a file; if the file is missing, write a new token to it."""
    from dwell.dash.gate import new_token
    from dwell.files import write_whole

    if not file.exists():
        write_whole(file, new_token(), private=True)
    token = file.read_text(encoding="utf-8").strip()
    if file.stat().st_mode & 0o007:
        raise typer.BadParameter(f"--token: every user here can read {file}; chmod o-rwx {file}")
    if not TOKEN.fullmatch(token):
        raise typer.BadParameter(f"--token: {file} has no token: 22 to 200 letters, digits, - or _")
    return token
