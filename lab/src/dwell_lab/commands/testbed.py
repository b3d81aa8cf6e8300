"""`dwell testbed`: cells on emulated hosts with links and CPU quotas, on one machine."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dwell.cli.options import (
    CellArgument,
    Json,
    Policy,
    Scenario,
    Seconds,
    Seed,
    TestbedName,
    Windows,
    argument,
    flag,
    option,
    require_one_length,
)
from dwell.cli.output import aligned, file_name, print_json
from dwell.errors import ExitCode
from dwell.live.log import say
from dwell.model.table_columns import USE_OF
from dwell_lab.commands.campaign import campaign
from dwell_lab.commands.chaos import chaos
from dwell_lab.commands.lengths import seconds_of_runs

if TYPE_CHECKING:
    from dwell.study.metric import Metric

testbed = typer.Typer(
    no_args_is_help=True,
    help="Run cells on emulated hosts of this machine; measure them.",
)


@testbed.command()
def run(
    cell: CellArgument,
    scenario: Scenario = "baseline",
    policy: Policy = None,
    windows: Windows = None,
    seconds: Seconds = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        option("FOLDER", "Folder for logs and the run.", default="below testbed-out"),
    ] = None,
    name: TestbedName = "bed",
    jobs: Annotated[bool, flag("--jobs", "Keep every job of the run.")] = False,
    as_json: Json = False,
) -> None:
    """Run a scenario once, then remove everything. Needs root.

    The run has 60 windows without --windows and --seconds.
    """
    import dwell
    from dwell_lab.testbed.run import length_s, run_once

    require_one_length(windows, seconds)
    problem = dwell.load(cell)
    parts = (problem.name, scenario, policy or problem.controller.policy, str(seed))
    folder = out or Path("testbed-out", file_name("-".join(parts)))
    saved = run_once(
        problem,
        scenario=scenario,
        policy=policy,
        seconds=seconds or length_s(problem, windows or 60),
        seed=seed,
        out=folder,
        name=name,
        jobs=jobs,
        tell=say,
    )
    _sum_up(saved, as_json=as_json)


def _sum_up(folder: Path, *, as_json: bool) -> None:
    """Print the results of a run; exit with an error if the machine was the bottleneck."""
    import dwell
    from dwell_lab.testbed.run import summary

    result = dwell.open_run(folder)
    pressure = result.meta.get("pressure") or {}
    totals = summary(result)
    failed = bool(pressure.get("failed"))
    if as_json:
        head = {key: result.meta.get(key) for key in ("cell", "scenario", "seed", "policy")}
        print_json({**head, **totals, "failed": failed, "why": pressure.get("why"), "run": folder})
    else:
        typer.echo(_lines(totals))
        typer.echo(f"\nrun: {folder}")
    if failed:
        say(
            f"error: the machine was the bottleneck in {totals['excluded']} of {totals['windows']} "
            f"windows ({pressure['why']}); run it on a machine that does nothing else"
        )
        raise typer.Exit(ExitCode.FAILED)


def _text(metric: Metric, value: float | None) -> str:
    return "-" if value is None else metric.text(value)


def _lines(totals: dict[str, Any]) -> str:
    from dwell.study.metric import METRICS, metric_of

    shown = (METRICS[name] for name in ("l95_ms", "violation_rate", "migrations"))
    used = {USE_OF.format(resource=name): use for name, use in totals["utilisation"].items()}
    rows = [
        ("windows after the warm-up", str(totals["windows"])),
        ("excluded: the machine was the bottleneck", str(totals["excluded"])),
        *((metric.title, _text(metric, totals[metric.column])) for metric in shown),
        *((metric_of(column).title, _text(metric_of(column), use)) for column, use in used.items()),
    ]
    return aligned(("", ""), rows).lstrip("\n")


@testbed.command()
def doctor(
    cells: Annotated[list[Path] | None, argument("CELL", "Cell files to check as well.")] = None,
    watch: Annotated[
        float, option("SECONDS", "Time to watch for pauses of the machine.", min=0)
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Check whether this machine can be a testbed."""
    import dwell
    from dwell.cli.findings import print_findings
    from dwell_lab.testbed.doctor import examine

    findings = examine([dwell.load(cell) for cell in cells or ()], watch_s=watch)
    missing = [one for one in findings if one.needed and not one.ok]
    if as_json:
        rows = [asdict(one) for one in findings]
        print_json({"ok": not missing, "findings": rows})
    else:
        print_findings(findings, broken="MISSING", lacking="without")
    if missing:
        raise typer.Exit(ExitCode.FAILED)


testbed.command()(campaign)


@testbed.command()
def calibrate(
    cell: CellArgument,
    out: Annotated[Path, option("FILE", "Cell file to write.")],
    runs: Annotated[
        list[Path] | None,
        argument(
            "RUN",
            "Folders of runs with their jobs: baseline and single-task stress. Without them, "
            "the baseline is run under every candidate.",
        ),
    ] = None,
    windows: Windows = None,
    seconds: Seconds = None,
    seed: Seed = 1,
    name: TestbedName = "calibrate",
    real: Annotated[
        bool, flag("--real-links", "Links are real: take the measured delays as theirs.")
    ] = False,
) -> None:
    """Write measured tasks and links into a cell file.

    Each new run takes 120 s without --windows and --seconds.
    """
    from dwell_lab.testbed.calibrate import calibrate as write_calibrated
    from dwell_lab.testbed.calibrate import make_runs

    if not runs:
        folder = out.with_name(f"{out.stem}.runs")
        length_s = seconds_of_runs(cell, windows, seconds)
        runs = make_runs(cell, folder, seconds=length_s, seed=seed, name=name, tell=say)
    write_calibrated(cell, runs, out, emulated=not real, say=typer.echo)
    typer.echo(f"written to {out}")


testbed.command()(chaos)
