"""Simulation of fleets: cells that share nodes, each with its own controller."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from dwell.control import Controller
from dwell.control.coordination import ByChance, Coordination
from dwell.control.ledger import FleetLedger, PricedCell, Seat
from dwell.errors import Fault, ProblemError
from dwell.kernels.random_draws import draw, stream
from dwell.kernels.realisation import Realisation
from dwell.model import Problem
from dwell.model.document import disturbance_document
from dwell.model.fleet import MOST_CELLS, Fleet, FleetCell, Phases
from dwell.model.instants import HORIZON_NS
from dwell.model.progress import Progress
from dwell.record import Run
from dwell.record.fleet_run import FleetRun
from dwell.sim.engine import PlayedCell, meta_of, play_cells
from dwell.sim.shared_load import shared_load
from dwell.sim.tables import PlayedRealisation, make_tables
from dwell.sim.waiting import Waiting, waiting_of

NS_PER_MS = 1e6
NS_PER_S = 1e9


def simulate_fleet(
    fleet: Fleet,
    *,
    seed: int = 1,
    windows: int = 100,
    seconds: float | None = None,
    policy: str | None = None,
    estimator: str | None = None,
    coordination: str | None = None,
    phases: Phases | None = None,
    guard: bool = False,
    jobs: bool = False,
    progress: Progress | None = None,
) -> FleetRun:
    """Sample a realisation for every cell of a fleet and simulate the cells together.

    Parameters
    ----------
    seed : int
        Seed of all random streams; the first copy of a cell has the same streams as the cell alone.
    windows : int
        Length of the run in windows of the cell with the longest windows.
    seconds : float, optional
        Length of the run; replaces `windows`.
    policy, estimator : str, optional
        Policy and estimator of every cell [default: the fleet file's].
    coordination, phases : optional
        As in the fleet file [default: the fleet file's].
    guard : bool
        Whether the cells' guards act.
    jobs : bool
        Whether to record the instants of all jobs.
    progress : callable, optional
        Receives the completed and the total number of steps: first of levels in the ledger's table
        of loads, then of windows.

    Raises
    ------
    ProblemError, PolicyError, TraceError, SimulationError
        If a name is unknown, or a realisation cannot be sampled.
    """
    fleet = fleet.changed(
        policy=policy, estimator=estimator, coordination=coordination, phases=phases
    )
    duration_ns = duration_of(fleet, windows, seconds)
    played = play_fleet(
        fleet, seed=seed, duration_ns=duration_ns, guard=guard, jobs=jobs, progress=progress
    )
    runs = {}
    for cell in fleet.cells:
        one = played[cell.name]
        meta = partial(_meta_of, fleet, cell, one, seed=seed, guard=guard)
        runs[cell.name] = Run(meta, *make_tables(one, jobs=jobs))
    load = shared_load(played, fleet.shared)
    offsets = phases_ms(fleet, seed)
    return FleetRun(
        *(fleet, runs, load),
        seed=seed,
        seconds=duration_ns / NS_PER_S,
        guard=guard,
        phases_ms=offsets,
    )


def duration_of(fleet: Fleet, windows: int, seconds: float | None = None) -> int:
    """Return the length of a run in nanoseconds, from `seconds` if given, else from `windows`.

    Raises ProblemError if `seconds` is shorter than the longest window, or too long for the clock.
    """
    if seconds is None:
        return fleet.duration_ns(windows)
    longest_ns = fleet.duration_ns(1)
    if not longest_ns <= seconds * NS_PER_S < HORIZON_NS:
        bounds = f"at least the longest window, {longest_ns / NS_PER_S:g}, and below 9.2e9"
        raise ProblemError([Fault("seconds", f"{seconds:g} is not allowed; it must be {bounds}")])
    return round(seconds * NS_PER_S)


def _meta_of(
    fleet: Fleet, cell: FleetCell, played: PlayedRealisation, *, seed: int, guard: bool
) -> dict[str, Any]:
    """Return the metadata of a cell's run, with the random streams and the shared disturbances."""
    meta = meta_of(
        played.controller,
        scenario=cell.entry.scenario,
        seed=seed,
        windows=played.realisation.windows,
        guard=guard,
    )
    if cell.streams:
        meta["streams"] = cell.streams
    if len(fleet.cells) > 1 and (fleet.disturbances or cell.streams):
        meta["shared"] = list(fleet.shared)
        meta["disturbances"] = [disturbance_document(one) for one in fleet.disturbances]
    return meta


def play_fleet(
    fleet: Fleet,
    *,
    seed: int,
    duration_ns: int,
    guard: bool = False,
    jobs: bool = False,
    progress: Progress | None = None,
) -> dict[str, PlayedRealisation]:
    """Simulate the cells of an unchanged fleet (see `simulate_fleet`); return them by name."""
    names = [cell.name for cell in fleet.cells]
    problems = dict(zip(names, phased(fleet, seed), strict=True))
    realisations = drawn(fleet, problems, seed, duration_ns)

    def cells() -> Iterator[PlayedCell]:
        asking = coordinations(fleet, problems, seed, progress)
        for cell, asks in zip(fleet.cells, asking, strict=True):
            chosen = cell.entry.policy or fleet.policy
            named = cell.entry.estimator or fleet.estimator
            problem, realisation = problems[cell.name], realisations[cell.name]
            controller = Controller(problem, chosen, named, asks)
            yield PlayedCell(problem, realisation, controller, guard and controller.guarded)

    played = play_cells(
        lambda: [*cells()],
        shared=fleet.shared,
        jobs=jobs,
        # The kernel implements the rules of policies, but no coordination.
        by_window=fleet.coordination != "none",
        progress=progress,
    )
    return dict(zip(names, played, strict=True))


def waiting_in_fleet(fleet: Fleet, *, seed: int, duration_ns: int) -> Waiting:
    """Return the waiting times of the missed cycles of a fleet, by resource and link."""
    whole = Waiting()
    for one in play_fleet(fleet, seed=seed, duration_ns=duration_ns, jobs=True).values():
        whole += waiting_of(one.problem, one.realisation, one.arrays)
    return whole


def phased(fleet: Fleet, seed: int) -> Iterator[Problem]:
    """Yield the problem of every cell, with its phase and the fleet's common warm-up."""
    warmup_ns = fleet.warmup_ns
    for cell, phase_ms in zip(fleet.cells, phases_ms(fleet, seed).values(), strict=True):
        yield at_phase(cell.problem, phase_ms, warmup_ns)


def at_phase(problem: Problem, phase_ms: float, warmup_ns: int) -> Problem:
    """Return a problem with a phase, and with a warm-up in whole windows."""
    return _phased(problem, problem.folder, phase_ms, warmup_ns)


# Cached because a capacity study uses one cell in many sizes, and a new problem is slow to check.
@lru_cache(MOST_CELLS)
def _phased(problem: Problem, folder: str | None, phase_ms: float, warmup_ns: int) -> Problem:
    # The folder is a separate key: problems that differ only in the folder are equal.
    windows = -(-warmup_ns // problem.window_ns)
    pipeline = replace(problem.pipeline, phase_ms=phase_ms)
    return replace(problem, pipeline=pipeline, warmup_windows=windows, folder=folder)


def phases_ms(fleet: Fleet, seed: int) -> dict[str, float]:
    """Return the phase of every cell in ms: its own if it has one, else the fleet's."""
    cells = fleet.cells
    found = {}
    for i, cell in enumerate(cells):
        own = cell.entry.phase_ms
        if own is None:
            own = cell.problem.pipeline.phase_ms
        if own is None:
            own = _phase_ms(fleet.phases, cell, i, len(cells), seed)
        found[cell.name] = own
    return found


def _phase_ms(phases: Phases, cell: FleetCell, place: int, count: int, seed: int) -> float:
    period_ms = cell.problem.pipeline.period_ms
    if isinstance(phases, tuple):
        return phases[place]
    if phases == "even":
        return period_ms * place / count
    if phases == "random":
        return period_ms * _random_share(seed, f"{cell.problem.name}-{cell.copy}/fleet-phase")
    return 0.0


# Cached because a capacity study asks for the phases of one cell in many sizes.
@lru_cache(MOST_CELLS)
def _random_share(seed: int, name: str) -> float:
    return float(np.random.Generator(np.random.SFC64(stream(seed, name))).random())


def priced_cells(fleet: Fleet, problems: Iterable[Problem]) -> list[PricedCell]:
    """Return the cells of a fleet for the ledger."""
    pairs = zip(fleet.cells, problems, strict=True)
    return [PricedCell(cell.name, problem, cell.streams) for cell, problem in pairs]


def tabled_cells(fleet: Fleet, seed: int) -> list[PricedCell]:
    """Return the cells for the table of loads.

    Even phases replace random phases: one table is then valid for all seeds.
    """
    spread = fleet.changed(phases="even") if fleet.phases == "random" else fleet
    return priced_cells(spread, phased(spread, seed))


def drawn(
    fleet: Fleet, problems: Mapping[str, Problem], seed: int, duration_ns: int
) -> dict[str, Realisation]:
    """Sample the realisation of every cell; disturbances of shared nodes are common to all."""
    found = {}
    for cell in fleet.cells:
        problem = problems[cell.name]
        whole = draw_cell(fleet, cell, problem, seed, duration_ns)
        found[cell.name] = whole.until(cycles_within(problem, duration_ns))
    return found


def draw_cell(
    fleet: Fleet, cell: FleetCell, problem: Problem, seed: int, duration_ns: int
) -> Realisation:
    """Sample a cell for a duration, rounded up to complete windows."""
    return draw(
        problem,
        scenario=cell.entry.scenario,
        seed=seed,
        windows=-(-duration_ns // problem.window_ns),
        streams=cell.streams,
        shared=fleet.shared,
        disturbances=fleet.disturbances,
    )


def cycles_within(problem: Problem, duration_ns: int) -> int:
    """Return the number of cycles that a cell releases within a duration."""
    first_ns = round(problem.pipeline.first_release_ms * NS_PER_MS)
    return -((first_ns - duration_ns) // problem.pipeline.period_ns)


def coordinations(
    fleet: Fleet,
    problems: Mapping[str, Problem],
    seed: int,
    progress: Progress | None = None,
) -> Iterator[Coordination | None]:
    """Yield the coordination of each cell's moves, or None if cells move independently."""
    if fleet.coordination == "ledger":
        ledger = FleetLedger(
            priced_cells(fleet, problems.values()),
            fleet.shared,
            fleet.objective,
            tabled=tabled_cells(fleet, seed),
            progress=progress,
            limit=fleet.limit,
            moves=not fleet.is_static,
        )
    for i, cell in enumerate(fleet.cells):
        if fleet.coordination == "ledger":
            yield Seat(ledger, i)
        elif fleet.coordination == "random":
            streams = stream(seed, f"{cell.problem.name}-{cell.copy}/coordination")
            yield ByChance(np.random.Generator(np.random.SFC64(streams)))
        else:
            yield None
