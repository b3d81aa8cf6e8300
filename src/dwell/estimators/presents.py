"""Simulate candidates under measured conditions, with the kernel.

Measured conditions (`Present`) are the differences from the undisturbed cell that windows have
shown: demands of some parts, foreign threads of some nodes, rates of links, nodes that are down.
All candidates are simulated on the same realisation. Each simulation continues where it stopped,
and its newest steps are averaged until the conditions change.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Message, Meter, Part, Site, cores_of, parts_of
from dwell.estimators.pool import Reference
from dwell.estimators.prices import SEED, Question, most_windows, prices_of
from dwell.estimators.sent_shadows import SentShadows, stamps_of
from dwell.estimators.slow_processes import slow_processes, unseen_error
from dwell.estimators.spans import patience_ns
from dwell.kernels.advance import LoggedCycles, play
from dwell.kernels.arrays import Arrays, CellArrays, flow_rows, lay_out
from dwell.kernels.codes import LAST_NS
from dwell.kernels.pools import TimesRow, fill
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import LinkSegments, NodeChange, NodeChanges, Realisation
from dwell.kernels.rows import Rows, row_types
from dwell.kernels.sampling_errors import PAIRS, SeriesSums, Steps, tail_error_ms
from dwell.model.fabric import Node
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats, Ints
from dwell.model.problem import Problem
from dwell.model.shadow_plan import ShadowFraction

#: Longest simulated window, cycles; cycles of a step, which has at least one window.
LONGEST_WINDOW, STEP = 1000, 100
#: Sampled cycles, which repeat when all are simulated; fewest windows of these cycles.
DRAWN, FEWEST = 2400, 4
#: Most steps in a candidate's price; the same while the measured demands change.
KEPT, RECENT = 24, 6
#: Limit of the correlation of successive steps; more would be a drift.
MOST_ALIKE = 0.9
#: Number of cycles after a step that may already be released when it ends.
BEYOND = 64
#: A fraction of a thread below this counts as 0, above 1 - this as 1.
FRACTION = 0.15
#: Most foreign threads of a node in addition to the declared threads.
MOST_THREADS = 64


@dataclass(frozen=True, slots=True)
class Present:
    """Measured conditions: all that differs from the declared cell."""

    #: Milliseconds, in the order of cycles: times of jobs alone on their node, or delays of
    #: messages, infinite if lost.
    demands: Mapping[Part, Floats] = field(default_factory=FrozenDict)
    #: Foreign threads of a node in addition to its bursts. A negative number is added to the mean
    #: number of declared threads, which is then constant.
    threads: Mapping[str, float] = field(default_factory=FrozenDict)
    #: Nodes that are down.
    down: frozenset[str] = frozenset()
    #: Rates of links.
    rates_mbps: Mapping[str, float] = field(default_factory=FrozenDict)

    def __repr__(self) -> str:
        what = [*map(str, self.demands), *self.threads, *(f"{name} down" for name in self.down)]
        what += [f"{name} at {mbps:.3g} Mbit/s" for name, mbps in self.rates_mbps.items()]
        return f"<Present: {', '.join(what) or 'as declared'}>"


class PlayedPrice(NamedTuple):
    """Means over the simulated windows of a candidate, with standard errors (see `Price`)."""

    l95_ms: float
    l95_error_ms: float
    uncut_l95_ms: float
    violation_rate: float
    violation_error: float
    own: Mapping[str, float]


class _Twin:
    """The simulation of a candidate, and the results of its steps."""

    def __init__(
        self, first: Arrays, index: int, shadows: SentShadows | None, resources: int
    ) -> None:
        self.arrays = first.copy()
        self.arrays.replace(stamps=stamps_of(first, index, shadows))
        #: Next cycle to simulate.
        self.cursor = 0
        #: Means of each step, oldest first: L95 (ms) and V_D, each followed by the mean of the same
        #: windows as declared; uncut L95; the cell's own share of every resource.
        self.steps = Steps(KEPT, PAIRS + 1 + resources)
        #: Latencies of the cycles of each step.
        self.latency_ns: deque[Ints] = deque(maxlen=KEPT)
        self.price: PlayedPrice | None = None

    def add(self, means: Sequence[float], latency_ns: Ints) -> None:
        """Add a step; drop the oldest beyond `KEPT`."""
        self.steps.add(means)
        self.latency_ns.append(latency_ns)

    def keep(self, most: int) -> None:
        """Keep the newest `most` steps."""
        self.steps.keep(most)
        while len(self.latency_ns) > most:
            self.latency_ns.popleft()


@dataclass(frozen=True, slots=True)
class Declared:
    """The undisturbed cell, as `Playing` simulates it."""

    realisation: Realisation
    #: Demands of every part, as windows would measure them.
    references: Mapping[Part, Reference]
    #: L95 of every window, by candidate.
    l95_ms: Mapping[str, Floats]
    #: V_D of every window, by candidate.
    violation_rate: Mapping[str, Floats]
    #: The simulated shadow jobs, if they slow any candidate down.
    shadows: SentShadows | None = None

    def __repr__(self) -> str:
        return f"<Declared: {self.realisation!r}, {len(self.references)} parts>"


class Playing:
    """Simulation of the candidates of a problem under measured conditions.

    `seed` is the seed of the declared realisation; `shadow_fraction` is the share of cycles that
    are also sent through each alternative, by simulated candidate. `prices` are the prices as
    declared; `cycles` counts the simulated cycles of all candidates.
    """

    def __init__(
        self, problem: Problem, seed: int = SEED, shadow_fraction: ShadowFraction = 0.0
    ) -> None:
        self.problem, self._seed, self._shadow_fraction = problem, seed, shadow_fraction
        self.declared = declared_of(problem, seed, shadow_fraction)
        self.prices = prices_of(problem, shadow_fraction=shadow_fraction)
        self._window = min(problem.window_cycles, LONGEST_WINDOW)
        self._names, self._resources = tuple(problem.candidates), tuple(problem.fabric.resources)
        self._step, self._censor_ms = max(STEP // self._window, 1), problem.censor_ms
        #: Standard deviations of a step's L95 (ms) and V_D, as declared.
        self._usual = {
            name: [
                float(windows[name][1:].std()) / math.sqrt(self._step)
                for windows in (self.declared.l95_ms, self.declared.violation_rate)
            ]
            for name in self._names
        }
        self.cycles = 0
        self._twins: dict[str, _Twin] = {}
        #: Demands in the tables of the cycles.
        self._filled: Mapping[Part, Floats] = {}

    def __reduce__(self) -> tuple[type[Playing], tuple[Problem, int, ShadowFraction]]:
        # The kernel's tables have addresses; a copy starts without simulations.
        return Playing, (self.problem, self._seed, self._shadow_fraction)

    def begin(self, present: Present) -> None:
        """Begin with other measured conditions; discard the results of earlier steps."""
        if not self._twins:
            self._lay_out()
        self.present = present
        self._offset = 0
        self._restore()
        changes = self._changes(present)
        self._first.replace(changes=changes)
        self._set_links(present)
        self._set_losses(present)
        for twin in self._twins.values():
            twin.keep(0)
            twin.arrays.replace(changes=changes)
        self._restart()

    def go_on(
        self, present: Present, names: Collection[str], steps: int = 1, *, has_grown: bool = False
    ) -> None:
        """Simulate more steps of some candidates; the measured conditions have the same parts.

        If `has_grown`, the parts have newer values, and prices use only the most recent steps.
        """
        self.present = present
        if has_grown:
            self._set_losses(present)
            self._fill(max(twin.cursor for twin in self._twins.values()))
            for name in names:
                self._twins[name].keep(RECENT - 1)
        for _ in range(steps):
            last = max(self._twins[name].cursor for name in names)
            if last + self._step * self._window > self._real.cycles:
                self._offset += self._real.cycles
                self._restart()
            for name in names:
                self._play(self._twins[name], name)

    def _restart(self) -> None:
        for twin in self._twins.values():
            twin.arrays.restart(self._first)
            twin.cursor = 0
        self._fill(0)

    def _play(self, twin: _Twin, name: str) -> None:
        first = twin.cursor // self._window
        last = first + self._step
        twin.cursor += self._step * self._window
        for _ in range(self._step):
            play(twin.arrays)
        first = max(first, 1)  # in the first window queues have not settled
        if first < last:
            tables, stretch = twin.arrays.tables, slice(first, last)
            seen = tables.seen[0, stretch]
            means = (
                _mean(seen["l95_ms"]),
                _mean(self.declared.l95_ms[name][stretch]),
                _mean(seen["missed"]) / _mean(seen["counted"]),
                _mean(self.declared.violation_rate[name][stretch]),
                _mean(seen["uncut_ms"]),
                *_mean_shares(tables.shares[0, stretch, 1]),
            )
            twin.add(means, tables.latency_ns[0, first * self._window : twin.cursor].copy())
        twin.price = None
        self.cycles += self._step * self._window

    def played(self, name: str) -> PlayedPrice:
        """Return the price of a candidate under the measured conditions."""
        twin = self._twins[name]
        if twin.price is None:
            twin.price = self._price(name, twin.steps)
        return twin.price

    def deviations(self, name: str) -> tuple[float, float]:
        """Return the standard deviations of one window's L95, milliseconds, and V_D."""
        price = self.prices[name]
        usual = price.l95_deviation_ms, price.violation_deviation
        if not self._twins or len(steps := self._twins[name].steps) < 2:
            return usual
        shown = np.ascontiguousarray(steps.table[:, :PAIRS:2])
        # A deviation from few values is itself uncertain.
        few = (len(steps) + 1) / (len(steps) - 1) * math.sqrt(self._step)
        l95_ms, rate = (few * shown.std(axis=0)).tolist()
        return max(l95_ms, usual[0]), max(rate, usual[1])

    def tail_error_ms(self, name: str, off: float) -> float:
        """Return the error of L95 (ms) that an error `off` of the share of lost cycles causes."""
        latency_ns = np.concatenate(self._twins[name].latency_ns)
        return tail_error_ms(latency_ns, self._censor_ms, off)

    def _price(self, name: str, steps: Steps) -> PlayedPrice:
        count, known = len(steps), self.prices[name]
        l95, rates, (uncut, *own) = steps.sums()
        l95_ms, l95_error_ms = _estimated(
            l95, count, known.l95_ms, known.l95_error_ms, usual=self._usual[name][0]
        )
        violation_rate, violation_error = _estimated(
            rates,
            count,
            known.violation_rate,
            known.violation_error,
            usual=self._usual[name][1],
            cycles=count * self._step * self._window,
        )
        l95_ms = min(l95_ms, self._censor_ms)
        return PlayedPrice(
            l95_ms,
            l95_error_ms,
            max(uncut / count, l95_ms),
            min(violation_rate, 1.0),
            violation_error,
            FrozenDict(zip(self._resources, [share / count for share in own], strict=True)),
        )

    def is_full(self, name: str) -> bool:
        """Whether a candidate's price has the most steps (`KEPT`)."""
        return len(self._twins[name].steps) == KEPT

    def _lay_out(self) -> None:
        problem = _with_short_windows(self.problem)
        declared, shadows = self.declared.realisation, self.declared.shadows
        # Every node has a change at 0, which measured conditions may replace.
        begins = [NodeChange(0, name, 0, False) for name in problem.fabric.nodes]
        # Nodes with a quota in ticks need room for the most threads; this change never happens.
        ends = [
            NodeChange(LAST_NS, name, _most_threads(node), False)
            for name, node in problem.fabric.nodes.items()
            if node.quota is not None and node.quota.tick_ms > 0
        ]
        changes = NodeChanges.of([*begins, *declared.node_changes, *ends])
        self._real = replace(_with_own_demands(declared), node_changes=changes)
        #: Declared and simulated realisation of the cycles, then of their shadows.
        self._replaced, sent = [(declared, self._real)], None
        if shadows is not None:
            sent = _with_own_demands(shadows.realisation)
            self._replaced.append((shadows.realisation, sent))
        self._first = lay_out([(problem, self._real)], shadows=[sent]).copy()
        tables = self._first.tables
        tables.clock[0]["pauses"] = 1
        self._declared_changes = tables.changes[tables.changes["at_ns"] < LAST_NS]
        self._declared_rates, self._declared_segments = tables.rates.copy(), tables.segments.copy()
        self._declared_layers = tables.layers.copy()
        self._nothing_ns = np.zeros(self._real.cycles, np.int64)
        self._rows: dict[Part, list[TimesRow]] = {}
        rates = _rates(problem)
        for _, played in self._replaced:
            for site, row in zip(played.sites, played.exec_ns, strict=True):
                part_rows = self._rows.setdefault(Site(*site), [])
                part_rows.append(TimesRow.of(row, rates[site[0]]))
            for hop, row in zip(played.hops, played.delay_ns, strict=False):
                part_rows = self._rows.setdefault(Message(*hop), [])
                part_rows.append(TimesRow.of(row, rates.get(hop[:2], 1)))
        self._stretched: dict[Part, float] = {
            Site(*site): _stretched(self.problem, Site(*site)) for site in self._real.sites
        }
        self._hops = {Message(*hop): number for number, hop in enumerate(self._real.hops)}
        rows = zip(problem.fabric.links, tables.links.tolist(), strict=False)
        self._segments = {link: slice(*row[-2:]) for link, row in rows}
        of = shadows, len(self._resources)
        self._twins = {name: _Twin(self._first, i, *of) for i, name in enumerate(self._names)}

    def _restore(self) -> None:
        """Restore the declared values."""
        for declared, played in self._replaced:
            np.copyto(played.exec_ns, declared.exec_ns)
            np.copyto(played.delay_ns, declared.delay_ns)
        tables = self._first.tables
        tables.rates[:], tables.segments[:] = self._declared_rates, self._declared_segments
        tables.layers[:] = self._declared_layers

    def _fill(self, since: int) -> None:
        """Set the measured demands of the cycles from `since` on, except those just released."""
        begin = since + BEYOND if since else 0
        for part, values in self.present.demands.items():
            # An earlier call has set the same values, up to the last cycle.
            if since and self._filled.get(part) is values:
                continue
            stretched = self._stretched.get(part, 1.0)
            fill(self._rows.get(part, ()), values, stretched, begin, self._offset)
        self._filled = self.present.demands

    def _set_links(self, present: Present) -> None:
        """Set measured rates of links; measured delays include the extra delays of their link."""
        tables = self._first.tables
        for part in present.demands:
            if part in self._hops:
                # The layers of shadows come after.
                every = len(self._hops) + len(self._real.forwards)
                layers = tables.layers[self._hops[part] :: every]
                layers[layers != 0] = self._nothing_ns.ctypes.data
        for link, mbps in present.rates_mbps.items():
            tables.rates["rate_mbps"][self._segments[link]] = mbps

    def _set_losses(self, present: Present) -> None:
        """Set the share of messages that each link loses."""
        tables, links = self._first.tables, self.problem.fabric.links
        for link, share in _lost(present).items():
            mine = self._segments[link]
            if links[link].retransmit_ms is None:
                tables.rates["loss"][mine] = share
            else:
                # Delays include lost attempts. A link that loses half its messages is down.
                tables.rates["loss"][mine] = 0.0
                tables.segments["is_down"][mine] = share >= 0.5

    def _changes(self, present: Present) -> Rows:
        """Return the changes of nodes under measured conditions."""
        rows = self._declared_changes
        if not present.threads and not present.down:
            return rows
        return _changed(rows, tuple(self.problem.fabric.nodes), present, self._real.release_ns)


def _changed(rows: Rows, nodes: Sequence[str], present: Present, release_ns: Ints) -> Rows:
    """Return the changes of nodes with measured foreign threads and outages."""
    is_other = np.array([name in present.threads or name in present.down for name in nodes])
    pieces = [rows[~is_other[rows["node"]]]]
    for i in np.flatnonzero(is_other).tolist():
        threads = present.threads.get(nodes[i], 0.0)
        pieces.append(with_threads(rows[rows["node"] == i], threads, release_ns))
        if nodes[i] in present.down:
            pieces[-1]["is_down"] = 1
    changes = np.concatenate(pieces)
    return changes[np.argsort(changes["at_ns"], kind="stable")]


def _lost(present: Present) -> dict[str, float]:
    """Return the measured share of lost messages, by link: the mean of its flows."""
    lost: dict[str, list[float]] = {}
    for part, values in present.demands.items():
        if isinstance(part, Message):
            share = np.count_nonzero(np.isinf(values)) / len(values)
            lost.setdefault(part.link, []).append(share)
    return {link: sum(shares) / len(shares) for link, shares in lost.items()}


def with_threads(rows: Rows, threads: float, release_ns: Ints) -> Rows:
    """Return a node's changes with more or fewer threads; a fraction is a share of periods."""
    at_ns, stress = rows["at_ns"], rows["stress"]
    if threads < 0.0:
        spans = np.diff(np.append(at_ns, max(int(release_ns[-1]), int(at_ns[-1]))))
        usual = float((stress * spans).sum()) / max(float(spans.sum()), 1.0)
        rows, threads = rows[:1].copy(), max(usual + threads, 0.0)
        at_ns, stress = rows["at_ns"], rows["stress"]
    whole = math.floor(min(threads, MOST_THREADS))
    rest = min(threads, MOST_THREADS) - whole
    if rest > 1 - FRACTION:
        whole, rest = whole + 1, 0.0
    if rest < FRACTION:
        changed = rows.copy()
        changed["stress"] += whole
        return changed
    release_ns = release_ns[:-1]
    all_ns = np.sort(np.concatenate((at_ns, release_ns[release_ns > at_ns[0]])))
    # Faster than `np.unique`, which hashes, by a factor of ten: the values are sorted.
    all_ns = all_ns[np.append(True, all_ns[1:] != all_ns[:-1])]
    cycle = np.searchsorted(release_ns, all_ns, side="right")
    more = np.floor((cycle + 1) * rest) - np.floor(cycle * rest)
    changed = np.zeros(len(all_ns), rows.dtype)
    changed["at_ns"], changed["node"] = all_ns, rows["node"][0]
    last = np.searchsorted(at_ns, all_ns, side="right") - 1
    changed["stress"] = stress[last] + whole + more.astype(np.int64)
    changed["is_down"] = rows["is_down"][last]
    return changed


def _estimated(
    steps: SeriesSums,
    count: int,
    known: float,
    known_error: float,
    *,
    usual: float,
    cycles: int | None = None,
) -> tuple[float, float]:
    """Return the mean over `count` steps, with its standard error.

    The same realisation is also simulated as declared; longer simulations give its expected value
    `known`, with error `known_error`. If the difference between the two varies less than the
    measured conditions do, its mean is added to `known` (a control variate; DOI
    10.1287/opre.30.5.961). `usual` is the standard deviation of a step as declared, since few steps
    may vary too little; `cycles` is the number of cycles if the mean is a share of cycles.
    """
    mean, squares, products, more, more_squares, more_products, apart = steps
    if not apart:
        return known, known_error
    error = _error(count, mean, squares, products, usual)
    more_error = _error(count, more, more_squares, more_products)
    if cycles is not None:
        error = max(error, unseen_error(mean, cycles))
        more_error = max(more_error, unseen_error(apart / count, cycles))
    more_error = math.hypot(more_error, known_error)
    return (max(known + more, 0.0), more_error) if more_error < error else (mean, error)


def _mean(windows: Floats | Ints) -> float:
    # Most steps are one window.
    return float(windows.item() if len(windows) == 1 else windows.mean())


def _mean_shares(windows: Floats) -> list[float]:
    mean: Floats = windows[0] if len(windows) == 1 else windows.mean(axis=0)
    shares: list[float] = mean.tolist()
    return shares


def _error(count: int, mean: float, squares: float, products: float, usual: float = 0.0) -> float:
    """Return the error of a mean as if one more value deviated by `usual` (see `SeriesSums`)."""
    if count < 2:
        return abs(mean)
    # A deviation from few values is itself uncertain: about Student's t over 2.
    few = (count + 1) / (count - 1)
    variance = max(squares / (count - 1), (squares + usual * usual) / count)
    factor = _correlation_factor(count, squares, products)
    return few * math.sqrt(variance / count * factor)


def _correlation_factor(count: int, squares: float, products: float) -> float:
    """Return the factor by which correlated steps of a queue increase the variance of a mean.

    It is (1 + r) / (1 - r) for an AR(1) process, where r is the correlation of successive steps.
    An estimate from n steps is 1 / n too low.
    """
    if not squares:
        return 1.0
    r = min(max(products / squares + 1.0 / count, 0.0), MOST_ALIKE)
    return (1.0 + r) / (1.0 - r)


def _with_own_demands(real: Realisation) -> Realisation:
    return replace(real, exec_ns=real.exec_ns.copy(), delay_ns=real.delay_ns.copy())


def _most_threads(node: Node) -> int:
    return MOST_THREADS + (node.bursts.threads if node.bursts is not None else 0)


def _stretched(problem: Problem, site: Site) -> float:
    """Return the threads per core of a job that has more threads than cores; else 1."""
    execution = problem.pipeline.tasks[site.task].on[site.node]
    if execution.accelerator is not None:
        return 1.0
    return execution.threads / cores_of(problem.fabric.nodes[site.node], execution)


def _with_short_windows(problem: Problem) -> Problem:
    if problem.window_cycles <= LONGEST_WINDOW:
        return problem
    every = min(problem.decide_cycles, LONGEST_WINDOW)
    controller = replace(problem.controller, decide_cycles=every)
    return replace(problem, window_cycles=LONGEST_WINDOW, controller=controller)


def _rates(problem: Problem) -> dict[str | tuple[str, str], int]:
    """Return the cycles from one run of each task to its next, and the same for messages."""
    pipeline = problem.pipeline
    rates: dict[str | tuple[str, str], int] = dict(pipeline.rates.items())
    for flow in pipeline.flows:
        rates[flow.source, flow.target] = pipeline.message_rate(flow)
    return rates


def realised(problem: Problem, real: Realisation, present: Present) -> Realisation:
    """Return the realisation of the undisturbed cell, changed to the measured conditions."""
    if present == Present():
        return real
    exec_ns, delay_ns, extra_ns = real.exec_ns.copy(), real.delay_ns.copy(), real.extra_ns.copy()
    segments = LinkSegments.of(real.link_segments)
    state, links, rates = segments.table.copy(), segments.table_f.copy(), _rates(problem)
    for part, values in present.demands.items():
        known: tuple[tuple[str, ...], ...] = real.sites
        times, stretched = exec_ns, 1.0
        if isinstance(part, Site):
            stretched = _stretched(problem, part)
        else:
            known, times = real.hops, delay_ns
            extra_ns[[real.hops[hop : hop + 1] == (part,) for hop, _ in real.layers]] = 0
        if part in known:
            rate = rates[part.task if isinstance(part, Site) else part[:2]]
            fill([TimesRow.of(times[known.index(part)], rate)], values, stretched, 0, 0)
    for name, mbps in present.rates_mbps.items():
        links[state[:, 1] == segments.links.index(name), 0] = mbps
    for name, share in _lost(present).items():
        mine = state[:, 1] == segments.links.index(name)
        if problem.fabric.links[name].retransmit_ms is None:
            links[mine, 1] = share
        else:
            links[mine, 1] = 0.0
            state[mine, 2] = share >= 0.5
    begins = [NodeChange(0, name, 0, False) for name in problem.fabric.nodes]
    changes = NodeChanges.of([*begins, *real.node_changes])
    rows = changes.table.view(row_types()["changes"]).reshape(len(changes))
    rows = _changed(rows, changes.nodes, present, real.release_ns)
    return replace(
        real,
        exec_ns=exec_ns,
        delay_ns=delay_ns,
        extra_ns=extra_ns,
        node_changes=NodeChanges(changes.nodes, rows.view(np.int64).reshape(len(rows), 4)),
        link_segments=LinkSegments(segments.links, state, links),
    )


def declared_of(
    problem: Problem, seed: int = SEED, shadow_fraction: ShadowFraction = 0.0
) -> Declared:
    """Return the undisturbed cell; results of earlier calls are kept."""
    question = Question.of(problem, "baseline", seed, DRAWN, shadow_fraction)
    known = _known.pop(question, None)
    if known is None:
        short = _with_short_windows(question.problem)
        if question.shadow_fractions:
            known = _with_shadows(short, declared_of(question.problem, seed), question)
        else:
            known = _played_as_declared(short, seed)
    _known[question] = known
    while len(_known) > REMEMBERED:
        del _known[next(iter(_known))]
    return known


_known: dict[Question, Declared] = {}
#: Number of undisturbed cells that are kept.
REMEMBERED = 64


def _played_as_declared(problem: Problem, seed: int) -> Declared:
    windows = max(-(-DRAWN // problem.window_cycles), FEWEST)
    real = _drawn_as_declared(problem, seed, windows)
    first = lay_out([(problem, real)])
    l95_ms, violation_rate = {}, {}
    for index, name in enumerate(problem.candidates):
        arrays = _played(first, index)
        l95_ms[name], violation_rate[name] = _shown(problem, arrays)
    references = _references(problem, seed, windows)
    return Declared(real, FrozenDict(references), FrozenDict(l95_ms), FrozenDict(violation_rate))


def _references(problem: Problem, seed: int, windows: int) -> dict[Part, Reference]:
    """Return the demands of every part.

    They come from at least `windows` windows, and from enough to show all of the slow processes.
    """
    least = slow_processes(problem, "baseline").least_cycles(problem.pipeline.period_ms)
    most = max(most_windows(problem), windows)
    real = _drawn_as_declared(
        problem, seed, min(max(windows, math.ceil(least / problem.window_cycles)), most)
    )
    first, meter = lay_out([(problem, real)], log_jobs=True), Meter(problem)
    patience_ms = max(patience_ns(problem) / 1e6, problem.pipeline.deadline_ms)
    references: dict[Part, Reference] = {}
    for index, placement in enumerate(problem.candidates.values()):
        missing = [part for part in parts_of(problem.pipeline, placement) if part not in references]
        if missing:
            demands = meter.demands(_evidence_of(problem, real, _played(first, index)))
            for part in missing:
                values = demands.get(part, np.empty(0)).copy()
                block = min(problem.window_cycles, STEP)
                kept = windows * problem.window_cycles
                references[part] = Reference(values, block, kept, patience_ms)
    return references


def _drawn_as_declared(problem: Problem, seed: int, windows: int) -> Realisation:
    return Drawing(problem, "baseline", seed=seed, windows=windows, wraps=True).take(windows)


def _played(first: Arrays, index: int) -> Arrays:
    """Simulate all cycles on one candidate, in a copy of the tables."""
    arrays = first.copy()
    arrays.replace(stamps=np.full_like(arrays.tables.stamps, index))
    play(arrays)
    return arrays


def _with_shadows(problem: Problem, plain: Declared, question: Question) -> Declared:
    """Simulate again, with shadow jobs, the candidates that these can delay."""
    shadows = SentShadows(problem, plain.realisation, question.shadow_fractions)
    first = lay_out([(problem, plain.realisation)], shadows=[shadows.realisation])
    l95_ms, violation_rate = dict(plain.l95_ms), dict(plain.violation_rate)
    for index, name in enumerate(problem.candidates):
        if question.shadow_fractions[name]:
            arrays = first.copy()
            arrays.replace(stamps=stamps_of(first, index, shadows))
            play(arrays)
            l95_ms[name], violation_rate[name] = _shown(problem, arrays)
    return replace(
        plain,
        l95_ms=FrozenDict(l95_ms),
        violation_rate=FrozenDict(violation_rate),
        shadows=shadows,
    )


def _shown(problem: Problem, arrays: Arrays) -> tuple[Floats, Floats]:
    """Return L95, milliseconds, and V_D of every simulated window."""
    seen = arrays.tables.seen[0]
    return seen["l95_ms"].copy(), seen["missed"] / seen["counted"]


def _evidence_of(problem: Problem, real: Realisation, arrays: Arrays) -> Evidence:
    """Return the evidence of all cycles of a simulated candidate."""
    logged = LoggedCycles(CellArrays(arrays), flow_rows(problem.pipeline))
    rows = logged.window(0, real.cycles)
    return Evidence(int(real.release_ns[-1]), real.release_ns[:-1], rows)
