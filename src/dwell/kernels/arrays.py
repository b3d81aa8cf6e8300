"""Lay cells and their realisations out as the arrays that the kernels work on."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dwell.errors import SimulationError
from dwell.kernels import layout as k
from dwell.kernels.far_instants import LAST_NS
from dwell.kernels.realisation import LinkSegments, NodeChanges, Phase, Realisation
from dwell.model import Flow, Node, Pipeline, Placement, Problem, Quota, Task
from dwell.model.instants import NEVER_NS
from dwell.model.window_close import window_close_ns

SCHEDULER_CODE = {"fair": k.FAIR, "fifo": k.FIFO, "priority": k.PRIORITY}
RING_START = 64
#: What a core draws on the pool of a quota at a time (sched_cfs_bandwidth_slice_us), and the least
#: run time of a turn (sched_base_slice of two CPUs; eight and more have twice as much), ms.
DRAWN_MS, LEAST_MS = 5.0, 1.4
#: What a server counts in time of its core (`_counted_ns`).
COUNTED = k.QUOTA_NS, k.STRESSED_NS, k.SLACK_NS, k.LEAST_NS, k.DRAWN_NS


class Arrays:
    """The kernels' tables, with the names of their rows.

    Attributes
    ----------
    tables : Tables
        Arguments of `advance`; replaced as a whole when a part of it grows.
    nodes : tuple of str
        Columns of the snapshots, as ``E`` or, in a fleet, ``cell/R1``.
    """

    def __init__(self, tables: k.Tables, nodes: tuple[str, ...]) -> None:
        self.tables = tables
        self.nodes = nodes

    def grow_events(self) -> None:
        """Double the room of the event heap."""
        t = self.tables
        self.tables = t._replace(
            event_t=np.concatenate((t.event_t, np.zeros_like(t.event_t))),
            event_key=np.concatenate((t.event_key, np.zeros_like(t.event_key))),
        )

    def grow_ring(self) -> None:
        """Double the number of cycles that may be in flight, and move those that are."""
        t = self.tables
        ring = t.ring
        cells = len(t.cells)
        jobs = np.zeros((2 * len(t.jobs), k.N_JOB), np.int64)
        slots = np.zeros((2 * len(t.slots), k.N_SLOT), np.int64)
        attempts = np.zeros((2 * len(t.slots), t.attempts.shape[1]), np.int64)
        stride = t.stride
        old = np.arange(cells * ring)
        # A slot that was never used names cycle 0; only one of them can be its slot.
        old = old[t.slots[:, k.CYCLE] % ring == old % ring]
        cycle = t.slots[old, k.CYCLE]
        new = (old // ring) * 2 * ring + (cycle & (2 * ring - 1))
        slots[new] = t.slots[old]
        attempts[new] = t.attempts[old]
        jobs.reshape(-1, stride, k.N_JOB)[new] = t.jobs.reshape(-1, stride, k.N_JOB)[old]
        self.tables = t._replace(ring=2 * ring, jobs=jobs, slots=slots, attempts=attempts)


def lay_out(
    cells: Sequence[tuple[Problem, Realisation]],
    *,
    shared: Collection[str] = (),
    log_jobs: bool = False,
    shadows: Realisation | None = None,
) -> Arrays:
    """Build the tables of one or more cells.

    Parameters
    ----------
    shared : collection of str
        Names of nodes that all cells have in common; such a node, with its stress and outages, is
        that of the first cell. Links are never shared.
    log_jobs : bool
        Whether every job's instants are kept.
    shadows : Realisation, optional
        Draws for the shadow jobs of a single cell (see `draw_shadows`); it gets a shadow then.
    """
    return _Layout(cells, shared, log_jobs, shadows).arrays()


class _Layout:
    """Rows being laid out, cell after cell."""

    def __init__(
        self,
        cells: Sequence[tuple[Problem, Realisation]],
        shared: Collection[str],
        log: bool,
        shadows: Realisation | None,
    ) -> None:
        self.cells, self.shared, self.log = cells, frozenset(shared), log
        self.shadows = shadows
        self.reals = [real for _, real in cells]
        self.single = len(cells) == 1
        self.cycles = max(real.cycles for _, real in cells)
        self.max_tasks = max(len(problem.pipeline.tasks) for problem, _ in cells)
        self.max_flows = max(len(problem.pipeline.flows) for problem, _ in cells)
        self.node_row: dict[str, int] = {}
        self.server_row: dict[tuple[str, str | None], int] = {}
        self.server_workers: list[int] = []
        self.cell_rows: list[list[int]] = []
        self.close_ns: list[k.Ints] = []
        self.tasks: list[list[int]] = []
        self.flows: list[list[int]] = []
        self.out_flows: list[int] = []
        self.sites: list[list[int]] = []
        self.servers: list[list[int]] = []
        self.servers_f: list[list[float]] = []
        self.hops: list[list[int]] = []
        self.links: list[list[int]] = []
        self.layer_rows: list[dict[int, int]] = []
        self.n_segments = 0
        self.segments = [np.empty((0, k.N_SEGMENT), np.int64)]
        self.segments_f = [np.empty((0, k.N_SEGMENT_F))]
        self.site_of: list[list[int]] = []
        self.route: list[list[int]] = []
        self.back_ns: list[int] = []
        self.shadow_parts: list[list[int]] = []
        self.changes = [np.empty((0, k.N_CHANGE), np.int64)]
        self.paces: list[list[int]] = []
        self.paces_f: list[float] = []
        self.extra_rows = 0

    def arrays(self) -> Arrays:
        for index, (problem, real) in enumerate(self.cells):
            self._add_nodes(index, problem, real)
            self._add_cell(index, problem, real)
        if self.shadows is not None:
            ((problem, _),) = self.cells
            self._add_shadow(problem, self.shadows)
        self._check_keys()
        return Arrays(self._tables(), tuple(self.node_row))

    def _node_key(self, index: int, name: str) -> str:
        return name if self.single or name in self.shared else f"{index}/{name}"

    def _add_nodes(self, index: int, problem: Problem, real: Realisation) -> None:
        new = []
        for name, node in problem.fabric.nodes.items():
            key = self._node_key(index, name)
            if key in self.node_row:
                continue
            new.append(name)
            self.node_row[key] = len(self.node_row)
            scheduler = SCHEDULER_CODE[node.scheduler]
            cpu = self._add_server(key, None, scheduler, node.cores)
            of = self.servers_f[-1]
            of[k.SPARE], of[k.BACKGROUND] = node.spare, node.background
            of[k.BESIDE], of[k.PACE] = 1.0 / node.interference, node.pace
            of[k.SPEED] = node.pace * (1.0 if node.scheduler == "fair" else node.spare / node.cores)
            cpu[k.QUOTA_T] = -1
            if node.quota is not None:
                period_ns = round(node.quota.period_ms * 1e6)
                cpu[k.PERIOD_NS] = period_ns
                for column, value in zip(COUNTED, _counted_ns(node, node.quota), strict=True):
                    cpu[column] = value
                cpu[k.TICK_NS] = round(node.quota.tick_ms * 1e6)
                pooled = cpu[k.SLACK_NS] or cpu[k.TICK_NS]
                cpu[k.POOL_NS if pooled else k.LEFT_NS] = cpu[k.QUOTA_NS]
                if cpu[k.TICK_NS]:
                    cpu[k.SCHEDULER] = k.TURNS
                    of_node = real.phases.get(name, Phase())
                    cpu[k.PERIOD_AGO], cpu[k.TICK_AGO] = of_node.period_ago_ns, of_node.tick_ago_ns
                    cpu[k.WAKE_KEY], wakes_hz = of_node.wakes, node.background_hz
                    if wakes_hz:
                        of[k.WAKE_GAP_NS] = 1e9 / wakes_hz
                    else:
                        cpu[k.WAKE_T] = LAST_NS
            for kind, count in node.accelerators.items():
                self._add_server(key, kind, k.FIFO, count)
        for name in new:
            self._add_paces(index, problem.fabric.nodes[name])

    def _add_paces(self, index: int, node: Node) -> None:
        """Add how fast a node is while others on its CPUs have foreign threads."""
        if node.quota is None or not node.contention_stressed:
            return
        server = self.server_row[self._node_key(index, node.name), None]
        others = {
            self.server_row[self._node_key(index, other), None]: share
            for other, share in node.contention_stressed.items()
        }
        for other, share in ({-1: node.contention} | others).items():
            of = replace(node, contention=share)
            self.paces.append([server, other, *_counted_ns(of, node.quota)])
            self.paces_f.append(of.pace)

    def _add_server(self, node: str, kind: str | None, scheduler: int, cores: int) -> list[int]:
        row = [0] * k.N_SERVER
        row[k.SCHEDULER], row[k.CORES] = scheduler, cores
        row[k.NODE_OF], row[k.IS_CPU], row[k.NEXT_KEY] = self.node_row[node], int(not kind), -1
        self.server_row[node, kind] = len(self.servers)
        self.servers.append(row)
        self.servers_f.append([0.0] * k.N_SERVER_F)
        self.servers_f[-1][k.BESIDE] = self.servers_f[-1][k.PACE] = 1.0
        self.servers_f[-1][k.SPEED], self.servers_f[-1][k.SPARE] = 1.0, float(cores)
        self.server_workers.append(0)
        return row

    def _add_cell(self, index: int, problem: Problem, real: Realisation) -> None:
        pipeline = problem.pipeline
        task_0, flow_0, hop_0 = len(self.tasks), len(self.flows), len(self.hops)
        names = list(pipeline.tasks)
        row = [0] * k.N_CELL
        row[k.TASK_0], row[k.N_TASKS] = task_0, len(names)
        row[k.FLOW_0], row[k.CANDIDATE_0] = flow_0, len(self.site_of)
        row[k.N_SINKS] = sum(not pipeline.outputs(name) for name in names)
        row[k.N_CYCLES] = real.cycles
        row[k.CLOSE_CYCLE] = row[k.WINDOW_CYCLES] = problem.window_cycles
        row[k.N_CANDIDATES], row[k.PAIR_0] = len(problem.candidates), len(self.shadow_parts)
        row[k.SHADOW] = row[k.PARENT] = -1
        self.cell_rows.append(row)
        release_ns = real.release_ns
        self.close_ns.append(window_close_ns(problem, release_ns[:-1], release_ns[1:]))
        flows = ordered_flows(pipeline)
        flow_row = {(flow.source, flow.target): i for i, flow in enumerate(flows)}
        for flow in flows:
            self.flows.append([names.index(flow.source), names.index(flow.target)])
        for name in names:
            outputs = [flow_row[flow.source, flow.target] for flow in pipeline.outputs(name)]
            self._add_task(pipeline, pipeline.tasks[name], outputs)
        link_row = self._add_links(problem, real)
        self._add_hops(problem, real, link_row)
        self._add_candidates(index, problem, real, hop_0)
        if self.shadows is not None:
            self._add_pairs(problem)
        self._add_changes(index, NodeChanges.of(real.node_changes))

    def _add_candidates(self, index: int, problem: Problem, real: Realisation, hop_0: int) -> None:
        """Add where the tasks run and the flows cross under every candidate."""
        names = list(problem.pipeline.tasks)
        site_row = self._add_sites(index, problem, real, names)
        hop_row = {hop: hop_0 + i for i, hop in enumerate(real.hops)}
        for placement in problem.candidates.values():
            on = [site_row[name, placement[name]] for name in names]
            self.site_of.append(on + [-1] * (self.max_tasks - len(on)))
            hop_of = [
                hop_row.get(
                    (f.source, f.target, f"{placement[f.source]}->{placement[f.target]}"), -1
                )
                for f in ordered_flows(problem.pipeline)
            ]
            self.route.append(hop_of + [-1] * (self.max_flows - len(hop_of)))
            self.back_ns.append(back_ns(problem, placement))

    def _add_pairs(self, problem: Problem) -> None:
        """Add what the tasks are to a shadow, by pair of candidates."""
        for active in problem.candidates.values():
            for other in problem.candidates.values():
                self.shadow_parts.append(shadow_parts(problem.pipeline, active, other))

    def _add_shadow(self, problem: Problem, real: Realisation) -> None:
        """Add the shadow of the only cell: workers and draws of its own, all else shared."""
        parent = self.cell_rows[0]
        shadow = list(parent)
        parent[k.SHADOW], shadow[k.PARENT] = 1, 0
        shadow[k.CANDIDATE_0] = len(self.site_of)
        # Its windows never close.
        shadow[k.CLOSE_CYCLE] = real.cycles + 1
        self.cell_rows.append(shadow)
        self.close_ns.append(self.close_ns[0])
        self.reals.append(real)
        hop_0 = len(self.hops)
        self._add_hops(problem, real, {name: i for i, name in enumerate(problem.fabric.links)})
        self._add_candidates(1, problem, real, hop_0)

    def _add_changes(self, index: int, changes: NodeChanges) -> None:
        """Add the changes of a cell's nodes; those of a shared node are the first cell's."""
        own = [index == 0 or name not in self.shared for name in changes.nodes]
        row = [self.node_row[self._node_key(index, name)] for name in changes.nodes]
        if row:
            table = changes.table[np.array(own)[changes.table[:, 1]]].copy()
            table[:, 1] = np.array(row)[table[:, 1]]
            self.changes.append(table)

    def _add_task(self, pipeline: Pipeline, task: Task, outputs: list[int]) -> None:
        row = [0] * k.N_TASK
        row[k.N_IN], row[k.N_OUT] = len(pipeline.inputs(task.name)), len(outputs)
        row[k.OUT_0] = len(self.out_flows)
        row[k.OFFSET_NS] = round(task.offset_ms * 1e6)
        self.tasks.append(row)
        self.out_flows += outputs

    def _add_sites(
        self, index: int, problem: Problem, real: Realisation, names: list[str]
    ) -> dict[tuple[str, str], int]:
        rows: dict[tuple[str, str], int] = {}
        for task_name, node_name in real.sites:
            task = problem.pipeline.tasks[task_name]
            execution = task.on[node_name]
            node = self._node_key(index, node_name)
            server = self.server_row[node, execution.accelerator]
            fair = self.servers[server][k.SCHEDULER] in (k.FAIR, k.TURNS)
            cores = self.servers[server][k.CORES]
            row = [0] * k.N_SITE
            row[k.SITE_CELL], row[k.SITE_TASK] = index, names.index(task_name)
            # A smaller rank goes first.
            row[k.DEPTH], row[k.RANK] = task.depth, -task.priority
            row[k.SERVER], row[k.NODE] = server, self.node_row[node]
            row[k.WORKERS] = row[k.IDLE] = execution.workers
            row[k.NEED] = row[k.THREADS] = 1
            if execution.accelerator is None:
                row[k.THREADS] = execution.threads
                row[k.NEED] = execution.threads if fair else min(execution.threads, cores)
            row[k.START_NS] = round(task.start_ms * 1e6)
            row[k.BEFORE_NS] = round(execution.before_ms * 1e6)
            row[k.AFTER_NS] = round(execution.after_ms * 1e6)
            self.server_workers[server] += execution.workers
            rows[task_name, node_name] = len(self.sites)
            self.sites.append(row)
        return rows

    def _add_links(self, problem: Problem, real: Realisation) -> dict[str, int]:
        pieces = LinkSegments.of(real.link_segments)
        link_row: dict[str, int] = {}
        for name, link in problem.fabric.links.items():
            link_row[name] = len(self.links)
            row = [0] * k.N_LINK
            row[k.IN_ORDER] = int(link.in_order)
            retransmit = link.retransmit_ms
            row[k.RETRANSMIT_NS] = -1 if retransmit is None else round(retransmit * 1e6)
            row[k.SEGMENT] = self.n_segments
            if name in pieces.links:
                mine = pieces.table[:, 1] == pieces.links.index(name)
                self.segments.append(pieces.table[mine][:, [0, 2, 3]])
                self.segments_f.append(pieces.table_f[mine])
                self.n_segments += int(mine.sum())
            row[k.SEGMENT_END] = self.n_segments
            self.links.append(row)
        return link_row

    def _add_hops(self, problem: Problem, real: Realisation, link_row: Mapping[str, int]) -> None:
        hop_0 = len(self.hops)
        payload = {
            (flow.source, flow.target): flow.payload_bytes for flow in problem.pipeline.flows
        }
        # The state of a task is a flow to itself.
        payload |= {
            (task.name, task.name): task.state_bytes for task in problem.pipeline.tasks.values()
        }
        for source, target, link_name in real.hops:
            self.hops.append([link_row[link_name], payload[source, target]])
            self.layer_rows.append({})
        for i, (hop, layer) in enumerate(real.layers):
            self.layer_rows[hop_0 + hop][layer] = self.extra_rows + i
        self.extra_rows += len(real.layers)

    def _check_keys(self) -> None:
        limits = (
            ("cells", len(self.cells), k.CELL_MASK),
            ("tasks of a cell", self.max_tasks, k.ITEM_MASK),
            ("flows of a cell", self.max_flows, k.LOST_ON_LINK - 1),
            ("feasible (task, node) pairs", len(self.sites), k.ITEM_MASK),
            ("nodes and accelerators", len(self.servers), k.ITEM_MASK - 1),
        )
        for what, number, limit in limits:
            if number > limit:
                raise SimulationError(f"{number} {what} are more than the simulator's {limit}")

    def _foreign(self, server: list[int], changes: k.Ints) -> int:
        """Most foreign threads of a server among those that take turns."""
        of = changes[changes[:, k.CHANGE_NODE] == server[k.NODE_OF], k.CHANGE_STRESS]
        return int(of.max(initial=0)) if server[k.SCHEDULER] == k.TURNS else 0

    def _tables(self) -> k.Tables:
        cells, nodes, cycles = len(self.cell_rows), len(self.node_row), self.cycles
        changes = np.concatenate(self.changes)
        changes = changes[np.argsort(changes[:, 0], kind="stable")]
        capacity = [
            max(workers, 1) + self._foreign(server, changes)
            for server, workers in zip(self.servers, self.server_workers, strict=True)
        ]
        base = np.concatenate(([0], np.cumsum(capacity)[:-1]))
        servers = _table(self.servers, k.N_SERVER)
        servers[:, k.BASE] = base
        room = int(sum(capacity))
        margin = 64 + len(self.sites) + len(self.flows) + len(self.tasks) + len(servers)
        windows = max(real.windows for _, real in self.cells)
        reals = self.reals
        jobs_logged = cells * cycles * self.max_tasks if self.log else 0
        n_layers = 1 + max((layer for rows in self.layer_rows for layer in rows), default=0)
        layer_rows = np.full((len(self.hops), n_layers), -1, np.int64)
        for hop, rows in enumerate(self.layer_rows):
            for layer, row in rows.items():
                layer_rows[hop, layer] = row
        clock = np.zeros(k.N_CLOCK, np.int64)
        clock[k.END] = max(int(close_ns[-1]) for close_ns in self.close_ns)
        stamps = np.zeros((cells, cycles), np.int16)
        stamps[[row[k.PARENT] >= 0 for row in self.cell_rows]] = -1
        tables = k.Tables(
            ring=RING_START,
            stride=self.max_tasks,
            margin=margin,
            tasks=_table(self.tasks, k.N_TASK),
            flows=_table(self.flows, k.N_FLOW),
            out_flows=np.array(self.out_flows, np.int64),
            site_of=_table(self.site_of, self.max_tasks),
            route=_table(self.route, self.max_flows),
            back_ns=np.array(self.back_ns, np.int64),
            shadow_parts=_table(self.shadow_parts, self.max_tasks),
            hops=_table(self.hops, k.N_HOP),
            loss_keys=np.concatenate([real.loss_keys for real in reals]),
            layer_rows=layer_rows,
            segments=np.concatenate(self.segments),
            segments_f=np.concatenate(self.segments_f),
            changes=changes,
            paces=_table(self.paces, k.N_PACE),
            paces_f=np.array(self.paces_f, np.float64),
            release_ns=_stack([real.release_ns[None] for real in reals], cycles + 1),
            close_ns=_stack([close_ns[None] for close_ns in self.close_ns], cycles),
            exec_ns=_stack([real.exec_ns for real in reals], cycles),
            delay_ns=_stack([real.delay_ns for real in reals], cycles),
            extra_ns=_stack([real.extra_ns for real in reals], cycles),
            stamps=stamps,
            clock=clock,
            cells=_table(self.cell_rows, k.N_CELL),
            sites=_table(self.sites, k.N_SITE),
            servers=servers,
            servers_f=np.array(self.servers_f, np.float64),
            links=_table(self.links, k.N_LINK),
            run_v=np.zeros(room),
            run_key=np.zeros(room, np.int64),
            wait_rank=np.zeros(room, np.int64),
            wait_ready=np.zeros(room, np.int64),
            wait_key=np.zeros(room, np.int64),
            wait_left=np.zeros(room),
            dirty=np.zeros(len(servers), np.int64),
            ready=np.zeros(margin, np.int64),
            event_t=np.zeros(4 * margin, np.int64),
            event_key=np.zeros(4 * margin, np.int64),
            jobs=np.zeros((cells * RING_START * self.max_tasks, k.N_JOB), np.int64),
            slots=np.zeros((cells * RING_START, k.N_SLOT), np.int64),
            attempts=np.zeros((cells * RING_START, max(self.max_flows, 1)), np.int64),
            own=np.zeros((cells, nodes)),
            latency_ns=np.full((cells, cycles), NEVER_NS),
            compute_ns=np.zeros((cells, cycles), np.int64),
            network_ns=np.zeros((cells, cycles), np.int64),
            outcome=np.zeros((cells, cycles), np.int8),
            opened=np.zeros((cells, windows, 3, nodes)),
            closed=np.zeros((cells, windows, 3, nodes)),
            log=np.full((jobs_logged, k.N_LOG), -1, np.int64),
            log_outcome=np.zeros(jobs_logged, np.int8),
            log_arrived=np.full((cells * cycles if self.log else 0, self.max_flows), -1, np.int64),
        )
        _announce_first(tables)
        return tables


def _announce_first(tables: k.Tables) -> None:
    """Put the first release of every cell, and the first change of a node, into the heap."""
    first = [
        (int(tables.release_ns[cell, 0]), (k.RELEASE << k.KIND_SHIFT) | (cell << k.CELL_SHIFT))
        for cell in range(len(tables.cells))
        if tables.cells[cell, k.PARENT] < 0
    ]
    if len(tables.changes):
        first.append((int(tables.changes[0, k.CHANGE_AT]), k.CHANGE << k.KIND_SHIFT))
    # A sorted array is a heap.
    for i, (at, key) in enumerate(sorted(first)):
        tables.event_t[i], tables.event_key[i] = at, key
    tables.clock[k.N_EVENTS] = len(first)


def back_ns(problem: Problem, placement: Placement) -> int:
    """Time from a completion until the guard hears of it, nanoseconds.

    A completion is a small message that takes whichever way is shortest: the least sum of mean
    delays from the sink's node to the stamper's, of the sink that is farthest; 0 where no links
    lead there.
    """
    pipeline, links = problem.pipeline, problem.fabric.links.values()
    sinks = {placement[task] for task in pipeline.tasks if not pipeline.outputs(task)}
    to_ms = {problem.stamper_node: 0.0}
    reached = [(0.0, problem.stamper_node)]
    while reached:
        ms, node = heapq.heappop(reached)
        for link in links:
            further_ms = ms + link.delay_ms.expectation
            if link.target == node and further_ms < to_ms.get(link.source, np.inf):
                to_ms[link.source] = further_ms
                heapq.heappush(reached, (further_ms, link.source))
    return round(max(to_ms.get(node, 0.0) for node in sinks) * 1e6)


def ordered_flows(pipeline: Pipeline) -> list[Flow]:
    """Flows by their target, so that arrivals at one instant order by task."""
    names = list(pipeline.tasks)
    return sorted(pipeline.flows, key=lambda flow: names.index(flow.target))


def shadow_parts(pipeline: Pipeline, active: Placement, other: Placement) -> list[int]:
    """Role of each task for the shadow, sent through `other`, of a cycle that runs under `active`.

    A task is shadowed where it, or any task before it, runs on another node; a sink behind such
    tasks discards what arrives. All other tasks are shared: their outputs are sent twice.
    """
    diverging = pipeline.diverging(active, other)
    return [
        k.SHARED if name not in diverging else k.SHADOWED if pipeline.outputs(name) else k.DISCARDED
        for name in pipeline.tasks
    ]


def _counted_ns(node: Node, quota: Quota) -> list[int]:
    """Quota without and with foreign threads, slack, least turn, and what is drawn at a time."""
    budgets = (max(node.wall_ns(ms), 1) for ms in (node.budget_ms, node.stressed_budget_ms))
    return [*budgets, *(node.wall_ns(ms) for ms in (quota.slack_ms, LEAST_MS, DRAWN_MS))]


def _table(rows: Sequence[Sequence[int]], columns: int) -> k.Ints:
    return np.array(rows, np.int64).reshape(len(rows), columns)


def _stack(parts: Sequence[k.Ints], columns: int) -> k.Ints:
    """Stack rows of cells; one cell's array is used as it is, without a copy."""
    if len(parts) == 1:
        return np.ascontiguousarray(parts[0])
    rows = sum(len(part) for part in parts)
    out = np.zeros((rows, columns), np.int64)
    at = 0
    for part in parts:
        out[at : at + len(part), : part.shape[1]] = part
        at += len(part)
    return out
