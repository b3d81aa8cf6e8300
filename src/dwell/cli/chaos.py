"""`dwell testbed chaos`: faults befall a cell, and somebody watches what it promises."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import typer

from dwell.cli.exit_codes import ExitCode
from dwell.cli.output import json_text, print_json, write_file

#: A folder with this file is a campaign's, and may be replaced by the next.
MARK = ".dwell-chaos"


def run_chaos(
    cell: Path | None,
    minutes: float | None,
    faults: int | None,
    seed: int,
    only: int | None,
    out: Path | None,
    *,
    hosts: bool,
    as_json: bool,
) -> None:
    """Run a campaign, and say what came of it.

    Raises
    ------
    DwellError
        If the cell does not come up, or the folder holds something else.
    """
    from dwell.testbed.chaos.disk import unmount_leftovers
    from dwell.testbed.chaos.fault_campaign import FaultCampaign, on_hosts, on_loopback, summary
    from dwell.testbed.playing import interruptible, make_folder

    if minutes is None and faults is None:
        minutes = 2.0
    folder = Path(tempfile.mkdtemp(prefix="dwell-chaos-")) if out is None else out
    if out is not None:
        unmount_leftovers(out)
        make_folder(out, MARK, "a chaos campaign's")
    what = ("" if cell is None else f" {cell}") + (" --hosts" if hosts else "")
    staging = on_hosts if hosts else on_loopback
    campaign = FaultCampaign(
        staging(cell, folder, seed),
        folder,
        seed,
        f"dwell testbed chaos{what} --seed {seed}",
        lambda line: typer.echo(line, err=True),
    )
    until_s = None if minutes is None else time.monotonic() + 60 * minutes
    result = campaign.result
    with interruptible():
        try:
            campaign.run(until_s=until_s, faults=1 if only is not None else faults, only=only)
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
            typer.echo(f"what there was is kept in {folder}", err=True)
        else:
            shutil.rmtree(folder, ignore_errors=True)
    if result.wrong:
        raise typer.Exit(ExitCode.FAILED)
