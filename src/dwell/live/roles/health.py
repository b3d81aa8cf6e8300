"""Health of a live cell, and a headline that names its faults, from a controller's status.

============  ====================================================================================
``health``    Condition
============  ====================================================================================
``ok``        All processes are ready and send beats, windows close, cycles complete. The headline
              may warn of certificates that end soon.
``degraded``  Windows close, but a process is silent, not ready, or has another cell file or
              version; or too many cycles miss, a sink applies no commands, a candidate's shadows
              fail, the run is not recorded, or a certificate has ended or ends within an hour.
``stalled``   No window has closed for too long, or all cycles of the last window are incomplete.
``silent``    The controller receives no beats from the cell.
``absent``    No controller answers; the operator's client reports this state
              (`dwell.live.host.operator_client`).
============  ====================================================================================

Processes on a drained node may be silent or differ, because an operator has taken the node out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, TypeAlias

from dwell.live.roles.role import CONTROLLER_BEAT
from dwell.live.wire.messages import STALE
from dwell.live.wire.wiring import Role, lane_of, roles
from dwell.model import Problem
from dwell.model.bounds import counted
from dwell.study.metric import METRICS

Health: TypeAlias = Literal["ok", "degraded", "stalled", "silent", "absent"]

RATE = METRICS["violation_rate"]
#: Least age at which a process counts as silent; a busy machine may be late without a fault.
LEAST_NS = 1_000_000_000
#: Time after which an unfinished migration is given up; until then it may delay a window.
PATIENCE_NS = 2_000_000_000
#: Largest number of faults that the headline names.
NAMED = 3
#: Time before the end of a certificate at which the cell becomes degraded.
LAST_MS = 3_600e3
#: Number of recent windows with silences or too few commands that degrades a cell.
BAD_WINDOWS = 2


def silent_after_ns(problem: Problem) -> int:
    """Return the age of the last beat above which a process is silent.

    The age is the guard's g periods, and twice the `CONTROLLER_BEAT` periods after which the
    relay's agent passes beats on.
    """
    periods = problem.controller.guard_cycles + 2 * CONTROLLER_BEAT
    return max(round(periods * problem.pipeline.period_ms * 1e6), LEAST_NS)


def window_late_ns(problem: Problem, release_ratio: float | None = None) -> int:
    """Return the age above which the last window is too old, at a ratio of releases.

    It permits two windows, because a window that a move interrupts starts again.
    """
    windows_ms = 2 * problem.window_ms / min(release_ratio or 1.0, 1.0)
    return round((windows_ms + problem.controller.close_grace_ms) * 1e6) + PATIENCE_NS


def diagnose(problem: Problem, status: Mapping[str, Any]) -> tuple[Health, str | None]:
    """Return a cell's health, and a headline with its faults and warnings, or None.

    `status` is the result of `dwell.live.roles.controlled_cell.ControlledCell.status`.
    """
    members = [
        role
        for role in roles(problem)
        if role.kind != "controller" and role.who not in status["strangers"]
    ]
    ended, ending = _certificates(status)
    deaf = _hears_nobody(problem, status, members)
    stalled = _no_window(problem, status) or _no_cycle(status)
    faults = [*ended, *([] if deaf else _faults(status, members))]
    faults += [
        why
        for who, why in status["strangers"].items()
        if who.partition("@")[2].partition(".")[0] not in status["drained"]
    ]
    if not deaf and _window_was_due(problem, status):
        faults += _symptoms(problem, status, members)
    if status["record"]:
        faults.append(f"the run is not kept: {status['record']}")
    more = len(faults) - NAMED
    found = [*filter(None, (deaf, stalled)), *faults[:NAMED]]
    if more > 0:
        found.append(f"and {more} more")
    if not found:
        return "ok", "; ".join(ending) or None
    found += ending
    return "silent" if deaf else "stalled" if stalled else "degraded", "; ".join(found)


def _certificates(status: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return faults and warnings: certificates that end within `LAST_MS`, or later but soon."""
    named: tuple[dict[str, list[str]], dict[str, list[str]]] = {}, {}
    for name, certificate in status["certificates"].items():
        left_ms = certificate["days"] * 86_400e3
        if left_ms >= LAST_MS and not certificate["soon"]:
            continue
        when = f"ended {_time(-left_ms)} ago" if left_ms <= 0 else f"ends in {_time(left_ms)}"
        named[left_ms >= LAST_MS].setdefault(when, []).append(name)
    ended, ending = (
        ["'s, ".join(names) + f"'s certificate {when}" for when, names in of.items()]
        for of in named
    )
    return ended, ending


def _hears_nobody(
    problem: Problem, status: Mapping[str, Any], members: Sequence[Role]
) -> str | None:
    heard = status["processes"]
    if not members or any(_heard(status, role) for role in members):
        return None
    ages_ms = [heard[role.who]["age_ms"] for role in members if role.who in heard]
    relay = problem.relay_node
    why = f": the relay, agent {relay}, is silent"
    if not ages_ms:
        return f"the controller has heard nobody since it began {_time(status['up_ms'])} ago{why}"
    return f"the controller hears nobody since {_time(min(ages_ms))}{why}"


def _no_window(problem: Problem, status: Mapping[str, Any]) -> str | None:
    window, begun_ms = status["window"], status.get("begun_ms")
    if window:
        age_ms = window["age_ms"]
    else:
        # A starting cell gets this time from its last new process to its first cycle, and again
        # from its first cycle to its first window.
        age_ms = status["joined_ms"] if begun_ms is None else begun_ms
    if age_ms * 1e6 <= window_late_ns(problem, status.get("release_ratio")):
        return None
    return f"no window since {_time(age_ms)}"


def _window_was_due(problem: Problem, status: Mapping[str, Any]) -> bool:
    """Whether the first window has closed, or its time is over."""
    if status["window"]:
        return True
    due_ms = problem.window_ms + problem.controller.close_grace_ms
    return bool((status.get("begun_ms") or 0.0) > due_ms)


def _no_cycle(status: Mapping[str, Any]) -> str | None:
    if not status["window"] or status["done_cycles"] or not status["heard_cycles"]:
        return None
    heard = [(who, one) for who, one in status["processes"].items() if one["heard"] and one["note"]]
    # Processes that are not ready first; agents last, because their notes are about the node.
    heard.sort(key=lambda item: (item[1]["ready"], item[0].startswith("agent@")))
    notes = [one["note"] for _, one in heard[:1]]
    return f"no cycle of the last window was completed{_because(notes)}"


def _symptoms(
    problem: Problem, status: Mapping[str, Any], members: Sequence[Role]
) -> Iterator[str]:
    """Yield the faults that the cell's cycles show, even if all processes are ready."""
    sinks = [role for role in members if role.kind == "sink"]
    patience_ms, rates = problem.guard_patience_ns / 1e6, problem.pipeline.rates
    slow = list(_slow(problem, status))
    for role in sinks:
        sink = status["sinks"][role.task]
        age_ms = status["begun_ms"] if sink["applied_age_ms"] is None else sink["applied_age_ms"]
        interval_ms = rates[role.task] * problem.pipeline.period_ms
        limit_ms = max(patience_ms + interval_ms, problem.max_age_ms(role.task))
        if _heard(status, role) and age_ms > limit_ms:
            # The last outcome shows that the gate rejects the commands.
            late = (
                [*slow, _stale(problem.max_age_ms(role.task), sink["stale_ms"])]
                if sink["outcome"] == STALE
                else []
            )
            why = [*late, *_notes(status, [role.who])]
            yield f"{role.who} has applied nothing since {_time(age_ms)}{_because(why)}"
    recent = status["recent"]
    rates = recent["violation_rates"]
    placed = problem.candidates[status["placement"]].sites
    names = [*(f"{task}@{node}" for task, node in placed), *(role.who for role in sinks)]
    unreached = [] if slow else _unreached(problem, status, recent["unreached"])
    why = [*slow, *unreached, *_old_data(problem, recent["over_age"]), *_notes(status, names)]
    yield from _uneven(problem, status, why)
    if problem.live.degraded_by(rates):
        rate = RATE.text(sum(rates) / len(rates))
        yield f"{RATE.name} is {rate} in the last {counted(len(rates), 'window')}{_because(why)}"
    for name, found in status["failing"].items():
        placed = problem.candidates[name].sites
        if not problem.candidates[name].nodes.isdisjoint(status["drained"]):
            continue
        why = [
            *_unreached(problem, status, found["unreached"]),
            *_notes(status, [f"{task}@{node}.shadow" for task, node in placed]),
        ]
        yield f"the last {found['shadows']} shadows through {name} have failed{_because(why)}"


def _slow(problem: Problem, status: Mapping[str, Any]) -> Iterator[str]:
    """Yield the stages that take longer than the time between jobs, and their replaced inputs."""
    for one in status["slow"]:
        lost = f": {one['replaced']} of {one['inputs']} inputs were replaced"
        task, _, _ = one["stage"].partition("@")
        interval_ms = problem.pipeline.rates[task] * problem.pipeline.period_ms
        takes = f"{one['stage']} takes {one['exec_ms']:.0f} ms of {interval_ms:.0f}"
        yield f"{takes}{lost if one['replaced'] else ''}"


def _old_data(problem: Problem, cycles: int) -> Iterator[str]:
    """Yield the chains whose data were too old in some cycles."""
    bounded = [
        f"{name}'s max_age_ms ({chain.max_age_ms:g})"
        for name, chain in problem.pipeline.chains.items()
        if chain.is_bounded
    ]
    if cycles:
        yield f"{counted(cycles, 'command')} had data older than {' or '.join(bounded)}"


def _stale(limit_ms: float, age_ms: float | None) -> str:
    """Return a reason for stale commands: their age, or only the comparison of clocks.

    `age_ms` is the age of the last stale command by the controller's clock alone, if known.
    """
    limit = f"max_age_ms ({limit_ms:g})"
    if age_ms is None or age_ms <= limit_ms:
        return f"by the clocks, commands are older than {limit} when they come"
    return f"commands are {age_ms:.0f} ms old when they come, more than {limit}"


def _uneven(problem: Problem, status: Mapping[str, Any], why: list[str]) -> Iterator[str]:
    """Yield a wrong rate of releases, and silences or too few commands at the actuators."""
    live, recent, ratio = problem.live, status["recent"], status["release_ratio"]
    period_ms = problem.pipeline.period_ms
    if ratio is not None and abs(ratio - 1) > live.degraded_at:
        every_ms = period_ms / ratio
        rates = f"{1e3 / every_ms:.3g} cycles a second of {1e3 / period_ms:.3g}"
        limit_ms = max(map(problem.max_age_ms, problem.pipeline.sinks))
        if every_ms > limit_ms:
            why = [f"cycles come every {every_ms:.0f} ms, max_age_ms is {limit_ms:g}"]
            yield f"{rates}{_because(why)}"
        else:
            yield rates
    silences, applied = recent["silences"], recent["applied"]
    least = 1 - live.degraded_at
    bad = [count > 0 or share < least for count, share in zip(silences, applied, strict=True)]
    if sum(bad) < BAD_WINDOWS:
        return
    windows = f"in the last {counted(len(bad), 'window')}"
    if any(silences):
        times = counted(sum(silences), "time")
        yield f"{live.silence}() was called {times} {windows}{_because(why)}"
    elif not live.degraded_by(recent["violation_rates"]):
        known = f"{sum(applied) / len(applied):.0%} of the commands are known to have been applied"
        yield f"{known} {windows}{_because(why)}"


def _notes(status: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return the notes in the beats of some processes, except for silent processes."""
    known = [status["processes"][who] for who in names if who in status["processes"]]
    return [one["note"] for one in known if one["heard"] and one["note"]]


def _unreached(
    problem: Problem, status: Mapping[str, Any], ways: tuple[str, str] | None
) -> Iterator[str]:
    """Yield messages that do not arrive; a silent end is a fault that `_faults` reports."""
    heard = status["processes"]
    if ways is None or not all(who in heard and heard[who]["heard"] for who in ways):
        return
    source, target = (who.partition("@")[0] for who in ways)
    (flow,) = (one for one in problem.pipeline.inputs(target) if one.source == source)
    what = "images" if lane_of(flow.payload_bytes) == "images" else "messages"
    yield f"{what} of {ways[0]} do not reach {ways[1]}"


def _faults(status: Mapping[str, Any], members: Sequence[Role]) -> Iterator[str]:
    """Yield the faults of processes; a silent node is one fault."""
    heard = status["processes"]
    for node in dict.fromkeys(role.node for role in members):
        there = [role for role in members if role.node == node]
        missing = [] if node in status["drained"] else [r for r in there if not _heard(status, r)]
        ages_ms = [heard[role.who]["age_ms"] for role in missing if role.who in heard]
        if missing and len(missing) == len(there):
            since = f" since {_time(min(ages_ms))}" if ages_ms else ""
            yield f"nothing is heard of {node}{since}"
            continue
        for role in missing:
            known = heard.get(role.who)
            silent = f"is silent since {_time(known['age_ms'])}" if known else "was never heard"
            yield f"{role.who} {silent}"
        for role in there:
            if _heard(status, role) and not heard[role.who]["ready"]:
                yield f"{role.who} is not ready{_because([heard[role.who]['note']])}"


def _heard(status: Mapping[str, Any], role: Role) -> bool:
    known = status["processes"].get(role.who)
    return known is not None and bool(known["heard"])


def _because(notes: Sequence[str]) -> str:
    """Return the first lines of the first two notes, as a reason."""
    lines = [note.splitlines()[0][:200] for note in notes if note.strip()]
    return f": {', '.join(lines[:2])}" if lines else ""


def _time(ms: float) -> str:
    """Return a time as text with a unit, to about two digits."""
    seconds = ms / 1e3
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7_200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3_600:.0f} h" if seconds < 172_800 else f"{seconds / 86_400:.0f} days"
