"""Faults: the faults that a cell can suffer, their bounds, and random timelines."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, TypeAlias

from dwell.control.guard import parts_of
from dwell.live.wire.wiring import lane_of, roles
from dwell.model import Problem

How: TypeAlias = Literal[
    "kill",
    "freeze",
    "cut",
    "slow",
    "fail",
    "jump",
    "drift",
    "starve",
    "fill",
    "hog",
    "pace",
    "power",
    "blank",
]

#: Drift of ordinary oscillators, and a drift that no oscillator should have.
WITHIN_PPM, BEYOND_PPM = 80.0, 2_000.0
JUMPS_MS = (200.0, 5_000.0)
#: Shortest and longest fault, seconds: shorter and longer than a session's lease.
LASTS_S = 0.5, 2.4
#: Shortest and longest pause before a fault, seconds.
RESTS_S = 0.0, 1.5


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of a cell.

    Parameters
    ----------
    whom : tuple of str
        Processes (``*E``: all of node E), directions of a link such as ``R1->E``, nodes, or
        ``runs`` for the disk of the recorded runs.
    amount : float
        Jump in ms, drift in parts per million, rate in Mbit/s, or frames per period.
    kind : str
        Kind in `planned`, which takes one fault per kind in each round; `how` if omitted.
    """

    name: str
    how: How
    whom: tuple[str, ...]
    amount: float = 0.0
    kind: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", self.kind or self.how)


def faults_of(problem: Problem, *, disks: bool = True, stages: bool = True) -> Iterator[Fault]:
    """Yield the faults of a cell; `bound_of` returns their bounds.

    Parameters
    ----------
    disks : bool
        Whether each node has its own disk that can be filled.
    stages : bool
        Whether the stages can raise on request, as the light cell's can.
    """
    everybody = roles(problem)
    relay = problem.relay_node
    nodes = list(problem.fabric.nodes)
    for how in ("kill", "freeze"):
        for role in everybody:
            yield Fault(f"{how} {role.who}", how, (role.who,))
        for role in everybody:
            spare = f"{role.who}.1"
            if role.kind == "worker" and any(other.who == spare for other in everybody):
                both = role.who, spare
                yield Fault(f"{how} {role.who} and its standby", how, both)
        for node in nodes:
            yield Fault(f"{how} all of {node}", how, (f"*{node}",), kind=f"{how} node")
    yield Fault(f"lose relay agent@{relay}", "kill", (f"agent@{relay}",), kind="relay")
    linked = {(link.source, link.target) for link in problem.fabric.links.values()}
    for one, other in combinations(nodes, 2):
        if linked.isdisjoint(((one, other), (other, one))):
            continue
        yield Fault(f"cut {one}-{other}", "cut", (f"{one}->{other}", f"{other}->{one}"))
        for a, b in ((one, other), (other, one)):
            yield Fault(f"cut {a}->{b}", "cut", (f"{a}->{b}",), kind="cut one way")
    yield from _slow_links(problem)
    if stages:
        for role in everybody:
            if role.kind == "worker" and len(problem.pipeline.tasks[role.task].on) > 1:
                yield Fault(f"fail {role.who}", "fail", (role.who,))
    for role in everybody:
        if role.kind == "sink":
            yield Fault(f"fail the actuator of {role.who}", "fail", (role.who,), kind="refuse")
    yield from _clocks(nodes)
    for node in nodes:
        yield Fault(f"starve {node}", "starve", (node,))
    yield Fault("fill the disk of the runs", "fill", ("runs",))
    if disks:
        for node in nodes:
            yield Fault(f"fill the disk of {node}", "fill", (node,))
    yield Fault("write to the same disk", "hog", ("runs",))


def _slow_links(problem: Problem) -> Iterator[Fault]:
    """Yield a fault for each link direction with images: a quarter of the rate that they need."""
    pipeline = problem.pipeline
    for link in problem.fabric.links.values():
        crossing = [
            flow.payload_bytes
            for placed in problem.candidates.values()
            for placement in placed.copies
            for flow in pipeline.flows
            if (placement[flow.source], placement[flow.target]) == (link.source, link.target)
        ]
        largest = max(crossing, default=0)
        if lane_of(largest) == "images":
            rate_mbps = largest * 8 / (pipeline.period_ms * 1e3) / 4
            yield Fault(f"slow {link.name}", "slow", (link.name,), rate_mbps)


def _clocks(nodes: Sequence[str]) -> Iterator[Fault]:
    for node in nodes:
        for ms in (jump * sign for jump in JUMPS_MS for sign in (1, -1)):
            kind = "jump" if ms > 0 else "jump back"
            yield Fault(f"jump {ms:+g} ms {node}", "jump", (node,), ms, kind)
        for ppm in (rate * sign for rate in (WITHIN_PPM, BEYOND_PPM) for sign in (1, -1)):
            yield Fault(f"drift {ppm:+g} ppm {node}", "drift", (node,), ppm)


def struck(problem: Problem, fault: Fault) -> list[str]:
    """Return the processes that a fault strikes."""
    names = []
    for who in fault.whom:
        if not who.startswith("*"):
            names.append(who)
            continue
        # The agent first: otherwise it would restart the other processes.
        there = [role.who for role in roles(problem) if role.node == who[1:]]
        names += sorted(there, key=lambda one: not one.startswith("agent"))
    return names


def hit_by(problem: Problem, fault: Fault) -> frozenset[str] | None:
    """Return the parts of placements that a fault disables (see `parts_of`).

    None if it hits what every placement needs: the stamper, a sink, or their nodes and clocks.
    """
    everybody = {role.who: role for role in roles(problem)}
    vital = {role.node for role in everybody.values() if role.kind in ("stamper", "sink")}
    match fault.how:
        case "cut" | "slow" | "fail":
            return frozenset(fault.whom)
        case "fill" | "hog" | "pace":
            return frozenset()
        case "drift" if abs(fault.amount) <= WITHIN_PPM:
            return frozenset()
        case "jump" | "drift":
            return None if vital & set(fault.whom) else frozenset()
        case "starve":
            return None if vital & set(fault.whom) else frozenset(fault.whom)
    found = set()
    for who in fault.whom:
        if who.startswith("*"):
            if who[1:] in vital:
                return None
            found.add(who[1:])
            continue
        role = everybody[who]
        if role.kind in ("stamper", "sink"):
            return None
        spare = f"{who}.1"
        covered = spare in everybody and spare not in fault.whom
        if role.kind == "worker" and not covered:
            found.add(who)
    return frozenset(found)


def bound_of(problem: Problem, fault: Fault, placement: str) -> int | None:
    """Return the largest number of consecutive cycles that a fault may cost; None if unbounded.

    Parameters
    ----------
    placement : str
        Placement when the fault begins.
    """
    hit = hit_by(problem, fault)
    if hit is None:
        return None
    bound = problem.controller.guard_cycles + problem.pipeline.open_cycles
    if not parts_of(problem, placement) & hit:
        return bound
    others = [name for name in problem.controller.fallbacks if name != placement]
    struck = [bool(parts_of(problem, name) & hit) for name in others]
    if all(struck):
        return None
    # The guard still receives messages from these parts, so it tries such fallbacks first.
    return bound * (1 + struck.index(False)) if fault.how in ("slow", "fail") else bound


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """A fault of a timeline.

    Parameters
    ----------
    number : int
        From 1.
    phase : float
        Fraction of the period at which it begins.
    lasts_s, rests_s : float
        Duration of the fault, and of the pause before it.
    """

    number: int
    fault: Fault
    phase: float
    lasts_s: float
    rests_s: float


def planned(seed: int, faults: Sequence[Fault]) -> Iterator[PlannedFault]:
    """Yield an endless random timeline of faults from a seed.

    Each round contains one fault of each kind, in random order. Within a kind, a fault repeats
    only after all the others of its kind.
    """
    kinds: dict[str, list[Fault]] = {}
    for fault in faults:
        kinds.setdefault(fault.kind, []).append(fault)
    draw = random.Random(f"chaos {seed}")  # noqa: S311 - no secret
    waiting: dict[str, list[Fault]] = {kind: [] for kind in kinds}
    number = 0
    while kinds:
        for kind in draw.sample(sorted(kinds), len(kinds)):
            if not waiting[kind]:
                waiting[kind] = draw.sample(kinds[kind], len(kinds[kind]))
            number += 1
            yield PlannedFault(
                number,
                waiting[kind].pop(),
                draw.random(),
                draw.uniform(*LASTS_S),
                draw.uniform(*RESTS_S),
            )
