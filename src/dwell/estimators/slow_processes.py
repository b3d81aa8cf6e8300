"""Slow processes: random processes of a cell that keep their state for many windows.

The mean over a candidate's windows is reliable after every slow process has had its full effect: an
on/off process (bursts, episodes) after `RENEWALS` times off and on, an AR(1) process after
`RENEWALS` correlation times, a trace after one loop. The error of a shorter simulation depends on
how often each process occurred, since single cycles are then correlated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.measured import Message, parts_of
from dwell.kernels.random_draws import NS_PER_MS, NS_PER_S, draw_on_off
from dwell.kernels.realisation import Realisation
from dwell.model.fabric import Bursts
from dwell.model.number_arrays import Floats
from dwell.model.problem import Problem
from dwell.model.process import AR1, Constant, Process, Trace
from dwell.model.scenario import LinkDisturbance, Scenario, acts

#: Number of times off and on, or of correlation times, after which a mean is reliable.
RENEWALS = 30
#: With fewer renewals or correlation times, the windows alone underestimate the error.
FEW = 300
#: An on/off process with a share of the time on up to this is ignored.
RARE = 0.0025
#: Number of parts of a run; the deviation of their means gives the error of the mean.
STRETCHES = 20


class OnOff(NamedTuple):
    """An on/off process: bursts of a node or a link, or the episodes of a scenario."""

    #: Name of its random streams.
    stream: str
    #: Nodes and links that it affects.
    places: frozenset[str]
    #: Times off, in units of `unit_ns`.
    every: Process
    #: Times on, in units of `unit_ns`.
    length: Process
    unit_ns: float
    #: Start of the first time off.
    begin_ns: int = 0

    @property
    def on_ms(self) -> float:
        """Mean time on."""
        return self.length.expectation * self.unit_ns / NS_PER_MS

    @property
    def renewal_ms(self) -> float:
        """Mean time off plus mean time on."""
        return self.every.expectation * self.unit_ns / NS_PER_MS + self.on_ms

    def seen(self, realisation: Realisation, edges_ns: NDArray[np.int64]) -> tuple[int, Floats]:
        """Return how often it is on in some windows, and its share of each window.

        `edges_ns` has the starts of the windows and the end of the last window.
        """
        name = f"{realisation.streams}{self.stream}"
        horizon_ns, seed = int(edges_ns[-1]), realisation.seed or 0
        on = draw_on_off(
            seed, name, self.every, self.length, self.unit_ns, self.begin_ns, horizon_ns
        )
        begins = int(np.count_nonzero(on.end > edges_ns[0]))
        if not len(on.begin):
            return 0, np.zeros(len(edges_ns) - 1)
        before_ns = np.cumsum(on.end - on.begin) - (on.end - on.begin)
        instants = np.column_stack((on.begin, on.end)).ravel()
        elapsed = np.column_stack((before_ns, before_ns + on.end - on.begin)).ravel()
        on_ns = np.diff(np.interp(edges_ns, instants, elapsed, left=0.0))
        return begins, on_ns / np.diff(edges_ns)


class Memory(NamedTuple):
    """An AR(1) process."""

    #: Nodes and links that it affects.
    places: frozenset[str]
    #: Correlation time: cycles with as much information on the mean as one independent value.
    cycles: float


@dataclass(frozen=True, slots=True)
class SlowProcesses:
    """The slow processes of a cell under a scenario."""

    #: On/off processes with a share of the time above `RARE`.
    on_off: tuple[OnOff, ...]
    memories: tuple[Memory, ...]
    #: Length of each replayed trace, cycles.
    loops: tuple[float, ...]
    #: Whether the only random input is one trace.
    has_one_loop: bool
    #: Whether disturbances begin or end at set times: a run then has no stationary mean.
    is_timed: bool

    def least_cycles(self, period_ms: float) -> float:
        """Return the number of cycles in which every slow process has its full effect."""
        renewals = [RENEWALS * one.renewal_ms / period_ms for one in self.on_off]
        return max((*renewals, *(RENEWALS * one.cycles for one in self.memories), *self.loops, 0.0))

    def errors(
        self,
        problem: Problem,
        realisation: Realisation,
        name: str,
        l95_ms: Floats,
        rates: Floats,
        errors: tuple[float, float],
    ) -> tuple[float, float]:
        """Return the standard errors of a candidate's L95 (ms) and V_D, including slow processes.

        `l95_ms` and `rates` are L95 and V_D of the last windows of the realisation. `errors` are
        their standard errors from the windows alone, which are correct without slow processes.
        """
        counted = len(rates) * problem.window_cycles
        if self.has_one_loop and counted >= self.loops[0]:
            rate = float(rates.mean())
            # Cycles after the last complete loop count some rows once more than others.
            more = math.fmod(counted, self.loops[0]) / counted
            return errors[0], more * math.sqrt(rate * (1 - rate))
        places, columns = _places(problem, name), np.column_stack((l95_ms, rates))
        rest, by_times = self._by_times(problem, realisation, places, columns)
        squares = np.square(errors)
        if rest is not columns:
            by_rest = [mean_and_error(column)[1] for column in rest.T]
            squares = np.minimum(np.square(by_rest), squares)
        for memory in self.memories:
            known = max(counted / memory.cycles, 1.0)
            if memory.places & places and known < FEW:
                least = columns[:, 0].std() / math.sqrt(known), unseen_error(rates.mean(), known)
                squares = np.maximum(squares, np.square(least))
        if any(counted < cycles for cycles in self.loops):
            # Each of `STRETCHES` parts of a trace counts as one value.
            share = unseen_error(0.0, STRETCHES) * math.sqrt(1 - counted / max(self.loops))
            most_ms = problem.censor_ms - float(l95_ms.mean())
            squares = np.maximum(squares, np.square((share * most_ms, share)))
        l95_error_ms, rate_error = np.sqrt(squares + by_times).tolist()
        return l95_error_ms, rate_error

    def _by_times(
        self, problem: Problem, realisation: Realisation, places: frozenset[str], columns: Floats
    ) -> tuple[Floats, Floats]:
        """Return windows without the effect of on/off processes, and the squared errors of it.

        Processes with at least `FEW` renewals are ignored. The effect comes from a regression on
        the share of each window in which a process is on. `places` are the nodes and links that the
        candidate uses; `columns` has L95 and V_D of each window, shape (windows, 2).
        """
        width = problem.window_cycles
        edges_ns = realisation.release_ns[-1 - len(columns) * width :: width]
        counted_ms = float(edges_ns[-1] - edges_ns[0]) / NS_PER_MS
        most = np.array([problem.censor_ms, 1.0]) - columns.mean(axis=0)
        squares = np.zeros(2)
        for one in self.on_off:
            if one.places.isdisjoint(places) or counted_ms >= FEW * one.renewal_ms:
                continue
            seen, shares = one.seen(realisation, edges_ns)
            spread = shares - shares.mean()
            variance, effect = float((spread * spread).sum()), most
            if variance:
                slope = (spread[:, None] * columns).sum(axis=0) / variance
                columns = columns - np.outer(spread, slope)
                effect = np.minimum(np.abs(slope), most)
            # A sum of n exponential times on, where n has a Poisson distribution.
            share_error = min(math.sqrt(2 * (seen + 1)) * one.on_ms / counted_ms, 1.0)
            squares += np.square(effect * share_error)
        return columns, squares

    def whole_loops(self, width: int, most: int) -> int | None:
        """Return the number of windows that replay the only random input, a trace, completely.

        A window has `width` cycles. If complete loops end with a window within the first `most`
        windows, the result is the number of this window; otherwise, it is the smallest number of
        windows with a complete loop. If other inputs are random, or no trace exists, it is None.
        """
        if not self.has_one_loop:
            return None
        (cycles,) = self.loops
        if cycles.is_integer() and (whole := int(cycles) // math.gcd(int(cycles), width)) <= most:
            return whole
        return math.ceil(cycles / width)


@lru_cache(maxsize=64)
def slow_processes(problem: Problem, scenario: str) -> SlowProcesses:
    """Return the slow processes of a cell under a scenario."""
    items, fabric = problem.scenario(scenario), problem.fabric
    processes = list(processes_of(problem, items))
    tables = {id(one.table): one.table for _, one, _ in processes if isinstance(one, Trace)}
    slowest = dict.fromkeys(tables, 1)
    for _, process, rate in processes:
        if isinstance(process, Trace) and process.table.by == "row":
            slowest[id(process.table)] = max(slowest[id(process.table)], rate)
    loops = tuple(
        slowest[table_id] * table.loop_cycles(problem.pipeline.period_ms)
        for table_id, table in tables.items()
    )
    # If rows are closer in time than releases, a loop skips some of them.
    replayed = [loop >= table.rows for loop, table in zip(loops, tables.values(), strict=True)]
    random = any(not isinstance(one, Constant | Trace) for _, one, _ in processes)
    lossy = any(link.loss for link in fabric.links.values()) or any(
        isinstance(item, LinkDisturbance) and item.loss for item in items
    )
    ticks = any(node.quota and node.quota.tick_ms for node in fabric.nodes.values())
    on_off: dict[str, OnOff] = {}
    for one in _on_off(problem, items):
        known = on_off.setdefault(one.stream, one)
        on_off[one.stream] = known._replace(places=known.places | one.places)
    timed = any(item.at_s or math.isfinite(item.for_s) for item in items)
    return SlowProcesses(
        on_off=tuple(one for one in on_off.values() if one.on_ms > RARE * one.renewal_ms),
        memories=tuple(
            Memory(places, rate * (1 + one.rho) / (1 - one.rho))
            for places, one, rate in processes
            if isinstance(one, AR1) and one.cv and one.rho > 0
        ),
        loops=loops,
        has_one_loop=replayed == [True] and not (random or lossy or ticks or on_off or timed),
        is_timed=timed,
    )


def processes_of(
    problem: Problem, scenario: Scenario
) -> Iterator[tuple[frozenset[str], Process, int]]:
    """Yield the processes that have a value for each run of a task, or for each message.

    Yields the nodes and links that the process acts on, the process, and the cycles from one value
    to the next; for links, of the slowest flow.
    """
    pipeline, fabric = problem.pipeline, problem.fabric
    rates, every, sent = pipeline.rates, pipeline.message_rates, dict.fromkeys(fabric.links, 1)
    placements = [copy for one in problem.candidates.values() for copy in one.copies]
    for flow, placement in itertools.product(pipeline.flows, placements):
        crossed = f"{placement[flow.source]}->{placement[flow.target]}"
        sent[crossed] = max(sent.get(crossed, 1), every[flow.source, flow.target])
    yield frozenset(fabric.nodes), pipeline.release_jitter_ms, 1
    for name, scale in pipeline.scales.items():
        scaled = [task.on for task in pipeline.tasks.values() if task.scale == name]
        yield frozenset(node for on in scaled for node in on), scale, 1
    for task in pipeline.tasks.values():
        for node, execution in task.on.items():
            yield frozenset((node,)), execution.exec_ms, rates[task.name]
    for name, link in fabric.links.items():
        yield frozenset((name,)), link.delay_ms, sent[name]
        if link.bursts is not None:
            yield frozenset((name,)), link.bursts.add_delay_ms, sent[name]
    for item in scenario:
        if isinstance(item, LinkDisturbance) and item.add_delay_ms is not None:
            yield frozenset((item.link,)), item.add_delay_ms, sent[item.link]


def _on_off(problem: Problem, scenario: Scenario) -> Iterator[OnOff]:
    """Yield the on/off processes with an effect and without an end."""
    fabric = problem.fabric
    for name, node in fabric.nodes.items():
        if node.bursts is not None and node.bursts.threads:
            yield _bursts(name, node.bursts)
    for name, link in fabric.links.items():
        if link.bursts is not None and link.bursts.add_delay_ms != Constant(0.0):
            yield _bursts(name, link.bursts)
    for item in scenario:
        episodes = item.episodes
        if episodes is not None and math.isinf(item.for_s) and acts(item, fabric):
            begin_ns = round(item.at_s * NS_PER_S)
            stream, times = f"episodes/{episodes.name}", (episodes.every_s, episodes.for_s)
            yield OnOff(stream, frozenset((item.place,)), *times, NS_PER_S, begin_ns)


def _bursts(place: str, bursts: Bursts) -> OnOff:
    times = bursts.every_ms, bursts.for_ms
    return OnOff(f"bursts/{place}", frozenset((place,)), *times, NS_PER_MS)


def _places(problem: Problem, name: str) -> frozenset[str]:
    """Return the nodes and links that a candidate's jobs and messages use."""
    parts = parts_of(problem.pipeline, problem.candidates[name])
    return frozenset(part.link if isinstance(part, Message) else part.node for part in parts)


def mean_and_error(by_window: Floats) -> tuple[float, float]:
    """Return the mean of windows, and its standard error from the means of stretches of windows.

    The error is 0 if all windows are equal, and infinite for a single window.
    """
    mean = float(by_window.mean())
    if len(by_window) < 2:
        return mean, math.inf
    if (by_window == by_window[0]).all():
        return mean, 0.0
    stretches = np.array_split(by_window, min(STRETCHES, len(by_window)))
    means = np.array([stretch.mean() for stretch in stretches])
    return mean, float(means.std(ddof=1) / math.sqrt(len(means)))


def unseen_error(rate: float, values: float) -> float:
    """Return the standard error of a rate with one more miss and one more hit (Laplace)."""
    rate = (rate * values + 1) / (values + 2)
    return math.sqrt(rate * (1 - rate) / values)
