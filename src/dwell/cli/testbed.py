"""`dwell testbed`: cells on hosts, links and CPUs of their own, on one machine."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from dwell.cli.exit_codes import ExitCode
from dwell.cli.options import (
    CellArgument,
    Json,
    Policy,
    Scenario,
    Seconds,
    Seed,
    Windows,
    require_one_length,
)
from dwell.cli.output import aligned, print_json

Name = Annotated[str, typer.Option(help="Of the testbed, among others on this machine.")]

testbed = typer.Typer(
    no_args_is_help=True,
    help="Run cells on hosts, links and CPUs of their own on this machine, and measure them.",
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
        typer.Option(
            metavar="FOLDER",
            help="Where logs and the run go; below testbed-out if not given.",
        ),
    ] = None,
    name: Name = "bed",
    jobs: Annotated[bool, typer.Option("--jobs", help="Keep every job of the run.")] = False,
    as_json: Json = False,
) -> None:
    """Play a scenario once, and take everything down again. Needs root.

    60 windows, if neither --windows nor --seconds is given.
    """
    import dwell
    from dwell.testbed.run import length_s, run_once

    require_one_length(windows, seconds)
    problem = dwell.load(cell)
    folder = out or _folder(problem.name, scenario, policy or problem.controller.policy, seed)
    found = run_once(
        problem,
        scenario=scenario,
        policy=policy,
        seconds=seconds or length_s(problem, windows or 60),
        seed=seed,
        out=folder,
        name=name,
        jobs=jobs,
        tell=_say,
    )
    _sum_up(found, as_json=as_json)


def _folder(*parts: object) -> Path:
    """Return the folder of a run that names none; a name may hold what a file name may not."""
    return Path("testbed-out", re.sub(r"[^\w.-]", "_", "-".join(map(str, parts))))


def _sum_up(folder: Path, *, as_json: bool) -> None:
    """Print what the run showed; it has failed where the machine was under pressure."""
    import dwell
    from dwell.testbed.run import summary

    found = dwell.open_run(folder)
    pressure = found.meta.get("pressure") or {}
    told = summary(found)
    failed = bool(pressure.get("failed"))
    if as_json:
        head = {key: found.meta.get(key) for key in ("cell", "scenario", "seed", "policy")}
        print_json({**head, **told, "failed": failed, "why": pressure.get("why"), "run": folder})
    else:
        typer.echo(_lines(told))
        typer.echo(f"\nrun: {folder}")
    if failed:
        _say(
            f"error: the machine was the bottleneck in {told['excluded']} of {told['windows']} "
            f"windows ({pressure['why']}); run it on a machine that does nothing else"
        )
        raise typer.Exit(ExitCode.FAILED)


def _lines(told: dict[str, Any]) -> str:
    def number(value: float | None, scale: float, unit: str) -> str:
        return "-" if value is None else f"{scale * value:.1f} {unit}"

    rows = [
        ("windows after the warm-up", str(told["windows"])),
        ("excluded: the machine was the bottleneck", str(told["excluded"])),
        ("L95, mean of windows", number(told["l95_ms"], 1.0, "ms")),
        ("missed deadlines (V_D)", number(told["violation_rate"], 100.0, "%")),
        ("migrations", str(told["migrations"])),
    ]
    rows += [
        (f"utilisation of {node}", number(used, 100.0, "%"))
        for node, used in told["utilisation"].items()
    ]
    return aligned(("", ""), rows).lstrip("\n")


@testbed.command()
def doctor(
    cells: Annotated[
        list[Path] | None, typer.Argument(metavar="CELL...", help="Cell files to have checked too.")
    ] = None,
    watch: Annotated[
        float,
        typer.Option(
            min=0, metavar="SECONDS", help="Watch for so long whether the machine stands still."
        ),
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Say what this machine can do as a testbed and what it cannot, and what to install."""
    import dwell
    from dwell.cli.doctor import print_findings
    from dwell.testbed.doctor import examine

    findings = examine([dwell.load(cell) for cell in cells or ()], watch_s=watch)
    missing = [one for one in findings if one.needed and not one.ok]
    if as_json:
        rows = [asdict(one) for one in findings]
        print_json({"ok": not missing, "findings": rows})
    else:
        print_findings(findings, broken="MISSING", lacking="without")
    if missing:
        raise typer.Exit(ExitCode.FAILED)


@testbed.command()
def campaign(
    cell: CellArgument,
    scenarios: Annotated[
        str | None,
        typer.Option(metavar="NAME,NAME", help="The paper's four if not given."),
    ] = None,
    policies: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME",
            help="Policies, candidates, or policies with an estimator, as cusum+corrected; all "
            "candidates, atp, dtp and cusum+corrected if not given.",
        ),
    ] = None,
    repetitions: Annotated[int, typer.Option(min=1, help="Of everything.")] = 5,
    windows: Windows = None,
    seconds: Seconds = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Of the campaign; campaigns/CELL if not given."),
    ] = None,
    name: Name = "campaign",
    minutes: Annotated[
        float | None, typer.Option(min=0, help="Begin no run that would end after these.")
    ] = None,
    inventory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Real hosts (YAML), instead of this machine's testbed."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Measure nothing: report on what is there.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Measure every policy in every scenario again and again, in random order, and report.

    What is done stays in the folder, whatever ends the work: the same command goes on. A run takes
    120 s, if neither --windows nor --seconds is given.
    """
    from dwell.cli.campaign import run_campaign_file

    done = run_campaign_file(
        cell,
        scenarios=_names(scenarios),
        policies=_names(policies),
        repetitions=repetitions,
        seconds=_run_s(cell, windows, seconds),
        seed=seed,
        out=out,
        name=name,
        minutes=minutes,
        inventory=inventory,
        report=report,
        as_json=as_json,
    )
    if not done:
        raise typer.Exit(ExitCode.FAILED)


def _run_s(cell: Path, windows: int | None, seconds: float | None) -> float:
    """Return how long each run of several takes, seconds."""
    import dwell
    from dwell.testbed.run import length_s

    require_one_length(windows, seconds)
    if windows is not None:
        return length_s(dwell.load(cell), windows)
    return 120.0 if seconds is None else seconds


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


@testbed.command()
def calibrate(
    cell: CellArgument,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Cell file to write.")],
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RUN...",
            help="Folders of runs with their jobs: baseline, and single-task stress. Without any, "
            "the baseline is run under every candidate.",
        ),
    ] = None,
    windows: Windows = None,
    seconds: Seconds = None,
    seed: Seed = 1,
    name: Name = "calibrate",
    real: Annotated[
        bool,
        typer.Option("--real-links", help="Links are real: their delays are what was measured."),
    ] = False,
) -> None:
    """Put what runs have shown of tasks and links into a cell file.

    A run that is made takes 120 s, if neither --windows nor --seconds is given.
    """
    from dwell.testbed.calibrate import calibrate as write_calibrated
    from dwell.testbed.calibrate import make_runs

    if not runs:
        folder = out.with_name(f"{out.stem}.runs")
        length = _run_s(cell, windows, seconds)
        runs = make_runs(cell, folder, seconds=length, seed=seed, name=name, tell=_say)
    write_calibrated(cell, runs, out, emulated=not real, say=typer.echo)
    typer.echo(f"written to {out}")


def _say(line: str) -> None:
    typer.echo(line, err=True)


@testbed.command()
def chaos(
    cell: Annotated[
        Path | None,
        typer.Argument(metavar="[CELL]", help="Cell file; a light cell if not given."),
    ] = None,
    minutes: Annotated[float | None, typer.Option(min=0.1, help="No fault begins later.")] = None,
    faults: Annotated[int | None, typer.Option(min=1, help="How many.")] = None,
    seed: Seed = 1,
    only: Annotated[
        int | None, typer.Option(min=1, help="Nothing but this fault of the timeline.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where logs, runs and what was seen go, to be kept."),
    ] = None,
    hosts: Annotated[
        bool,
        typer.Option("--hosts", help="Every node on a host of its own of a testbed; needs root."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Have faults befall a cell on this machine, and watch whether it keeps its promises.

    Processes are killed and frozen, links cut, clocks set wrong, CPUs and disks taken away, one
    after the other, by a seed, for two minutes if nothing else is said.
    """
    from dwell.cli.chaos import run_chaos

    run_chaos(cell, minutes, faults, seed, only, out, hosts=hosts, as_json=as_json)
