"""A fleet in the simulator: cells that share nodes, played together, each with its controller."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from dwell.control import Controller
from dwell.control.coordination import ByChance, Coordination
from dwell.control.ledger import FleetLedger, PricedCell, Seat
from dwell.kernels.random_draws import draw, stream
from dwell.kernels.realisation import NodeChanges, Realisation
from dwell.model import NodeDisturbance, Problem, Scenario
from dwell.model.fleet import Fleet, FleetCell, Phases
from dwell.model.progress import Progress
from dwell.record import Run
from dwell.record.fleet_run import FleetRun
from dwell.sim.engine import PlayedCell, meta_of, play_cells
from dwell.sim.shared_load import shared_load
from dwell.sim.tables import PlayedRealisation, make_tables
from dwell.sim.waiting import Waiting, waiting_of


def simulate_fleet(
    fleet: Fleet,
    *,
    seed: int = 1,
    windows: int = 100,
    policy: str | None = None,
    estimator: str | None = None,
    coordination: str | None = None,
    phases: Phases | None = None,
    guard: bool = False,
    jobs: bool = False,
    progress: Progress | None = None,
) -> FleetRun:
    """Draw a realisation for every cell of a fleet, and play them together.

    Parameters
    ----------
    seed : int
        Seed of all random streams; the first cell of a file draws what it draws alone.
    windows : int
        Windows of every cell.
    policy, estimator : str, optional
        Of every cell; what the fleet's file says where None.
    coordination, phases : optional
        As in the fleet's file; what that says where None.
    guard : bool
        Whether the cells' guards act.
    jobs : bool
        Whether every job's instants are kept.
    progress : callable, optional
        Told how much of how much is done: levels of the ledger's table of loads, then windows.

    Raises
    ------
    ProblemError, PolicyError, TraceError, SimulationError
        If something named is unknown, or a run cannot be drawn.
    """
    fleet = fleet.changed(
        policy=policy, estimator=estimator, coordination=coordination, phases=phases
    )
    played = play_fleet(
        fleet, seed=seed, windows=windows, guard=guard, jobs=jobs, progress=progress
    )
    runs = {}
    for cell in fleet.cells:
        one = played[cell.name]
        meta = partial(
            _meta_of,
            cell,
            one,
            fleet.shared,
            seed=seed,
            windows=windows,
            guard=guard,
        )
        runs[cell.name] = Run(meta, *make_tables(one, jobs=jobs))
    load = shared_load(played, fleet.shared)
    offsets = phases_ms(fleet, seed)
    return FleetRun(fleet, runs, load, seed=seed, guard=guard, phases_ms=offsets)


def _meta_of(
    cell: FleetCell,
    played: PlayedRealisation,
    shared: Sequence[str],
    **settings: Any,
) -> dict[str, Any]:
    """Return what the record of a cell says; of a copy, also which streams its draws are of."""
    meta = meta_of(played.controller, scenario=cell.entry.scenario, **settings)
    drawn = {"streams": cell.streams, "shared": list(shared)} if cell.streams else {}
    return {**meta, **drawn}


def play_fleet(
    fleet: Fleet,
    *,
    seed: int,
    windows: int,
    guard: bool = False,
    jobs: bool = False,
    progress: Progress | None = None,
) -> dict[str, PlayedRealisation]:
    """Play the cells of a fleet as it is (see `simulate_fleet`), and return them by name."""
    names = [cell.name for cell in fleet.cells]
    problems = dict(zip(names, phased(fleet, seed), strict=True))
    realisations = drawn(fleet, problems, seed, windows)

    asked = partial(coordinations, fleet, problems, seed, progress)

    def cells() -> Iterator[PlayedCell]:
        for cell, asks in zip(fleet.cells, asked(), strict=True):
            chosen = cell.entry.policy or fleet.policy
            named = cell.entry.estimator or fleet.estimator
            problem, realisation = problems[cell.name], realisations[cell.name]
            controller = Controller(problem, chosen, named, asks)
            yield PlayedCell(problem, realisation, controller, guard and controller.guarded)

    # The kernel knows the rules of policies, and nothing of a fleet's.
    by_window = fleet.coordination != "none"
    play = partial(
        play_cells, shared=fleet.shared, jobs=jobs, by_window=by_window, progress=progress
    )
    # As in a cell alone, shadows are drawn for probes where the first are wanted.
    played = play([*cells()]) or play([*cells()], shadow=True) or []
    return dict(zip(names, played, strict=True))


def waiting_in_fleet(fleet: Fleet, *, seed: int, windows: int) -> Waiting:
    """Return where the cycles of a fleet that missed have waited."""
    whole = Waiting()
    for one in play_fleet(fleet, seed=seed, windows=windows, jobs=True).values():
        whole += waiting_of(one.problem, one.realisation, one.arrays)
    return whole


def phased(fleet: Fleet, seed: int) -> Iterator[Problem]:
    """Yield the problem of every cell, with its phase."""
    for cell, phase_ms in zip(fleet.cells, phases_ms(fleet, seed).values(), strict=True):
        yield cell.problem.at_phase(phase_ms)


def phases_ms(fleet: Fleet, seed: int) -> dict[str, float]:
    """Return the phase of every cell; one that says its own keeps it."""
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
        name = f"{cell.problem.name}-{cell.copy}/fleet-phase"
        return period_ms * float(np.random.Generator(np.random.SFC64(stream(seed, name))).random())
    return 0.0


def drawn(
    fleet: Fleet, problems: Mapping[str, Problem], seed: int, windows: int
) -> dict[str, Realisation]:
    """Draw every cell; what befalls a shared node is drawn once, with the first cell."""
    found: dict[str, Realisation] = {}
    first, *others = fleet.cells
    found[first.name] = draw_cell(fleet, first, problems[first.name], seed, windows, is_first=True)
    for cell in others:
        real = draw_cell(fleet, cell, problems[cell.name], seed, windows)
        found[cell.name] = _meeting(real, found[first.name], fleet.shared)
    return found


def draw_cell(
    fleet: Fleet,
    cell: FleetCell,
    problem: Problem,
    seed: int,
    windows: int,
    *,
    is_first: bool = False,
) -> Realisation:
    """Draw a cell; the first one of the fleet with what all scenarios do to shared nodes."""
    scenario = cell.entry.scenario
    if is_first:
        problem = _with_all(problem, scenario, fleet)
    return draw(problem, scenario=scenario, seed=seed, windows=windows, streams=cell.streams)


def _with_all(problem: Problem, scenario: str, fleet: Fleet) -> Problem:
    """Return the first cell with what the scenarios of all do to shared nodes; equal ones once."""
    own: Scenario = problem.scenario(scenario)
    others = [
        one
        for entry in fleet.entries
        for one in entry.cell.scenario(entry.scenario)
        if isinstance(one, NodeDisturbance) and one.node in fleet.shared
    ]
    added = tuple(one for one in dict.fromkeys(others) if one not in own)
    if not added:
        return problem
    return replace(problem, scenarios={**problem.scenarios, scenario: (*own, *added)})


def _meeting(real: Realisation, first: Realisation, shared: tuple[str, ...]) -> Realisation:
    """Return a realisation whose shared nodes go through what those of the first cell do."""
    own, theirs = NodeChanges.of(real.node_changes), NodeChanges.of(first.node_changes)
    nodes = tuple(dict.fromkeys((*own.nodes, *theirs.nodes)))
    rows = []
    for changes, is_first in ((own, False), (theirs, True)):
        taken = [i for i, name in enumerate(changes.nodes) if (name in shared) == is_first]
        table = changes.table[np.isin(changes.table[:, 1], taken)]
        places = np.array([nodes.index(name) for name in changes.nodes], np.int64)
        table[:, 1] = places[table[:, 1]]
        rows.append(table)
    merged = np.concatenate(rows)
    order = np.argsort(merged[:, 0], kind="stable")
    return replace(real, node_changes=NodeChanges(nodes, merged[order]))


def coordinations(
    fleet: Fleet,
    problems: Mapping[str, Problem],
    seed: int,
    progress: Progress | None = None,
) -> Iterator[Coordination | None]:
    """Yield what each cell asks before it moves; None where it asks nobody."""
    if fleet.coordination == "ledger":
        specs = [PricedCell(cell.name, problems[cell.name], cell.streams) for cell in fleet.cells]
        ledger = FleetLedger(specs, fleet.shared, fleet.objective, progress=progress)
    for i, cell in enumerate(fleet.cells):
        if fleet.coordination == "ledger":
            yield Seat(ledger, i)
        elif fleet.coordination == "random":
            streams = stream(seed, f"{cell.problem.name}-{cell.copy}/coordination")
            yield ByChance(np.random.Generator(np.random.SFC64(streams)))
        else:
            yield None
