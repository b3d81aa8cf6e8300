"""`dwell testbed campaign`: measure every policy in every scenario, or go on with that."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import typer

import dwell
from dwell.cli.exit_codes import ExitCode
from dwell.cli.output import print_json, working, write_report
from dwell.model import Problem
from dwell.report.campaign_page import campaign_page, campaign_text
from dwell.study.measured_campaign import MeasuredCampaign, read_measured
from dwell.testbed.campaign import (
    Campaign,
    default_entrants,
    default_scenarios,
    entrant,
)
from dwell.testbed.execution import Play, State, run_campaign
from dwell.testbed.playing import interruptible
from dwell.testbed.timeline import require_playable_scenario

PAGE = "report.html"


def run_campaign_file(
    cell: Path,
    *,
    scenarios: Sequence[str],
    policies: Sequence[str],
    repetitions: int,
    seconds: float,
    seed: int,
    out: Path | None,
    name: str,
    minutes: float | None,
    inventory: Path | None,
    report: bool,
    as_json: bool,
) -> bool:
    """Measure, write the report, and print what it comes to; None is the default.

    Parameters
    ----------
    scenarios, policies : sequence of str
        Empty for the default ones.
    seconds : float
        Of each run.
    name : str
        Of the testbed.
    inventory : Path or None
        Of real hosts, in place of the testbed.
    report : bool
        Whether nothing is measured: only the report of what is there is written.

    Returns
    -------
    bool
        Whether no run was given up.

    Raises
    ------
    DwellError
        If something asked for is wrong, this machine cannot do it, the folder holds something else,
        or the cell does not come up.
    typer.Exit
        If it was interrupted.
    """
    problem = dwell.load(cell)
    folder = out or Path("campaigns", re.sub(r"[^\w.-]", "_", problem.name))
    if report:
        report_campaign(folder, folder / PAGE, as_json=as_json)
        return True
    scenarios = tuple(scenarios) or default_scenarios(problem)
    entrants = tuple(entrant(problem, policy) for policy in policies)
    play, where = _player(inventory, problem, scenarios)
    campaign = Campaign(
        problem,
        scenarios,
        entrants or default_entrants(problem),
        repetitions,
        seconds,
        seed,
        where,
    )
    state = _run(campaign, folder, play, name, minutes)
    if state.done:
        measured = _write_page(folder, folder / PAGE)
        _print(measured, folder, folder / PAGE, state, as_json=as_json)
    else:
        typer.echo(f"no run is done; see {folder}", err=True)
    return not state.given_up and bool(state.done or state.left)


def _player(hosts: Path | None, problem: Problem, scenarios: Sequence[str]) -> tuple[Play, str]:
    """Return what makes a run, and where; refuse what can be played in no run."""
    outages = hosts is None
    for name in scenarios:
        require_playable_scenario(problem, name, outages=outages)
    if hosts is not None:
        from dwell.testbed.inventory import load_inventory
        from dwell.testbed.real_hosts import require_commands, run_on_hosts

        inventory = load_inventory(hosts, problem)
        require_commands(inventory, [item for name in scenarios for item in problem.scenario(name)])
        return partial(run_on_hosts, inventory), inventory.digest
    from dwell.testbed.run import require_machine, run_once

    require_machine([problem])
    return run_once, "testbed"


def _run(campaign: Campaign, folder: Path, play: Play, name: str, minutes: float | None) -> State:
    try:
        with interruptible():
            return run_campaign(
                campaign,
                folder,
                play,
                name=name,
                minutes=minutes,
                tell=partial(typer.echo, err=True),
            )
    except KeyboardInterrupt:
        done = len(list(folder.glob("runs/*/run.json")))
        typer.echo(
            f"interrupted: {done} of {len(campaign.plan())} runs are done and stay in {folder}; "
            "the same command goes on from there",
            err=True,
        )
        raise typer.Exit(ExitCode.INTERRUPTED) from None


def report_campaign(
    folder: Path,
    page: Path,
    *,
    figures: Path | None = None,
    static: bool = False,
    as_json: bool,
) -> None:
    """Write the report of a campaign, finished or not, and print what it comes to.

    Parameters
    ----------
    figures : Path, optional
        Folder for its figures and tables as files.
    static : bool
        Whether the page is without scripts.

    Raises
    ------
    RunError
        If the folder is no campaign, or none of its runs is done.
    """
    measured = _write_page(folder, page, figures=figures, static=static)
    _print(measured, folder, page, None, as_json=as_json)


def _write_page(
    folder: Path, page: Path, *, figures: Path | None = None, static: bool = False
) -> MeasuredCampaign:
    with working("writing the report"):
        measured = read_measured(folder)
        write_report(campaign_page(measured), page, figures=figures, static=static)
    return measured


def _print(
    measured: MeasuredCampaign, folder: Path, page: Path, state: State | None, *, as_json: bool
) -> None:
    if as_json:
        print_json(_told(measured, folder, page, state))
        return
    typer.echo(f"{campaign_text(measured)}\n\nruns: {folder}/runs\nreport: {page}")
    if state is not None and state.given_up:
        typer.echo(f"given up: {_listed(state.given_up)}", err=True)
    if state is not None and state.left:
        typer.echo(f"{state.left} runs are left; the same command goes on", err=True)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)


def _told(
    measured: MeasuredCampaign, folder: Path, page: Path, state: State | None
) -> dict[str, Any]:
    from dwell.study.campaign_questions import questions

    found: dict[str, Any] = {
        "folder": folder,
        "report": page,
        "planned": measured.planned,
        "done": measured.log.height,
        "repetitions": measured.repetitions,
        "excluded_windows": int(measured.log["excluded"].sum()),
        "failed_attempts": measured.failed.height,
        "given_up": [] if state is None else list(state.given_up),
        "questions": [
            {
                "question": one.title,
                "answer": one.answer,
                "verdict": one.answer,
                "comparisons": one.table.to_dicts(),
            }
            for one in questions(measured)
        ],
        "table": measured.comparison.table().to_dicts(),
        "profiles": measured.profiles.to_dicts(),
        "links": measured.links.to_dicts(),
    }
    return found
