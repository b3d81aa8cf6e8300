"""Sampling of realisations; each random quantity has its own named stream."""

from __future__ import annotations

import hashlib
import math
import os
import struct
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import Fault, ProblemError, SimulationError
from dwell.kernels.disturbances import LinkFault, NodeEffect, link_segments, node_changes
from dwell.kernels.drawn_path import BLOCK, Path, ReplayedPath, independent, path_of
from dwell.kernels.on_off_intervals import OnOffIntervals, drawn_intervals, interval, ramp
from dwell.kernels.realisation import LinkSegments, NodeChanges, Phase, Realisation, TraceStart
from dwell.kernels.rows import LEVELS
from dwell.model import (
    Bursts,
    Constant,
    Disturbance,
    LinkDisturbance,
    NodeDisturbance,
    Problem,
    Process,
    Scenario,
    Trace,
    TraceTable,
)
from dwell.model.bounds import short
from dwell.model.instants import HORIZON_NS
from dwell.model.number_arrays import Floats, Ints
from dwell.model.placement import Copy
from dwell.model.scenario import RAMP_STEPS

#: A flow's source and target, and the link of its message.
Hop: TypeAlias = tuple[str, str, str]

NS_PER_MS = 1e6
NS_PER_S = 1e9
# Prefixes of the streams of single jobs and messages.
OF_A_JOB = ("exec/", "delay/", "extra/", "loss/")
# Numbers per cycle without its samples: release, latency and its parts, and columns of a Run.
OF_A_CYCLE = 8
# Share of the full strength at each level of a disturbance, and whether it is on.
STRENGTHS = np.arange(LEVELS) / RAMP_STEPS
ON = np.arange(LEVELS).clip(max=1)


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """Return the seed of the stream `name` in the run with a given seed.

    The spawn key is a hash of the name. A new node, link or task therefore leaves the samples of
    all others unchanged.
    """
    digest = hashlib.blake2b(name.encode(), digest_size=16).digest()
    words = struct.unpack("<4I", digest)
    return np.random.SeedSequence(seed, spawn_key=words)


def draw(
    problem: Problem,
    *,
    scenario: str = "baseline",
    seed: int,
    windows: int,
    streams: str = "",
    shared: Collection[str] = (),
    disturbances: Scenario = (),
) -> Realisation:
    """Sample a realisation of a scenario.

    Parameters
    ----------
    scenario : str
        Name of a scenario of the problem.
    seed : int
        At least 0; the same seed gives the same realisation on any machine.
    windows : int
        Number of windows, at least 1; the run has ``windows * window_cycles`` cycles.
    streams : str
        Prefix of the names of the streams, if several cells use one seed.
    shared : collection of str
        Nodes that the cell shares with others; their changes are sampled without the prefix.
    disturbances : sequence of Disturbance
        All disturbances of shared nodes; for these nodes they replace the scenario's disturbances.

    Raises
    ------
    ProblemError
        If the scenario does not exist, or 64 bits are too few for the cycles or their instants.
    TraceError
        If a trace that does not wrap is shorter than the run.
    SimulationError
        If `seed` or `windows` is out of range, or the memory of this computer too small.
    """
    problem.scenario(scenario)
    if isinstance(windows, bool) or windows < 1:
        raise SimulationError(f"windows is {windows!r}; it must be a whole number of at least 1")
    if isinstance(seed, bool) or seed < 0:
        raise SimulationError(f"seed is {seed!r}; it must be a whole number of at least 0")
    _require_memory(problem, windows)
    try:
        drawing = Drawing(
            *(problem, scenario),
            seed=seed,
            windows=windows,
            streams=streams,
            shared=shared,
            disturbances=disturbances,
        )
        return drawing.take(windows)
    except MemoryError:
        raise SimulationError(
            f"{windows} windows of {scenario!r} need more memory than there is, for their cycles, "
            "or for the episodes and bursts that come in them: ask for fewer windows"
        ) from None


def _require_memory(problem: Problem, windows: int) -> None:
    """Refuse a run whose arrays are larger than this computer's memory."""
    pipeline = problem.pipeline
    sites = sum(len(task.on) for task in pipeline.tasks.values())
    columns = OF_A_CYCLE + sites + len(tuple(_hops(problem))) + len(pipeline.scales)
    cycles = problem.cycles_of(windows)
    needed = 8 * columns * cycles
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > memory:
        raise SimulationError(
            f"{windows} windows of window_cycles = {problem.window_cycles} are {cycles} cycles, "
            f"which take at least {needed / 1e9:.1f} GB; this computer has {memory / 1e9:.1f}: ask "
            "for fewer windows"
        )


def draw_shadows(
    problem: Problem,
    realisation: Realisation,
    sent: Ints | None = None,
    *,
    others: bool = False,
    wraps: bool = False,
) -> Realisation:
    """Sample execution times, delays and losses of the shadow jobs in a realisation.

    Releases, disturbances, scales and the rows of traces are the same as in the realisation,
    because they belong to the cycle or to the fabric.

    Parameters
    ----------
    sent : int64 array, optional
        Cycles with a shadow, ascending; the times of other cycles are 0. All cycles if None.
    others : bool
        Whether to sample the other cycles, too; this does not change the samples of `sent`.
    wraps : bool
        Whether every trace restarts at its end, as in the realisation.
    """

    def drawing(sent: Ints | None) -> Drawing:
        drawing = Drawing.again(problem, realisation, shadow=True, wraps=wraps)
        drawing.sent = sent
        # Rows of traces depend on the releases of complete windows.
        if realisation.cycles == drawing.cycles:
            drawing.release_ns = realisation.release_ns
        return drawing

    if sent is None:
        return drawing(None).take(realisation.windows).until(realisation.cycles)
    whole = drawing(None).take(realisation.windows) if others else None
    return drawing(sent).take_sent(realisation, whole).until(realisation.cycles)


def draw_on_off(
    seed: int,
    name: str,
    every: Process,
    length: Process,
    unit_ns: float,
    begin_ns: int,
    horizon_ns: int,
) -> OnOffIntervals:
    """Sample the intervals of an on/off process from its two streams (see `drawn_intervals`).

    `name` is the common part of the streams' names, such as ``bursts/R1->E`` after the prefix of
    the run.
    """
    rngs = (
        _generator(stream(seed, f"{name}/every")),
        _generator(stream(seed, f"{name}/for")),
    )
    return drawn_intervals(every, length, unit_ns, rngs, begin_ns, horizon_ns)


def _generator(sequence: np.random.SeedSequence) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(sequence))


class Drawing:
    """A realisation that is sampled in successive parts of some windows each.

    Releases and the changes of nodes and links are sampled for the entire run.

    Parameters
    ----------
    problem : Problem
    scenario : str
        Name of a scenario of the problem.
    seed : int
    windows : int
        Number of windows of the entire run.
    shadow : bool
        Whether to sample the quantities of single jobs and messages for shadow jobs.
    wraps : bool
        Whether every trace restarts at its end.
    streams : str
        Prefix of the names of the streams.
    shared, disturbances
        As in `draw`.
    every_hop : bool
        Whether to sample all hops that any placement can use, and not only those of candidates.

    Raises
    ------
    ProblemError
        If the scenario does not exist, or the run is too long.
    """

    def __init__(
        self,
        problem: Problem,
        scenario: str,
        *,
        seed: int,
        windows: int,
        shadow: bool = False,
        wraps: bool = False,
        streams: str = "",
        shared: Collection[str] = (),
        disturbances: Scenario = (),
        every_hop: bool = False,
    ) -> None:
        if problem.is_searched:
            raise ProblemError(
                f"cell {problem.name!r} has `candidates: all`; search first, by "
                "dwell.estimators.searched(problem)"
            )
        self.problem, self.name, self.shared = problem, scenario, shared
        own = (item for item in problem.scenario(scenario) if not self._is_shared(item))
        self.scenario: Scenario = (*own, *disturbances)
        self.seed, self.windows, self.shadow, self.wraps = seed, windows, shadow, wraps
        self.streams = streams
        self.cycles = problem.cycles_of(windows)
        self.drawn = 0
        #: The sampled cycles; None for all (see `draw_shadows`).
        self.sent: Ints | None = None
        tasks = problem.pipeline.tasks
        self.sites = tuple((task, node) for task in tasks for node in tasks[task].on)
        self.hops = tuple(_hops(problem, of_any=every_hop))
        #: Shadow jobs bring no values, so nothing of theirs is forwarded.
        self.forwards = () if shadow else tuple(_forwards(problem))
        #: Link of each hop and forward, with the prefix and the end of the names of its streams.
        self.sent_over = [
            *((hop[2], "", _hop_name(hop)) for hop in self.hops),
            *((hop[2], "forward/", _hop_name(hop)) for hop in self.forwards),
        ]
        rates, every = problem.pipeline.rates, problem.pipeline.message_rates
        #: Cycles from one value of each row to its next, 1 for states; all other values are 0.
        self.site_rates = [rates[task] for task, _ in self.sites]
        self.hop_rates = [every.get(hop[:2], 1) for hop in (*self.hops, *self.forwards)]
        self.paths: dict[str, Path] = {}
        self.rows: dict[int, tuple[TraceTable, Ints]] = {}
        self.release_ns = self._releases()

    @classmethod
    def again(cls, problem: Problem, realisation: Realisation, **more: Any) -> Drawing:
        """Begin to sample a realisation again; `more` are further arguments."""
        return cls(
            *(problem, realisation.scenario),
            seed=realisation.seed or 0,
            windows=realisation.windows,
            streams=realisation.streams,
            **more,
        )

    def take(self, windows: int) -> Realisation:
        """Sample the next windows; raise ValueError if fewer remain.

        The changes of nodes and the segments of links in the result cover the entire run.
        """
        begin, cycles = self.drawn, windows * self.problem.window_cycles
        if begin + cycles > self.cycles:
            raise ValueError(
                f"{windows} windows are more than are left: {self.cycles - begin} cycles"
            )
        self.drawn += cycles
        # The rows of traces are known once they are drawn.
        sampled = self._sampled(self._filled(cycles))
        node_changes, link_segments = self.changes
        return Realisation(
            scenario=self.name,
            seed=self.seed,
            windows=windows,
            release_ns=self.release_ns[begin : self.drawn + 1],
            sites=self.sites,
            hops=self.hops,
            node_changes=node_changes,
            link_segments=link_segments,
            phases=self._phases(),
            trace_starts=tuple(self._trace_starts()),
            streams=self.streams,
            **sampled,
        )

    def take_sent(self, realisation: Realisation, whole: Realisation | None) -> Realisation:
        """Sample the cycles in `sent`; the others are taken from `whole`, or are 0."""
        sent = np.empty(0, np.int64) if self.sent is None else self.sent
        drawn = self._filled(len(sent))
        table = np.zeros((len(drawn), self.cycles), np.int64)
        if whole is not None:
            np.concatenate((whole.exec_ns, whole.delay_ns, whole.extra_ns), out=table)
        layer_rates = [self.hop_rates[hop] for hop, _ in self._layers()]
        rates = (*self.site_rates, *self.hop_rates, *layer_rates)
        for row, values, rate in zip(table, drawn, rates, strict=True):
            due = sent % rate == 0 if rate > 1 else slice(None)
            row[sent[due]] = values[due]
        return replace(realisation, **self._sampled(table))

    def _sampled(self, table: Ints) -> dict[str, Any]:
        """Return the fields of a realisation that depend on the sampled cycles, or on shadows."""
        exec_ns, delay_ns, extra_ns = self._parts(table)
        return {
            "exec_ns": exec_ns,
            "delay_ns": delay_ns,
            "loss_keys": self._loss_keys(),
            "layers": self._layers(),
            "extra_ns": extra_ns,
            "forwards": self.forwards,
        }

    def _filled(self, cycles: int) -> Ints:
        """Sample the next cycles, with one row per site, then per hop, then per extra delay."""
        # One block of memory: the system uses larger pages for large blocks.
        rows = len(self.sites) + len(self.sent_over) + len(self._layers())
        table = np.empty((rows, cycles), np.int64)
        for at in range(0, cycles, BLOCK):
            exec_ns, delay_ns, extra_ns = self._parts(table[:, at : at + BLOCK])
            self._fill_extra(extra_ns, at)
            self._fill_executions(exec_ns, at)
            self._fill_delays(delay_ns, at)
        return table

    def _fill(
        self, row: Ints, at: int, rate: int, path: Path, factors: Floats | None = None
    ) -> None:
        """Sample the values of the next cycles in a row; cycles that are not due have 0."""
        if rate == 1:
            path.fill_ns(row, factors)
            return
        due: slice | NDArray[np.bool_] = slice(-at % rate, None, rate)
        if self.sent is not None:
            due = self.sent[at : at + len(row)] % rate == 0
        row[:] = 0
        values = row[due].copy()
        path.fill_ns(values, None if factors is None else np.ascontiguousarray(factors[due]))
        row[due] = values

    def _parts(self, table: Ints) -> list[Ints]:
        """Return the rows of sites, of hops, and of layers of extra delay."""
        sites = len(self.sites)
        return np.split(table, (sites, sites + len(self.sent_over)))

    def _loss_keys(self) -> NDArray[np.uint64]:
        names = [f"{prefix}loss/{name}" for _, prefix, name in self.sent_over]
        return np.array([self._key(name) for name in names], np.uint64)

    @cached_property
    def changes(self) -> tuple[NodeChanges, LinkSegments]:
        """Changes of nodes and segments of links in the entire run."""
        return self._node_changes(), self._link_segments()

    def episodes(self) -> Scenario:
        """Return the scenario with one disturbance for each sampled episode.

        Raises
        ------
        TraceError
            If the times of episodes come from a trace that is too short or missing.
        """
        return tuple(one for item in self.scenario for one in self._episodes_of(item))

    def _phases(self) -> dict[str, Phase]:
        """Sample the phases of quota periods and ticks for nodes that check quotas at ticks."""
        phases = {}
        for name, node in self.problem.fabric.nodes.items():
            if node.quota is not None and node.quota.tick_ms > 0:
                rng = self._rng(f"phase/{name}")
                period_ns = round(node.quota.period_ms * NS_PER_MS)
                tick_ns = round(node.quota.tick_ms * NS_PER_MS)
                ago_ns = int(rng.integers(period_ns)), int(rng.integers(tick_ns))
                phases[name] = Phase(*ago_ns, self._key(f"wakes/{name}") >> 1)
        return phases

    def _rng(self, name: str) -> np.random.Generator:
        return _generator(self._stream(name))

    def _key(self, name: str) -> int:
        return int(self._stream(name).generate_state(1, np.uint64)[0])

    def _stream(self, name: str) -> np.random.SeedSequence:
        if self.shadow and name.startswith(OF_A_JOB):
            # The key of the losses does not depend on the sampled cycles.
            sent = self.sent is not None and not name.startswith("loss/")
            name = f"shadow/sent/{name}" if sent else f"shadow/{name}"
        return stream(self.seed, f"{self.streams}{name}")

    def _path(self, process: Process, name: str, rate: int = 1) -> Path:
        """Return the path of a stream, which continues after its last value.

        The stream has a value for every `rate`-th cycle.
        """
        if name not in self.paths:
            # Cycles with a value, and the number of each value in the complete path.
            cycles = None if self.sent is None else self.sent[self.sent % rate == 0]
            runs = None if cycles is None else cycles // rate
            if isinstance(process, Trace):
                rows = self._table_rows(process.table)
                if process.table.by == "time":
                    rows = rows[::rate]
                path: Path = ReplayedPath(process.values, rows if runs is None else rows[runs])
            else:
                path = path_of(process, self._rng(name))
                if runs is not None and not (name.startswith(OF_A_JOB) and independent(process)):
                    # Sample all runs and select those with a shadow.
                    path = ReplayedPath(path.values(-(-self.cycles // rate)), runs)
            self.paths[name] = path
        return self.paths[name]

    def _releases(self) -> Ints:
        """Sample the instants of all releases, and of the first release after the run."""
        pipeline, count = self.problem.pipeline, self.cycles + 1
        release = np.empty(count, np.int64)
        for at in range(0, count, BLOCK):
            nominal = np.arange(at, min(at + BLOCK, count), dtype=np.float64)
            nominal *= pipeline.period_ms * NS_PER_MS
            nominal += pipeline.first_release_ms * NS_PER_MS
            release[at : at + BLOCK] = np.rint(nominal, out=nominal)
        jitter = pipeline.release_jitter_ms
        if jitter == Constant(0.0):
            return release
        # Rows of a trace depend on the releases; a trace of the jitter uses the nominal releases.
        self.release_ns = release
        path, last_ns = self._path(jitter, "release"), int(release[-1])
        for at in range(0, self.cycles, BLOCK):
            block = release[at : min(at + BLOCK, self.cycles)]
            late = np.empty_like(block)
            path.fill_ns(late)
            if last_ns + int(late.max()) > HORIZON_NS:
                late_s, latest_s = short(late.max() / NS_PER_S), short(HORIZON_NS / NS_PER_S)
                message = (
                    f"moves one of these {self.cycles} cycles by {late_s} s, beyond {latest_s} s, "
                    "where a run ends at the latest: lower it, or ask for fewer windows"
                )
                raise ProblemError([Fault("release_jitter_ms", message)])
            block += late
        # A cycle is never released before its predecessor.
        return np.maximum.accumulate(release, out=release)

    def _table_rows(self, table: TraceTable) -> Ints:
        if id(table) not in self.rows:
            rng = self._rng(f"trace/{table.stream}/{table.by}/{table.group}")
            # The last release only ends the last window and needs no row.
            release_ms = self.release_ns[:-1] / NS_PER_MS
            self.rows[id(table)] = table, table.replay(rng, release_ms, wraps=self.wraps)
        return self.rows[id(table)][1]

    def _trace_starts(self) -> Iterator[TraceStart]:
        """Yield the first row of each replayed trace."""
        for table, rows in self.rows.values():
            yield TraceStart(table.file, tuple(table.columns), int(rows[0]) + 1)

    def _fill_executions(self, out: Ints, at: int) -> None:
        """Sample the next execution times, one row per site."""
        pipeline = self.problem.pipeline
        factors: dict[str, Floats] = {}
        for row, (task, node), rate in zip(out, self.sites, self.site_rates, strict=True):
            scale = pipeline.tasks[task].scale
            if scale is not None and scale not in factors:
                path = self._path(pipeline.scales[scale], f"scale/{scale}")
                factors[scale] = path.values(len(row))
            process = pipeline.tasks[task].on[node].exec_ms
            path = self._path(process, f"exec/{task}/{node}", rate)
            self._fill(row, at, rate, path, factors[scale] if scale is not None else None)

    def _fill_delays(self, out: Ints, at: int) -> None:
        """Sample the next delays, one row per hop."""
        links = self.problem.fabric.links
        for row, sent, rate in zip(out, self.sent_over, self.hop_rates, strict=True):
            link, prefix, name = sent
            path = self._path(links[link].delay_ms, f"{prefix}delay/{name}", rate)
            self._fill(row, at, rate, path)

    def _fill_extra(self, out: Ints, at: int) -> None:
        """Sample the next extra delays, one row per layer."""
        row = 0
        for (link, prefix, name), rate in zip(self.sent_over, self.hop_rates, strict=True):
            for ordinal, (process, count) in enumerate(self._added(link)):
                rows = out[row : row + count]
                path = self._path(process, f"{prefix}extra/{ordinal}/{name}", rate)
                self._fill(rows[-1], at, rate, path)
                if count > 1:
                    _split(rows)
                row += count

    def _layers(self) -> tuple[tuple[int, int], ...]:
        """Return the hop and number of each layer of extra delay."""
        return tuple(
            (i, layer)
            for i, (link, *_) in enumerate(self.sent_over)
            for layer in range(sum(count for _, count in self._added(link)))
        )

    def _added(self, name: str) -> list[tuple[Process, int]]:
        """Return a link's extra delays with their layers: first bursts, then disturbances."""
        bursts = self.problem.fabric.links[name].bursts
        added = [(bursts.add_delay_ms, 1)] if bursts is not None else []
        items = self._on_link(name)
        return added + [(i.add_delay_ms, i.layers) for i in items if i.add_delay_ms is not None]

    def _is_shared(self, item: Disturbance) -> bool:
        return isinstance(item, NodeDisturbance) and item.node in self.shared

    def _on_link(self, link: str) -> list[LinkDisturbance]:
        return [i for i in self.scenario if isinstance(i, LinkDisturbance) and i.link == link]

    def _bursts(self, bursts: Bursts, name: str) -> OnOffIntervals:
        """Sample the bursts of a node or link up to the end of the run."""
        streams = "" if name in self.shared else self.streams
        horizon_ns, name = int(self.release_ns[-1]), f"{streams}bursts/{name}"
        return draw_on_off(
            self.seed, name, bursts.every_ms, bursts.for_ms, NS_PER_MS, 0, horizon_ns
        )

    def _intervals(self, item: Disturbance) -> OnOffIntervals:
        """Return the intervals of a disturbance up to the end of the run."""
        begin_ns = round(item.at_s * NS_PER_S)
        end_ns = max(begin_ns, round(min(begin_ns + item.for_s * NS_PER_S, HORIZON_NS)))
        if item.ramp_s:
            return ramp(begin_ns, end_ns, round(item.ramp_s * NS_PER_S))
        if item.episodes is None:
            return interval(begin_ns, end_ns)
        episodes, horizon_ns = item.episodes, min(end_ns, int(self.release_ns[-1]))
        # The stream is named after the episodes: disturbances with the same name are simultaneous.
        name, every, length = episodes.name, episodes.every_s, episodes.for_s
        name = f"{'' if self._is_shared(item) else self.streams}episodes/{name}"
        drawn = draw_on_off(self.seed, name, every, length, NS_PER_S, begin_ns, horizon_ns)
        return drawn.until(end_ns)

    def _episodes_of(self, item: Disturbance) -> Iterator[Disturbance]:
        """Yield one disturbance per episode; a disturbance without episodes is unchanged."""
        if item.episodes is None:
            yield item
            return
        on = self._intervals(item)
        for begin_ns, end_ns in zip(on.begin.tolist(), on.end.tolist(), strict=True):
            length_s = (end_ns - begin_ns) / NS_PER_S
            yield replace(item, at_s=begin_ns / NS_PER_S, for_s=length_s, episodes=None)

    def _node_changes(self) -> NodeChanges:
        """Merge stress, bursts and outages of nodes into their changes over time."""
        nodes = self.problem.fabric.nodes
        effects = []
        for number, node in enumerate(nodes.values()):
            if node.bursts is not None and node.bursts.threads:
                threads = np.rint(node.bursts.threads * STRENGTHS)
                effects.append(
                    NodeEffect(self._bursts(node.bursts, node.name), number, threads, False)
                )
            effects += [
                NodeEffect(
                    self._intervals(item),
                    number,
                    np.rint(item.stress_threads * STRENGTHS),
                    item.down,
                )
                for item in self.scenario
                if isinstance(item, NodeDisturbance) and item.node == node.name
            ]
        return NodeChanges(
            tuple(nodes), node_changes(effects, len(nodes), int(self.release_ns[-1]))
        )

    def _link_segments(self) -> LinkSegments:
        """Merge bursts and faults of each link into segments."""
        links = self.problem.fabric.links
        tables = [(np.empty((0, 4), np.int64), np.empty((0, 2)))]
        for number, link in enumerate(links.values()):
            faults, layer = [], 0
            if link.bursts is not None:
                always, own_rate = np.ones(LEVELS), np.full(LEVELS, math.inf)
                faults.append(
                    LinkFault(self._bursts(link.bursts, link.name), ON, always, own_rate, False)
                )
                layer = 1
            for item in self._on_link(link.name):
                layers = np.zeros(LEVELS, np.int64)
                if item.layers:
                    # The bits of a ramp's level are its active layers.
                    layers = (np.arange(LEVELS) if item.ramp_s else ON) << layer
                    layer += item.layers
                arriving = 1 - item.loss * STRENGTHS
                rates = _rates(link.rate_mbps, item.rate_mbps)
                intervals = self._intervals(item)
                faults.append(LinkFault(intervals, layers, arriving, rates, item.down))
            tables.append(link_segments(faults, number, link.rate_mbps, link.loss))
        table, table_f = map(np.concatenate, zip(*tables, strict=True))
        return LinkSegments(tuple(links), table, table_f)


def _split(rows: Ints) -> None:
    """Split the last row into layers with the weights 1, 2, 4, ... of `RAMP_STEPS`."""
    weights = 2 ** np.arange(len(rows) - 1)
    # Multiply quotient and remainder separately: the product may need more than 64 bits.
    whole, rest = np.divmod(rows[-1], RAMP_STEPS)
    rows[:-1] = whole * weights[:, None] + rest * weights[:, None] // RAMP_STEPS
    rows[-1] -= rows[:-1].sum(axis=0)


def _rates(own_mbps: float, mbps: float) -> Floats:
    """Return the rate of a link at each level of a disturbance; the time per bit is linear."""
    rates = np.full(LEVELS, math.inf)
    if mbps < math.inf:
        rates[1:] = 1 / ((1 - STRENGTHS[1:]) / own_mbps + STRENGTHS[1:] / mbps)
        rates[-1] = mbps
    return rates


def _hop_name(hop: Hop) -> str:
    source, target, link = hop
    return f"{link}/{source}->{target}"


def _placements(problem: Problem) -> Iterator[Copy]:
    """Yield the placements of the copies of each candidate."""
    for placement in problem.candidates.values():
        yield from placement.copies


def _hops(problem: Problem, *, of_any: bool = False) -> Iterator[Hop]:
    """Yield flows with the links that they use in some candidate, by flow, then by link.

    With `of_any`, yield the links that they can use in any placement. Else the state of tasks
    follows, as a flow from a task to itself: cold and warm migrations have the same realisation.
    """
    tasks = problem.pipeline.tasks
    for flow in problem.pipeline.flows:
        source, target = flow.source, flow.target
        if of_any:
            yield from _over(problem, source, target, product(tasks[source].on, tasks[target].on))
        else:
            used = ((placed[source], placed[target]) for placed in _placements(problem))
            yield from _over(problem, source, target, used)
    if not of_any:
        for name, task in tasks.items():
            if task.state_bytes > 0:
                yield from _over(problem, name, name, _host_pairs(problem, name))


def _forwards(problem: Problem) -> Iterator[Hop]:
    """Yield sampled flows with the links between nodes of their targets, by flow, then by link."""
    for flow in problem.pipeline.flows:
        if flow.sampled:
            pairs = _host_pairs(problem, flow.target)
            yield from _over(problem, flow.source, flow.target, pairs)


def _host_pairs(problem: Problem, task: str) -> Iterable[tuple[str, str]]:
    """Return the pairs of nodes that candidates give a task."""
    hosts = {placed[task] for placed in _placements(problem)}
    return product(hosts, hosts)


def _over(
    problem: Problem, source: str, target: str, pairs: Iterable[tuple[str, str]]
) -> Iterator[Hop]:
    """Yield a flow with each link that leads between a pair of nodes."""
    ends = set(pairs)
    for link in problem.fabric.links.values():
        if (link.source, link.target) in ends:
            yield source, target, link.name
