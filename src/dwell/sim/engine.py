"""The simulator: a realisation in, a policy beside it, a Run out."""

from __future__ import annotations

import bisect
import platform
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from dwell import __version__
from dwell.control import ClosedWindow, Controller, Estimator, MinimalPolicy
from dwell.errors import SimulationError
from dwell.kernels import layout as k
from dwell.kernels.advance import advance
from dwell.kernels.compiled import COMPILED
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.record import Run
from dwell.sim.arrays import Arrays, lay_out
from dwell.sim.drawing import draw
from dwell.sim.realisation import NodeChanges, Realisation
from dwell.sim.tables import Played, make_tables

__all__ = ["play", "simulate", "simulate_realisation"]


def simulate(
    problem: Problem,
    *,
    scenario: str = "baseline",
    policy: MinimalPolicy | str | None = None,
    estimator: Estimator | str | None = None,
    seed: int,
    windows: int = 300,
    jobs: bool = False,
) -> Run:
    """Draw a realisation of a scenario and play it under a policy.

    Parameters
    ----------
    problem : Problem
    scenario : str
        Name of one of the problem's scenarios; ``baseline`` exists always.
    policy : policy, str, or None
        An object with ``decide``, a policy's name, a candidate's name for the placement that never
        moves, or None for what the cell file says. The caller's object is not changed.
    estimator : Estimator, str, or None
        Likewise.
    seed : int
        Of everything random; policies under one seed meet the same realisation.
    windows : int
        Number of windows, at least 1.
    jobs : bool
        Whether the run keeps every job's instants (48 bytes a cycle and task).

    Returns
    -------
    Run

    Raises
    ------
    ProblemError, PolicyError, TraceError, SimulationError
        If something named is unknown, or the run cannot be drawn.
    """
    realisation = draw(problem, scenario=scenario, seed=seed, windows=windows)
    return simulate_realisation(problem, realisation, policy=policy, estimator=estimator, jobs=jobs)


def simulate_realisation(
    problem: Problem,
    realisation: Realisation,
    *,
    policy: MinimalPolicy | str | None = None,
    estimator: Estimator | str | None = None,
    jobs: bool = False,
    by_window: bool = False,
) -> Run:
    """Play a realisation under a policy (see `simulate`).

    Parameters
    ----------
    by_window : bool
        Stop at every window even where nothing that is decided could matter; the Run is the same.
    """
    _check_fit(problem, realisation)
    controller = Controller(problem, policy, estimator)
    arrays = lay_out([(problem, realisation)], log_jobs=jobs)
    sees_all = not _host_changes(problem, realisation)[:, 3].any()
    if controller.fixed_profile is not None and sees_all and not by_window:
        played = _play_static(problem, realisation, controller, arrays)
    else:
        played = _play_windows(problem, realisation, controller, arrays)
    return Run(_meta(problem, realisation, controller), make_tables(played))


def play(arrays: Arrays) -> int:
    """Advance to the next pause or to the end, enlarging what has become too small.

    Returns
    -------
    int
        ``PAUSED`` or ``FINISHED`` (see `dwell.kernels.advance`).
    """
    while True:
        status = advance(*arrays.tables)
        if status == k.GROW_EVENTS:
            arrays.grow_events()
        elif status == k.GROW_RING:
            arrays.grow_ring()
        else:
            return status


def _check_fit(problem: Problem, realisation: Realisation) -> None:
    """Refuse a realisation of another problem."""
    tasks = problem.pipeline.tasks
    sites = tuple((task, node) for task in tasks for node in tasks[task].on)
    if realisation.sites != sites:
        raise SimulationError(
            f"the realisation has execution times for {realisation.sites}, but this problem needs "
            f"{sites}; draw it from the same problem"
        )
    cycles = realisation.windows * problem.window_cycles
    if realisation.cycles != cycles:
        raise SimulationError(
            f"the realisation has {realisation.cycles} cycles, but {realisation.windows} windows "
            f"of {problem.window_cycles} cycles need {cycles}"
        )


def _quiet() -> AbstractContextManager[object]:
    """Without compilation, NumPy warns where 64-bit counters wrap, as they are meant to."""
    return nullcontext() if COMPILED else np.errstate(over="ignore")


def _host_changes(problem: Problem, realisation: Realisation) -> NDArray[np.int64]:
    """Return the rows of `NodeChanges` that are about the controller's node."""
    changes = NodeChanges.of(realisation.node_changes)
    mine = [i for i, name in enumerate(changes.nodes) if name == problem.controller_node]
    return changes.table[np.isin(changes.table[:, 1], mine)]


def _play_static(
    problem: Problem, realisation: Realisation, controller: Controller, arrays: Arrays
) -> Played:
    """Play everything in one call: no decision can change anything."""
    arrays.tables.stamps[:] = list(problem.candidates).index(controller.incumbent)
    with _quiet():
        play(arrays)
    first = np.arange(realisation.windows) * problem.window_cycles
    return Played(problem, realisation, controller, arrays, first)


def _play_windows(
    problem: Problem, realisation: Realisation, controller: Controller, arrays: Arrays
) -> Played:
    """Play window by window; the controller looks at each and stamps what follows."""
    stamper = _Stamper(problem, realisation, controller, arrays)
    with _quiet():
        while play(arrays) == k.PAUSED:
            stamper.close_window()
    return Played(problem, realisation, controller, arrays, np.array(stamper.first, np.int64))


class _Stamper:
    """Carries closed windows to the controller, and its orders to the cycles they stamp."""

    def __init__(
        self, problem: Problem, realisation: Realisation, controller: Controller, arrays: Arrays
    ) -> None:
        self.controller, self.arrays = controller, arrays
        self.release_ns = realisation.release_ns
        self.cycles = realisation.cycles
        self.window_cycles = problem.window_cycles
        self.code = {name: i for i, name in enumerate(problem.candidates)}
        settings = problem.controller
        self.lead = settings.order_lead_cycles
        self.delay_ns = round(settings.order_delay_ms * 1e6)
        self.grace_ns = round(settings.close_grace_ms * 1e6)
        table = _host_changes(problem, realisation)
        self.host_at_ns, self.host_down = table[:, 0].tolist(), table[:, 3].tolist()
        self.first: list[int] = []
        self.stamped = self._reach(self.window_cycles)
        self.placement = controller.incumbent
        tables = arrays.tables
        tables.clock[k.PAUSE] = 1
        tables.stamps[0, : self.stamped] = self.code[self.placement]
        self.next_first = 0

    def _reach(self, boundary: int) -> int:
        """Cycles that may be released before the decision of the window closing at `boundary`."""
        if self.grace_ns == 0 or boundary > self.cycles:
            return boundary
        close_ns = self.release_ns[min(boundary, self.cycles)] + self.grace_ns
        return int(np.searchsorted(self.release_ns, close_ns, side="right"))

    def close_window(self) -> None:
        """Hand the window that has just closed to the controller and carry out its order."""
        tables = self.arrays.tables
        index = len(self.first)
        first = self.next_first
        boundary = first + self.window_cycles
        close_ns = int(self.release_ns[boundary]) + self.grace_ns
        self.first.append(first)
        order = self.placement
        if self._host_down(close_ns):
            self.controller.miss()
        else:
            order = self.controller.close(
                ClosedWindow(
                    latency_ns=tables.latency_ns[0, first:boundary],
                    release_ns=self.release_ns[first:boundary],
                    close_ns=close_ns,
                    open_ns=int(self.release_ns[first]),
                    core_ns=tables.closed[0, index] - tables.opened[0, index],
                )
            )
        start = self.stamped
        following = boundary
        if order != self.placement:
            start = following = self._takes_effect(boundary, close_ns)
            self.placement = order
            tables.cells[0, k.WINDOW_FIRST] = following
            tables.cells[0, k.CLOSE_CYCLE] = following + self.window_cycles
            tables.stamps[0, self.stamped : start] = tables.stamps[0, self.stamped - 1]
        self.next_first = following
        self.stamped = self._reach(following + self.window_cycles)
        tables.stamps[0, start : self.stamped] = self.code[order]

    def _takes_effect(self, boundary: int, close_ns: int) -> int:
        """First cycle that an order given at a close stamps."""
        arrived = np.searchsorted(self.release_ns[: self.cycles], close_ns + self.delay_ns)
        return max(boundary + self.lead, int(arrived))

    def _host_down(self, at_ns: int) -> bool:
        i = bisect.bisect_right(self.host_at_ns, at_ns) - 1
        return i >= 0 and bool(self.host_down[i])


def _meta(problem: Problem, realisation: Realisation, controller: Controller) -> dict[str, Any]:
    policy = controller.policy
    return {
        "kind": "simulated",
        "cell": problem.name,
        "scenario": realisation.scenario,
        "policy": repr(policy)
        if type(policy).__repr__ is not object.__repr__
        else type(policy).__name__,
        "estimator": type(controller.estimator).__name__,
        "seed": realisation.seed,
        "windows": realisation.windows,
        "problem": to_document(problem),
        "versions": {
            "dwell": __version__,
            "numpy": np.__version__,
            "numba": numba.__version__,
            "python": platform.python_version(),
        },
    }
