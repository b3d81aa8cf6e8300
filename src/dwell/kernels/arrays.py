"""Conversion of cells and their realisations to the tables of the kernel."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.kernels import codes
from dwell.kernels.codes import (
    LAST_NS,
    EventKind,
    Scheduler,
    ShadowPart,
    cell_of,
    kind_of,
    make_key,
)
from dwell.kernels.realisation import LinkSegments, NodeChanges, Phase, Realisation
from dwell.kernels.rows import Rows, Tables, row_types
from dwell.model import Flow, Node, Pipeline, Placement, Problem, Replicas
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints
from dwell.model.placement import Copy
from dwell.model.window_close import close_after_ns, window_close_ns

SCHEDULERS = {"fair": Scheduler.FAIR, "fifo": Scheduler.FIFO, "priority": Scheduler.PRIORITY}
RING_START = 8
#: A shadow is given up when a window of cycles and this many more have been released after it.
GIVEN_UP_AFTER = 64
#: Number of events after which the kernel returns to Python, about every 20 ms.
BUDGET = 200_000
#: Slice that a core draws from the pool of a quota (sched_cfs_bandwidth_slice_us), and least length
#: of a turn (sched_base_slice of two CPUs; twice as long for eight and more), ms.
DRAWN_MS, LEAST_MS = 5.0, 1.4
#: Number of shares of a resource: busy, own, of shadows, of other cells.
PARTS = 4
#: Tables with one plain value per row, and tables with one per task.
LISTS = ("outputs", "sampled", "sink_rates", "cell_servers", "capacity", "back_ns", "after_ns")
BY_TASK = ("site_of", "hear_ns", "shadow_parts")
#: Alignment in bytes of the tables of a state in one block of memory.
LINE = 64


class CellPart(NamedTuple):
    """Position of a cell in the kernel's tables.

    Parameters
    ----------
    row, rows : int
        First row of the cell and number of its rows: two with a shadow, else one.
    cycles, windows, tasks, resources, candidates : int
        Numbers of these items in the cell.
    candidate_0, hop_0, site_0 : int
        Rows of its first candidate, hop and site.
    copies : int
        Columns of each task and flow in the logs: two if candidates have replicas, else one.
    """

    row: int
    rows: int
    cycles: int
    windows: int
    tasks: int
    resources: int
    candidate_0: int
    candidates: int
    hop_0: int
    site_0: int
    copies: int


class Arrays:
    """The kernel's tables, and the position of each cell in them.

    Attributes
    ----------
    tables : Tables
        The tables of the kernel; replaced by a new object when one of them grows.
    parts : tuple of CellPart
        Positions of the cells.
    address : int
        Argument of the kernel's functions: address of the tables' addresses.
    """

    def __init__(self, tables: Tables, parts: tuple[CellPart, ...], behind: Sequence[Ints]) -> None:
        self.parts = parts
        # Keep the arrays whose addresses are in the tables.
        self._behind = behind
        self._use(tables)

    def _use(self, tables: Tables) -> None:
        self.tables = tables
        self._addresses = tables.addresses()
        self.address = self._addresses.ctypes.data
        #: The state in one block of memory, if the tables are a copy.
        self._state: NDArray[np.uint8] | None = None

    def copy(self) -> Arrays:
        """Return tables with their own state, which share the fixed tables."""
        other = Arrays(self.tables, self.parts, self._behind)
        other.restart(self)
        return other

    def restart(self, first: Arrays) -> None:
        """Restore the state of `first`, the unused tables that were copied."""
        if self._state is not None and first._state is not None:
            np.copyto(self._state, first._state)
            return
        state, tables = _with_own_state(self.tables, first.tables)
        self._use(tables)
        self._state = state

    def replace(self, **tables: NDArray[Any]) -> None:
        """Replace fixed tables."""
        self.tables = self.tables._replace(**tables)
        for name, table in tables.items():
            row = self.tables._fields.index(name)
            self._addresses[row] = table.ctypes.data, table.size

    def on(self, candidates: Mapping[int, int | NDArray[np.int16]]) -> Arrays:
        """Return a copy in which cells stay on a candidate, by row; other cells are left out.

        The row of a shadow has the stamps of its cycles in place of a candidate.
        """
        arrays = self.copy()
        stamps = np.zeros_like(self.tables.stamps)
        for row, candidate in candidates.items():
            stamps[row] = candidate
        arrays.replace(stamps=stamps)
        if others := set(range(len(stamps))).difference(candidates):
            arrays.leave_out(others)
        return arrays

    def leave_out(self, rows: Collection[int]) -> None:
        """Leave some cells out of the simulation: they release no cycles and have no windows."""
        cells, clock, events = self.tables.cells, self.tables.clock[0], self.tables.events
        without = [*rows]
        cells["close_cycle"][without] = cells["n_cycles"][without] + 1
        first = events[: clock["n_events"]]
        kept = [
            kind_of(key) != EventKind.RELEASE or cell_of(key) not in rows
            for key in first["key"].tolist()
        ]
        clock["n_events"] = sum(kept)
        events[: clock["n_events"]] = first[kept]

    def use_rule(
        self,
        numbers: Mapping[str, float],
        options: Mapping[str, NDArray[np.float64]],
        **tables: NDArray[Any],
    ) -> None:
        """Let the kernel decide at the end of windows; for a single cell without a shadow.

        `numbers` and `options` contain columns of the tables `rule` and `options`. The further
        tables are `work`, `switching` and `tiers`.
        """
        candidates, resources = tables["work"].shape
        decisions = self.tables.looked.shape[1] or self.tables.seen.shape[1]
        rule = _table("rule", [numbers], 0)
        rows = np.zeros(candidates, row_types()["options"])
        for name, values in options.items():
            rows[name] = values
        columns = (5 + resources) * candidates
        self.tables.clock[0]["n_priced"] = columns
        self._use(
            self.tables._replace(
                rule=rule,
                options=rows,
                shown=np.ones((resources, candidates)),
                decided=np.zeros(decisions, row_types()["decided"]),
                priced=np.zeros((decisions, columns)),
                **tables,
            )
        )

    def grow_events(self) -> None:
        """Double the capacity of the queue of events and of the held messages."""
        t = self.tables
        room = 2 * len(t.events)
        names = ("events", "following", "held", "repeats")
        self._use(t._replace(**{name: np.resize(getattr(t, name), room) for name in names}))

    def grow_ring(self) -> None:
        """Double the capacity for cycles in flight, and move the present cycles."""
        t = self.tables
        clock = t.clock[0]
        n_slots, cells = int(clock["n_slots"]), len(t.cells)
        old = np.arange(cells * n_slots)
        # Unused slots have cycle 0, which belongs to one slot only.
        old = old[t.slots["cycle"] % n_slots == old % n_slots]
        cycle = t.slots["cycle"][old]
        new = (old // n_slots) * 2 * n_slots + (cycle & (2 * n_slots - 1))

        def larger(table: NDArray[Any]) -> NDArray[Any]:
            by_slot = table.reshape(len(t.slots), table.size // len(t.slots))
            moved = np.zeros((2 * len(by_slot), by_slot.shape[1]), table.dtype)
            moved[new] = by_slot[old]
            return moved.reshape(2 * len(table), *table.shape[1:])

        clock["n_slots"] = 2 * n_slots
        names = ["slots", "jobs", "attempts"]
        if not clock["logs_all"]:
            names += ["log", "log_outcome", "log_arrived", "log_taken"]
        self._use(t._replace(**{name: larger(getattr(t, name)) for name in names}))


#: Tables with rows by cell.
BY_CELL = (
    *("cells", "stamps", "latency_ns", "compute_ns", "network_ns", "outcome", "late_copies"),
    *("paid", "actuated_ns", "actuated_from", "actuated_newest"),
    *("opened", "closed", "seen", "shares"),
    *("look_opened", "look_closed", "looked", "look_shares"),
)


class JobLogs(NamedTuple):
    """The log of a cell's jobs and messages.

    Parameters
    ----------
    jobs, outcomes : arrays, shape (rows, cycles, tasks)
        Instants and outcomes of all jobs.
    arrived_ns, taken : int64 arrays, shape (rows, cycles, flows)
        Arrival of each message, and cycle of the sampled message that a job of this cycle took; -1
        for none. Flows have the order of `flow_rows`.
    """

    jobs: Rows
    outcomes: NDArray[np.int8]
    arrived_ns: Ints
    taken: Ints


class CellArrays:
    """A cell's part of the kernel's tables; row 0 is the cell, and row 1 its shadow."""

    def __init__(self, whole: Arrays, index: int = 0) -> None:
        self.whole, self.part = whole, whole.parts[index]
        self._of: Tables | None = None
        self._tables = whole.tables

    @property
    def tables(self) -> Tables:
        """The tables, restricted to this cell."""
        whole, part = self.whole.tables, self.part
        if whole is not self._of:
            self._of = whole
            own, cycles = slice(part.row, part.row + part.rows), slice(part.cycles)
            candidates = slice(part.candidate_0, part.candidate_0 + part.candidates)
            rows = {name: getattr(whole, name)[own] for name in BY_CELL}
            for name in ("opened", "closed", "shares"):
                rows[name] = rows[name][:, : part.windows, :, : part.resources]
            for name in ("look_opened", "look_closed", "look_shares"):
                rows[name] = rows[name][..., : part.resources]
            if len(whole.shadow_bytes):
                rows["shadow_bytes"] = whole.shadow_bytes[part.row, cycles]
            self._tables = whole._replace(
                **rows,
                site_of=whole.site_of[candidates, : part.copies * part.tasks],
                back_ns=whole.back_ns[candidates],
            )
        return self._tables

    def logs(self) -> JobLogs:
        """Return the log of all jobs and messages; needs a log of all jobs."""
        whole, part = self.whole.tables, self.part
        shape = len(whole.cells), int(whole.clock[0]["n_cycles"]), -1
        own = slice(part.row, part.row + part.rows), slice(part.cycles)
        tasks = *own, slice(part.copies * part.tasks)
        log, outcome = whole.log.reshape(shape), whole.log_outcome.reshape(shape)
        arrived, taken = (
            table.reshape(shape)[own] for table in (whole.log_arrived, whole.log_taken)
        )
        return JobLogs(log[tasks], outcome[tasks], arrived, taken)


def lay_out(
    cells: Sequence[tuple[Problem, Realisation]],
    *,
    shared: Collection[str] = (),
    log_jobs: bool = False,
    log_windows: bool = False,
    decides: bool = False,
    shadows: Sequence[Realisation | None] = (),
) -> Arrays:
    """Build the tables of one or more cells.

    Parameters
    ----------
    shared : collection of str
        Names of nodes that all cells share. Their stress and outages are taken from the first
        cell. Links are never shared.
    log_jobs : bool
        Whether to record the instants of all jobs.
    log_windows : bool
        Whether to record the instants of the jobs of a window until its end.
    decides : bool
        Whether to fill the `look` tables if decisions are more frequent than windows.
    shadows : sequence of Realisation
        Samples for the shadow jobs of each cell (see `draw_shadows`); None if a cell sends no
        shadows.
    """
    return _Layout(cells, shared, log_jobs, log_windows, decides, shadows).arrays()


class _Layout:
    """Builder of the tables, cell after cell."""

    def __init__(
        self,
        cells: Sequence[tuple[Problem, Realisation]],
        shared: Collection[str],
        logs_all: bool,
        logs_windows: bool,
        decides: bool,
        shadows: Sequence[Realisation | None],
    ) -> None:
        self.cells, self.shared = cells, frozenset(shared)
        self.logs_all, self.logs_windows = logs_all, logs_windows
        #: Cycles between two decisions of each cell; 0 if each window has one decision.
        self.decide_cycles = [
            problem.decide_cycles if decides and problem.decides_within_windows else 0
            for problem, _ in cells
        ]
        self.shadows = shadows if any(one is not None for one in shadows) else ()
        self.cycles = max(real.cycles for _, real in cells)
        self.max_tasks = max(_copies(problem) * len(problem.pipeline.tasks) for problem, _ in cells)
        self.max_flows = max(_copies(problem) * len(problem.pipeline.flows) for problem, _ in cells)
        self.max_resources = max(len(problem.fabric.resources) for problem, _ in cells)
        self.node_row: dict[tuple[int, str], int] = {}
        self.server_row: dict[tuple[int, str | None], int] = {}
        self.server_workers: list[int] = []
        self.rows: dict[str, list[dict[str, Any]]] = {
            name: [] for name, kind in row_types().items() if kind.names
        }
        self.behind: list[Ints] = []
        self.end_ns = 0
        #: Tables of plain values, row after row.
        self.lists: dict[str, list[Any]] = {name: [] for name in (*LISTS, *BY_TASK, "route")}
        self.layers: list[dict[int, int]] = []
        self.parts: list[CellPart] = []
        self.segments: list[Rows] = []
        self.rates: list[Rows] = []
        self.n_segments = 0
        self.changes: list[Rows] = []

    def arrays(self) -> Arrays:
        for index, (problem, real) in enumerate(self.cells):
            self._add_nodes(index, problem, real)
            self.parts.append(self._begun(problem, real))
            link_row = self._add_links(problem, real)
            self._add_cell(index, problem, real)
            self._add_candidates(index, problem, real, link_row)
            self._add_changes(index, NodeChanges.of(real.node_changes))
            if self.shadows:
                self._add_pairs(problem)
                if (shadow := self.shadows[index]) is not None:
                    self._add_shadow(index, problem, shadow, link_row)
        self._check_keys()
        return Arrays(self._tables(), tuple(self.parts), self.behind)

    def _begun(self, problem: Problem, real: Realisation) -> CellPart:
        """Return the position of the next cell in the tables."""
        return CellPart(
            row=len(self.rows["cells"]),
            rows=1,
            cycles=real.cycles,
            windows=real.windows,
            tasks=len(problem.pipeline.tasks),
            resources=len(problem.fabric.resources),
            candidate_0=len(self.lists["back_ns"]),
            candidates=len(problem.candidates),
            hop_0=len(self.rows["hops"]),
            site_0=len(self.rows["sites"]),
            copies=_copies(problem),
        )

    def _addresses(self, table: Ints) -> list[int]:
        """Return the address of every row of a realisation's table."""
        kept = np.ascontiguousarray(table, np.int64)
        self.behind.append(kept)
        first, stride = kept.ctypes.data, kept.strides[0]
        return [first + row * stride for row in range(len(kept))]

    def _add_nodes(self, index: int, problem: Problem, real: Realisation) -> None:
        for name, node in problem.fabric.nodes.items():
            if name in self.shared and (0, name) in self.node_row:
                self.node_row[index, name] = self.node_row[0, name]
                continue
            row = self.node_row[index, name] = len(self.rows["nodes"])
            servers = {"server_0": len(self.rows["servers"])}
            self.rows["nodes"].append({**servers, "n_servers": 1 + len(node.accelerators)})
            self._add_cpu(row, node, real.phases.get(name, Phase()))
            for kind, count in node.accelerators.items():
                self._add_server(row, kind, Scheduler.FIFO, count)

    def _add_cpu(self, row: int, node: Node, phase: Phase) -> None:
        """Add the CPU of a node, with its quota."""
        quota, scheduler = node.quota, SCHEDULERS[node.scheduler]
        if quota is not None and round(quota.tick_ms * 1e6):
            scheduler = Scheduler.TURNS
        cpu = self._add_server(row, None, scheduler, node.cores)
        speed = 1.0 if node.scheduler == "fair" else node.spare / node.cores
        cpu |= {
            "spare": node.spare,
            "background": node.background,
            "beside": 1.0 / node.interference,
            "speed": speed,
        }
        if quota is None:
            return
        cpu["quota"] = len(self.rows["quotas"])
        ticks = scheduler == Scheduler.TURNS
        quota_ns, slack_ns = max(round(node.budget_ms * 1e6), 1), round(quota.slack_ms * 1e6)
        new: dict[str, Any] = {
            "quota_ns": quota_ns,
            "stressed_ns": max(round(node.stressed_budget_ms * 1e6), 1),
            "slack_ns": slack_ns,
            "least_ns": round(LEAST_MS * 1e6),
            "drawn_ns": round(DRAWN_MS * 1e6),
            "looks_ns": -1,
            "period_ns": round(quota.period_ms * 1e6),
            "tick_ns": round(quota.tick_ms * 1e6),
            "pool_ns" if slack_ns or ticks else "left_ns": quota_ns,
        }
        if ticks:
            hz = node.background_hz
            new |= {
                "period_ago_ns": phase.period_ago_ns,
                "tick_ago_ns": phase.tick_ago_ns,
                "wake_key": phase.wakes,
                "wake_gap_ns": 1e9 / hz if hz else 0.0,
                "wakes_ns": 0 if hz else LAST_NS,
            }
        self.rows["quotas"].append(new)

    def _add_server(
        self, node: int, kind: str | None, scheduler: Scheduler, cores: int
    ) -> dict[str, Any]:
        row: dict[str, Any] = {
            "node": node,
            "scheduler": scheduler,
            "cores": cores,
            "is_cpu": not kind,
            "next_key": -1,
            "quota": -1,
            "above": -1,
            "below": -1,
            "beside": 1.0,
            "speed": 1.0,
            "spare": float(cores),
        }
        self.server_row[node, kind] = len(self.rows["servers"])
        self.rows["servers"].append(row)
        self.server_workers.append(0)
        return row

    def _add_cell(self, index: int, problem: Problem, real: Realisation) -> None:
        pipeline, release_ns, part = problem.pipeline, real.release_ns, self.parts[index]
        resources = problem.fabric.resources.values()
        flows = ordered_flows(pipeline)
        due_ns, grace_ns = close_after_ns(problem)
        latency = problem.objective.latency
        self.end_ns = max(self.end_ns, int(release_ns[-1]) + grace_ns, int(release_ns[-2]) + due_ns)
        cell = {
            "release_ns": self._addresses(release_ns[None])[0],
            "due_ns": due_ns,
            "grace_ns": grace_ns,
            "n_cycles": part.cycles,
            "deadline_ns": pipeline.deadline_ns,
            "longest_ms": problem.censor_ms,
            "close_cycle": problem.window_cycles,
            "window_cycles": problem.window_cycles,
            "decide_cycles": self.decide_cycles[index],
            "look_cycle": self.decide_cycles[index],
            "task_0": len(self.rows["tasks"]),
            "n_tasks": _copies(problem) * part.tasks,
            "copies": part.tasks if problem.replicas else 0,
            "flow_copies": len(flows) if problem.replicas else 0,
            "flow_0": len(self.rows["flows"]),
            "candidate_0": part.candidate_0,
            "n_candidates": part.candidates,
            "n_sinks": len(pipeline.sinks),
            "sampled_0": len(self.lists["sampled"]),
            "n_sampled": sum(flow.sampled for flow in flows),
            "forward_0": len(self.rows["forwards"]),
            "n_forwards": len(real.forwards),
            "period_ns": pipeline.period_ns,
            "given_up_after": problem.window_cycles + GIVEN_UP_AFTER,
            "pair_0": len(self.lists["shadow_parts"]),
            "resource_0": len(self.lists["cell_servers"]),
            "n_resources": part.resources,
            "n_flows": len(flows),
            "chain_0": len(self.rows["chains"]),
            "n_chains": len(pipeline.chains),
            "latency_chain": -1 if latency is None else list(pipeline.chains).index(latency),
            "weighs_age": problem.objective.weights.age > 0,
            "shadow": -1,
            "parent": -1,
        }
        self.rows["cells"].append(cell)
        self.lists["cell_servers"] += [
            self.server_row[self.node_row[index, one.node], one.kind or None] for one in resources
        ]
        self.lists["capacity"] += [one.capacity for one in resources]
        for copy in range(_copies(problem)):
            self._add_pipeline(pipeline, flows, copy)

    def _add_pipeline(self, pipeline: Pipeline, flows: Sequence[Flow], copy: int) -> None:
        """Add a copy of the tasks of a cell, and of its flows in the order of `ordered_flows`."""
        names, every = list(pipeline.tasks), pipeline.message_rates
        flow_row = {
            (flow.source, flow.target): i for i, flow in enumerate(flows, copy * len(flows))
        }
        self.rows["flows"] += [
            {
                "source": copy * len(names) + names.index(flow.source),
                "target": copy * len(names) + names.index(flow.target),
                "is_sampled": flow.sampled,
                "every": every[flow.source, flow.target],
            }
            for flow in flows
        ]
        self.lists["sampled"] += [
            flow_row[flow.source, flow.target] for flow in pipeline.flows if flow.sampled
        ]
        self.rows["chains"] += [
            {
                "source": names.index(chain.source),
                "target": names.index(chain.target),
                "max_age_ns": chain.max_age_ns,
            }
            for chain in pipeline.chains.values()
        ]
        rates, needed_by = pipeline.rates, pipeline.sink_rates
        in_0 = copy * len(flows)
        for name, task in pipeline.tasks.items():
            outputs = [flow_row[flow.source, flow.target] for flow in pipeline.outputs(name)]
            n_inputs = sum(flow.target == name for flow in flows)
            self.rows["tasks"].append(
                {
                    "n_in": len(pipeline.waited(name)),
                    "in_0": in_0,
                    "n_inputs": n_inputs,
                    "n_out": len(outputs),
                    "out_0": len(self.lists["outputs"]),
                    "offset_ns": round(task.offset_ms * 1e6),
                    "every": rates[name],
                    "rate_0": len(self.lists["sink_rates"]),
                    "n_rates": len(needed_by[name]),
                }
            )
            in_0 += n_inputs
            self.lists["outputs"] += outputs
            self.lists["sink_rates"] += needed_by[name]

    def _add_candidates(
        self,
        index: int,
        problem: Problem,
        real: Realisation,
        link_row: Mapping[str, int],
    ) -> None:
        """Add the sites of tasks and the hops of flows of the newest cell row, by candidate."""
        hop_0 = self._add_hops(problem, real, link_row)
        hop_row = {hop: hop_0 + i for i, hop in enumerate(real.hops)}
        names = list(problem.pipeline.tasks)
        site_row = self._add_sites(index, problem, real, names)
        self._add_forwards(problem, real, hop_0 + len(real.hops), site_row)
        for placement in problem.candidates.values():
            on: list[int] = []
            hop_of: list[int] = []
            doubled = placement.doubled if isinstance(placement, Replicas) else ()
            for copy in placement.copies:
                is_first = copy is placement.first
                on += [
                    site_row[name, copy[name]] if is_first or name in doubled else -1
                    for name in names
                ]
                hop_of += [
                    hop_row.get((f.source, f.target, f"{copy[f.source]}->{copy[f.target]}"), -1)
                    for f in ordered_flows(problem.pipeline)
                ]
            self.lists["site_of"].append(on + [-1] * (self.max_tasks - len(on)))
            self.lists["route"].append(hop_of + [-1] * (self.max_flows - len(hop_of)))
            self.lists["back_ns"].append(back_ns(problem, placement.first))
            self._add_hearing(problem, placement)

    def _add_hearing(self, problem: Problem, placement: Placement) -> None:
        """Add when second copies may be sent, and when nodes hear that a cycle is done."""
        hear: list[int] = []
        after_ns = -1
        if isinstance(placement, Replicas):
            ways_ns, tasks = hear_ns(problem, placement), problem.pipeline.tasks
            nodes = [copy[name] for copy in placement.copies for name in tasks]
            # Only the first task of a node.
            hear = [
                ways_ns[node] if node not in nodes[:row] else -1 for row, node in enumerate(nodes)
            ]
            after_ns = round(placement.after_ms * 1e6)
        self.lists["after_ns"].append(after_ns)
        self.lists["hear_ns"].append(hear + [-1] * (self.max_tasks - len(hear)))

    def _add_forwards(
        self,
        problem: Problem,
        real: Realisation,
        hop_0: int,
        site_row: Mapping[tuple[str, str], int],
    ) -> None:
        """Add the forwards of sampled messages; their hops follow the hops of flows."""
        ends = [(flow.source, flow.target) for flow in ordered_flows(problem.pipeline)]
        for hop, (source, target, name) in enumerate(real.forwards, hop_0):
            link = problem.fabric.links[name]
            self.rows["forwards"].append(
                {
                    "flow": ends.index((source, target)),
                    "from_site": site_row[target, link.source],
                    "to_site": site_row[target, link.target],
                    "hop": hop,
                }
            )

    def _add_pairs(self, problem: Problem) -> None:
        """Add the roles of the tasks for a shadow, by pair of candidates."""
        for active, other in itertools.product(problem.candidates.values(), repeat=2):
            parts = shadow_parts(problem.pipeline, active, other.first)
            # No shadow shares the jobs of second copies.
            parts += [ShadowPart.DISCARDED] * (self.max_tasks - len(parts))
            self.lists["shadow_parts"].append(parts)

    def _add_shadow(
        self, index: int, problem: Problem, real: Realisation, link_row: Mapping[str, int]
    ) -> None:
        """Add the shadow of a cell: its own workers and samples; it shares all other rows."""
        cells, part = self.rows["cells"], self.parts[index]
        cells[part.row]["shadow"] = len(cells)
        # A shadow has no windows.
        shadow = {"candidate_0": len(self.lists["back_ns"]), "close_cycle": real.cycles + 1}
        shadow["decide_cycles"] = shadow["n_chains"] = 0
        cells.append(cells[part.row] | shadow | {"shadow": -1, "parent": part.row})
        self.parts[index] = part._replace(rows=2)
        for node, kind in list(self.server_row):
            self._add_below(node, kind)
        self._add_candidates(index, problem, real, link_row)

    def _add_below(self, node: int, kind: str | None) -> None:
        """Add the server below a server, which has the cores that own jobs leave, if missing."""
        row = self.server_row[node, kind]
        above = self.rows["servers"][row]
        if above["below"] >= 0:
            return
        turns = above["scheduler"] == Scheduler.TURNS
        above["below"] = len(self.rows["servers"])
        below = {"above": row, "below": -1, "quota": -1, "background": 0.0}
        self.rows["servers"].append(
            above | below | {"scheduler": Scheduler.FAIR if turns else above["scheduler"]}
        )
        self.server_workers.append(0)

    def _add_changes(self, index: int, changes: NodeChanges) -> None:
        """Add the changes of a cell's nodes; the first cell's changes apply to shared nodes."""
        row = np.array([self.node_row[index, name] for name in changes.nodes], np.int64)
        table = changes.table
        if not np.array_equal(row, np.arange(len(row))):
            own = [index == 0 or name not in self.shared for name in changes.nodes]
            table = table[np.array(own)[table[:, 1]]]
            table[:, 1] = row[table[:, 1]]
        self.changes.append(_as_rows("changes", table))

    def _add_sites(
        self, index: int, problem: Problem, real: Realisation, names: list[str]
    ) -> dict[tuple[str, str], int]:
        """Add the sites of the newest row of cells."""
        rows: dict[tuple[str, str], int] = {}
        cell = len(self.rows["cells"]) - 1
        columns = list(problem.fabric.resources)
        for (task_name, node_name), exec_ns in zip(
            real.sites, self._addresses(real.exec_ns), strict=True
        ):
            task = problem.pipeline.tasks[task_name]
            execution = task.on[node_name]
            node = self.node_row[index, node_name]
            server = self.server_row[node, execution.accelerator]
            on = self.rows["servers"][server]
            if self.rows["cells"][cell]["parent"] >= 0:
                server = on["below"]
            fair, cores = on["scheduler"] in (Scheduler.FAIR, Scheduler.TURNS), on["cores"]
            threads = execution.threads if execution.accelerator is None else 1
            self.server_workers[server] += execution.workers
            rows[task_name, node_name] = len(self.rows["sites"])
            self.rows["sites"].append(
                {
                    "cell": cell,
                    "task": names.index(task_name),
                    "server": server,
                    "node": node,
                    "own": cell * self.max_resources + columns.index(execution.resource(node_name)),
                    "exec_ns": exec_ns,
                    "depth": task.depth,
                    "rank": -task.priority,  # the smallest goes first
                    "workers": execution.workers,
                    "idle": execution.workers,
                    "threads": threads,
                    "need": threads if fair else min(threads, cores),
                    "start_ns": round(task.start_ms * 1e6),
                    "mean_ns": round(min(execution.exec_ms.expectation * 1e6, LAST_NS)),
                }
            )
        return rows

    def _add_links(self, problem: Problem, real: Realisation) -> dict[str, int]:
        pieces = LinkSegments.of(real.link_segments)
        link_row: dict[str, int] = {}
        for name, link in problem.fabric.links.items():
            link_row[name] = len(self.rows["links"])
            place = pieces.links.index(name) if name in pieces.links else -1
            mine = pieces.table[:, 1] == place
            self.segments.append(_as_rows("segments", pieces.table[mine]))
            self.rates.append(_as_rows("rates", pieces.table_f[mine]))
            first, self.n_segments = self.n_segments, self.n_segments + int(mine.sum())
            retransmit = link.retransmit_ms
            self.rows["links"].append(
                {
                    "in_order": link.in_order,
                    "retransmit_ns": -1 if retransmit is None else round(retransmit * 1e6),
                    "segment": first,
                    "segment_end": self.n_segments,
                }
            )
        return link_row

    def _add_hops(self, problem: Problem, real: Realisation, link_row: Mapping[str, int]) -> int:
        """Add the hops of a row of cells; return the number of the first."""
        hop_0 = len(self.layers)
        payload = {
            (flow.source, flow.target): flow.payload_bytes for flow in problem.pipeline.flows
        }
        # The state of a task is a flow to itself.
        payload |= {
            (task.name, task.name): task.state_bytes for task in problem.pipeline.tasks.values()
        }
        rows = self._addresses(real.delay_ns), real.loss_keys
        links = problem.fabric.links
        for (source, target, link_name), delay_ns, loss_key in zip(
            (*real.hops, *real.forwards), *rows, strict=True
        ):
            self.rows["hops"].append(
                {
                    "link": link_row[link_name],
                    "payload_bytes": payload[source, target],
                    "delay_ns": delay_ns,
                    "loss_key": loss_key,
                    "price": payload[source, target] * links[link_name].price_per_byte,
                }
            )
            self.layers.append({})
        for (hop, layer), extra_ns in zip(real.layers, self._addresses(real.extra_ns), strict=True):
            self.layers[hop_0 + hop][layer] = extra_ns
        return hop_0

    def _check_keys(self) -> None:
        # Forwards of sampled flows are numbered after all flows.
        messages = self.max_flows + max(len(real.forwards) for _, real in self.cells)
        limits = (
            ("cells", len(self.rows["cells"]), codes.CELL_MASK),
            ("tasks of a cell", self.max_tasks, codes.ITEM_MASK),
            ("flows of a cell", self.max_flows, codes.MOST_FLOWS),
            ("flows and forwards of a cell", messages, codes.MOST_FLOWS),
            ("feasible (task, node) pairs", len(self.rows["sites"]), codes.ITEM_MASK),
            ("nodes and accelerators", len(self.rows["servers"]), codes.ITEM_MASK - 1),
        )
        for what, number, limit in limits:
            if number > limit:
                raise SimulationError(f"{number} {what} are more than the simulator's {limit}")

    def _foreign(self, server: Mapping[str, Any], changes: Rows) -> int:
        """Largest number of a server's foreign threads that take turns; 0 without turns."""
        if server["scheduler"] != Scheduler.TURNS:
            return 0
        return int(changes["stress"][changes["node"] == server["node"]].max(initial=0))

    def _tables(self) -> Tables:
        rows, cells, cycles = self.rows, len(self.rows["cells"]), self.cycles
        if len(self.changes) == 1:
            (changes,) = self.changes
        else:
            changes = np.concatenate(self.changes)
            changes = changes[np.argsort(changes["at_ns"], kind="stable")]
        base = 0
        for server, workers in zip(rows["servers"], self.server_workers, strict=True):
            server["base"] = base
            base += max(workers, 1) + self._foreign(server, changes)
        windows, slots = max(real.windows for _, real in self.cells), self._slots()
        looks = max(
            real.cycles // every if every else 0
            for (_, real), every in zip(self.cells, self.decide_cycles, strict=True)
        )
        margin = 64 + sum(len(rows[name]) for name in ("sites", "flows", "tasks", "servers"))
        chains = max(len(problem.pipeline.chains) for problem, _ in self.cells)
        n_layers = 1 + max((layer for known in self.layers for layer in known), default=0)
        clock = {
            "n_slots": slots,
            "n_tasks": self.max_tasks,
            "n_flows": self.max_flows,
            "n_layers": n_layers,
            "n_resources": self.max_resources,
            "has_shared": len(self.cells) > 1 and bool(self.shared),
            "has_rates": any(
                problem.pipeline.has_rates or problem.pipeline.chains or problem.replicas
                for problem, _ in self.cells
            ),
            "n_chains": chains,
            "n_cycles": cycles,
            "n_windows": windows,
            "n_looks": looks,
            "margin": margin,
            "budget": BUDGET,
            "logs_all": self.logs_all,
            "end_ns": self.end_ns,
            "plays_on": any(real.is_cut(problem) for problem, real in self.cells),
        }
        day_bits, n_days = self._calendar()
        rows["clock"].append(clock | {"day_bits": day_bits})
        self._announce_first(changes)
        logged = cells * (cycles if self.logs_all else slots if self.logs_windows else 0)
        # Empty rows of each table.
        room = {
            "events": 4 * margin,
            "held": len(rows["events"]) + 4 * margin,
            "repeats": len(rows["events"]) + 4 * margin,
            "running": base,
            "waiting": base,
            "jobs": cells * slots * self.max_tasks,
            "slots": cells * slots,
        }
        types, of_parts = row_types(), (cells, windows, PARTS, self.max_resources)
        blank: dict[str, Any] = {
            **dict.fromkeys(("work", "switching", "shown", "priced", "tiers"), 0),
            **dict.fromkeys(("stamps", "compute_ns", "network_ns", "outcome"), (cells, cycles)),
            **dict.fromkeys(("opened", "closed", "shares"), of_parts),
            "seen": (cells, windows),
            **dict.fromkeys(
                ("look_opened", "look_shares"), (cells, looks, 2, PARTS, self.max_resources)
            ),
            "look_closed": (cells, looks, PARTS, self.max_resources),
            "looked": (cells, looks),
            "layers": (len(self.layers), n_layers),
            "following": len(rows["events"]) + room["events"],
            "days": n_days,
            "dirty": len(rows["servers"]),
            "ready": margin,
            "attempts": (cells * slots, max(self.max_flows, 1)),
            "own_ns": (cells, self.max_resources),
            "ages": max(problem.window_cycles for problem, _ in self.cells),
            "descents": (cells, cycles, self.max_tasks, chains),
            **dict.fromkeys(("actuated_from", "actuated_newest"), (cells, chains, cycles)),
            "shadow_bytes": (cells if self.shadows else 0, cycles),
            "log_outcome": logged * self.max_tasks,
            "paid": (cells * any(problem.fabric.has_prices for problem, _ in self.cells), cycles),
            "late_copies": (cells * any(problem.replicas for problem, _ in self.cells), cycles),
        }
        width = {"route": (self.max_flows,), **dict.fromkeys(BY_TASK, (self.max_tasks,))}
        tables: dict[str, NDArray[Any]] = {
            **{name: _table(name, of, room.get(name, 0)) for name, of in rows.items()},
            **{name: np.zeros(shape, types[name]) for name, shape in blank.items()},
            **{
                name: np.array(values, types[name]).reshape(len(values), *width.get(name, ()))
                for name, values in self.lists.items()
            },
            "changes": changes,
            "latency_ns": np.full((cells, cycles), NEVER_NS),
            "actuated_ns": np.full((cells, chains, cycles), NEVER_NS),
            "log": _as_rows("log", np.full((logged * self.max_tasks, 6), -1)),
            "log_arrived": np.full((logged, self.max_flows), -1),
            "log_taken": np.full((logged if clock["has_rates"] else 0, self.max_flows), -1),
            "forwarded": np.full(len(rows["forwards"]), -1),
            "values": np.full((len(rows["sites"]) * clock["has_rates"], self.max_flows), -1),
            "soonest_ns": np.full((len(self.lists["back_ns"]), self.max_tasks), -1),
        }
        tables["segments"] = np.concatenate([tables["segments"], *self.segments])
        tables["rates"] = np.concatenate([tables["rates"], *self.rates])
        tables["stamps"][[row["parent"] >= 0 for row in rows["cells"]]] = -1
        for hop, known in enumerate(self.layers):
            for layer, address in known.items():
                tables["layers"][hop, layer] = address
        return Tables(**tables)

    def _calendar(self) -> tuple[int, int]:
        """Bits of a day, with about one event, and the number of days of a year, two periods."""
        pipelines = [problem.pipeline for problem, _ in self.cells]
        # Releases, completions, and messages.
        rate_hz = sum(
            (1 + len(one.tasks) + len(one.flows)) / one.period_ms * 1e3 for one in pipelines
        )
        day_bits = int(1e9 / rate_hz).bit_length()
        year_ns = round(2e6 * max(one.period_ms for one in pipelines))
        return day_bits, 1 << (year_ns >> day_bits).bit_length()

    def _slots(self) -> int:
        """Initial room of the ring in cycles, a power of two; for evidence if it is logged."""
        held = RING_START
        if self.logs_windows and not self.logs_all:
            for problem, real in self.cells:
                close_ns = window_close_ns(problem, real.release_ns[:-1], real.release_ns[1:])
                # Cycles that are released between the last cycle of a window and its end.
                after = 0
                if (close_ns > real.release_ns[1:]).any():
                    released = np.searchsorted(real.release_ns[:-1], close_ns)
                    after = int((released - np.arange(1, real.cycles + 1)).max())
                needed = problem.earlier_cycles + problem.window_cycles + after
                held = max(held, min(needed, real.cycles))
        return 1 << (held - 1).bit_length()

    def _announce_first(self, changes: Rows) -> None:
        """Put the first release of every cell, and the first change of a node, into the queue."""
        first = [
            (int(real.release_ns[0]), make_key(EventKind.RELEASE, part.row))
            for part, (_, real) in zip(self.parts, self.cells, strict=True)
        ]
        if len(changes):
            first.append((int(changes[0]["at_ns"]), make_key(EventKind.CHANGE)))
        # The queue is sorted; the first event is last.
        self.rows["events"] = [
            {"at_ns": at_ns, "key": key} for at_ns, key in sorted(first, reverse=True)
        ]
        self.rows["clock"][0]["n_events"] = len(first)


def _copies(problem: Problem) -> int:
    """Rows of each task and flow of a cell: two if candidates have replicas."""
    return 2 if problem.replicas else 1


def back_ns(problem: Problem, placement: Copy) -> int:
    """Time from a completion until the guard learns of it, of the farthest sink, nanoseconds."""
    return way_back_ns(problem, {placement[task] for task in problem.pipeline.sinks})


def way_back_ns(problem: Problem, from_nodes: Collection[str]) -> int:
    """Longest time that a small message takes from some nodes to the guard, nanoseconds.

    The time is the least sum of mean delays of links to the stamper's node; 0 without a path.
    """
    ways_ms = _ways_ms(problem, problem.stamper_node)
    return round(max(ways_ms.get(node, 0.0) for node in from_nodes) * 1e6)


def hear_ns(problem: Problem, placement: Placement) -> dict[str, int]:
    """Time from the completion of a cycle until each node hears of it; -1 for never."""
    ways = {}
    for name in problem.fabric.nodes:
        ways_ms = _ways_ms(problem, name)
        ms = max(ways_ms.get(placement.first[task], np.inf) for task in problem.pipeline.sinks)
        ways[name] = round(ms * 1e6) if ms < np.inf else -1
    return ways


def _ways_ms(problem: Problem, end: str) -> dict[str, float]:
    """Return the least sum of mean delays over links to a node, from each node that reaches it."""
    to_ms = {end: 0.0}
    reached = [(0.0, end)]
    while reached:
        ms, node = heapq.heappop(reached)
        for link in problem.fabric.links.values():
            further_ms = ms + link.delay_ms.expectation
            if link.target == node and further_ms < to_ms.get(link.source, np.inf):
                to_ms[link.source] = further_ms
                heapq.heappush(reached, (further_ms, link.source))
    return to_ms


def ordered_flows(pipeline: Pipeline) -> list[Flow]:
    """Flows ordered by target; arrivals at one instant then have the order of tasks."""
    names = list(pipeline.tasks)
    return sorted(pipeline.flows, key=lambda flow: names.index(flow.target))


def flow_rows(pipeline: Pipeline) -> Ints:
    """Return the index of each flow of a pipeline among `ordered_flows`."""
    order = ordered_flows(pipeline)
    return np.array([order.index(flow) for flow in pipeline.flows], np.int64)


def flow_columns(problem: Problem) -> Ints:
    """Return the rows of the flows of a cell's first copies, then of its second copies, if any."""
    rows = flow_rows(problem.pipeline)
    return np.concatenate([rows, rows + len(rows)]) if problem.replicas else rows


def shadow_parts(pipeline: Pipeline, active: Placement, other: Copy) -> list[ShadowPart]:
    """Role of each task for the shadow, sent through `other`, of a cycle that runs under `active`.

    A task is shadowed if it, or any task before it, runs on another node or has two copies; a sink
    behind such tasks discards its inputs. All other tasks are shared: their outputs are sent twice.
    """
    diverging = pipeline.diverging(active, other)
    return [
        ShadowPart.SHARED
        if name not in diverging
        else ShadowPart.SHADOWED
        if pipeline.outputs(name)
        else ShadowPart.DISCARDED
        for name in pipeline.tasks
    ]


def _with_own_state(tables: Tables, first: Tables) -> tuple[NDArray[np.uint8], Tables]:
    """Copy the state of the tables `first` into one block; return it, and tables that use it."""
    fields = Tables._fields
    changing = ("clock", "cells", *fields[fields.index("sites") :])
    old = {name: np.ascontiguousarray(getattr(first, name)) for name in changing}
    ends = np.cumsum([-(-table.nbytes // LINE) * LINE for table in old.values()])
    state = np.empty(int(ends[-1]), np.uint8)
    new = {}
    for (name, table), end in zip(old.items(), ends.tolist(), strict=True):
        begin = end - -(-table.nbytes // LINE) * LINE
        new[name] = state[begin : begin + table.nbytes].view(table.dtype).reshape(table.shape)
        new[name][...] = table
    return state, tables._replace(**new)


def _table(name: str, rows: Sequence[Mapping[str, Any]], room: int) -> Rows:
    """Make a table of rows and `room` empty rows; missing columns and empty rows are 0."""
    table = np.zeros(len(rows) + room, row_types()[name])
    for column in dict.fromkeys(key for row in rows for key in row):
        table[column][: len(rows)] = [row.get(column, 0) for row in rows]
    return table


def _as_rows(name: str, table: NDArray[Any]) -> Rows:
    """Return a view of a two-dimensional table as a table of structs."""
    return np.ascontiguousarray(table).view(row_types()[name]).reshape(len(table))
