"""Draw a realisation: everything random in a scenario, each thing from a stream of its own name."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.kernels.compiled import COMPILED
from dwell.kernels.streams import ar1_path, nanoseconds, standard_normals
from dwell.model import (
    AR1,
    Bursts,
    Constant,
    LinkDisturbance,
    LogNormal,
    NodeDisturbance,
    Problem,
    Process,
    Scenario,
    Trace,
    TraceTable,
)
from dwell.sim.realisation import LinkSegments, NodeChanges, Realisation

__all__ = ["draw", "stream"]

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

NS_PER_MS = 1e6
NS_PER_S = 1e9
# A duration beyond three years is as good as for ever, and its sums still fit 64 bits.
LONGEST_NS = 1e17
# Values drawn at a time: a block and its temporaries stay in the second-level cache.
BLOCK = 16384


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """Seed of the stream called `name` in the run with this seed.

    The name, hashed, is the spawn key of the run's one SeedSequence, so that adding a node, a link
    or a task shifts nobody else's draws.
    """
    digest = hashlib.blake2b(name.encode(), digest_size=16).digest()
    words = tuple(int(word) for word in np.frombuffer(digest, dtype="<u4"))
    return np.random.SeedSequence(seed, spawn_key=words)


def draw(problem: Problem, *, scenario: str = "baseline", seed: int, windows: int) -> Realisation:
    """Draw a realisation of a scenario.

    Parameters
    ----------
    problem : Problem
    scenario : str
        Name of one of its scenarios.
    seed : int
        At least 0; the same seed gives the same realisation on any machine.
    windows : int
        Number of windows, at least 1; the run has ``windows * window_cycles`` cycles.

    Returns
    -------
    Realisation

    Raises
    ------
    ProblemError
        If there is no such scenario.
    TraceError
        If a trace that does not wrap is shorter than the run.
    SimulationError
        If `seed` or `windows` is out of range.
    """
    disturbances = problem.scenario(scenario)
    if isinstance(windows, bool) or windows < 1:
        raise SimulationError(f"windows is {windows!r}; it must be a whole number of at least 1")
    if isinstance(seed, bool) or seed < 0:
        raise SimulationError(f"seed is {seed!r}; it must be a whole number of at least 0")
    cycles = windows * problem.window_cycles
    if cycles >= 1 << 32:
        raise SimulationError(f"windows is {windows}; {cycles} cycles are more than 2^32")
    return _Draw(problem, scenario, disturbances, seed, windows).realisation()


class _Generator(np.random.Generator):
    """NumPy's generator, with normals drawn by compiled code: the same ones, in half the time."""

    def standard_normal(self, size: int) -> Floats:  # type: ignore[override]
        if not COMPILED:
            return super().standard_normal(size)
        out = np.empty(size)
        standard_normals(self, out)
        return out


class _Draw:
    """One drawing in progress: the seed, the releases and the rows that traces share."""

    def __init__(
        self, problem: Problem, name: str, scenario: Scenario, seed: int, windows: int
    ) -> None:
        self.problem, self.name, self.scenario = problem, name, scenario
        self.seed, self.windows = seed, windows
        self.cycles = windows * problem.window_cycles
        self.rows: dict[int, Ints] = {}
        self.release_ns = self._releases()

    def realisation(self) -> Realisation:
        tasks = self.problem.pipeline.tasks
        sites = tuple((task, node) for task in tasks for node in tasks[task].on)
        hops = _hops(self.problem)
        layers, extra_ns, of_link = self._layers(hops)
        return Realisation(
            scenario=self.name,
            seed=self.seed,
            windows=self.windows,
            release_ns=self.release_ns,
            sites=sites,
            exec_ns=self._executions(sites),
            hops=hops,
            delay_ns=self._delays(hops),
            loss_keys=np.array([self._key(f"loss/{_hop_name(hop)}") for hop in hops], np.uint64),
            layers=layers,
            extra_ns=extra_ns,
            node_changes=self._node_changes(),
            link_segments=self._link_segments(of_link),
        )

    def _rng(self, name: str) -> np.random.Generator:
        return _Generator(np.random.SFC64(stream(self.seed, name)))

    def _key(self, name: str) -> int:
        return int(stream(self.seed, name).generate_state(1, np.uint64)[0])

    def _releases(self) -> Ints:
        pipeline = self.problem.pipeline
        nominal = np.arange(self.cycles + 1) * (pipeline.period_ms * NS_PER_MS)
        release: Ints = np.rint(nominal, out=nominal).astype(np.int64)
        jitter = pipeline.release_jitter_ms
        if jitter == Constant(0.0):
            return release
        if isinstance(jitter, Trace):
            # Rows of a trace follow the releases; for its own jitter they follow the nominal ones.
            self.release_ns = release
        late = np.zeros(self.cycles + 1, np.int64)
        self._fill(late[:-1], jitter, "release")
        # A cycle is never released before the one ahead of it.
        ordered: Ints = np.maximum.accumulate(release + late)
        return ordered

    def _table_rows(self, table: TraceTable) -> Ints:
        rows = self.rows.get(id(table))
        if rows is None:
            rng = self._rng(f"trace/{table.file}/{table.by}/{table.group}")
            # The last release only closes the last window; no cycle needs a row for it.
            rows = table.replay(rng, self.release_ns[:-1] / NS_PER_MS)
            self.rows[id(table)] = rows
        return rows

    def _fill(self, out: Ints, process: Process, name: str, scale: Floats | None = None) -> None:
        """Fill `out` with a path of the process in nanoseconds, block by block."""
        if isinstance(process, Constant) and scale is None:
            out[:] = round(min(process.value * NS_PER_MS, LONGEST_NS))
            return
        rng = self._rng(name)
        state = math.nan
        for begin in range(0, len(out), BLOCK):
            end = min(begin + BLOCK, len(out))
            values, state = self._block(process, rng, begin, end, state)
            if scale is not None:
                values *= scale[begin:end]
            nanoseconds(values, NS_PER_MS, LONGEST_NS, out[begin:end])

    def _block(
        self, process: Process, rng: np.random.Generator, begin: int, end: int, state: float
    ) -> tuple[Floats, float]:
        if isinstance(process, Trace):
            return process.values[self._table_rows(process.table)[begin:end]], state
        if not isinstance(process, AR1):
            return process.marginal(rng, end - begin), state
        noise = rng.standard_normal(end - begin)
        state = ar1_path(noise, process.log_correlation, state, begin == 0)
        mu, sigma = LogNormal(process.mean, process.cv).log_parameters
        noise *= sigma
        noise += mu
        return np.exp(noise, out=noise), state

    def _executions(self, sites: tuple[tuple[str, str], ...]) -> Ints:
        pipeline = self.problem.pipeline
        scales: dict[str, Floats] = {}
        exec_ns = np.empty((len(sites), self.cycles), np.int64)
        for row, (task, node) in enumerate(sites):
            name = pipeline.tasks[task].scale
            if name is not None and name not in scales:
                scales[name] = self._factors(pipeline.scales, name)
            scale = scales[name] if name is not None else None
            process = pipeline.tasks[task].on[node].exec_ms
            self._fill(exec_ns[row], process, f"exec/{task}/{node}", scale)
        return exec_ns

    def _factors(self, scales: Mapping[str, Process], name: str) -> Floats:
        factors = np.empty(self.cycles)
        rng = self._rng(f"scale/{name}")
        state = math.nan
        for begin in range(0, self.cycles, BLOCK):
            end = min(begin + BLOCK, self.cycles)
            factors[begin:end], state = self._block(scales[name], rng, begin, end, state)
        return factors

    def _delays(self, hops: tuple[tuple[str, str, str], ...]) -> Ints:
        links = self.problem.fabric.links
        delay_ns = np.empty((len(hops), self.cycles), np.int64)
        for row, hop in enumerate(hops):
            self._fill(delay_ns[row], links[hop[2]].delay_ms, f"delay/{_hop_name(hop)}")
        return delay_ns

    def _layers(
        self, hops: tuple[tuple[str, str, str], ...]
    ) -> tuple[tuple[tuple[int, int], ...], Ints, dict[str, list[Bursts | LinkDisturbance]]]:
        """Extra-delay layers: per link its bursts first, then the scenario's impairments."""
        of_link: dict[str, list[Bursts | LinkDisturbance]] = {}
        for name, link in self.problem.fabric.links.items():
            if link.bursts is not None:
                of_link.setdefault(name, []).append(link.bursts)
        for item in self.scenario:
            if isinstance(item, LinkDisturbance) and item.add_delay_ms is not None:
                of_link.setdefault(item.link, []).append(item)
        layers = tuple(
            (hop, layer)
            for hop, (_, _, link) in enumerate(hops)
            for layer in range(len(of_link.get(link, ())))
        )
        extra_ns = np.empty((len(layers), self.cycles), np.int64)
        for row, (hop, layer) in enumerate(layers):
            process = of_link[hops[hop][2]][layer].add_delay_ms
            if process is None:
                continue
            self._fill(extra_ns[row], process, f"extra/{layer}/{_hop_name(hops[hop])}")
        return layers, extra_ns, of_link

    def _episodes(self, bursts: Bursts, name: str) -> tuple[Ints, Ints]:
        """Begins and ends of all bursts up to the end of the run, nanoseconds, ascending."""
        horizon = float(self.release_ns[-1])
        quiet, active = self._rng(f"bursts/{name}/every"), self._rng(f"bursts/{name}/for")
        mean_ms = bursts.every_ms.expectation + bursts.for_ms.expectation
        count = 64 + round(1.1 * horizon / (mean_ms * NS_PER_MS))
        begins, ends = [np.empty(0)], [np.empty(0)]
        now = 0.0
        while now < horizon:
            end = bursts.every_ms.marginal(quiet, count)
            end *= NS_PER_MS
            length = bursts.for_ms.marginal(active, count)
            length *= NS_PER_MS
            end += length
            np.cumsum(end, out=end)
            end += now
            now = float(end[-1])
            begins.append(np.subtract(end, length, out=length))
            ends.append(end)
        begin = np.concatenate(begins)
        begun = int(np.searchsorted(begin, horizon))
        begin, end = begin[:begun], np.minimum(np.concatenate(ends)[:begun], LONGEST_NS)
        return np.rint(begin).astype(np.int64), np.rint(end).astype(np.int64)

    def _node_changes(self) -> NodeChanges:
        """Fold stress, bursts and outages of each node into the states it goes through."""
        nodes = tuple(self.problem.fabric.nodes)
        horizon = int(self.release_ns[-1])
        tables = [np.empty((0, 4), np.int64)]
        for row, node in enumerate(self.problem.fabric.nodes.values()):
            steps = [np.empty((3, 0), np.int64)]
            if node.bursts is not None and node.bursts.threads:
                steps.append(_in_turn(*self._episodes(node.bursts, node.name)))
                steps[-1][1] *= node.bursts.threads
            for item in self.scenario:
                if isinstance(item, NodeDisturbance) and item.node == node.name:
                    begin, end = _interval_ns(item.at_s, item.for_s)
                    threads, down = item.stress_threads, int(item.down)
                    steps.append(np.array([[begin, end], [threads, -threads], [down, -down]]))
            at, threads, down = _accumulate(np.concatenate(steps, axis=1))
            count = int(np.searchsorted(at, horizon, side="right"))
            table = np.empty((count, 4), np.int64)
            table[:, 0], table[:, 1] = at[:count], row
            table[:, 2], table[:, 3] = threads[:count], down[:count] > 0
            tables.append(table)
        table = np.concatenate(tables)
        return NodeChanges(nodes, table.take(np.argsort(table[:, 0], kind="stable"), axis=0))

    def _link_segments(self, of_link: dict[str, list[Bursts | LinkDisturbance]]) -> LinkSegments:
        """Cut each link's time where something begins or ends, and sum up what holds in between."""
        links = tuple(self.problem.fabric.links)
        tables = [np.empty((0, 4), np.int64)]
        tables_f = [np.empty((0, 2))]
        for row, link in enumerate(self.problem.fabric.links.values()):
            active = [
                (*_interval_ns(item.at_s, item.for_s), item)
                for item in self.scenario
                if isinstance(item, LinkDisturbance) and item.link == link.name
            ]
            none = np.empty(0, np.int64)
            begins, ends = (
                self._episodes(link.bursts, link.name) if link.bursts is not None else (none, none)
            )
            edges = [edge for begin, end, _ in active for edge in (begin, end)]
            cuts = np.unique(np.concatenate(([0], edges, begins, ends))).astype(np.int64)
            table = np.zeros((len(cuts), 4), np.int64)
            table_f = np.empty((len(cuts), 2))
            table[:, 0], table[:, 1] = cuts, row
            survives = np.full(len(cuts), 1 - link.loss)
            rate = np.full(len(cuts), link.rate_mbps)
            layers = of_link.get(link.name, [])
            if link.bursts is not None:
                # Bursts of one link never overlap: more of them begun than ended means one is on.
                begun = np.searchsorted(begins, cuts, side="right")
                table[:, 3] |= begun > np.searchsorted(ends, cuts, side="right")
            for begin, end, item in active:
                on = (begin <= cuts) & (cuts < end)
                table[on, 2] |= int(item.down)
                survives[on] *= 1 - item.loss
                rate[on] = np.minimum(rate[on], item.rate_mbps)
                if item.add_delay_ms is not None:
                    layer = next(i for i, other in enumerate(layers) if other is item)
                    table[on, 3] |= 1 << layer
            table_f[:, 0], table_f[:, 1] = rate, 1 - survives
            tables.append(table)
            tables_f.append(table_f)
        return LinkSegments(links, np.concatenate(tables), np.concatenate(tables_f))


def _in_turn(begins: Ints, ends: Ints) -> Ints:
    """Steps of episodes that never overlap: rows at, change by one thread, no outage."""
    steps = np.zeros((3, 2 * len(begins)), np.int64)
    steps[0, 0::2], steps[0, 1::2] = begins, ends
    steps[1, 0::2], steps[1, 1::2] = 1, -1
    return steps


def _accumulate(steps: Ints) -> Ints:
    """Sum steps (rows at, change, change) up into the levels that hold from each instant on."""
    # Take and compress are several times as fast as indexing, and nothing is faster still.
    if (steps[0, 1:] < steps[0, :-1]).any():
        steps = steps.take(np.argsort(steps[0], kind="stable"), axis=1)
    np.cumsum(steps[1:], axis=1, out=steps[1:])
    last = np.ones(steps.shape[1], np.bool_)
    np.not_equal(steps[0, 1:], steps[0, :-1], out=last[:-1])
    return steps if last.all() else steps.compress(last, axis=1)


def _interval_ns(at_s: float, for_s: float) -> tuple[int, int]:
    begin = round(at_s * NS_PER_S)
    return begin, round(min(begin + for_s * NS_PER_S, LONGEST_NS))


def _hop_name(hop: tuple[str, str, str]) -> str:
    source, target, link = hop
    return f"{link}/{source}->{target}"


def _hops(problem: Problem) -> tuple[tuple[str, str, str], ...]:
    """Flows on the links they cross in some candidate, in the order of flows and links."""
    hops: dict[tuple[str, str, str], None] = {}
    for flow in problem.pipeline.flows:
        crossed = {
            f"{placement[flow.source]}->{placement[flow.target]}"
            for placement in problem.candidates.values()
        }
        for link in problem.fabric.links:
            if link in crossed:
                hops[flow.source, flow.target, link] = None
    return tuple(hops)
