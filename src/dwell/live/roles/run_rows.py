"""Rows of a live run's tables (`dwell.record.schema` defines their columns).

Cycles and windows count from 0 without gaps, as in any run; extra columns have the stamps' numbers.
``jobs`` and ``processes`` are optional. If a cycle never reached a sink, its jobs are unknown,
unless a newer cycle replaced it. A replaced job has only the time at which it was ready.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.control import Controller, Proposal, final_l95_ms, overtaken_cycles
from dwell.live.roles.cycle_ledger import Ledger, LiveCycle, told, violation_rate
from dwell.live.roles.data_ages import DataAges, KnownOrigins
from dwell.live.roles.loads import ProcessLoads
from dwell.live.roles.offsets import UNBOUNDED_NS
from dwell.live.wire.messages import NOT_APPLIED
from dwell.model.instants import NEVER_NS
from dwell.model.table_columns import Feature
from dwell.record import Columns, Row, Values, column_types, row_of

Rows: TypeAlias = dict[str, list[Row]]
#: Estimates of a candidate in the status.
PREDICTED = "l95_ms", "violation_rate", "age_ms"


@dataclass(frozen=True, slots=True)
class Resume:
    """Point in a run from which a controller, perhaps restarted, records it.

    `window` and `cycle` are the numbers of the first window and cycle to record. `origin_ns` is the
    first release of the run on the stamper's clock; None takes it from the first stamp. `jobs`
    records jobs and the CPU time of processes too.
    """

    window: int = 0
    cycle: int = 0
    origin_ns: int | None = None
    jobs: bool = False


@dataclass(eq=False, slots=True)
class LiveWindow:
    """A closed window for the record, or the cycles that a decision has looked at.

    Parameters
    ----------
    span_ns : int
        Time from its first release to the first release after it.
    close_ns : int
        End of the window since the origin.
    lead : int
        Number of cycles between the previous window and this one.
    led : sequence of LiveCycle
        The last of these cycles.
    heard : int
        Number of cycles with a known stamp. The controller misses a decision if less than
        half of its cycles are known (`Controller.miss`).
    bound_ns : int
        Error bound of its latencies, from the clocks; `UNBOUNDED_NS` if unknown.
    unproven : bool
        Whether the bound exceeds 20 % of D, or the outcome of a cycle is unknown.
    rate_at_close : float
        V_D as known at the end of the window.
    known_origins : dict of str to KnownOrigins
        Origins of the actuations before its cycles, by chain.
    age_ms : float or None
        Mean age of the newest command, if J weighs it.
    used : float64 array, shape (3, resources)
        Utilisation by all work, by the cell's jobs, and by shadows.
    seen : tuple of float or None
        L95 (ms), violation rate and cost as the controller saw them, or None.
    """

    number: int
    cycles: list[LiveCycle]
    span_ns: int
    close_ns: int
    lead: int
    led: Sequence[LiveCycle]
    heard: int
    bound_ns: int
    unproven: bool
    rate_at_close: float
    used: NDArray[np.float64]
    closed_unix_ns: int | None
    seen: tuple[float | None, ...] = (None, None, None)
    known_origins: Mapping[str, KnownOrigins] = field(default_factory=dict)
    age_ms: float | None = None

    def shown(self, proposal: Proposal, controller: Controller, ages: DataAges) -> dict[str, Any]:
        """Return a proposal and its cycles for the status."""
        decision, names = proposal.decision, controller.problem.candidates
        l95_ms, _, cost = proposal.seen
        columns = controller.decision_columns[-len(proposal.priced) :]
        priced = dict(zip(columns, proposal.priced, strict=True))
        return {
            "number": self.number,
            "last_cycle": proposal.looked.last_cycle,
            "cycles": proposal.looked.cycles,
            "placement": self.cycles[0].placement,
            "l95_ms": l95_ms,
            "violation_rate": self.rate_at_close,
            "cost": cost,
            "mean_age_ms": self.age_ms,
            "ages": ages.values(self.cycles, self.known_origins),
            "reason": decision.reason,
            "decided": decision.name,
            "estimates": {name: decision.costs.get(name) for name in names},
            "predicted": {
                name: {of: priced.get(f"est_{of}_{name}") for of in PREDICTED} for name in names
            },
            "utilisation": {
                name: _known(share)
                for name, share in zip(controller.resources, self.used[0].tolist(), strict=True)
            },
        }

    def violation_rate(self, deadline_ns: int) -> float:
        """Return V_D, the share of missed cycles among the cycles with a known outcome."""
        return violation_rate(told(self.cycles), deadline_ns)


def sends_shadows(controller: Controller) -> bool:
    """Whether cycles may have shadows, to measure or to prove other candidates."""
    return controller.sends_shadows or bool(controller.problem.controller.fallbacks)


def columns_of(controller: Controller, *, jobs: bool = False) -> Columns:
    """Return the type of every column in the tables of a live run, with or without ``jobs``."""
    features: list[Feature] = ["live", *controller.features]
    if sends_shadows(controller):
        features.append("shadows")
    if controller.problem.objective.latency is not None:
        features.append("chain")
    if controller.problem.replicas:
        features.append("replicas")
    tables = ["cycles", "windows", "decisions", *(("jobs", "processes") if jobs else ())]
    return {name: column_types(name, controller.problem, features) for name in tables}


class RunRows:
    """Makes the rows of a run that are new or have changed.

    `kept` is the number of recorded cycles whose rows late completions may still change, and
    `known` has these cycles and all later ones, by run and number.
    """

    def __init__(
        self,
        controller: Controller,
        ledger: Ledger,
        processes: ProcessLoads,
        *,
        resume: Resume,
        kept: int,
        known: Mapping[tuple[int, int], LiveCycle],
    ) -> None:
        self._controller, self._ledger, self._processes = controller, ledger, processes
        self._known = known
        problem = controller.problem
        #: Data ages of the cell's chains.
        self.ages = DataAges(problem, ledger)
        self._nodes, self._size = tuple(problem.fabric.nodes), problem.window_cycles
        self._warmup_windows, self._kept = problem.warmup_windows, kept
        self._deadline_ns = problem.pipeline.deadline_ns
        self._sends_shadows = sends_shadows(controller)
        self._weighs_age = problem.objective.weighs_age
        self._has_prices = problem.fabric.has_prices
        self._jobs = resume.jobs
        self._columns = columns_of(controller, jobs=resume.jobs)
        #: Row of the next cycle, and the last cycle that is known to be complete.
        self.next_row, self.newest_done = resume.cycle, (-1, -1)
        # First cycle without recorded jobs, and windows without recorded processes.
        self._next_jobs = resume.cycle
        self._unwritten: deque[LiveWindow] = deque()
        self._recorded: deque[LiveCycle] = deque()
        self._windows: dict[int, LiveWindow] = {}
        self._changed: dict[int, LiveCycle] = {}
        self._changed_windows: set[int] = set()
        self._in_flight: dict[int, LiveCycle] = {}

    def add(self, cycles: Iterable[LiveCycle]) -> Iterator[LiveCycle]:
        """Record cycles; yield old cycles, which are then forgotten."""
        for cycle in cycles:
            cycle.row = self.next_row
            self.next_row += 1
            self._changed[cycle.row] = cycle
            self._recorded.append(cycle)
        while len(self._recorded) > self._kept:
            old = self._recorded.popleft()
            self._in_flight.pop(old.row, None)
            if old.window is not None:
                self._windows.pop(old.window, None)
            yield old

    def window_of(self, cycle: LiveCycle) -> LiveWindow | None:
        """Return the closed window that contains a cycle, if it is still kept."""
        return None if cycle.window is None else self._windows.get(cycle.window)

    def close(self, window: LiveWindow) -> None:
        """Record a window."""
        window.known_origins = self.ages.known
        self.ages.closed(window.cycles)
        self._windows[window.number] = window
        self._changed_windows.add(window.number)
        if self._jobs:
            self._unwritten.append(window)

    def touch(self, cycle: LiveCycle) -> None:
        """Mark the rows of a cycle and of its window as changed, if the cycle is recorded."""
        if cycle.row >= 0:
            self._changed[cycle.row] = cycle
            if cycle.window is not None:
                self._changed_windows.add(cycle.window)
                if self.ages.known:
                    # The next window's reaction times depend on this one's actuations.
                    self._changed_windows.add(cycle.window + 1)

    def rows(self, *, last: bool = False) -> Rows:
        """Return the rows that are new or have changed since the last call.

        Rows of jobs and processes are one window late, because reports of some arrive later.
        `last` returns them at once.
        """
        for row, cycle in self._in_flight.items():
            if self._outcome(cycle) != cycle.outcome:
                self._changed[row] = cycle
        numbers = sorted(self._changed_windows & self._windows.keys())
        windows = [self._windows[number] for number in numbers]
        for window in windows:
            self.ages.judge(window.cycles, window.close_ns, self._origins_before(window))
        decided = (decision_values(self._controller, row) for row in self._controller.decisions)
        values: dict[str, Iterable[Values]] = {
            "cycles": [self._cycle_values(self._changed[row]) for row in sorted(self._changed)],
            "windows": [self._window_values(window) for window in windows],
            "decisions": list(decided if last else takewhile(self._is_recorded, decided)),
            **(self._job_values(last=last) if self._jobs else {}),
        }
        rows = {name: [row_of(self._columns[name], of) for of in values[name]] for name in values}
        # Drop recorded decisions, because a controller runs for months.
        del self._controller.decisions[: len(rows["decisions"])]
        self._changed.clear()
        self._changed_windows.clear()
        return rows

    def _is_recorded(self, decision: Values) -> bool:
        """Whether the cycles of a decision are recorded."""
        last = decision["last_cycle"]
        return isinstance(last, int) and last < self.next_row

    def _outcome(self, cycle: LiveCycle) -> str:
        if cycle.idle:
            return "idle"
        if cycle.came_to(NOT_APPLIED):
            return NOT_APPLIED
        if self._ledger.complete(cycle) or cycle.told:
            return "done"
        if self._ledger.is_replaced(cycle):
            return "replaced"
        return "dropped" if cycle.key < self.newest_done else "in_flight"

    def _cycle_values(self, cycle: LiveCycle) -> Values:
        cycle.outcome = self._outcome(cycle)
        if cycle.outcome == "in_flight":
            self._in_flight[cycle.row] = cycle
        else:
            self._in_flight.pop(cycle.row, None)
        compute_ns, queue_ns, network_ns = cycle.parts_ns or (None, None, None)
        return {
            "cycle": cycle.row,
            "release_ns": cycle.at_ns,
            "placement": cycle.placement,
            "latency_ns": None if cycle.latency_ns >= NEVER_NS else cycle.latency_ns,
            "missed": cycle.missed(self._deadline_ns),
            "outcome": cycle.outcome,
            "compute_ns": compute_ns,
            "queue_ns": queue_ns,
            "network_ns": network_ns,
            "run": cycle.run,
            "number": cycle.number,
            "term": cycle.term,
            "lead": cycle.window is None,
            "heard": cycle.heard,
            "actuated": self._ledger.complete(cycle) and cycle.actuated,
            "interval_ns": cycle.interval_ns,
            "stamper_interval_ns": cycle.stamper_interval_ns,
            "bound_ns": None if cycle.bound_ns >= UNBOUNDED_NS else cycle.bound_ns,
            **self.ages.cycle_values(cycle),
        }

    def _window_values(self, window: LiveWindow) -> Values:
        cycles, names = window.cycles, self._controller.resources
        known = self._origins_before(window)
        busy, _, by_shadows = window.used.tolist()
        seen_l95_ms, seen_violation_rate, cost = map(_known, window.seen)
        seen_age_ms = None if seen_l95_ms is None else window.age_ms
        latency_ns = np.array([cycle.latency_ns for cycle in told(cycles)], np.int64)
        values: dict[str, object] = {
            "window": window.number,
            "first_cycle": cycles[0].row,
            "warmup": window.number < self._warmup_windows,
            "placement": cycles[0].placement,
            "mixed": any(cycle.placement != cycles[0].placement for cycle in cycles),
            "l95_ms": float(final_l95_ms(latency_ns)),
            "violation_rate": window.violation_rate(self._deadline_ns),
            "seen_l95_ms": seen_l95_ms,
            "seen_violation_rate": seen_violation_rate,
            **{f"u_{name}": _known(share) for name, share in zip(names, busy, strict=True)},
            "cost": cost,
            **({"seen_age_ms": seen_age_ms} if self._weighs_age else {}),
            # Only the simulator measures prices.
            **({"seen_price_per_hour": None} if self._has_prices else {}),
            **self.ages.values(cycles, known),
            "overtaken": self._overtaken(cycles),
            "term": cycles[-1].term,
            "lead": window.lead,
            "heard": window.heard,
            "bound_ms": None if window.bound_ns >= UNBOUNDED_NS else window.bound_ns / 1e6,
            "unproven": window.unproven,
            "closed_unix_ns": window.closed_unix_ns,
        }
        if self._controller.problem.replicas:
            values["late_copies"] = sum(cycle.late_copies for cycle in cycles)
        if self._sends_shadows:
            sent, sent_bytes = self._ledger.shadow_bytes(cycles)
            values |= {"shadow_cycles": sent, "shadow_bytes": sent_bytes}
            values |= {
                f"shadow_{name}": _known(share)
                for name, share in zip(names, by_shadows, strict=True)
            }
        return values

    def _origins_before(self, window: LiveWindow) -> Mapping[str, KnownOrigins]:
        """Return the origins of the actuations before a window, by chain, as known now."""
        before = self._windows.get(window.number - 1)
        if before is None:
            return window.known_origins
        return self.ages.after([*before.cycles, *window.led], before.known_origins)

    def _overtaken(self, cycles: Sequence[LiveCycle]) -> int:
        """Return how many cycles of a window completed after a later cycle."""
        known = sorted(key for key in self._known if key >= cycles[0].key)
        ends_ns = [(self._known[key].at_ns, self._known[key].latency_ns) for key in known]
        return int(overtaken_cycles(*np.array(ends_ns).T)[: len(cycles)].sum())

    def _job_values(self, *, last: bool) -> Mapping[str, Iterable[Values]]:
        end = self.next_row if last else self.next_row - self._size
        ready = [cycle for cycle in self._recorded if self._next_jobs <= cycle.row < end]
        self._next_jobs = max(self._next_jobs, end)
        processes: list[Values] = []
        while self._unwritten and (last or self._unwritten[0].cycles[-1].row < end):
            processes += self._process_values(self._unwritten.popleft())
        jobs = [values for cycle in ready for values in self._ledger.jobs(cycle)]
        return {"jobs": jobs, "processes": processes}

    def _process_values(self, window: LiveWindow) -> Iterable[Values]:
        for node in self._nodes:
            span_ns = self._ledger.span_ns(node, window.cycles[0], window.close_ns)
            for who, cpu_ns in sorted(self._processes.between(node, *span_ns).items()):
                yield {
                    "window": window.number,
                    "process": who,
                    "node": node,
                    "cpu_ns": round(cpu_ns),
                }


def decision_values(controller: Controller, row: Sequence[object]) -> Values:
    """Return a row of ``decisions``, with the reason if it was not carried out."""
    columns = *controller.decision_columns, "refused"
    return dict(zip(columns, map(_known, row), strict=True))


def _known(value: object) -> object:
    """Return the value, or None if it is NaN."""
    return None if isinstance(value, float) and math.isnan(value) else value
