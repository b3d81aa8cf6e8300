"""`dwell testbed chaos`: inject faults into a cell, and check its promises."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from dwell.cli.options import Json, Seed, argument, flag, option
from dwell.cli.output import json_text, print_json, write_file
from dwell.errors import ExitCode
from dwell.live.log import say

#: File that marks the folder of a chaos campaign, which the next campaign may replace.
MARK = ".dwell-chaos"


def chaos(
    cell: Annotated[Path | None, argument("CELL", "Cell file; a light cell without it.")] = None,
    minutes: Annotated[float | None, option("N", "Start no fault later.", min=0.1)] = None,
    faults: Annotated[int | None, option("N", "Number of faults.", min=1)] = None,
    seed: Seed = 1,
    only: Annotated[
        int | None, option("N", "Inject only this fault of the timeline.", min=1)
    ] = None,
    out: Annotated[
        Path | None, option("FOLDER", "Folder for logs, runs and observations, which are kept.")
    ] = None,
    hosts: Annotated[
        bool, flag("--hosts", "Give each node its own host of a testbed; needs root.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Inject faults into a cell on this machine; check promises.

    One fault after another, drawn by the seed: processes are killed and frozen, links cut, clocks
    changed, CPUs and disks taken away. It takes two minutes without --minutes and --faults.
    """
    from dwell.live.local.playing import interruptible, make_folder
    from dwell_lab.chaos.disk import unmount_leftovers
    from dwell_lab.chaos.fault_campaign import FaultCampaign, Staging, summary

    if minutes is None and faults is None:
        minutes = 2.0
    folder = Path(tempfile.mkdtemp(prefix="dwell-chaos-")) if out is None else out
    if out is not None:
        unmount_leftovers(out)
        make_folder(out, MARK, "a chaos campaign's")
    what = ("" if cell is None else f" {cell}") + (" --hosts" if hosts else "")
    campaign = FaultCampaign(
        Staging(cell, folder, seed, hosts=hosts),
        f"dwell testbed chaos{what} --seed {seed}",
        say,
    )
    seconds = None if minutes is None else 60 * minutes
    result = campaign.result
    with interruptible():
        try:
            campaign.run(seconds=seconds, faults=1 if only is not None else faults, only=only)
        except KeyboardInterrupt:
            result.wrong.append("interrupted")
    document = result.document()
    if out is not None:
        write_file(out / "chaos.json", json_text(document))
    if as_json:
        print_json(document)
    else:
        for line in summary(document):
            typer.echo(line)
    if out is None:
        if result.wrong:
            typer.echo(f"logs and runs are kept in {folder}", err=True)
        else:
            shutil.rmtree(folder, ignore_errors=True)
    if result.wrong:
        raise typer.Exit(ExitCode.FAILED)
