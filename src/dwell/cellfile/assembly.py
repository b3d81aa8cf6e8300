"""Assembly: the entry of a cell becomes the objects of the model, and they are checked together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dwell.cellfile.document_faults import Faults
from dwell.cellfile.entries import (
    BurstsEntry,
    CellEntry,
    ControllerEntry,
    DisturbanceEntry,
    Entry,
    EpisodesEntry,
    LinkEntry,
    LiveEntry,
    NodeEntry,
    ObjectiveEntry,
    ProcessEntry,
    QuotaEntry,
    ServoEntry,
    TaskEntry,
)
from dwell.cellfile.traces import Source, Tables
from dwell.estimators import registry as estimators
from dwell.model import (
    Bursts,
    Caps,
    Constant,
    ControllerSettings,
    Disturbance,
    Endpoint,
    Episodes,
    Execution,
    Fabric,
    Flow,
    Host,
    Link,
    LinkDisturbance,
    LiveSettings,
    MovingTarget,
    Node,
    NodeDisturbance,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Quota,
    Servo,
    Targets,
    Task,
    Trace,
    Weights,
)
from dwell.model.bounds import require
from dwell.model.frozen import FrozenDict
from dwell.model.process import DRAWN, UnreadTrace
from dwell.model.semantics import CellParts, find_faults
from dwell.policies import registry as policies

# Keys of a disturbance that belong to one kind of it.
NODE_KEYS = ("stress_threads",)
LINK_KEYS = ("both_ways", "add_delay_ms", "loss", "rate_mbps")

# Stands for a process at fault; it passes every check of meaning.
STAND_IN = Constant(1.0)


def _given(**values: object) -> dict[str, Any]:
    """Return the arguments that the file gives; the model knows the defaults of the others."""
    return {name: value for name, value in values.items() if value is not None}


@dataclass(slots=True)
class Assembly:
    """One cell on its way from its entry to a Problem.

    Parameters
    ----------
    entry : CellEntry
        Less what is at fault.
    tables : dict of Source to TraceTable, optional
        Less the sources at fault; where None, traces are named and not read.
    faults : Faults
        Holds the faults so far, takes those found here.
    anchored : bool
        Whether a candidate may name anchored tasks where they are.
    judged : bool
        Whether policies and estimators must be known here. A record names what its machine had.
    home : str, optional
        `Problem.folder`.
    """

    entry: CellEntry
    tables: Tables | None
    faults: Faults
    anchored: bool = False
    judged: bool = True
    home: str | None = None

    def problem(self, name: str) -> Problem:
        """Return the problem.

        Parameters
        ----------
        name : str
            For a cell that does not name itself.

        Raises
        ------
        ProblemError
            With every fault found, those before the assembly included.
        """
        problem = self._problem(name)
        if problem is None or self.faults:
            raise self.faults.error()
        return problem

    def _problem(self, name: str) -> Problem | None:
        """Return the problem, or None beside at least one fault."""
        entry = self.entry
        nodes = {name: self._node(name, node) for name, node in entry.nodes.items()}
        tasks = {name: self._task(name, task) for name, task in entry.tasks.items()}
        links, flows = list(self._links()), list(self._flows())
        timing = self._timing()
        objective = self._objective(entry.objective or ObjectiveEntry(), nodes)
        controller = self._controller(entry.controller or ControllerEntry())
        servo = self._servo(entry.servo)
        live = self._live(entry.live or LiveEntry())
        scenarios = {
            name: list(self._disturbances(name, items or ()))
            for name, items in (entry.scenarios or {}).items()
        }
        candidates = {name: moves for name, moves in entry.candidates.items() if moves is not None}
        parts = CellParts(
            nodes=nodes,
            links=links,
            links_complete=len(dict(links)) == len(entry.links or ()),
            tasks=tasks,
            flows=flows,
            scales=dict(entry.scales or {}),
            candidates=candidates,
            broken_candidates=[name for name, moves in entry.candidates.items() if moves is None],
            scenarios=scenarios,
            controller=controller,
            tiers=objective.tiers if objective is not None else (),
            policies=policies.names() if self.judged else None,
            estimators=estimators.names() if self.judged else None,
            shadowing=estimators.shadowing() if self.judged else (),
            live=live,
        )
        if not self.anchored:
            self._refuse_anchored(candidates, tasks)
        self._judge(parts)
        if timing is None or objective is None or controller is None or live is None:
            return None
        if self.faults:
            return None
        whole = {name: task for name, task in tasks.items() if task is not None}
        fabric = self.faults.attempt(
            "",
            Fabric,
            nodes={name: node for name, node in nodes.items() if node is not None},
            links={link.name: link for _, link in links},
        )
        pipeline = self.faults.attempt(
            "", replace, timing, tasks=whole, flows=tuple(flow for _, flow in flows)
        )
        if fabric is None or pipeline is None:
            return None
        return self.faults.attempt(
            "",
            Problem,
            name=entry.name or name,
            pipeline=pipeline,
            fabric=fabric,
            candidates={name: _complete(moves, whole) for name, moves in candidates.items()},
            objective=objective,
            scenarios={name: tuple(item for _, item in items) for name, items in scenarios.items()},
            controller=controller,
            servo=servo,
            live=live,
            folder=self.home,
            **_given(window_cycles=entry.window_cycles, warmup_windows=entry.warmup_windows),
        )

    # ------------------------------------------------------------------------- processes

    def _process(self, entry: ProcessEntry, path: str) -> Process:
        if entry.constant is not None:
            return Constant(entry.constant)
        if entry.trace is not None:
            if self.tables is None:
                return UnreadTrace(FrozenDict(entry.trace.model_dump(exclude_none=True)))
            table = self.tables.get(Source.of(entry.trace))
            return Trace(table, entry.trace.column) if table is not None else STAND_IN
        for name, kind in DRAWN.items():
            values: Entry | None = getattr(entry, name)
            if values is not None:
                arguments = values.model_dump(exclude_none=True)
                return self.faults.attempt(path, kind, **arguments) or STAND_IN
        return STAND_IN

    def _maybe(self, entry: ProcessEntry | None, path: str) -> Process | None:
        return self._process(entry, path) if entry is not None else None

    def _bursts(self, entry: BurstsEntry | None, path: str, **more: object) -> Bursts | None:
        if entry is None:
            return None
        every_ms = self._process(entry.every_ms, f"{path}.every_ms")
        for_ms = self._process(entry.for_ms, f"{path}.for_ms")
        return self.faults.attempt(path, Bursts, every_ms, for_ms, **_given(**more))

    # ---------------------------------------------------------------------------- fabric

    def _node(self, name: str, entry: NodeEntry | None) -> Node | None:
        if entry is None:
            return None
        path = f"nodes.{name}"
        burst = entry.bursts
        bursts = self._bursts(burst, f"{path}.bursts", threads=burst.threads) if burst else None
        return self.faults.attempt(
            path,
            Node,
            name,
            entry.tier,
            **_given(
                cores=entry.cores,
                scheduler=entry.scheduler,
                accelerators=entry.accelerators,
                bursts=bursts,
                quota=self._quota(path, entry.quota),
                background=entry.background,
                background_beside=entry.background_beside,
                background_hz=entry.background_hz,
                interference=entry.interference,
                contention=entry.contention,
                contention_stressed=entry.contention_stressed,
            ),
        )

    def _quota(self, path: str, entry: QuotaEntry | None) -> Quota | None:
        if entry is None:
            return None
        more = _given(slack_ms=entry.slack_ms, tick_ms=entry.tick_ms)
        return self.faults.attempt(path, Quota, entry.cpu, entry.period_ms, **more)

    def _links(self) -> Iterator[tuple[str, Link]]:
        for index, entry in enumerate(self.entry.links or ()):
            path = f"links[{index}]"
            link = self._link(path, entry) if entry is not None else None
            if entry is not None and link is not None:
                yield path, link
                if entry.both_ways:
                    yield path, replace(link, source=link.target, target=link.source)

    def _link(self, path: str, entry: LinkEntry) -> Link | None:
        delay_ms = self._process(entry.delay_ms, f"{path}.delay_ms")
        burst, bursts = entry.bursts, None
        if burst is not None:
            extra = self._maybe(burst.add_delay_ms, f"{path}.bursts.add_delay_ms")
            bursts = self._bursts(burst, f"{path}.bursts", add_delay_ms=extra)
        return self.faults.attempt(
            path,
            Link,
            entry.source,
            entry.target,
            delay_ms,
            **_given(
                rate_mbps=entry.rate_mbps,
                loss=entry.loss,
                retransmit_ms=entry.on_loss.retransmit_ms if entry.on_loss else None,
                in_order=entry.in_order,
                bursts=bursts,
            ),
        )

    # -------------------------------------------------------------------------- pipeline

    def _task(self, name: str, entry: TaskEntry | None) -> Task | None:
        if entry is None:
            return None
        path = f"tasks.{name}"
        on = {node: self._execution(f"{path}.on.{node}", entry, node) for node in entry.on}
        return self.faults.attempt(
            path,
            Task,
            name,
            on,
            **_given(
                depth=entry.input.depth if entry.input else None,
                priority=entry.priority,
                scale=entry.scale,
                offset_ms=entry.offset_ms,
                start_ms=entry.start_ms,
                state_bytes=entry.state_bytes,
                run=entry.run,
            ),
        )

    def _execution(self, path: str, task: TaskEntry, node: str) -> Execution:
        entry = task.on[node]
        if entry is None:  # at fault; the task may run there all the same
            return Execution(STAND_IN)
        return Execution(
            self._process(entry.exec_ms, f"{path}.exec_ms"),
            **_given(
                threads=entry.threads,
                workers=entry.workers if entry.workers is not None else task.workers,
                accelerator=entry.accelerator,
                standby=entry.standby,
                before_ms=entry.before_ms,
                after_ms=entry.after_ms,
            ),
        )

    def _flows(self) -> Iterator[tuple[str, Flow]]:
        for index, entry in enumerate(self.entry.flows or ()):
            if entry is not None:
                payload = _given(payload_bytes=entry.payload_bytes)
                yield f"flows[{index}]", Flow(entry.source, entry.target, **payload)

    def _timing(self) -> Pipeline | None:
        """Return the pipeline without its tasks and flows."""
        entry = self.entry
        period_ms, deadline_ms = entry.period_ms, entry.deadline_ms
        jitter = self._maybe(entry.release_jitter_ms, "release_jitter_ms")
        scales = {
            name: self._process(scale, f"scales.{name}") if scale is not None else STAND_IN
            for name, scale in (entry.scales or {}).items()
        }
        return self.faults.attempt(
            "",
            Pipeline,
            tasks={},
            flows=(),
            period_ms=period_ms,
            deadline_ms=period_ms if deadline_ms is None else deadline_ms,
            scales=scales,
            **_given(release_jitter_ms=jitter),
        )

    # --------------------------------------------------- scenarios, objective, controller

    def _disturbances(
        self, scenario: str, entries: Sequence[DisturbanceEntry | None]
    ) -> Iterator[tuple[str, Disturbance]]:
        for index, entry in enumerate(entries):
            if entry is None:
                continue
            path = f"scenarios.{scenario}[{index}]"
            if (entry.node is None) == (entry.link is None):
                if not self.faults.touches(path):
                    has = "neither" if entry.node is None else "both"
                    self.faults.add(path, f"needs `node` or `link` and has {has}; give one of them")
                continue
            self._only(path, entry, LINK_KEYS if entry.link is None else NODE_KEYS)
            make = self._node_disturbance if entry.link is None else self._link_disturbance
            first = self.faults.attempt(path, make, path, entry)
            if first is None:
                continue
            yield path, first
            if isinstance(first, LinkDisturbance) and entry.both_ways:
                yield path, replace(first, source=first.target, target=first.source)

    def _only(self, path: str, entry: DisturbanceEntry, others: Sequence[str]) -> None:
        what = "links" if entry.link is None else "nodes"
        for key in others:
            if getattr(entry, key) is not None:
                self.faults.add(f"{path}.{key}", f"belongs to a disturbance of {what}; remove it")

    def _episodes(self, entry: EpisodesEntry | None, path: str) -> Episodes | None:
        # What is at fault must not be said to differ from what shares its name, too.
        if entry is None or self.faults.touches(path):
            return None
        every_s = self._process(entry.every_s, f"{path}.every_s")
        for_s = self._process(entry.for_s, f"{path}.for_s")
        return Episodes(entry.name, every_s, for_s)

    def _node_disturbance(self, path: str, entry: DisturbanceEntry) -> Disturbance:
        return NodeDisturbance(
            entry.node or "",
            **_given(
                at_s=entry.at_s,
                for_s=entry.for_s,
                stress_threads=entry.stress_threads,
                down=entry.down,
                episodes=self._episodes(entry.episodes, f"{path}.episodes"),
                ramp_s=entry.ramp_s,
            ),
        )

    def _link_disturbance(self, path: str, entry: DisturbanceEntry) -> Disturbance:
        source, arrow, target = (entry.link or "").partition("->")
        good = bool(arrow and source.strip() and target.strip())
        require(good, "link", entry.link, "two node names and an arrow, as `R1->E`")
        return LinkDisturbance(
            source.strip(),
            target.strip(),
            **_given(
                at_s=entry.at_s,
                for_s=entry.for_s,
                add_delay_ms=self._maybe(entry.add_delay_ms, f"{path}.add_delay_ms"),
                loss=entry.loss,
                rate_mbps=entry.rate_mbps,
                down=entry.down,
                episodes=self._episodes(entry.episodes, f"{path}.episodes"),
                ramp_s=entry.ramp_s,
            ),
        )

    def _objective(
        self, entry: ObjectiveEntry, nodes: Mapping[str, Node | None]
    ) -> Objective | None:
        deadline_ms = self.entry.deadline_ms or self.entry.period_ms
        values = {"latency_ms": deadline_ms, **_values(entry.targets)}
        tiers = {name: node.tier for name, node in nodes.items() if node is not None}
        weights = self.faults.attempt("objective", Weights, **_values(entry.weights))
        targets = self.faults.attempt("objective", Targets, **values)
        caps = self.faults.attempt("objective", Caps, **_values(entry.caps))
        if targets is None:
            return None
        return self.faults.attempt(
            "objective",
            Objective,
            weights=weights or Weights(),
            targets=targets,
            caps=caps or Caps(),
            tiers=tiers if entry.tiers is None else entry.tiers,
        )

    def _controller(self, entry: ControllerEntry) -> ControllerSettings | None:
        values = _values(entry)
        if entry.fallbacks is not None:
            values["fallbacks"] = tuple(entry.fallbacks)
        return self.faults.attempt("controller", ControllerSettings, **values)

    def _servo(self, entry: ServoEntry | None) -> Servo | None:
        if entry is None:
            return None
        target = MovingTarget(entry.target.amplitude_mm, entry.target.period_s)
        values = {**_values(entry), "target": target}
        servo = self.faults.attempt("servo", Servo, **values)
        if servo is not None and not self.faults.at("period_ms"):
            self.faults.attempt("", servo.require_seen, self.entry.period_ms)
        return servo

    def _live(self, entry: LiveEntry) -> LiveSettings | None:
        values = _values(entry)
        values["hosts"] = {
            name: Host(
                **{
                    **_values(host),
                    "seen_from": {
                        node: Endpoint(seen.address, seen.port)
                        for node, seen in (host.seen_from or {}).items()
                    },
                }
            )
            for name, host in (entry.hosts or {}).items()
        }
        return self.faults.attempt("", LiveSettings, **values)

    # --------------------------------------------------------------------------- meaning

    def _refuse_anchored(
        self, candidates: Mapping[str, Mapping[str, str]], tasks: Mapping[str, Task | None]
    ) -> None:
        """Add a fault for every anchored task that a candidate places where it is anyway."""
        for name, moves in candidates.items():
            for task_name, node in moves.items():
                task = tasks.get(task_name)
                if task is not None and task.anchored and node in task.on:
                    self.faults.add(
                        f"candidates.{name}.{task_name}",
                        f"{task_name} is anchored to {node}, in every candidate; leave it out",
                    )

    def _judge(self, parts: CellParts) -> None:
        """Add the faults of meaning, but for those that other faults cause."""
        self._assume(parts)
        known = all(
            link.source in parts.nodes and link.target in parts.nodes for _, link in parts.links
        )
        # Only where every link is good can one be said to be missing.
        parts.links_complete = parts.links_complete and known and not self.faults.at("links")
        parts.links = _forward(parts.links, parts.nodes)
        for fault in find_faults(parts):
            if not self.faults.at(fault.path):
                self.faults.add(fault.path, fault.message)

    def _assume(self, parts: CellParts) -> None:
        """Take names for declared where the section that would declare them could not be read."""
        faults, controller = self.faults, parts.controller
        placed = list(parts.candidates.values())
        if faults.at("nodes"):
            names = [name for _, link in parts.links for name in (link.source, link.target)]
            names += [name for task in parts.tasks.values() if task for name in task.on]
            names += [name for moves in placed for name in moves.values()]
            names += [
                item.node
                for items in parts.scenarios.values()
                for _, item in items
                if isinstance(item, NodeDisturbance)
            ]
            names += parts.tiers
            names += [controller.on] if controller is not None and controller.on else []
            parts.nodes = dict.fromkeys(names)
        if faults.at("tasks"):
            names = [name for _, flow in parts.flows for name in (flow.source, flow.target)]
            names += [name for moves in placed for name in moves]
            parts.tasks = dict.fromkeys(names)
        if faults.at("scales"):
            parts.scales = [task.scale for task in parts.tasks.values() if task and task.scale]
        if faults.at("candidates") and controller is not None:
            names = [controller.policy, *controller.fallbacks, controller.initial or ""]
            parts.broken_candidates = names


def _forward(
    links: Iterable[tuple[str, Link]], nodes: Mapping[str, object]
) -> list[tuple[str, Link]]:
    """Leave out the way back where a node is unknown: the way there says so."""
    kept: list[tuple[str, Link]] = []
    for path, link in links:
        back = bool(kept) and kept[-1][0] == path
        if not (back and (link.source not in nodes or link.target not in nodes)):
            kept.append((path, link))
    return kept


def _complete(moves: Mapping[str, str], tasks: Mapping[str, Task]) -> Placement:
    """Return the placement of every task: an anchored one follows its anchor."""
    return Placement((name, moves.get(name) or next(iter(task.on))) for name, task in tasks.items())


def _values(entry: Entry | None) -> dict[str, Any]:
    return entry.model_dump(exclude_none=True) if entry is not None else {}
