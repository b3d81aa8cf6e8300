"""Strike: injects a fault into a cell, waits for the recovery, and measures the cost."""

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

#: Longest time until a cell must have recovered.
RECOVERED_S = 60.0
#: Longest time to wait for a fault's duration, or for cycles after it.
PATIENCE_S = 30.0
SOON_NS = 5_000_000


@dataclass(slots=True)
class Outcome:
    """Cost of a fault.

    Parameters
    ----------
    phase : float
        Fraction of the period, after a release, at which the fault began.
    lost, lost_after : int
        Most consecutive cycles without an actuation, by cycle numbers: during the fault, and after
        its end. `lost` is -1 if the stamper was killed, because its restart skips numbers.
    gap_ms, gap_after_ms : float
        Longest time between two actuations, during the fault and after its end.
    recovery_ms : float
        Time from the end of the fault to the recovery (see `recovered`).
    silences : int
        Number of calls of ``hold`` and ``zero``.
    moved : str
        Placements of the actuated commands, in order, as the commands name them.
    stall_ms : float
        Longest stall of the machine in this time.
    bound : int, optional
        Largest number of consecutive cycles that may be lost.
    begin_ns, end_ns, back_ns : int
        Instants of the beginning, the end and the recovery, on the true clock.
    wrong : list of str
        Violations.
    late : list of str
        Violations that a stall of the machine can excuse.
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
    """Inject a fault into a cell, end it, and wait until the cell has recovered.

    Parameters
    ----------
    cell : Harness
        At home, and healthy if the fault makes it move.
    seed : int
        Seed of `phase` and `lasts`.
    lasts : int
        Duration of the fault, in periods.
    bound : int, optional
        Largest number of consecutive cycles that may be lost.
    outcome : Outcome, optional
        Outcome to fill in; a new one if omitted. After an error it contains the steps so far.

    Raises
    ------
    LiveError
        If an expected event does not happen in time.
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
        # The first actuated cycle is the end of the fault.
        since_ns = found.end_ns
        cell.wait_for("a cycle after it", lambda: _few(cell, since_ns, 1), PATIENCE_S)
        found.end_ns = time.monotonic_ns()
    recovered = f"the whole cell at home after '{fault.name}'"
    cell.wait_for(recovered, cell.at_home, RECOVERED_S)
    found.back_ns = time.monotonic_ns()
    # Include the messages that were on their way at the recovery. A node with a small quota can be
    # slow while other processes start.
    cell.wait_for("five more cycles", lambda: _few(cell, found.back_ns, 5), PATIENCE_S)
    period_ns = cell.period_ns
    found.stall_ms = stalls.worst_ms(found.begin_ns - period_ns, found.back_ns, but=cpus)
    weigh(cell.problem, [fault], cell.actuations.since(found.begin_ns - 10 * period_ns), found)
    return found


def beyond(outcome: Outcome) -> list[str]:
    """Return the violations of a fault's bound on lost cycles."""
    if outcome.bound is None:
        return []
    lost = ("by it", outcome.lost), ("after it", outcome.lost_after)
    return [
        f"{count} consecutive cycles lost {when}, not {outcome.bound}"
        for when, count in lost
        if count > outcome.bound
    ]


def _last(cell: Harness, fault: Fault, begin_ns: int, lasts: int, bound: int | None) -> None:
    """Wait for the duration of a fault and, if it has a bound, for twelve actuations.

    A fault that kills and has no bound ends at once.
    """
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
    """Fill in the cost of simultaneous faults, and the violations at the actuator.

    Parameters
    ----------
    seen : sequence of Seen
        Calls of the actuator, starting at least ten periods before the first fault.
    outcome : Outcome
        Its instants and `stall_ms` are set.
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
        max_age_ms = max(map(problem.max_age_ms, problem.pipeline.sinks))
        during = [one for one in seen if one.at_ns >= begin_ns - period_ms * 1e6]
        outcome.late += unsafe(during, max_age_ms + period_ms + outcome.stall_ms)


def too_old(problem: Problem, seen: Sequence[Seen], stamped_ns: Mapping[int, int]) -> list[str]:
    """Return the commands that were applied too long after their stamp was received.

    Parameters
    ----------
    stamped_ns : mapping of int to int
        Instants of the stamps, by cycle, on the true clock.
    """
    # The process may lose the CPU between the gate's check and the call of the actuator.
    limit_ms = max(map(problem.max_age_ms, problem.pipeline.sinks)) + problem.pipeline.period_ms
    return [
        f"cycle {one.cycle} was actuated {age_ms:.0f} ms after it was stamped"
        for one in seen
        if one.what == APPLY and one.cycle in stamped_ns
        for age_ms in [(one.at_ns - stamped_ns[one.cycle]) / 1e6]
        if age_ms > limit_ms
    ]


def recovered(judge: Judge, outcome: Outcome, home: str | None) -> None:
    """Set the recovery time from the wire: until the first stamp with an ordered placement.

    If the guard has moved the cell home, there may be no such cycle; the note says so.
    """
    at_ns = judge.ordered_since(outcome.end_ns)
    if at_ns is not None:
        outcome.recovery_ms = (at_ns - outcome.end_ns) / 1e6
    elif home is not None and judge.terms[max(judge.terms)].placement == home:
        outcome.note = f"{outcome.note} brought home by the guard, not by an order".strip()
    else:
        outcome.wrong.append("no cycle was stamped by an order after it has ended")


def moved_in_vain(judge: Judge, fault: Fault, term: int) -> list[str]:
    """Return a violation if the guard moved the cell because its actuator raises."""
    if fault.kind == "refuse" and judge.moved_by_guard(term):
        return ["the guard has moved, though each placement ends at that sink"]
    return []


def _strikes_sink(fault: Fault) -> bool:
    """Whether a fault hits the sink, which calls the actuator's ``hold`` and ``zero``."""
    return fault.how == "starve" or any(who.startswith(("sink.", "*")) for who in fault.whom)
