"""Common base of the estimators that learn from windows.

They keep the measured conditions (`Present`): demands of every part of a cycle, foreign threads of
every node, rates of links, and nodes that are down. Conditions are as declared until evidence shows
a change. An unaffected candidate has its price from the profile. The kernel simulates the others
(see `StepwisePlayer`): several steps after a change, one more step for new samples, and further
steps for candidates on which the next move may depend.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial

from dwell.cost import SATURATED, cost_error, hamming
from dwell.estimators.cell_terms import CellTerms
from dwell.estimators.evidence import Evidence
from dwell.estimators.foreign_threads import ForeignThreads, Stretches
from dwell.estimators.link_rates import Rate
from dwell.estimators.measured import (
    NOT_FULL,
    Message,
    Meter,
    Part,
    UsedCores,
    groups,
    job_columns,
    parts_of,
)
from dwell.estimators.present import Present
from dwell.estimators.prices import SEED
from dwell.estimators.profile import Foreign, Profile, mean_ms
from dwell.estimators.protocol import CellEstimator
from dwell.estimators.spans import task_patience_ns
from dwell.estimators.stepwise_player import StepwisePlayer
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats
from dwell.model.problem import Problem
from dwell.model.qos import NO_ERROR, QoS, unchecked_qos
from dwell.model.shadow_plan import alternatives, by_candidate

#: Simulated steps after a change of conditions; the first fills the queues.
FIRST_STEPS = 6
#: Largest number of rounds per window for unsure candidates, and steps per round.
ROUNDS, STEPS = 2, 2
#: A decision is sure if a price difference is this many standard errors from its thresholds.
BAND = 2.0


class Online(CellEstimator):
    """Base of the estimators that learn from windows; `seed` is the seed of their simulations."""

    seed = SEED

    def start(self, problem: Problem) -> None:
        """Forget everything but the profile."""
        self.problem = problem
        self.profile, self._terms = Profile(problem), CellTerms(problem, ())
        self._regimes = 0
        self._meter, self._stretches = Meter(problem), Stretches(problem)
        self._player = StepwisePlayer(problem, self.seed, self.shadow_fraction)
        self._parts = {
            name: tuple(dict.fromkeys(parts_of(problem.pipeline, placed)))
            for name, placed in problem.candidates.items()
        }
        every = problem.decisions_per_window
        self._foreign = {
            name: ForeignThreads(node, every) for name, node in problem.fabric.nodes.items()
        }
        self._down: frozenset[str] = frozenset()
        #: Measured rates of links that differ from the declared rates.
        self._rates: dict[str, Rate] = {}
        self._shared: frozenset[str] = frozenset()
        #: Counts changes of the measured conditions, and each doubling of the windows behind them.
        self.revision = 0
        self._grown = self._until = 1
        self._plays = False
        self._patience_ns = task_patience_ns(problem)
        self._sent = self._sent_shares()
        #: Price and work of each candidate as declared, cached at the first estimate.
        self._declared: dict[str, tuple[QoS, list[tuple[str, float]]]] = {}
        #: The last window until `estimate` uses it, and until its demands are learnt.
        self._evidence: Evidence | None = None
        self._pending: Evidence | None = None
        #: Used cores of the nodes that were full in that window.
        self._full: Mapping[str, UsedCores] = {}
        #: Whether the measured conditions have changed, or have new samples.
        self._has_changed = self._has_grown = False

    def share(self, nodes: Collection[str], cells: int, *, known: bool = True) -> None:
        """Register nodes that the cells of a fleet share (see `CellEstimator`).

        The evidence lacks the jobs of other cells, and jobs on these nodes therefore show no waits.
        They show the number of foreign threads if the number of the fleet's threads is known. Cells
        take turns with shadows there: each sends 1 / `cells` of its share.
        """
        shared, self._declared = frozenset(nodes), {}
        self._shared = shared if known else frozenset()
        self._meter = Meter(self.problem, self._shared)
        for link, rate in self._rates.items():
            self._meter.set_rate(link, rate.mbps)
        self._stretches = Stretches(self.problem, self._shared)
        for name, sent in self._sent_shares().items():
            of = {
                one: share / cells if one.partition(".")[0] in shared else share
                for one, share in sent.items()
            }
            self._sent[name] = FrozenDict(of)

    def __getstate__(self) -> dict[str, object]:
        # A copy repeats the simulations of its measured conditions.
        return {**self.__dict__, "_has_changed": True}

    @abstractmethod
    def _take_in(self, evidence: Evidence) -> None:
        """Learn from the demands that the meter has found in a window."""

    @abstractmethod
    def _otherwise(self) -> Mapping[Part, Floats]:
        """Return the demands of parts that differ from the declared demands (see `Present`)."""

    def _known_error(self, name: str, rate: float, parts: Collection[Part]) -> tuple[float, float]:
        """Return the errors of L95 (ms) and V_D of a candidate due to few samples of parts."""
        return 0.0, 0.0

    def look(self, evidence: Evidence) -> None:
        """Learn from a window."""
        self.learn(evidence)

    def learn(self, evidence: Evidence) -> None:
        """Keep a window; its demands are learnt after the state of its nodes."""
        self._take_in_pending()
        self._evidence = self._pending = evidence
        self._full = {}

    def _take_in_pending(self) -> None:
        """Learn from the demands of the last window, once per window."""
        evidence, self._pending = self._pending, None
        if evidence is not None:
            self._meter.measure(evidence, self._threads, self._full)
            self._take_in(evidence)

    @property
    def regimes(self) -> int:
        """Number of changes detected since the start."""
        self._take_in_pending()
        return self._regimes

    @property
    def present(self) -> Present:
        """The measured conditions that differ from the declared conditions."""
        self._take_in_pending()
        return self._present(self._otherwise())

    def _present(self, otherwise: Mapping[Part, Floats]) -> Present:
        threads = {name: one.beyond for name, one in self._foreign.items() if one.beyond}
        rates_mbps = FrozenDict({link: rate.mbps for link, rate in self._rates.items()})
        return Present(FrozenDict(otherwise), FrozenDict(threads), self._down, rates_mbps)

    @property
    def _threads(self) -> dict[str, float]:
        """Estimated number of foreign threads on each node."""
        return {name: foreign.threads for name, foreign in self._foreign.items()}

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics, the incumbent's too (see `Estimator`)."""
        foreign = self.profile.see(observed, incumbent, own)
        evidence, self._evidence = self._evidence, None
        if evidence is not None:
            self._full = dict(self._used_cores(observed, foreign, own))
            self._look_at_nodes(evidence, foreign, observed, own, incumbent)
            self._take_in_pending()
        otherwise = self._otherwise()
        names = self._names(otherwise)
        if self._plays and not names:
            self.revision += 1
        self._plays = bool(names)
        if names and (evidence is not None or self._has_changed):
            self._play(names, otherwise)
        estimates = self._priced(names, foreign)
        if evidence is not None and names:
            for _ in range(ROUNDS):
                unsure = self._unsure(names, estimates, incumbent)
                if not unsure:
                    break
                self._player.go_on(self._player.present, unsure, STEPS)
                estimates = self._priced(names, foreign)
        for name in names:
            one, error = estimates[name], self._stated_error(name)
            known = one.l95_ms, one.violation_rate, one.utilisation, one.cut_from_ms
            further = self._stated_age(name), one.misses, None, one.price_per_hour
            estimates[name] = unchecked_qos(*known, error, *further)
        if self.problem.every_placement is not None:
            return self._paired(names, estimates, incumbent)
        return estimates

    def _paired(
        self, names: Collection[str], estimates: Mapping[str, QoS], incumbent: str
    ) -> dict[str, QoS]:
        """Add the errors of the differences from the incumbent (`QoS.paired`)."""
        here = estimates[incumbent].error or NO_ERROR
        paired = {}
        for name, qos in estimates.items():
            l95_ms, rate = qos.error or NO_ERROR
            errors = math.hypot(l95_ms, here[0]), math.hypot(rate, here[1])
            if name == incumbent:
                errors = NO_ERROR
            elif name in names and incumbent in names:
                # With few common steps, the errors as if independent may be smaller.
                of = self._difference_errors(name, incumbent)
                errors = min(errors[0], of[0]), min(errors[1], of[1])
            paired[name] = replace(qos, paired=errors)
        return paired

    def _difference_errors(self, name: str, incumbent: str) -> tuple[float, float]:
        """Return errors of the differences of L95 (ms) and V_D of two simulated candidates.

        The values of parts that both use are the same, and have the same errors.
        """
        found = [self._player.difference_errors(name, incumbent)]
        for one, other in ((name, incumbent), (incumbent, name)):
            parts = [part for part in self._parts[one] if part not in self._parts[other]]
            rate = self._player.played(one).violation_rate
            found.append(self._known_error(one, rate, parts))
        l95_ms, violation_rate = map(math.hypot, *found)
        return l95_ms, violation_rate

    def _stated_error(self, name: str) -> tuple[float, float]:
        """Return standard errors of L95 (ms) and V_D due to simulated and measured samples."""
        played = self._player.played(name)
        known = self._known_error(name, played.violation_rate, self._parts[name])
        l95_error_ms, violation_error = played.error or NO_ERROR
        return math.hypot(l95_error_ms, known[0]), math.hypot(violation_error, known[1])

    def _stated_age(self, name: str) -> tuple[float, float] | None:
        """Return the mean age and its error; measured samples have the relative error of L95."""
        played = self._player.played(name)
        if played.age_ms is None:
            return None
        known_ms, _ = self._known_error(name, played.violation_rate, self._parts[name])
        share = known_ms / played.l95_ms if played.l95_ms else 0.0
        return played.age_ms, math.hypot(played.age_error_ms, share * played.age_ms)

    def deviations(self, name: str) -> tuple[float, float]:
        """Return standard deviations of one window under a candidate (see `CellEstimator`)."""
        return self._player.deviations(name)

    def _priced(self, names: list[str], foreign: Foreign) -> dict[str, QoS]:
        """Return the metrics of all candidates; some of them are simulated."""
        if not self._declared:
            self._declared = {
                name: (price.qos, self._with_sent(name, price.own))
                for name, price in self._player.prices.items()
            }
        priced = dict(self._declared)
        for name in names:
            qos = self._player.played(name)
            priced[name] = qos, self._with_sent(name, qos.utilisation)
        shares = self.profile.with_work(foreign, ((name, priced[name][1]) for name in priced))
        return {
            name: unchecked_qos(
                qos.l95_ms,
                qos.violation_rate,
                shares[name],
                qos.cut_from_ms,
                qos.error,
                qos.age,
                qos.misses,
                None,
                qos.price_per_hour,
            )
            for name, (qos, _) in priced.items()
        }

    def _with_sent(self, name: str, work: Mapping[str, float]) -> list[tuple[str, float]]:
        """Add the share of each resource that shadow jobs take to the cell's own work."""
        sent = self._sent[name]
        return [(one, share + sent[one]) for one, share in work.items()]

    def _unsure(self, names: list[str], estimates: Mapping[str, QoS], incumbent: str) -> list[str]:
        """Return the simulated candidates that need more simulation.

        A candidate needs more if its gain in J over the incumbent may be positive but may be below
        the gain required for a move (both within `BAND` standard errors), and if the standard error
        of the gain exceeds a third of the smallest improvement. The incumbent then needs more too.
        """
        problem, least = self.problem, self.problem.controller.min_improvement
        objective, here = problem.objective, problem.candidates[incumbent]
        errors = {name: self._sampled(name) for name in names}
        can_go_on = {name for name in names if errors[name] and not self._player.is_full(name)}
        if not can_go_on:
            return []
        unsure, cost = set(), self._terms.cost(estimates[incumbent])
        for name, there in problem.candidates.items():
            error = math.hypot(errors.get(name, 0.0), errors.get(incumbent, 0.0))
            if name == incumbent or error <= least / 3:
                continue
            gain = cost - self._terms.cost(estimates[name])
            asked = least + objective.weights.switching * hamming(there, here)
            if -BAND * error < gain < asked + BAND * error:
                unsure |= {name, incumbent}
        return [name for name in names if name in unsure & can_go_on]

    def _sampled(self, name: str) -> float:
        """Return the standard error of a candidate's J due to few simulated cycles."""
        played = self._player.played(name)
        return cost_error(played.error or NO_ERROR, self.problem.objective, played.age_error_ms)

    def _used_cores(
        self, observed: QoS, foreign: Foreign, own: Mapping[str, float]
    ) -> Iterator[tuple[str, UsedCores]]:
        """Yield every node that was full in a window, with its used cores."""
        for name, node in self.problem.fabric.nodes.items():
            if observed.utilisation[name] >= SATURATED:
                others = max(foreign.shares[name] * node.capacity - node.background, 0.0)
                yield name, (own[name] * node.capacity, others)

    def _look_at_nodes(
        self,
        evidence: Evidence,
        seen: Foreign,
        observed: QoS,
        own: Mapping[str, float],
        incumbent: str,
    ) -> None:
        """Update the foreign threads of nodes, and the nodes that are down, from a window."""
        known = self._player.prices[incumbent]
        for name, foreign in self._foreign.items():
            usual, deviation = known.foreign[name], known.foreign_deviation[name]
            used = self._full.get(name, NOT_FULL)
            level = partial(self._stretches.level, evidence, name, used)
            is_full = name in seen.full
            changed = foreign.see(seen.shares[name], usual, deviation, level, is_full=is_full)
            if changed:
                self._has_changed = True
                self._regimes += 1
        down = frozenset(self._down_nodes(evidence, observed.utilisation, own))
        if down != self._down:
            self._down, self._has_changed = down, True

    def _down_nodes(
        self, evidence: Evidence, used: Mapping[str, float], own: Mapping[str, float]
    ) -> Iterator[str]:
        """Yield idle nodes that have lost at least two jobs since their last completed job."""
        limit_ns = evidence.close_ns - self._patience_ns
        stretches = [one for one in (evidence.earlier, evidence) if one is not None]
        if not any(one.rows.unknown(int(limit_ns.max()))[0] for one in stretches):
            return
        placements = tuple(self.problem.candidates.values())
        ended_ns: dict[str, int] = {}
        ready_ns: dict[str, list[int]] = {}
        by_code = [
            (code, one.cycles.at(rows)) for one in stretches for code, rows in groups(one.placement)
        ]
        for code, cycles in by_code:
            lost = (cycles.end_ns < 0) & (cycles.ready_ns >= 0) & (cycles.ready_ns < limit_ns)
            for column, site in enumerate(job_columns(self.problem, placements[code])):
                if site is None:
                    continue
                node = site.node
                latest = int(cycles.end_ns[:, column].max())
                ended_ns[node] = max(ended_ns.get(node, -1), latest)
                mine = cycles.ready_ns[:, column][lost[:, column]]
                ready_ns.setdefault(node, []).extend(mine.tolist())
        span_ns = evidence.close_ns - int(evidence.release_ns[0])
        for node, ready in ready_ns.items():
            after = [at_ns for at_ns in ready if at_ns > ended_ns[node]]
            # A node with a running job is up.
            idle_ns = evidence.close_ns - max(ended_ns[node], min(after, default=0))
            idle_ns = min(idle_ns, span_ns)
            capacity = self.problem.fabric.nodes[node].capacity
            works = own[node] * capacity * span_ns >= 0.5 * idle_ns
            # A node that is down has no foreign load, either.
            is_used = used[node] * span_ns >= span_ns - 0.5 * idle_ns
            if len(after) >= 2 and not (works or is_used):
                yield node

    def _names(self, otherwise: Mapping[Part, Floats]) -> list[str]:
        """Return the candidates with a part, node or link that differs from its declaration."""
        nodes = {name for name, foreign in self._foreign.items() if foreign.beyond} | self._down
        links = {part.link for part in otherwise if isinstance(part, Message)}
        links |= self._rates.keys()
        if not otherwise and not nodes and not links:
            return []
        return [
            name
            for name, parts in self._parts.items()
            if any(
                part in otherwise
                or (part.link in links if isinstance(part, Message) else part.node in nodes)
                for part in parts
            )
        ]

    def _play(self, names: list[str], otherwise: Mapping[Part, Floats]) -> None:
        """Simulate the affected candidates; start again if the measured conditions changed."""
        present = self._present(otherwise)
        self._count_presents()
        if self._has_changed:
            self._player.begin(present)
            self._player.go_on(present, names, FIRST_STEPS)
        elif self._has_grown:
            self._player.go_on(present, names, has_grown=True)
        self._has_changed = self._has_grown = False

    def _count_presents(self) -> None:
        """Increase `revision` after a change, and when the number of windows has doubled."""
        self._grown += 1
        if self._has_changed:
            self._grown = self._until = 1
        if self._has_changed or self._grown >= self._until:
            self.revision += 1
            self._until *= 2

    def _sent_shares(self) -> dict[str, Mapping[str, float]]:
        """Return the share of each resource that shadow jobs take, by the active candidate."""
        problem, placed = self.problem, self.problem.candidates
        pipeline, resources = problem.pipeline, problem.fabric.resources
        fractions, names = by_candidate(self.shadow_fraction, placed), [*placed]
        rates, found = pipeline.rates, dict[str, Mapping[str, float]]()
        for name, others in zip(names, alternatives(placed), strict=True):
            share = dict.fromkeys(resources, 0.0)
            for there in (placed[names[i]].first for i in others if fractions[name]):
                apart = pipeline.diverging(placed[name], there)
                # In the order of tasks: the order of a set, and so the rounding, may differ.
                for task in pipeline.tasks:
                    if task not in apart or not pipeline.outputs(task):
                        continue
                    execution = pipeline.tasks[task].on[there[task]]
                    resource = execution.resource(there[task])
                    threads = execution.threads if execution.accelerator is None else 1
                    mean = mean_ms(pipeline, pipeline.tasks[task], execution)
                    busy_ms = mean * threads / rates[task]
                    capacity = resources[resource].capacity
                    share[resource] += fractions[name] * busy_ms / pipeline.period_ms / capacity
            found[name] = FrozenDict(share)
        return found
