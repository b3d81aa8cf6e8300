"""Strike: a fault befalls a cell, ends, and the cell recovers; its cost."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from dwell.model import Problem
from dwell_lab.chaos.actuations import Seen, out_of_order, unsafe
from dwell_lab.chaos.faults import Fault, hit_by
from dwell_lab.chaos.harness import Harness
from dwell_lab.chaos.invariants import Judge
from dwell_lab.chaos.stages import APPLY, HOLD, ZERO
from dwell_lab.chaos.stalls import StallDetector

#: Time in which a cell has to have recovered.
RECOVERED_S = 60.0
#: Longest time that a fault may take to be brought about, or to pass.
PATIENCE_S = 30.0
SOON_NS = 5_000_000


@dataclass(slots=True)
class Outcome:
    """Cost of a fault.

    Parameters
    ----------
    phase : float
        Fraction of the period, after a release, at which it began.
    lost, lost_after : int
        Most consecutive cycles without an actuation, by their numbers: from the fault to its end,
        and from there to the recovery. A stamper that starts anew leaves numbers out: -1.
    gap_ms, gap_after_ms : float
        Longest time between two actuations, likewise.
    recovery_ms : float
        From the end of the fault until the cell was whole and at home.
    silences : int
        Times that the actuator was told that no command came.
    moved : str
        Placements that were actuated, in order, by the commands' own account.
    stall_ms : float
        Longest time that the machine kept a thread waiting meanwhile.
    bound : int, optional
        Consecutive cycles that may be lost.
    begin_ns, end_ns, back_ns : int
        When it began, ended, and the cell had recovered, on the true clock.
    wrong : list of str
        Violations.
    late : list of str
        Violations that the machine has caused where it stalled.
    """

    fault: str
    seed: int
    phase: float
    lost: int = 0
    lost_after: int = 0
    gap_ms: float = 0.0
    gap_after_ms: float = 0.0
    recovery_ms: float = 0.0
    silences: int = 0
    moved: str = ""
    stall_ms: float = 0.0
    bound: int | None = None
    begin_ns: int = 0
    end_ns: int = 0
    back_ns: int = 0
    note: str = ""
    wrong: list[str] = field(default_factory=list)
    late: list[str] = field(default_factory=list)


def strike(
    cell: Harness,
    fault: Fault,
    stalls: StallDetector,
    *,
    phase: float,
    seed: int,
    lasts: int,
    bound: int | None,
    outcome: Outcome | None = None,
) -> Outcome:
    """Have a fault befall a cell, end it, and wait until the cell has recovered.

    Parameters
    ----------
    cell : Harness
        At home, and healthy where the fault makes it move.
    seed : int
        Seed that `phase` and `lasts` were drawn with.
    lasts : int
        Periods until what is frozen or cut is so no more.
    bound : int, optional
        Consecutive cycles that may be lost.
    outcome : Outcome, optional
        Filled in; a new one if left out. It tells how far it came where something is waited for
        in vain.

    Raises
    ------
    LiveError
        If an event that it waits for does not come.
    """
    found = Outcome(fault.name, seed, phase) if outcome is None else outcome
    found.bound = bound
    last = cell.actuations.last()
    released_ns = 0 if last is None else last.released_ns
    soon_ns = time.monotonic_ns() + SOON_NS
    period_ns = cell.period_ns
    wait_ns = (released_ns + round(phase * period_ns) - soon_ns) % period_ns
    found.begin_ns = cell.begin(fault, soon_ns + wait_ns)
    try:
        cpus = cell.starved_cpus
        _last(cell, fault, found.begin_ns, lasts, bound)
        found.end_ns = time.monotonic_ns()
    finally:
        found.note = cell.end(fault)
    if fault.how == "kill" and bound is None:
        # Its end is the first cycle again.
        since_ns = found.end_ns
        cell.wait_for("a cycle after it", lambda: _few(cell, since_ns, 1), PATIENCE_S)
        found.end_ns = time.monotonic_ns()
    recovered = f"the whole cell at home after '{fault.name}'"
    cell.wait_for(recovered, cell.at_home, RECOVERED_S)
    found.back_ns = time.monotonic_ns()
    # What is on its way when the cell is back is seen, too. A node with a small quota waits for
    # processes that still start.
    cell.wait_for("five more cycles", lambda: _few(cell, found.back_ns, 5), PATIENCE_S)
    period_ns = cell.period_ns
    found.stall_ms = stalls.worst_ms(found.begin_ns - period_ns, found.back_ns, but=cpus)
    weigh(cell.problem, [fault], cell.actuations.since(found.begin_ns - 10 * period_ns), found)
    return found


def beyond(outcome: Outcome) -> list[str]:
    """Return how a fault has cost more cycles than its bound."""
    if outcome.bound is None:
        return []
    lost = ("by it", outcome.lost), ("after it", outcome.lost_after)
    return [
        f"{count} consecutive cycles lost {when}, not {outcome.bound}"
        for when, count in lost
        if count > outcome.bound
    ]


def _last(cell: Harness, fault: Fault, begin_ns: int, lasts: int, bound: int | None) -> None:
    """Wait for the event that the fault's end waits for."""
    over_ns = begin_ns + lasts * cell.period_ns
    if bound is not None:
        cell.wait_for(
            f"ten cycles released after '{fault.name}'", lambda: _few(cell, begin_ns, 12), 20.0
        )
    elif fault.how == "kill":
        return
    cell.wait_for(
        f"{lasts} periods of it",
        lambda: "" if time.monotonic_ns() >= over_ns else "not yet",
        PATIENCE_S,
    )


def _few(cell: Harness, since_ns: int, count: int) -> str:
    actuated = sum(seen.what == APPLY for seen in cell.actuations.since(since_ns))
    return "" if actuated >= count else f"{actuated} of {count} cycles actuated"


def weigh(
    problem: Problem, faults: Sequence[Fault], seen: Sequence[Seen], outcome: Outcome
) -> None:
    """Fill in what faults at one time have cost, and what was wrong at the actuator.

    Parameters
    ----------
    seen : sequence of Seen
        Calls of the actuator, from ten periods before the first fault on at least.
    outcome : Outcome
        With its instants and the machine's stall.
    """
    begin_ns = outcome.begin_ns
    applied = [one for one in seen if one.what == APPLY]
    for before, later in pairwise(applied):
        if later.at_ns < begin_ns:
            continue
        lost, gap_ms = later.cycle - before.cycle - 1, (later.at_ns - before.at_ns) / 1e6
        if before.at_ns < outcome.end_ns:
            outcome.lost, outcome.gap_ms = max(outcome.lost, lost), max(outcome.gap_ms, gap_ms)
        else:
            outcome.lost_after = max(outcome.lost_after, lost)
            outcome.gap_after_ms = max(outcome.gap_after_ms, gap_ms)
    outcome.recovery_ms = (outcome.back_ns - outcome.end_ns) / 1e6
    outcome.silences = sum(one.what in (HOLD, ZERO) for one in seen if one.at_ns >= begin_ns)
    steps = [one.placement for one in applied]
    outcome.moved = " ".join(b for a, b in pairwise(["", *steps]) if a != b)
    stamper = f"*{problem.stamper_node}", f"stamper@{problem.stamper_node}"
    ends = "kill", "power", "blank"
    if any(fault.how in ends and set(fault.whom) & set(stamper) for fault in faults):
        outcome.lost = -1
    outcome.wrong += out_of_order(applied)
    if all(hit_by(problem, fault) is not None or not _strikes_sink(fault) for fault in faults):
        period_ms = problem.pipeline.period_ms
        during = [one for one in seen if one.at_ns >= begin_ns - period_ms * 1e6]
        outcome.late += unsafe(during, problem.max_age_ms + period_ms + outcome.stall_ms)


def too_old(problem: Problem, seen: Sequence[Seen], stamped_ns: Mapping[int, int]) -> list[str]:
    """Return commands that were applied too long after their stamp was heard.

    Parameters
    ----------
    stamped_ns : mapping of int to int
        Instants, by cycle, on the true clock.
    """
    # The gate looks a little before the actuator is called, which may be scheduled out between.
    limit_ms = problem.max_age_ms + problem.pipeline.period_ms
    return [
        f"cycle {one.cycle} was actuated {age_ms:.0f} ms after it was stamped"
        for one in seen
        if one.what == APPLY and one.cycle in stamped_ns
        for age_ms in [(one.at_ns - stamped_ns[one.cycle]) / 1e6]
        if age_ms > limit_ms
    ]


def recovered(judge: Judge, outcome: Outcome, home: str | None) -> None:
    """Take the recovery from the wire: the first cycle that an order stands behind.

    None follows where the guard's own move has brought the cell home; that is said beside it.
    """
    at_ns = judge.ordered_since(outcome.end_ns)
    if at_ns is not None:
        outcome.recovery_ms = (at_ns - outcome.end_ns) / 1e6
    elif home is not None and judge.terms[max(judge.terms)].placement == home:
        outcome.note = f"{outcome.note} brought home by the guard, not by an order".strip()
    else:
        outcome.wrong.append("no cycle was stamped by an order after it has ended")


def moved_in_vain(judge: Judge, fault: Fault, term: int) -> list[str]:
    """Return whether the guard has moved since a term for an actuator that raises."""
    if fault.kind == "refuse" and judge.moved_by_guard(term):
        return ["the guard has moved, though each placement ends at that sink"]
    return []


def _strikes_sink(fault: Fault) -> bool:
    """Whether the process that tells the actuator that no command comes is struck itself."""
    return fault.how == "starve" or any(who.startswith(("sink.", "*")) for who in fault.whom)
