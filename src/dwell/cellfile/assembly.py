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
    HostEntry,
    LinkEntry,
    LiveEntry,
    NodeEntry,
    ObjectiveEntry,
    ProcessEntry,
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
from dwell.model.fabric import accelerator_tiers
from dwell.model.frozen import FrozenDict
from dwell.model.process import DRAWN, UnreadTrace
from dwell.model.semantics import CellParts, find_faults
from dwell.policies import registry as policies

# Keys of a disturbance that belong to one kind of it.
NODE_KEYS = ("stress_threads",)
LINK_KEYS = ("both_ways", "add_delay_ms", "loss", "rate_mbps")

# Stands for a process at fault; it passes every check of meaning.
STAND_IN = Constant(1.0)


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
        Whether policies and estimators must be known here, and the cell's name be one. A record
        names what its machine had.
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
        called = name if entry.name is None else entry.name
        parts = CellParts(
            name=called if self.judged else None,
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
            tiers=objective.tiers if objective is not None else {},
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
            name=called,
            pipeline=pipeline,
            fabric=fabric,
            candidates={name: _complete(moves, whole) for name, moves in candidates.items()},
            objective=objective,
            scenarios={name: tuple(item for _, item in items) for name, items in scenarios.items()},
            controller=controller,
            servo=servo,
            live=live,
            folder=self.home,
            **_present(window_cycles=entry.window_cycles, warmup_windows=entry.warmup_windows),
        )

    # ------------------------------------------------------------- arguments and processes

    def _given(self, path: str, entry: Entry | None, *but: str, **made: object) -> dict[str, Any]:
        """Return the arguments that an entry gives, processes made of theirs, and what is `made`.

        The model knows the defaults of what is absent.

        Parameters
        ----------
        but : str
            Fields of the entry that are no arguments.
        """
        values: dict[str, object] = {}
        for name in type(entry).model_fields if entry is not None else ():
            if name not in but and name not in made:
                value = getattr(entry, name)
                process = isinstance(value, ProcessEntry)
                values[name] = self._process(value, f"{path}.{name}") if process else value
        return _present(**values, **made)

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
                return self.faults.attempt(path, kind, **self._given(path, values)) or STAND_IN
        return STAND_IN

    # ---------------------------------------------------------------------------- fabric

    def _bursts(self, path: str, entry: BurstsEntry | None) -> Bursts | None:
        if entry is None:
            return None
        return self.faults.attempt(path, Bursts, **self._given(path, entry))

    def _node(self, name: str, entry: NodeEntry | None) -> Node | None:
        if entry is None:
            return None
        path = f"nodes.{name}"
        bursts = self._bursts(f"{path}.bursts", entry.bursts)
        quota = entry.quota and self.faults.attempt(path, Quota, **self._given(path, entry.quota))
        given = self._given(path, entry, bursts=bursts, quota=quota)
        return self.faults.attempt(path, Node, name, **given)

    def _links(self) -> Iterator[tuple[str, Link]]:
        for index, entry in enumerate(self.entry.links or ()):
            path = f"links[{index}]"
            link = self._link(path, entry) if entry is not None else None
            if entry is not None and link is not None:
                yield path, link
                if entry.both_ways:
                    yield path, replace(link, source=link.target, target=link.source)

    def _link(self, path: str, entry: LinkEntry) -> Link | None:
        retransmit_ms = entry.on_loss.retransmit_ms if entry.on_loss else None
        bursts = self._bursts(f"{path}.bursts", entry.bursts)
        given = self._given(
            path, entry, "both_ways", "on_loss", retransmit_ms=retransmit_ms, bursts=bursts
        )
        return self.faults.attempt(path, Link, **given)

    # -------------------------------------------------------------------------- pipeline

    def _task(self, name: str, entry: TaskEntry | None) -> Task | None:
        if entry is None:
            return None
        path = f"tasks.{name}"
        on = {node: self._execution(f"{path}.on.{node}", entry, node) for node in entry.on}
        depth = entry.input.depth if entry.input else None
        given = self._given(path, entry, "input", "workers", on=on, depth=depth)
        return self.faults.attempt(path, Task, name, **given)

    def _execution(self, path: str, task: TaskEntry, node: str) -> Execution:
        entry = task.on[node]
        if entry is None:  # at fault; the task may run there all the same
            return Execution(STAND_IN)
        workers = entry.workers if entry.workers is not None else task.workers
        return Execution(**self._given(path, entry, workers=workers))

    def _flows(self) -> Iterator[tuple[str, Flow]]:
        for index, entry in enumerate(self.entry.flows or ()):
            if entry is not None:
                path = f"flows[{index}]"
                yield path, Flow(**self._given(path, entry))

    def _timing(self) -> Pipeline | None:
        """Return the pipeline without its tasks and flows."""
        entry = self.entry
        period_ms, deadline_ms = entry.period_ms, entry.deadline_ms
        jitter = entry.release_jitter_ms
        jitter_ms = self._process(jitter, "release_jitter_ms") if jitter is not None else None
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
            **_present(release_jitter_ms=jitter_ms),
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
            first = self.faults.attempt(path, self._disturbance, path, entry)
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
        return Episodes(**self._given(path, entry))

    def _disturbance(self, path: str, entry: DisturbanceEntry) -> Disturbance:
        if entry.link is None:
            episodes = self._episodes(entry.episodes, f"{path}.episodes")
            return NodeDisturbance(**self._given(path, entry, *LINK_KEYS, episodes=episodes))
        source, arrow, target = entry.link.partition("->")
        good = bool(arrow and source.strip() and target.strip())
        require(good, "link", entry.link, "two node names and an arrow, as `R1->E`")
        given = self._given(
            path,
            entry,
            *("link", "both_ways", *NODE_KEYS),
            source=source.strip(),
            target=target.strip(),
            episodes=self._episodes(entry.episodes, f"{path}.episodes"),
        )
        return LinkDisturbance(**given)

    def _objective(
        self, entry: ObjectiveEntry, nodes: Mapping[str, Node | None]
    ) -> Objective | None:
        deadline_ms = self.entry.deadline_ms or self.entry.period_ms
        tiers = entry.tiers
        if tiers is None:
            tiers = {name: node.tier for name, node in nodes.items() if node is not None}
        values = {"latency_ms": deadline_ms, **self._given("objective", entry.targets)}
        weights = self.faults.attempt(
            "objective", Weights, **self._given("objective", entry.weights)
        )
        targets = self.faults.attempt("objective", Targets, **values)
        caps = self.faults.attempt("objective", Caps, **self._given("objective", entry.caps))
        if targets is None:
            return None
        return self.faults.attempt(
            "objective",
            Objective,
            weights=weights or Weights(),
            targets=targets,
            caps=caps or Caps(),
            tiers=tiers,
            accelerators=accelerator_tiers(nodes, tiers) if entry.accelerators else {},
        )

    def _controller(self, entry: ControllerEntry) -> ControllerSettings | None:
        given = self._given("controller", entry)
        return self.faults.attempt("controller", ControllerSettings, **given)

    def _servo(self, entry: ServoEntry | None) -> Servo | None:
        if entry is None:
            return None
        target = MovingTarget(**self._given("servo.target", entry.target))
        given = self._given("servo", entry, target=target)
        servo = self.faults.attempt("servo", Servo, **given)
        if servo is not None and not self.faults.at("period_ms"):
            self.faults.attempt("", servo.require_seen, self.entry.period_ms)
        return servo

    def _live(self, entry: LiveEntry) -> LiveSettings | None:
        hosts = {name: self._host(host) for name, host in (entry.hosts or {}).items()}
        return self.faults.attempt("", LiveSettings, **self._given("live", entry, hosts=hosts))

    def _host(self, entry: HostEntry) -> Host:
        seen_from = {
            node: Endpoint(**self._given("", seen))
            for node, seen in (entry.seen_from or {}).items()
        }
        return Host(**self._given("", entry, seen_from=seen_from))

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


def _present(**values: object) -> dict[str, Any]:
    """Leave out what is absent."""
    return {name: value for name, value in values.items() if value is not None}
