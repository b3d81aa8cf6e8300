"""Problem: everything known before a run starts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from typing import NamedTuple

from dwell.display import Displayed
from dwell.errors import Fault, ProblemError
from dwell.model.bounds import MAX_COUNT, Bound, counted, require
from dwell.model.chain import Chain, ChainPatience
from dwell.model.controller_settings import USUAL_DWELL, ControllerSettings
from dwell.model.declaration import declared, key
from dwell.model.every_placement import EveryPlacement
from dwell.model.fabric import Fabric
from dwell.model.frozen import FrozenDict, shortened
from dwell.model.instants import NEVER_NS, require_length
from dwell.model.live import LiveSettings
from dwell.model.objective import Objective
from dwell.model.pipeline import Pipeline
from dwell.model.placement import Placement, Replicas, plain_candidates
from dwell.model.replicated import Replicated
from dwell.model.scenario import Scenario
from dwell.model.semantics import CellParts, find_faults, nearest_of
from dwell.model.servo import Servo

#: Default share of the cycles for each alternative, unless the shares add up to more than 1.
SHADOWED = 0.05
#: The same for all alternatives together, where a search adds candidates.
SHADOWED_TOGETHER = 0.1


class Drawn(NamedTuple):
    """The part of a problem that determines its realisations."""

    pipeline: Pipeline
    fabric: Fabric
    candidates: Mapping[str, Placement]
    scenarios: Mapping[str, Scenario]
    window_cycles: int
    servo: Servo | None


@declared()
class Problem(Displayed):
    """A valid cell, with all parts checked against each other.

    Raises
    ------
    ProblemError
        With every fault found.
    """

    name: str = key("Name of the cell.", usual="the file's", tier="first")
    pipeline: Pipeline
    fabric: Fabric
    candidates: Mapping[str, Placement] = key(
        "Placements that the policy may choose, by name: a node for each relocatable task.",
        tier="first",
    )
    objective: Objective = key("Cost, targets and caps.", tier="first")
    scenarios: Mapping[str, Scenario] = key(
        "Lists of disturbances, by name. `baseline: []` exists always.",
        default_factory=FrozenDict,
        tier="first",
    )
    controller: ControllerSettings = key(
        "Policy and protocol.", default_factory=ControllerSettings, tier="first"
    )
    window_cycles: int = key("Cycles of a window (W).", Bound(1, MAX_COUNT, whole=True), default=50)
    warmup_windows: int = key(
        "First windows of a run, recorded but left out of statistics.",
        Bound(0, MAX_COUNT, whole=True),
        default=0,
    )
    servo: Servo | None = key(
        "Control loop that follows the commands of each run; needed for the tracking error.",
        default=None,
    )
    live: LiveSettings = key(
        "Hosts and habits of the live runtime.", default_factory=LiveSettings, tier="first"
    )
    #: Search that adds the cheapest of all placements to the candidates.
    every_placement: EveryPlacement | None = None
    #: The cell file's folder, searched first for classes named ``package.module:Class``. Equality
    #: ignores it.
    folder: str | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        require_length(1, self.window_cycles, self.pipeline.period_ms, "window_cycles")
        self.live.require_in_time(self.pipeline.deadline_ms)
        every, width = self.controller.decide_cycles, self.window_cycles
        bound = f"at most window_cycles = {width}; lower decide_cycles, or raise window_cycles"
        require(every is None or every <= width, "controller.decide_cycles", every, bound)
        phased = self.pipeline.first_release_ms > 0 and self.live.release == "frames"
        bound = "timer in a cell with a phase_ms, which a camera's frames do not keep"
        require(not phased, "live.release", self.live.release, bound)
        declared = {name: tuple(items) for name, items in self.scenarios.items()}
        scenarios = {"baseline": (), **declared}
        object.__setattr__(self, "scenarios", FrozenDict(scenarios))
        faults = [*find_faults(self.parts), *self._unplaced()]
        if faults:
            raise ProblemError(faults)
        priced = self.fabric.has_prices or not self.objective.weighs_price
        bound = "0 in a cell without a link that has a price_per_gb"
        require(priced, "objective.weights.price", self.objective.weights.price, bound)
        self._require_searchable()
        self._require_due_sinks()
        self._require_supported_replicas()
        if self.servo is not None:
            chain = self.latency_chain
            cycles = self.pipeline.chain_cycles(chain) if chain else self.pipeline.due_interval
            self.servo.require_seen(cycles * self.pipeline.period_ms)

    def __repr__(self) -> str:
        """Return a summary of its parts; `dwell.model.document` has all of it."""
        pipeline, controller = self.pipeline, self.controller
        parts = {"scenarios": self.scenarios, "candidates": self.candidates}
        names = [f"{what}: {shortened(these)}" for what, these in parts.items()]
        return "\n  ".join(
            (
                f"<Problem {self.name!r}",
                f"{pipeline!r}",
                f"{self.fabric!r}",
                *names,
                f"windows of {counted(self.window_cycles, 'cycle')}, "
                f"{self.warmup_windows} of warm-up",
                f"controller on {self.controller_node}: {controller.policy}, "
                f"{controller.estimator or 'its usual estimator'}, begins with {self.initial}>",
            )
        )

    def _require_searchable(self) -> None:
        """Refuse an objective that the search of placements does not support."""
        if self.is_searched:
            self.objective.require_searchable()

    def require_counted(self, windows: int, path: str = "windows") -> None:
        """Refuse runs without a window after the warm-up.

        Raises
        ------
        ProblemError
            If the number of windows is at most that of the warm-up; the fault is at `path`.
        """
        bound = f"more than the {self.warmup_windows} windows of warm-up"
        require(windows > self.warmup_windows, path, windows, bound)

    def require_simple(self, what: str) -> None:
        """Refuse cells that some features do not support; `what` names the features.

        These are cells in which no sink is due in some cycles, and objectives with ages, prices or
        a cap on misses.

        Raises
        ------
        ProblemError
            If it is such a cell.
        """
        if self.pipeline.has_idle_cycles:
            raise ProblemError(
                f"{what} do not support cell {self.name!r}, because no sink is due in some of its "
                "cycles; let a sink run in each cycle, or leave them out"
            )
        priced = "weights.price" if self.objective.weighs_price else ""
        if name := self.objective.beyond_cycles or priced:
            raise ProblemError(
                f"{what} do not support objective.{name} of cell {self.name!r}; remove it, or "
                "leave them out"
            )

    def _require_due_sinks(self) -> None:
        """Refuse windows in which a sink never runs, and camera frames in cells with rates."""
        rates = self.pipeline.rates
        slowest = max(self.pipeline.sinks, key=lambda name: rates[name])
        bound = f"at least {rates[slowest]}, so that {slowest} runs in each window"
        holds = rates[slowest] <= self.window_cycles
        require(holds, "window_cycles", self.window_cycles, bound)
        if (chain := self.latency_chain) is not None:
            every, rate = self.decide_cycles, rates[chain.target]
            bound = f"at least {rate}, the interval of {chain.target}, whose age objective.latency"
            require(rate <= every, "controller.decide_cycles", every, f"{bound} names")
        framed = self.live.release == "frames" and max(rates.values()) > 1
        bound = "timer in a cell with `every`, because each frame releases a cycle"
        require(not framed, "live.release", self.live.release, bound)

    def _require_supported_replicas(self) -> None:
        """Refuse replicas in cells whose features do not support them."""
        pipeline = self.pipeline
        for name, one in self.replicas.items():
            bound = f"at most deadline_ms = {pipeline.deadline_ms:g}; lower after_ms"
            holds = one.after_ms <= pipeline.deadline_ms
            require(holds, f"candidates.{name}.after_ms", one.after_ms, bound)
            members, path = list(one.members), f"candidates.{name}.replicas"
            known = all(
                member in self.candidates and self.candidates[member].first == copy
                for member, copy in zip(members, one.copies, strict=True)
            )
            require(known, path, members, "the names of two candidates with these placements")
            rated = pipeline.has_rates
            bound = "absent in a cell with `every` or sampled flows; remove the candidate"
            require(not rated, path, members, bound)
            bound = "absent in a cell with chains; remove the candidate, or the chains"
            require(not pipeline.chains, path, members, bound)
            late = pipeline.deadline_ms > pipeline.period_ms
            bound = "absent in a cell with deadline_ms above period_ms; remove the candidate"
            require(not late, path, members, bound)

    def _unplaced(self) -> list[Fault]:
        """Return faults of placements without an anchored task, which only cell files may omit."""
        return [
            Fault(f"candidates.{name}.{task}", f"not placed; put it on {next(iter(on))}")
            for name, placement in self.plain_candidates.items()
            for task, on in ((task.name, task.on) for task in self.pipeline.tasks.values())
            if task not in placement and len(on) == 1
        ]

    @property
    def parts(self) -> CellParts:
        """Its parts, with the path that each has in a cell file."""
        pipeline, fabric = self.pipeline, self.fabric
        return CellParts(
            nodes=fabric.nodes,
            links=[(f"links[{i}]", link) for i, link in enumerate(fabric.links.values())],
            tasks=pipeline.tasks,
            flows=[(f"flows[{i}]", flow) for i, flow in enumerate(pipeline.flows)],
            scales=pipeline.scales,
            chains=pipeline.chains,
            candidates={name: one.first for name, one in self.plain_candidates.items()},
            replicated={
                name: Replicated(replicas=one.members, after_ms=one.after_ms)
                for name, one in self.replicas.items()
            },
            every_placement=self.every_placement,
            scenarios={
                name: [(f"scenarios.{name}[{i}]", item) for i, item in enumerate(items)]
                for name, items in self.scenarios.items()
            },
            controller=self.controller,
            tiers=self.objective.tiers,
            accelerators=self.objective.accelerators,
            latency=self.objective.latency,
            live=self.live,
        )

    @property
    def drawn(self) -> Drawn:
        """The part that determines its realisations."""
        return Drawn(*(getattr(self, name) for name in Drawn._fields))

    @property
    def replicas(self) -> dict[str, Replicas]:
        """The candidates with two copies of each cycle."""
        return {name: one for name, one in self.candidates.items() if isinstance(one, Replicas)}

    @property
    def plain_candidates(self) -> dict[str, Placement]:
        """The candidates with one copy of each cycle."""
        return plain_candidates(self.candidates)

    def at_phase(self, phase_ms: float | None) -> Problem:
        """Return the problem with another offset of all its releases."""
        return replace(self, pipeline=replace(self.pipeline, phase_ms=phase_ms))

    @property
    def initial(self) -> str:
        """Name of the candidate that a run starts with; empty if only a search finds it."""
        return self.controller.initial or next(iter(self.candidates), "")

    @property
    def is_searched(self) -> bool:
        """Whether a search must still add candidates (`dwell.estimators.searched`)."""
        return self.every_placement is not None and not self.every_placement.is_found

    def policy_and_estimator(self, name: str) -> tuple[str, str | None]:
        """Split a name as ``cusum+corrected`` into policy and estimator.

        The estimator of ``cusum`` or ``LOC`` is None.
        """
        policy, plus, estimator = name.rpartition("+")
        return (policy, estimator) if plus and name not in self.candidates else (name, None)

    def under(self, name: str) -> Problem:
        """Return the problem with another policy, which may change the initial candidate.

        Parameters
        ----------
        name : str
            As ``cusum`` or ``cusum+corrected``; or a candidate, which then never moves and is
            the initial placement.
        """
        policy, estimator = self.policy_and_estimator(name)
        controller = replace(
            self.controller,
            policy=policy,
            estimator=estimator or self.controller.estimator,
            initial=policy if policy in self.candidates else self.controller.initial,
        )
        return replace(self, controller=controller)

    def cycles_of(self, windows: int) -> int:
        """Return the number of cycles of a run of this many windows.

        Raises
        ------
        ProblemError
            If 64 bits do not hold them, or their instants in nanoseconds.
        """
        return require_length(windows, self.window_cycles, self.pipeline.period_ms)

    @property
    def window_ms(self) -> float:
        """Length of a window: W P."""
        return self.window_cycles * self.pipeline.period_ms

    @property
    def due_cycles(self) -> int:
        """Fewest cycles of a window in which a sink is due."""
        return self.window_cycles // self.pipeline.due_interval

    @property
    def window_ns(self) -> int:
        """Length of a window, nanoseconds."""
        return self.window_cycles * self.pipeline.period_ns

    @property
    def decide_cycles(self) -> int:
        """Cycles between two decisions."""
        given = self.controller.decide_cycles
        if given is not None:
            return given
        interval = self.pipeline.sink_cycles
        return max(-(-(self.window_cycles // 4) // interval), 1) * interval

    def patience_cycles(self, every: int) -> int:
        """Return the cycles for which a run of a task with this rate may be unfinished.

        They are two of its intervals, but at most one cycle less than the window. Then the run
        counts as lost (see `dwell.estimators.spans`).
        """
        return min(2 * every, self.window_cycles - 1)

    @property
    def earlier_cycles(self) -> int:
        """Cycles before a decision's own whose slow runs may count in its evidence; 0 for none."""
        pipeline, slowest = self.pipeline, max(self.pipeline.rates.values())
        if slowest == 1:
            return 0
        order_ms = 2 * pipeline.deadline_ms + self.controller.order_delay_ms
        order = self.controller.order_lead_cycles + math.ceil(order_ms / pipeline.period_ms)
        return self.patience_cycles(slowest) + order

    @property
    def decides_within_windows(self) -> bool:
        """Whether decisions are more frequent than windows."""
        return self.decide_cycles < self.window_cycles

    @property
    def decisions_per_window(self) -> float:
        """W over the cycles between two decisions: 1 or more."""
        return self.window_cycles / self.decide_cycles

    @property
    def min_dwell(self) -> int:
        """N_min, windows; by default the value for estimators without errors."""
        given = self.controller.min_dwell
        return USUAL_DWELL if given is None else given

    @property
    def dwell_cycles(self) -> int:
        """Least number of cycles for which a placement stays: max(N_min W, `min_dwell_cycles`)."""
        return max(self.min_dwell * self.window_cycles, self.controller.min_dwell_cycles)

    @property
    def min_dwell_decisions(self) -> int:
        """Least number of decisions for which a placement stays."""
        return -(-self.dwell_cycles // self.decide_cycles)

    @property
    def stay_cycles(self) -> int:
        """Least number of cycles from one move of a policy that dwells to its next."""
        return (self.min_dwell_decisions + 1) * self.decide_cycles

    @property
    def latency_chain(self) -> Chain | None:
        """Chain whose data age counts as latency, if any."""
        name = self.objective.latency
        return None if name is None else self.pipeline.chains[name]

    @property
    def censor_ms(self) -> float:
        """Largest latency in J: max(4 D, 2 P), at least L_max; J cuts longer latencies to it.

        It is a whole number of nanoseconds, as all latencies are.
        If a chain's data age counts as latency: max(4 max_age, or 4 D without max_age, 2 n P), n
        being the rate of the chain's last task. docs/concepts.md explains the reason.
        """
        pipeline, cap_ms, chain = self.pipeline, self.objective.caps.latency_ms, self.latency_chain
        usual_ms, every = pipeline.deadline_ms, 1
        if chain is not None:
            every = pipeline.rates[chain.target]
            usual_ms = chain.max_age_ms if chain.is_bounded else usual_ms
        bound_ms = max(4 * usual_ms, 2 * every * pipeline.period_ms)
        longest_ms = max(bound_ms, cap_ms) if math.isfinite(cap_ms) else bound_ms
        return round(min(longest_ms * 1e6, NEVER_NS)) / 1e6

    @property
    def shadow_fraction(self) -> float:
        """Largest share of the cycles also sent through each alternative, if the estimator does so.

        With `auto` 0.05, or 1/(alternatives) if that is less, 0.1/(alternatives) if a search adds
        candidates; see `dwell.estimators.shadow_price`.
        """
        given = self.controller.shadow_fraction
        if not isinstance(given, str):
            return given
        alternatives = max(len(self.plain_candidates) - 1, 1)
        together = 1.0 if self.every_placement is None else SHADOWED_TOGETHER
        return min(SHADOWED, together / alternatives)

    @property
    def controller_node(self) -> str:
        """Node of the controller."""
        if self.controller.on is not None:
            return self.controller.on
        return next(iter((*self.fabric.tier("edge"), *self.fabric.nodes)))

    @property
    def relay_node(self) -> str:
        """Node whose agent relays small messages if a direct link fails."""
        return self.live.relay or self.controller_node

    def max_age_ms(self, task: str) -> float:
        """Return the largest age of a sink's commands, or of a source's frames.

        By default max(2 nP, D + nP) for a task that runs in every n-th cycle.
        """
        given_ms, pipeline = self.live.max_age_ms, self.pipeline
        if given_ms is not None:
            return given_ms
        interval_ms = pipeline.rates[task] * pipeline.period_ms
        return max(2 * interval_ms, pipeline.deadline_ms + interval_ms)

    @property
    def guard_patience_ns(self) -> int:
        """Longest wait of the guard for a cycle after its release: max(D, P) + (g - 1) P."""
        pipeline, more = self.pipeline, self.controller.guard_cycles - 1
        return max(pipeline.deadline_ns, pipeline.period_ns) + more * pipeline.period_ns

    @property
    def chain_patiences(self) -> dict[str, ChainPatience]:
        """Age of the newest origin at which the guard fires, of each chain with a `max_age_ms`.

        It is max_age_ms + (g - 1) n P, where n is the interval between two origins that may differ.
        """
        pipeline, g = self.pipeline, self.controller.guard_cycles
        rates, found = pipeline.rates, dict[str, ChainPatience]()
        for name, chain in pipeline.chains.items():
            if chain.is_bounded:
                interval_ns = pipeline.chain_cycles(chain) * pipeline.period_ns
                patience_ns = chain.max_age_ns + (g - 1) * interval_ns
                found[name] = ChainPatience(patience_ns, rates[chain.source])
        return found

    @property
    def longest_patience_ns(self) -> int:
        """Longest wait of the guard, for a cycle or for a chain with a `max_age_ms`."""
        chains = self.chain_patiences.values()
        return max([self.guard_patience_ns, *(chain.patience_ns for chain in chains)])

    @property
    def stamper_node(self) -> str:
        """Node that releases cycles: the first source task's node in the initial placement.

        In a live cell the task is anchored there.
        """
        pipeline = self.pipeline
        source = next(name for name in pipeline.tasks if not pipeline.inputs(name))
        return self.candidates[self.initial].first[source]

    def require_node(self, name: str) -> None:
        """Raise a ProblemError that lists the nodes if the cell has no such node."""
        if name not in self.fabric.nodes:
            known = ", ".join(self.fabric.nodes)
            raise ProblemError(f"no node {name!r} in cell {self.name!r}; there are {known}")

    def scenario(self, name: str) -> Scenario:
        """Return the disturbances of a scenario.

        Raises a ProblemError that lists the known names if the name is unknown.
        """
        if name not in self.scenarios:
            hint = nearest_of(name, self.scenarios, "scenarios")
            raise ProblemError(f"unknown scenario {name!r}; {hint}")
        return self.scenarios[name]
