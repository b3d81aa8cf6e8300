"""FaultCampaign: injects the faults of a timeline into a cell one by one, and judges the cell."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from dwell.cellfile import load
from dwell.cellfile.yaml_text import yaml_of
from dwell.errors import DwellError, LiveError
from dwell.live.local.loopback import Loopback, on_this_machine
from dwell.live.local.testbed import LocalTestbed
from dwell.model import FrozenDict, Problem
from dwell_lab.chaos.disk import may_mount
from dwell_lab.chaos.faults import PlannedFault, bound_of, faults_of, planned
from dwell_lab.chaos.harness import CLOCK_FILE, STARVING_THREADS, Harness, environment_of
from dwell_lab.chaos.light_cell import PATIENT_MS, document, exec_ms
from dwell_lab.chaos.stalls import StallDetector
from dwell_lab.chaos.strike import (
    Outcome,
    beyond,
    moved_in_vain,
    recovered,
    strike,
    too_old,
)
from dwell_lab.chaos.wiretap import ActuatorObserver
from dwell_lab.testbed.netns_testbed import NetnsTestbed

LIGHT_HOME = "SO"
#: Seconds to wait for messages on their way to a wiretap.
HEARD_S = 0.15


@dataclass(frozen=True, slots=True)
class Staging:
    """Settings for the testbeds of a campaign; each cell gets its own folder.

    Parameters
    ----------
    cell : Path, optional
        Cell file; the light cell if omitted.
    hosts : bool
        Whether every node runs on its own host of a network testbed, which needs root; otherwise
        all nodes use this computer's loopback.
    """

    cell: Path | None
    out: Path
    seed: int
    hosts: bool = False

    def testbed(self, number: int) -> tuple[LocalTestbed, str | None]:
        """Return the testbed and the home of a cell, by its number in the campaign."""
        folder = (self.out / f"cell-{number}").resolve()
        folder.mkdir(parents=True, exist_ok=True)
        home = LIGHT_HOME if self.cell is None else None
        if self.cell is None:
            written = folder / "written.yaml"
            light = document(LIGHT_HOME, period_ms=PATIENT_MS, quotas=self.hosts)
            written.write_text(yaml_of(light), encoding="utf-8")
            problem, environment = load(written), environment_of(folder, exec_ms(LIGHT_HOME))
        else:
            problem, environment = _witnessed(load(self.cell), folder)
        clocks = folder / CLOCK_FILE
        testbed: LocalTestbed
        if self.hosts:
            testbed = NetnsTestbed(
                *(problem, folder),
                name=f"chaos{os.getpid() % 10_000}",
                seed=self.seed,
                environment=environment,
                clocks=clocks,
            )
        else:
            testbed = Loopback(
                *(on_this_machine(problem), folder, {}),
                seed=self.seed,
                environment=environment,
                clocks=clocks,
            )
        return testbed, home


def _witnessed(problem: Problem, folder: Path) -> tuple[Problem, dict[str, str]]:
    """Return a cell that logs each call of its actuator, and the environment that this needs."""
    actuators = dict(problem.live.actuators)
    if len(actuators) != 1:
        raise LiveError("chaos needs a cell with one sink, whose actuator live.actuators names")
    if not all(isinstance(one, str) for one in actuators.values()):
        raise LiveError("chaos cannot watch a ROS 2 topic: give live.actuators a module:Name")
    witnessed = FrozenDict(dict.fromkeys(actuators, "dwell_lab.chaos.stages:Witnessed"))
    environment = environment_of(folder, {}, actuators=actuators)
    return replace(problem, live=replace(problem.live, actuators=witnessed)), environment


@dataclass(slots=True)
class Result:
    """Result of a campaign.

    Parameters
    ----------
    stalled : int
        Number of faults with violations that a stall of the machine excuses.
    wrong : list of str
        Violations, each with its fault and the command that repeats it.
    heard : dict of str to int
        Number of checked messages, by kind.
    means : dict of str to str
        How faults that need special rights or machines were produced, by kind.
    """

    seed: int
    outcomes: list[tuple[PlannedFault, Outcome]] = field(default_factory=list)
    stalled: int = 0
    wrong: list[str] = field(default_factory=list)
    heard: Counter[str] = field(default_factory=Counter)
    actuated: int = 0
    seconds: float = 0.0
    means: dict[str, str] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return the result as a document for JSON."""
        bounded = [o for _, o in self.outcomes if o.bound is not None]
        return {
            "seed": self.seed,
            "faults": len(self.outcomes),
            "kinds": dict(sorted(Counter(one.fault.kind for one, _ in self.outcomes).items())),
            "bounded": len(bounded),
            "most_lost_where_bounded": max((max(o.lost, o.lost_after) for o in bounded), default=0),
            "slowest_recovery_ms": max((o.recovery_ms for _, o in self.outcomes), default=0.0),
            "stalled": self.stalled,
            "violations": self.wrong,
            "heard": self.heard,
            "actuated": self.actuated,
            "seconds": round(self.seconds, 1),
            "means": self.means,
        }


class FaultCampaign:
    """A campaign of faults.

    Parameters
    ----------
    staging : Staging
        Its folder also gets ``faults.jsonl``.
    again : str
        Command that repeats the campaign; messages append ``--only`` and the number of a fault.
    """

    def __init__(
        self,
        staging: Staging,
        again: str,
        say: Callable[[str], None],
    ) -> None:
        self._staging, self._out, self._seed = staging, staging.out, staging.seed
        self._again, self._say = again, say
        self._disks = may_mount()
        # On the clock of `time.monotonic`; set when the first cell has started.
        self._until_s: float | None = None
        self.result = Result(self._seed)
        self.result.means = {
            "full disk": "a tmpfs in place of each folder, made as small as what is on it"
            if self._disks
            else "RLIMIT_FSIZE of the controller; not root, so no disk of a node is filled",
            "slow disk": "writers beside that wait for every write; the wait is measured",
            "starving": f"{STARVING_THREADS} busy threads on the one CPU that the node has then",
            "clocks": "an offset and a rate that the node's processes add to what they read",
        }

    def run(
        self, *, seconds: float | None = None, faults: int | None = None, only: int | None = None
    ) -> Result:
        """Inject faults into cells, and judge the cells.

        Parameters
        ----------
        seconds : float, optional
            Time after the start of the first cell within which faults are taken from the timeline.
        only : int, optional
            Number of the only fault to inject.

        Raises
        ------
        LiveError
            If a cell does not start.
        """
        begin_s = time.monotonic()
        number, waiting = 0, None
        plan = self._plan(faults, only)
        with StallDetector() as stalls:
            while waiting is not None or number == 0:
                number += 1
                waiting = self._cell(number, plan, waiting, stalls, seconds)
        self.result.seconds = time.monotonic() - begin_s
        if not self.result.outcomes:
            self.result.wrong.append("no fault has befallen the cell: nothing was watched")
        return self.result

    def _plan(self, faults: int | None, only: int | None) -> Any:
        testbed, _ = self._staging.testbed(1)
        light = self._staging.cell is None
        faults_here = list(faults_of(testbed.problem, disks=self._disks, stages=light))
        timeline = planned(self._seed, faults_here)
        if only is not None:
            return islice(timeline, only - 1, only)
        return iter(timeline) if faults is None else islice(timeline, faults)

    def _cell(
        self,
        number: int,
        plan: Any,
        first: PlannedFault | None,
        stalls: StallDetector,
        seconds: float | None,
    ) -> PlannedFault | None:
        """Inject faults into one cell; if the cell does not recover, return the next fault."""
        testbed, home = self._staging.testbed(number)
        with ExitStack() as stack:
            cell = stack.enter_context(Harness(testbed, home=home, disks=self._disks))
            observer = stack.enter_context(ActuatorObserver(testbed, testbed.folder / "cell.yaml"))
            if seconds is not None and self._until_s is None:
                self._until_s = time.monotonic() + seconds
            while True:
                one = first or next(plan, None)
                first = None
                late = self._until_s is not None and time.monotonic() > self._until_s
                if one is None or late:
                    break
                stalls.stalls.clear()
                if not self._one(cell, observer, one, stalls):
                    self._count(cell, observer)
                    return next(plan, None)
            self._count(cell, observer)
            cell.testbed.processes.stop_controller()
            self.result.wrong += [f"record: {wrong}" for wrong in _unread(cell)]
        return None

    def _one(
        self, cell: Harness, observer: ActuatorObserver, one: PlannedFault, stalls: StallDetector
    ) -> bool:
        """Inject a fault into a cell; return whether the cell is still usable."""
        fault = one.fault
        outcome = Outcome(fault.name, self._seed, one.phase)
        usable, term = True, -1
        try:
            _settle(cell, one.rests_s, outcome)
            outcome.wrong += observer.look()
            judge = observer.judge
            term = max(judge.terms)
            placement = judge.terms[term].placement
            lasts = max(round(one.lasts_s * 1e9 / cell.period_ns), 1)
            strike(
                *(cell, fault, stalls),
                phase=one.phase,
                seed=self._seed,
                lasts=lasts,
                bound=bound_of(cell.problem, fault, placement),
                outcome=outcome,
            )
            time.sleep(HEARD_S)
            outcome.wrong += cell.ended(fault)
        except DwellError as error:
            outcome.wrong += [str(error), *cell.ended(fault)]
            outcome.stall_ms = stalls.worst_ms(outcome.begin_ns, time.monotonic_ns())
            usable = False
        outcome.wrong += observer.look()
        outcome.late += _untrue(cell, observer)
        if usable:
            recovered(observer.judge, outcome, cell.home)
            outcome.late += [*beyond(outcome), *moved_in_vain(observer.judge, fault, term)]
            if fault.how not in ("jump", "drift"):
                seen = cell.actuations.since(outcome.begin_ns)
                outcome.late += too_old(cell.problem, seen, observer.judge.stamped_ns)
        self._keep(cell, one, outcome)
        return usable

    def _keep(self, cell: Harness, one: PlannedFault, outcome: Outcome) -> None:
        wrong = list(outcome.wrong)
        if outcome.stall_ms >= cell.problem.pipeline.period_ms and outcome.late:
            self.result.stalled += 1
        else:
            wrong += outcome.late
        again = f"{self._again} --only {one.number}"
        self.result.wrong += [f"{one.fault.name}: {what}; again: {again}" for what in wrong]
        self.result.outcomes.append((one, outcome))
        with (self._out / "faults.jsonl").open("a", encoding="utf-8") as file:
            about = {"number": one.number, "kind": one.fault.kind}
            file.write(json.dumps({**about, **asdict(outcome)}) + "\n")
        self._say(_line(one, outcome))
        for what in wrong:
            self._say(f"    VIOLATION {what}; again: {again}")

    def _count(self, cell: Harness, observer: ActuatorObserver) -> None:
        self.result.heard.update(observer.judge.counts)
        self.result.actuated += len(cell.actuations.applied)


def _untrue(cell: Harness, observer: ActuatorObserver) -> list[str]:
    """Return a violation for each status `ok` during which the actuator lacked commands."""
    cell.actuations.look()
    wrong = []
    for at_ns, status in cell.looks:
        seen = [one for one in cell.actuations.all if one.at_ns <= at_ns]
        wrong += observer.judge.looked(status, seen)
    cell.looks.clear()
    return wrong


def _settle(cell: Harness, rests_s: float, outcome: Outcome) -> None:
    """Wait until a cell is complete and at home, before and after a pause without faults.

    The bound applies to a single fault of a cell at home, and the guard may move the cell during
    the pause.
    """
    while True:
        cell.wait_for("the whole cell at home", cell.at_home, 60.0)
        cell.wait_for("health", cell.healthy, 60.0)
        time.sleep(rests_s)
        if not (missing := cell.at_home()):
            return
        outcome.note = f"left alone, it had to be waited for: {missing}"


def _unread(cell: Harness) -> Sequence[str]:
    """Return the error of each run that cannot be read."""
    from dwell.record import open_run

    unreadable = []
    for folder in cell.runs:
        try:
            open_run(folder).cycles.height  # noqa: B018 - reads it
        except DwellError as error:
            unreadable.append(str(error))
    return unreadable


def _line(one: PlannedFault, outcome: Outcome) -> str:
    bound = "-" if outcome.bound is None else str(outcome.bound)
    note = f"  {outcome.note}" if outcome.note else ""
    return (
        f"{one.number:4d} {outcome.fault:40} {one.lasts_s:4.1f} s  lost {outcome.lost:3d} "
        f"{outcome.lost_after:3d} of {bound:>2}  gap {outcome.gap_ms:5.0f} "
        f"{outcome.gap_after_ms:5.0f} ms  back {outcome.recovery_ms:6.0f} ms  "
        f"stall {outcome.stall_ms:3.0f}  {outcome.moved}{note}"
    )


def summary(document: Mapping[str, Any]) -> list[str]:
    """Return a result as lines of text."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in document["kinds"].items())
    heard = ", ".join(f"{count} {word}" for word, count in sorted(document["heard"].items()))
    lines = [
        f"seed {document['seed']}: {document['faults']} faults in {document['seconds']:.0f} s "
        f"({kinds})",
        f"{document['bounded']} with a bound: at most {document['most_lost_where_bounded']} "
        f"consecutive cycles lost; slowest recovery {document['slowest_recovery_ms'] / 1e3:.1f} s; "
        f"{document['stalled']} in which the machine stalled for a period or more",
        f"judged: {document['actuated']} actuations; heard {heard}",
    ]
    lines += [f"{what}: {how}" for what, how in document["means"].items()]
    lines += [f"VIOLATION {wrong}" for wrong in document["violations"]]
    return [*lines, "passed" if not document["violations"] else "failed"]
