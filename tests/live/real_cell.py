"""A cell of real processes over real Zenoh, light enough for two cores, and what can befall it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import yaml

import dwell
from dwell.cellfile import from_document
from dwell.live.local.loopback import Loopback, on_this_machine
from dwell_lab.chaos.faults import Fault, bound_of, faults_of
from dwell_lab.chaos.harness import CLOCK_FILE, Harness, environment_of
from dwell_lab.chaos.light_cell import (
    EXEC_MS,
    MAX_AGE_MS,
    PERIOD_MS,
    document,
    exec_ms,
)
from dwell_lab.chaos.stalls import StallDetector
from dwell_lab.chaos.strike import Outcome, beyond
from dwell_lab.chaos.strike import strike as strike_by


def wrong_record(
    cycles: Sequence[int],
    windows: Sequence[int],
    ordered: Sequence[int],
    apart: int,
    told: Iterable[int],
    applied: Set[int],
) -> list[str]:
    """Return what is wrong with the record of a run.

    Parameters
    ----------
    ordered : sequence of int
        Cycles after which the controller has migrated.
    apart : int
        How many are between two of them at least.
    told, applied : of int
        Cycles that were actuated, by the record and by the actuator.
    """
    found = []
    for name, numbers in (("number", cycles), ("window", windows)):
        if any(later <= before for before, later in pairwise(numbers)):
            found.append(f"{name} does not grow")
    found += [
        f"migrations after cycles {before} and {later}"
        for before, later in pairwise(ordered)
        if later - before < apart
    ]
    if unknown := set(told) - applied:
        found.append(f"actuated by the record, not by the actuator: {sorted(unknown)[:5]}")
    return found


class RealCell(Harness):
    """A cell on this machine whose controller wants to be at one place; `more` of its file."""

    def __init__(self, home: str, folder: Path, *, seed: int = 0, **more: object) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        written = folder / "written.yaml"
        written.write_text(yaml.safe_dump(document(home) | more))
        problem = on_this_machine(dwell.load(written))
        environment = environment_of(folder, exec_ms(home))
        testbed = Loopback(
            *(problem, folder, {}),
            seed=seed,
            environment=environment,
            clocks=folder / CLOCK_FILE,
        )
        super().__init__(testbed, home=home)

    def check_run(self) -> list[str]:
        """Return what is wrong with the record of the run, as far as it goes."""
        if len(self.runs) != 1:
            return [f"{len(self.runs)} runs instead of one"]
        run = dwell.open_run(self.runs[0])
        ordered = run.decisions.filter(run.decisions["migrated"] & (run.decisions["cycles"] > 0))
        told = run.cycles.filter(run.cycles["actuated"].cast(bool, strict=False))
        self.actuations.look()
        return wrong_record(
            run.cycles["number"].to_list(),
            run.windows["window"].to_list(),
            ordered["last_cycle"].to_list(),
            self.problem.stay_cycles,
            told["number"].to_list(),
            {seen.cycle for seen in self.actuations.applied},
        )

    def too_old(self) -> list[str]:
        """Return what was applied when it was too old."""
        # The gate looks a little before the actuator is called, which may be scheduled out between.
        limit_ms = MAX_AGE_MS + PERIOD_MS
        ages_ms = [
            (seen.cycle, (seen.at_ns - seen.released_ns) / 1e6) for seen in self.actuations.applied
        ]
        return [f"cycle {cycle}: {age_ms:.0f} ms" for cycle, age_ms in ages_ms if age_ms > limit_ms]


def strike(
    cell: RealCell, fault: HomeFault, stalls: StallDetector, *, phase: float, seed: int, lasts: int
) -> Outcome:
    """Have a fault befall a cell that is at home, and healthy where it will have to move."""
    cell.wait_for("the whole cell at home", cell.at_home, 30.0)
    if moves(fault):
        cell.wait_for("health", cell.healthy, 30.0)
    found = strike_by(cell, fault, stalls, phase=phase, seed=seed, lasts=lasts, bound=fault.bound)
    found.wrong += [*found.late, *beyond(found), *cell.too_old()]
    return found


# --------------------------------------------------------------------------------- faults


@dataclass(frozen=True, slots=True)
class HomeFault(Fault):
    """A fault that befalls the cell at home, and the consecutive cycles that may be lost there."""

    bound: int | None = None
    home: str = ""


def _names(home: str) -> Iterator[str]:
    """Yield the faults that befall the cell at a home."""
    anchored = ("sensing@R1", "control@R2")
    agents = ("controller@E", "agent@E", "agent@R1", "agent@R2")
    for how in ("kill", "freeze"):
        whom = {
            "SO": (*agents, "perception@E", "planning@E", *anchored, "all of E"),
            "LOC": (
                *("perception@R1", "planning@R2"),
                # No fallback is without these.
                *(f"{who} and its standby" for who in anchored),
                *("stamper@R1", "sink.control@R2", "all of R2"),
            ),
        }
        yield from (f"{how} {who}" for who in whom[home])
    yield from {"SO": ("slow R1->E", "fail perception@E"), "LOC": ("fail planning@R2",)}[home]
    for a, b in {"SO": (("R1", "E"), ("E", "R2")), "LOC": (("R1", "R2"),)}[home]:
        yield from (f"cut {a}->{b}", f"cut {b}->{a}", f"cut {a}-{b}")


def _faults() -> Iterator[HomeFault]:
    for home in EXEC_MS:
        problem = from_document(document(home))
        known = {fault.name: fault for fault in faults_of(problem)}
        for name in _names(home):
            fault = known[name]
            bound = bound_of(problem, fault, home)
            yield HomeFault(**asdict(fault), bound=bound, home=home)


FAULTS = {fault.name: fault for fault in _faults()}


def moves(fault: HomeFault) -> bool:
    """Whether the guard has to move the cell, for which it should have been healthy before."""
    if fault.how in ("cut", "slow"):
        return True
    relocatable = any(who.startswith(("perception", "planning", "*E")) for who in fault.whom)
    return fault.bound is not None and relocatable


def mixed(home: str) -> list[HomeFault]:
    """Return a home's faults, those that make the cell move apart from one another."""
    mine = [fault for fault in FAULTS.values() if fault.home == home]
    moving = [fault for fault in mine if moves(fault)]
    others = [fault for fault in mine if not moves(fault)]
    placed = [(index / len(moving), fault) for index, fault in enumerate(moving)]
    placed += [((index + 0.5) / len(others), fault) for index, fault in enumerate(others)]
    return [fault for _, fault in sorted(placed, key=lambda item: item[0])]
