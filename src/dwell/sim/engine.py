"""The simulator: runs a realisation under a policy and returns a Run."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.control import (
    Controller,
    Estimator,
    Evidence,
    LookedAt,
    MinimalPolicy,
    plain_rule,
)
from dwell.errors import SimulationError
from dwell.estimators.searched_cell import searched
from dwell.kernels.advance import LoggedCycles, play
from dwell.kernels.arrays import CellArrays, flow_columns, lay_out
from dwell.kernels.codes import BuiltInPolicy, EventKind, Status, Tier, cell_of, kind_of
from dwell.kernels.random_draws import draw, draw_shadows
from dwell.kernels.realisation import NodeChanges, Realisation
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.model.fabric import resources_of
from dwell.model.progress import Progress
from dwell.model.shadow_plan import ShadowPlan, alternatives
from dwell.model.table_columns import require_apart
from dwell.model.window_close import close_after_ns
from dwell.record import Run
from dwell.sim.cold_migration import ColdMigration
from dwell.sim.simulated_guard import SimulatedGuard
from dwell.sim.tables import PlayedRealisation, make_tables
from dwell.sim.versions import versions

#: Columns of the kernel's table `seen`.
SEEN = (
    *("first_cycle", "cycles", "missed", "counted"),
    *("l95_ms", "uncut_ms", "age_ms", "price_per_hour"),
)


def simulate(
    problem: Problem,
    *,
    scenario: str = "baseline",
    policy: MinimalPolicy | str | None = None,
    estimator: Estimator | str | None = None,
    seed: int,
    windows: int = 300,
    jobs: bool = False,
    guard: bool = False,
) -> Run:
    """Sample a realisation of a scenario and simulate it under a policy.

    Parameters
    ----------
    scenario : str
        Name of a scenario of the problem; ``baseline`` always exists.
    policy : policy, str, or None
        An object with ``decide``, a policy's name (``cusum``, or with its estimator
        ``cusum+corrected``), a candidate's name for a fixed placement, or None for the policy of
        the cell file. The simulation leaves the caller's object unchanged.
    estimator : Estimator, str, or None
        An object with ``estimate``, an estimator's name, or None for the estimator of
        the cell file.
    seed : int
        Seed of all random streams; one seed gives all policies the same realisation.
    windows : int
        Number of windows, at least 1.
    jobs : bool
        Whether the run records the instants of all jobs (48 bytes per cycle and task).
    guard : bool
        Whether the cell's guard acts, if the cell has fallbacks and the policy may move.

    Raises
    ------
    ProblemError, PolicyError, TraceError, SimulationError
        If a name is unknown, or the realisation cannot be sampled.
    """
    problem = searched(problem)
    realisation = draw(problem, scenario=scenario, seed=seed, windows=windows)
    return simulate_realisation(
        problem, realisation, policy=policy, estimator=estimator, jobs=jobs, guard=guard
    )


def simulate_realisation(
    problem: Problem,
    realisation: Realisation,
    *,
    policy: MinimalPolicy | str | None = None,
    estimator: Estimator | str | None = None,
    jobs: bool = False,
    guard: bool = False,
    by_window: bool = False,
) -> Run:
    """Simulate a realisation under a policy (see `simulate`).

    Parameters
    ----------
    by_window : bool
        Whether Python decides after every window, even if the kernel could; the Run is the same.
    """
    problem = searched(problem)
    _check_fit(problem, realisation)
    chains = tuple(problem.pipeline.chains)
    require_apart(tuple(resources_of(problem.fabric.nodes)), tuple(problem.candidates), chains)

    def cells() -> list[PlayedCell]:
        controller = Controller(problem, policy, estimator)
        return [PlayedCell(problem, realisation, controller, guard and controller.guarded)]

    (played,) = play_cells(cells, jobs=jobs, by_window=by_window)
    meta = partial(
        meta_of,
        played.controller,
        scenario=realisation.scenario,
        seed=realisation.seed,
        windows=realisation.windows,
        guard=guard,
    )
    return Run(meta, *make_tables(played, jobs=jobs))


def describe(
    problem: Problem,
    *,
    scenario: str = "baseline",
    policy: MinimalPolicy | str | None = None,
    estimator: Estimator | str | None = None,
    seed: int,
    windows: int = 300,
    guard: bool = False,
) -> dict[str, Any]:
    """Return the metadata of a run without simulating it (see `simulate`).

    Returns
    -------
    dict
        `Run.meta` that `simulate` would return for the same arguments, ready for JSON. A policy
        object must not change its `repr` or parameters during a run.

    Raises
    ------
    ProblemError, PolicyError
        If a name is unknown.
    """
    problem = searched(problem)
    problem.scenario(scenario)
    controller = Controller(problem, policy, estimator)
    meta = meta_of(controller, scenario=scenario, seed=seed, windows=windows, guard=guard)
    return Run(meta, {}).meta


class PlayedCell(NamedTuple):
    """A cell to simulate.

    Parameters
    ----------
    problem, realisation, controller
        The controller must be new.
    guarded : bool
        Whether the cell's guard acts.
    """

    problem: Problem
    realisation: Realisation
    controller: Controller
    guarded: bool


def play_cells(
    cells: Callable[[], Sequence[PlayedCell]],
    *,
    shared: Collection[str] = (),
    jobs: bool = False,
    by_window: bool = False,
    progress: Progress | None = None,
) -> list[PlayedRealisation]:
    """Simulate cells together.

    Parameters
    ----------
    cells : callable
        Makes the cells.
    shared : collection of str
        Nodes that the cells share.
    jobs : bool
        Whether to record all jobs.
    by_window : bool
        See `simulate_realisation`.
    progress : callable, optional
        Receives the number of closed windows and the number of all windows.
    """
    asked = shared, jobs, by_window, progress
    # Simulate without shadows first, which is faster, and again with shadows only if a guard wants
    # probes. Both give the same up to the first probe.
    return _play(cells(), *asked) or _play(cells(), *asked, shadow=True)


def _play(
    cells: Sequence[PlayedCell],
    shared: Collection[str],
    jobs: bool,
    by_window: bool,
    progress: Progress | None,
    *,
    shadow: bool = False,
) -> list[PlayedRealisation]:
    """Simulate cells; return no result if a cell wants probes but has no shadow.

    If `shadow`, all guarded cells have a shadow, even if their estimators send none.
    """
    plans = [_shadow_plan(cell, shadow and cell.guarded) for cell in cells]
    whole = lay_out(
        [(cell.problem, cell.realisation) for cell in cells],
        shared=shared,
        log_jobs=jobs,
        log_windows=any(cell.controller.learns for cell in cells),
        decides=True,
        shadows=[
            # Any cycle of a guarded cell may become a probe.
            draw_shadows(cell.problem, cell.realisation, plan.sent, others=cell.guarded)
            if plan is not None
            else None
            for cell, plan in zip(cells, plans, strict=True)
        ],
    )
    stampers = [
        SimulatedStamper(cell, CellArrays(whole, i), plan, shared)
        for i, (cell, plan) in enumerate(zip(cells, plans, strict=True))
    ]
    first = stampers[0]
    if len(cells) == 1 and not (cells[0].guarded or by_window or any(first.host_down)):
        first.leave_to_kernel()
    by_row = {stamper.arrays.part.row: stamper for stamper in stampers}
    total = sum(cell.realisation.windows for cell in cells)
    while (status := play(whole)) != Status.FINISHED:
        clock = whole.tables.clock[0]
        if status == Status.STEP:
            stamper = by_row[cell_of(int(clock["step_key"]))]
            stamper.step()
        else:
            stamper = by_row[int(clock["closed_cell"])]
            stamper.decide()
            if progress is not None:
                progress(sum(one.closed.item(0) for one in stampers), total)
        if stamper.lacks_shadow:
            return []
    return [
        PlayedRealisation(
            cell.problem,
            cell.realisation,
            cell.controller,
            stamper.arrays,
            stamper.host_is_down,
        )
        for cell, stamper in zip(cells, stampers, strict=True)
    ]


def _shadow_plan(cell: PlayedCell, probes: bool) -> ShadowPlan | None:
    """Return the plan of a cell's shadows, if it needs shadows."""
    if not (probes or cell.controller.sends_shadows):
        return None
    fractions = cell.controller.shadow_fractions
    others = alternatives(cell.problem.candidates)
    return ShadowPlan(0, cell.realisation.cycles, [*fractions.values()], others)


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


def _host_changes(problem: Problem, realisation: Realisation) -> NDArray[np.int64]:
    """Return the rows of `NodeChanges` for the controller's node."""
    changes = NodeChanges.of(realisation.node_changes)
    mine = [i for i, name in enumerate(changes.nodes) if name == problem.controller_node]
    return changes.table[np.isin(changes.table[:, 1], mine)]


class SimulatedStamper:
    """Passes closed windows to the controller, and stamps cycles with the ordered placement."""

    def __init__(
        self,
        cell: PlayedCell,
        arrays: CellArrays,
        plan: ShadowPlan | None,
        shared: Collection[str] = (),
    ) -> None:
        problem, realisation, controller, guarded = cell
        self.controller, self.arrays = controller, arrays
        self.release_ns = realisation.release_ns
        self.cycles = realisation.cycles
        self.window_cycles, self.every = problem.window_cycles, problem.decide_cycles
        #: Whether decisions are more frequent than windows.
        self.looks = problem.decides_within_windows
        self.names = tuple(problem.candidates)
        self.code = {name: i for i, name in enumerate(self.names)}
        settings = problem.controller
        self.lead = settings.order_lead_cycles
        self.delay_ns = round(settings.order_delay_ms * 1e6)
        self.due_ns, self.grace_ns = close_after_ns(problem)
        table = _host_changes(problem, realisation)
        self.host_at_ns, self.host_down = table[:, 0].tolist(), table[:, 3].tolist()
        self.cold = ColdMigration(problem, realisation) if settings.migration == "cold" else None
        self.plan = plan
        #: Whether each cycle may send shadows to shared nodes.
        self.turns: NDArray[np.bool_] | None = None
        if plan is not None and controller.coordination is not None:
            self.turns = controller.coordination.turns(realisation.release_ns[:-1])
        placed = problem.candidates.values()
        self.there = [i for i, one in enumerate(placed) if not one.nodes.isdisjoint(shared)]
        #: Whether the guard wants probes in a run without a shadow.
        self.lacks_shadow = False
        self.course = controller.course
        self.evidence = _evidence(problem, realisation, arrays) if controller.learns else None
        # Tables that every decision reads; they never grow.
        tables = arrays.tables
        self.stamps, self.cell = tables.stamps, tables.cells[0]
        self.closed, self.firsts = tables.cells["window"], tables.seen["first_cycle"]
        seen = tables.looked if self.looks else tables.seen
        self.seen = [seen[name] for name in SEEN]
        self.made = tables.cells["look" if self.looks else "window"]
        self.shares = tables.look_shares if self.looks else tables.shares
        #: Incumbent and number of stamped cycles in the kernel's rule, if the kernel decides.
        self.decided = self.rule_stamped = np.zeros(0, np.int64)
        tables.clock[0]["pauses"] = 1
        self.watch = SimulatedGuard(problem, realisation, arrays) if guarded else None
        self.stamped = self._reach(self.every)
        self._stamp(0, self.stamped)

    def _stamp(self, start: int, stop: int, placement: str | None = None) -> None:
        """Stamp cycles with a placement (by default the incumbent) and with their shadows."""
        if start >= stop:
            return
        stamps, code = self.stamps, self.code[placement or self.course.placement]
        stamps[0, start:stop] = code
        if self.plan is not None and start < self.cycles:
            stop = min(stop, self.cycles)
            shadows = self.plan.stamps(start, stop, code)
            if self.turns is not None:
                shadows[~self.turns[start:stop] & np.isin(shadows, self.there)] = -1
            stamps[1, start:stop] = shadows
        if self.watch is not None:
            self.watch.stamp(start, stop)

    def _reach(self, boundary: int) -> int:
        """Return the number of cycles released by the decision on the window before `boundary`."""
        if boundary > self.cycles:
            return boundary
        close_ns = self.close_ns(boundary)
        if close_ns <= self.release_ns.item(boundary):
            return boundary
        return int(np.searchsorted(self.release_ns, close_ns, side="right"))

    def close_ns(self, boundary: int) -> int:
        """Return when the window before the cycle `boundary` closes (see `window_close_ns`)."""
        due_ns: int = self.release_ns.item(boundary - 1) + self.due_ns
        return max(due_ns, self.release_ns.item(boundary) + self.grace_ns)

    def leave_to_kernel(self) -> None:
        """Let the kernel decide if it implements the controller's rule; idle cycles it does not."""
        plain = plain_rule(self.controller)
        if plain is None or self.controller.problem.pipeline.has_idle_cycles:
            return
        numbers = {
            **plain.numbers,
            "policy": BuiltInPolicy[plain.policy.upper()],
            "stamped": self.stamped,
        }
        tiers = [Tier[tier.upper()] if tier else Tier.NONE for tier in plain.tiers]
        self.arrays.whole.use_rule(
            numbers,
            plain.options,
            work=plain.work,
            switching=plain.switching,
            tiers=np.array(tiers, np.int8),
        )
        rule = self.arrays.tables.rule
        self.decided, self.rule_stamped = rule["incumbent"], rule["stamped"]

    def decide(self) -> None:
        """Decide on the newest window, or read the kernel's decision, and carry it out."""
        index = self.made.item(0) - 1
        cycles = self.seen[1].item(0, index)
        boundary = self.seen[0].item(0, index) + cycles
        close_ns = self.close_ns(boundary)
        left = self.course.placement
        self.controller.looked = LookedAt(self._window_of(boundary - 1), boundary - 1, cycles)
        if len(self.decided):
            self.course.move(self.names[self.decided.item(0)])
        elif self.host_is_down(close_ns) or not self.seen[3].item(0, index):
            self.controller.miss()
        else:
            self.consult(index, boundary, close_ns)
        if left == self.course.placement:
            self._go_on(boundary)
            return
        earliest = self._takes_effect(boundary, close_ns)
        cold = self.cold
        if cold is not None and not cold.moves(left, self.course.placement):
            cold = None
        # If no window can follow, the run is over and needs no simulated migration.
        if cold is not None and earliest + self.window_cycles <= self.cycles:
            self._begin(cold, left, boundary, close_ns)
        else:
            self._stamp(self.stamped, earliest, left)
            self._move(earliest, begins_window=cold is not None or not self.looks)

    def _window_of(self, cycle: int) -> int:
        """Return the number of windows that end before a cycle: the index of its own window."""
        window: int = self.closed.item(0)
        while window and self.firsts.item(0, window - 1) + self.window_cycles > cycle:
            window -= 1
        return window

    def consult(self, index: int, boundary: int, close_ns: int) -> None:
        """Pass the newest metrics to the controller, and stamp the probes that it wants."""
        watch, controller = self.watch, self.controller
        if self.evidence is not None:
            first = boundary - self.every
            controller.learn(partial(self.evidence, first, boundary, close_ns))
        _, _, missed, counted, l95_ms, uncut_ms, age_ms, per_hour = [
            column.item(0, index) for column in self.seen
        ]
        seen = l95_ms, missed / counted, uncut_ms
        terms = {"age_ms": age_ms, "price_per_hour": per_hour}
        shares = self.shares[0, index]
        if self.looks:
            proposal = controller.propose_on(*seen, shares[1], recent=shares[0], **terms)
        else:
            proposal = controller.propose_on(*seen, shares, **terms)
        if watch is None or not self.course.by_guard:
            controller.commit(proposal)
            return
        controller.settle(proposal, proven=watch.proven(close_ns))
        self.lacks_shadow = self.course.wanted is not None and self.plan is None
        if self.course.by_guard and not self.lacks_shadow:
            first = self._takes_effect(boundary, close_ns)
            watch.want(self.course.wanted, first)
            # A cycle released exactly at the close is stamped already.
            self._stamp(min(first, self.stamped), self.stamped)

    def _go_on(self, boundary: int) -> None:
        """Stamp the cycles up to the next decision with the unchanged placement."""
        start, self.stamped = self.stamped, self._reach(boundary + self.every)
        self._stamp(start, self.stamped)

    def _move(self, following: int, *, begins_window: bool = True) -> None:
        """Apply the ordered placement from the cycle `following` on."""
        if self.watch is not None:
            self.watch.moved(following)
        self._place(following, begins_window=begins_window)
        self._stamp(following, self.stamped)
        self.rule_stamped[:] = self.stamped

    def _place(self, following: int, *, begins_window: bool) -> None:
        """Restart the intervals of decisions, and on request of windows, at a cycle."""
        cell = self.cell
        if begins_window:
            cell["window_first"] = following
            cell["close_cycle"] = following + self.window_cycles
            cell["close_pending"] = 0
        if self.looks:
            cell["since"], cell["look_0"] = following, cell["look"]
            cell["look_cycle"] = following + self.every
            cell["look_pending"] = 0
        self.stamped = self._reach(following + self.every)

    def _begin(self, cold: ColdMigration, left: str, boundary: int, close_ns: int) -> None:
        """Begin a cold migration; `step` completes it."""
        arrival_ns = close_ns + self.delay_ns
        cold.begin(self.arrays, left, self.course.placement, boundary, arrival_ns)
        cell = self.cell
        # No window closes, and no decision is due, before the migration is over.
        cell["window_first"] = cell["close_cycle"] = cell["look_cycle"] = self.cycles + 1
        cell["close_pending"] = cell["look_pending"] = 0
        cell["migrating"] = 1
        self._stamp(self.stamped, self.cycles, left)

    def step(self) -> None:
        """Process the current event: of a cold migration, or of the guard."""
        if kind_of(int(self.arrays.tables.clock[0]["step_key"])) == EventKind.GUARD:
            self._fire()
        else:
            self._carry_on()

    def _fire(self) -> None:
        """Move to the guard's fallback, if any; the open window is discarded."""
        tables, watch = self.arrays.tables, self.watch
        if watch is None:
            return
        now = int(tables.clock[0]["step_ns"])
        first = int(np.searchsorted(self.release_ns[: self.cycles], now))
        active = self.names[tables.stamps[0, first - 1]]
        fallback = watch.wake(now)
        if fallback is None:
            return
        if self.cold is not None:
            self.cold.stop()
        self.cell["migrating"] = 0
        self._place(first, begins_window=True)
        if first + self.window_cycles > self.cycles:
            # No window can follow: the run ended with the last close.
            return
        self.controller.looked = LookedAt(self.closed.item(0), first - 1, 0)
        self.controller.adopt(fallback, left=active)
        self._stamp(first, self.stamped)

    def _carry_on(self) -> None:
        """Advance a cold migration; apply its order when the last task is ready."""
        cold = self.cold
        if cold is None or not cold.step(self.arrays):
            return
        self.cell["migrating"] = 0
        ready_ns = int(self.arrays.tables.clock[0]["step_ns"])
        self.stamped = self._takes_effect(cold.boundary, ready_ns - self.delay_ns)
        self._move(self.stamped)

    def _takes_effect(self, boundary: int, close_ns: int) -> int:
        """Return the first cycle that an order can stamp; earlier cycles are released already."""
        first, arrived_ns = boundary + self.lead, close_ns + self.delay_ns
        if first >= self.cycles or arrived_ns <= self.release_ns.item(first):
            return first
        return int(self.release_ns[: self.cycles].searchsorted(arrived_ns))

    def host_is_down(self, at_ns: int) -> bool:
        """Whether the controller's node is down at an instant."""
        i = bisect.bisect_right(self.host_at_ns, at_ns) - 1
        return i >= 0 and bool(self.host_down[i])


def _evidence(
    problem: Problem, realisation: Realisation, arrays: CellArrays
) -> Callable[[int, int, int], Evidence]:
    """Return the function that extracts a window's evidence from the logs."""
    logged = LoggedCycles(arrays, flow_columns(problem))
    count = problem.earlier_cycles

    def cut(first: int, last: int, close_ns: int) -> Evidence:
        begin = max(first - count, 0)
        earlier = cut_rows(begin, first, close_ns) if begin < first else None
        return cut_rows(first, last, close_ns, earlier)

    def cut_rows(first: int, last: int, close_ns: int, earlier: Evidence | None = None) -> Evidence:
        rows, release_ns = logged.window(first, last), realisation.release_ns[first:last].copy()
        return Evidence(close_ns, release_ns, rows, earlier=earlier)

    return cut


def meta_of(
    controller: Controller,
    *,
    scenario: str,
    seed: int | None,
    windows: int,
    guard: bool,
) -> dict[str, Any]:
    """Return the metadata of a simulated run."""
    return {
        "kind": "simulated",
        "cell": controller.problem.name,
        "scenario": scenario,
        **controller.described(),
        "guard": guard and controller.guarded,
        "seed": seed,
        "windows": windows,
        "problem": to_document(controller.problem),
        "versions": versions(),
    }
