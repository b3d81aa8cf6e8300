"""Execution of a campaign: its runs in sequence, with resume after an interruption.

The folder alone (`dwell_lab.testbed.campaign_folder`) records the completed runs, and a run's
folder appears complete, in one step. So a stopped campaign can always resume.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

from dwell.cellfile.work_folder import open_work_folder, unwritable
from dwell.errors import DwellError, LiveError
from dwell.files import write_whole
from dwell.model import Problem
from dwell.record import Run, open_run
from dwell_lab.testbed.campaign import Campaign, Planned
from dwell_lab.testbed.campaign_folder import ATTEMPT, CAMPAIGN, FAILED, RUNS
from dwell_lab.testbed.idle import Idle, Quiet, wait_until_idle

#: Folder of the current run, in a campaign's folder.
WORK = ".work"
#: Number of repeats of a failed run.
REPEATS = 2
#: Give up the campaign if its first attempts all end with an error.
HOPELESS = 3
#: Estimated time of a run beyond its length, until the first run has been timed.
AROUND_S = 20.0

Tell: TypeAlias = Callable[[str], None]
Wait: TypeAlias = Callable[[Quiet], Idle]


class Play(Protocol):
    """A function that makes a run, as `dwell_lab.testbed.run.run_once` does."""

    def __call__(
        self,
        problem: Problem,
        *,
        scenario: str,
        policy: str,
        seconds: float,
        seed: int,
        out: Path,
        name: str,
        jobs: bool,
    ) -> Path:
        """Return the folder of the run, below `out`."""


class State(NamedTuple):
    """Progress of a campaign.

    `planned` and `done` count runs, `given_up` names runs that failed in every repeat, and
    `failures` counts all failed attempts, also of completed runs.
    """

    planned: int
    done: int
    given_up: tuple[str, ...]
    failures: int

    @property
    def left(self) -> int:
        """Number of runs that are neither done nor given up."""
        return self.planned - self.done - len(self.given_up)


def run_campaign(
    campaign: Campaign,
    folder: Path,
    play: Play,
    *,
    name: str = "campaign",
    quiet: Quiet | None = None,
    repeats: int = REPEATS,
    minutes: float | None = None,
    tell: Tell = print,
    wait: Wait = wait_until_idle,
    clock: Callable[[], float] = time.monotonic,
) -> State:
    """Make the missing runs of a campaign.

    A run fails if its cell does not start, or if too many of its windows were under pressure.
    Failed runs are repeated after all other runs, up to `repeats` times each. An existing folder
    of the same campaign is resumed. `name` is the testbed's name on this machine. `quiet` sets
    when the machine counts as idle before a run. A run that would end after `minutes` is not
    started. `tell` receives a line per event.

    Raises `RunError` if the folder has other content, another campaign, or runs of other software;
    `SimulationError` if the folder cannot be written; `LiveError` if the first attempts all end
    with an error.
    """
    with open_work_folder(folder, CAMPAIGN, campaign.describe()):
        _keep_traces(campaign, folder)
        attempts = _Attempts(campaign, folder, partial(play, name=name), wait, quiet or Quiet())
        shutil.rmtree(folder / WORK, ignore_errors=True)
        begun_s, expected_s = clock(), campaign.seconds + AROUND_S
        for planned in attempts.in_turn(repeats):
            before_s = clock()
            if minutes is not None and before_s - begun_s + expected_s > minutes * 60:
                tell(f"stopped: another run would end after the {minutes:g} minutes")
                break
            number = attempts.failed(planned) + 1
            again = f", attempt {number}" if number > 1 else ""
            tell(
                f"{planned.place}/{len(attempts.plan)} {planned.scenario}, {planned.policy}{again}"
            )
            record = attempts.make(planned, number)
            expected_s = clock() - before_s
            if record["outcome"] != "done":
                tell(f"  {record['outcome']}: {record['reason']}")
            if attempts.errors == HOPELESS:
                raise LiveError(
                    f"the first {HOPELESS} runs ended with an error; the last error: "
                    f"{record['reason']}; see {folder / FAILED}"
                )
        shutil.rmtree(folder / WORK, ignore_errors=True)
        return attempts.state(repeats)


def _keep_traces(campaign: Campaign, folder: Path) -> None:
    """Copy the trace files of the cell, so the folder can be read without the original cell."""
    for kept, file in campaign.traces.items():
        if not (folder / kept).exists():
            try:
                write_whole(folder / kept, file.read_bytes())
            except OSError as error:
                raise unwritable(folder / kept, error) from None


class _Attempts:
    """The attempts at a campaign's runs, and their folders.

    `errors` counts the attempts from the start that all ended with an error; it stops increasing
    at the first attempt without an error.
    """

    def __init__(
        self,
        campaign: Campaign,
        folder: Path,
        play: Callable[..., Path],
        wait: Wait,
        quiet: Quiet,
    ) -> None:
        self.campaign, self.folder, self.play = campaign, folder, play
        self.wait, self.quiet = wait, quiet
        self.plan = campaign.plan()
        self.errors = 0
        self._worked = any(self.has(one) for one in self.plan)

    def in_turn(self, repeats: int) -> Iterator[Planned]:
        """Yield the runs to make: first the untried runs, then the failed runs, round by round."""
        for attempts in range(repeats + 1):
            for planned in self.plan:
                if not self.has(planned) and self.failed(planned) <= attempts:
                    yield planned

    def has(self, planned: Planned) -> bool:
        """Whether a run is done."""
        return (self.folder / RUNS / planned.name / ATTEMPT).is_file()

    def failed(self, planned: Planned) -> int:
        """Return the number of failed attempts at a run."""
        return len(list((self.folder / FAILED).glob(f"{planned.name}.*")))

    def make(self, planned: Planned, number: int) -> Mapping[str, Any]:
        """Make a run once, and move it to its folder."""
        one = next(one for one in self.campaign.entrants if one.name == planned.policy)
        idle = self.wait(self.quiet)
        work = self.folder / WORK
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        record: dict[str, Any] = {
            **planned._asdict(),
            "estimator": one.estimator,
            "attempt": number,
            "idle": {**idle._asdict(), "rule": asdict(self.quiet)},
            "began_unix_s": round(time.time(), 3),
        }
        run: Path | None = None
        try:
            run = self.play(
                one.problem(self.campaign.problem),
                scenario=planned.scenario,
                policy=one.policy,
                seconds=self.campaign.seconds,
                seed=planned.seed,
                out=work,
                jobs=True,
            )
            record |= _judged(open_run(run))
        except DwellError as error:
            record |= {"outcome": "error", "reason": str(error)}
        record["ended_unix_s"] = round(time.time(), 3)
        self._keep(planned, number, record, run if record["outcome"] == "done" else None)
        failed = record["outcome"] == "error"
        self._worked = self._worked or not failed
        self.errors += failed and not self._worked
        return record

    def _keep(
        self, planned: Planned, number: int, record: Mapping[str, Any], run: Path | None
    ) -> None:
        """Move a run to the done runs, or the remains of an attempt to the failed attempts."""
        source = self.folder / WORK if run is None else run
        place = self.folder / (FAILED if run is None else RUNS)
        target = place / (f"{planned.name}.{number}" if run is None else planned.name)
        try:
            text = json.dumps(record, indent=2, allow_nan=False)
            write_whole(source / ATTEMPT, f"{text}\n")
            source.rename(target)
        except OSError as error:
            raise unwritable(target, error) from None

    def state(self, repeats: int) -> State:
        """Return the progress of the campaign."""
        undone = [one for one in self.plan if not self.has(one)]
        return State(
            planned=len(self.plan),
            done=len(self.plan) - len(undone),
            given_up=tuple(one.name for one in undone if self.failed(one) > repeats),
            failures=sum(map(self.failed, self.plan)),
        )


def _judged(run: Run) -> dict[str, Any]:
    """Judge whether a run counts: it has windows, and few enough of them are excluded."""
    pressure = run.meta.get("pressure") or {}
    excluded, windows = len(pressure.get("excluded", ())), int((~run.windows["warmup"]).sum())
    if pressure.get("failed"):
        why = f" ({pressure['why']})" if pressure.get("why") else ""
        after = f"{windows} windows after the warm-up"
        reason = f"{excluded} of {after} were measured under pressure{why}"
        return {"outcome": "failed", "reason": reason}
    if not windows:
        return {"outcome": "failed", "reason": "it has no window after the warm-up"}
    return {"outcome": "done", "reason": "", "windows": windows, "excluded": excluded}
