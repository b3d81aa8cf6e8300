"""`dwell testbed campaign`: measure every policy in every scenario, or continue a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import dwell
from dwell.cli.completion import several_policies, several_scenarios
from dwell.cli.options import (
    CellArgument,
    Json,
    Seconds,
    Seed,
    TestbedName,
    Windows,
    flag,
    option,
)
from dwell.cli.output import file_name, interrupted, mark_of, print_json, working, write_report
from dwell.errors import ExitCode
from dwell.live.log import say
from dwell.model.bounds import counted
from dwell_lab.commands.lengths import seconds_of_runs

if TYPE_CHECKING:
    from dwell.model import Problem
    from dwell_lab.testbed.campaign import Campaign
    from dwell_lab.testbed.execution import Play, State
    from dwell_lab.validation.measured_campaign import MeasuredCampaign


def campaign(
    cell: CellArgument,
    scenarios: Annotated[
        str | None,
        option(
            "NAME,NAME",
            "Scenarios.",
            default="the paper's four",
            autocompletion=several_scenarios,
        ),
    ] = None,
    policies: Annotated[
        str | None,
        option(
            "NAME,NAME",
            "Policies, candidates, or policies with an estimator, such as cusum+corrected.",
            default="all candidates, atp, dtp, cusum+corrected",
            autocompletion=several_policies,
        ),
    ] = None,
    repetitions: Annotated[int, option("N", "Repetitions of each run.", min=1)] = 5,
    windows: Windows = None,
    seconds: Seconds = None,
    seed: Seed = 1,
    out: Annotated[
        Path | None, option("FOLDER", "Folder of the campaign.", default="campaigns/CELL")
    ] = None,
    name: TestbedName = "campaign",
    minutes: Annotated[
        float | None, option("N", "Start no run that would end later.", min=0)
    ] = None,
    inventory: Annotated[
        Path | None, option("FILE", "Real hosts (YAML), instead of this machine's testbed.")
    ] = None,
    report: Annotated[
        bool, flag("--report", "Measure nothing: report on the finished runs.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Measure all policies in all scenarios, in random order.

    Finished runs stay in the folder; the same command continues after an interruption. A run takes
    120 s without --windows and --seconds.
    """
    length_s = seconds_of_runs(cell, windows, seconds)
    problem = dwell.load(cell)
    folder = out or Path("campaigns", file_name(problem.name))
    page = folder / "report.html"
    if report:
        report_campaign(folder, page, as_json=as_json)
        return
    from dwell_lab.testbed.campaign import Campaign, default_entrants, default_scenarios, entrant

    played = _names(scenarios) or default_scenarios(problem)
    entrants = tuple(entrant(problem, policy) for policy in _names(policies))
    play, where = _player(inventory, problem, played)
    plan = Campaign(
        problem,
        played,
        entrants or default_entrants(problem),
        repetitions,
        length_s,
        seed,
        where,
    )
    state = _run(plan, folder, play, name, minutes)
    if state.done:
        _print(_write_page(folder, page), folder, page, state, as_json=as_json)
    else:
        typer.echo(f"no run is done; see {folder}", err=True)
    if state.given_up or not (state.done or state.left):
        raise typer.Exit(ExitCode.FAILED)


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def _player(hosts: Path | None, problem: Problem, scenarios: Sequence[str]) -> tuple[Play, str]:
    """Return the function that makes a run, and its place; raise if a scenario cannot be run."""
    from dwell.live.local.timeline import require_playable_scenario

    outages = hosts is None
    for name in scenarios:
        require_playable_scenario(problem, name, outages=outages)
    if hosts is not None:
        from dwell_lab.testbed.inventory import load_inventory
        from dwell_lab.testbed.real_hosts import require_commands, run_on_hosts

        inventory = load_inventory(hosts, problem)
        require_commands(inventory, [item for name in scenarios for item in problem.scenario(name)])
        return partial(run_on_hosts, inventory), inventory.digest
    from dwell_lab.testbed.run import require_machine, run_once

    require_machine(problem)
    return run_once, "testbed"


def _run(campaign: Campaign, folder: Path, play: Play, name: str, minutes: float | None) -> State:
    from dwell.live.local.playing import interruptible
    from dwell_lab.testbed.execution import run_campaign

    try:
        with interruptible():
            return run_campaign(
                campaign,
                folder,
                play,
                name=name,
                minutes=minutes,
                tell=say,
            )
    except KeyboardInterrupt:
        done, planned = len(list(folder.glob("runs/*/run.json"))), len(campaign.plan())
        interrupted(
            f"{done} of {counted(planned, 'run')} are done and stay in {folder}; the same command "
            "continues"
        )


def report_campaign(
    folder: Path,
    page: Path,
    *,
    figures: Path | None = None,
    static: bool = False,
    as_json: bool,
) -> None:
    """Write the report of a campaign, also before its end (`write_report`), and print its results.

    Raises
    ------
    RunError
        If the folder is not a campaign, or has no finished run.
    """
    measured = _write_page(folder, page, figures=figures, static=static)
    _print(measured, folder, page, None, as_json=as_json)


def _write_page(
    folder: Path, page: Path, *, figures: Path | None = None, static: bool = False
) -> MeasuredCampaign:
    from dwell_lab.pages.campaign_page import campaign_page
    from dwell_lab.validation.measured_campaign import read_measured

    with working("writing the report"):
        measured = read_measured(folder)
        mark = mark_of(str(folder.resolve()))
        write_report(campaign_page(measured), page, figures=figures, static=static, mark=mark)
    return measured


def _print(
    measured: MeasuredCampaign, folder: Path, page: Path, state: State | None, *, as_json: bool
) -> None:
    if as_json:
        print_json(_document(measured, folder, page, state))
        return
    from dwell_lab.pages.campaign_page import campaign_text

    typer.echo(f"{campaign_text(measured)}\n\nruns: {folder}/runs\nreport: {page}")
    if state is not None and state.given_up:
        typer.echo(f"given up: {', '.join(state.given_up)}", err=True)
    if state is not None and state.left:
        typer.echo(f"{counted(state.left, 'run')} left; the same command continues", err=True)


def _document(
    measured: MeasuredCampaign, folder: Path, page: Path, state: State | None
) -> dict[str, Any]:
    from dwell_lab.validation.campaign_questions import questions

    return {
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
