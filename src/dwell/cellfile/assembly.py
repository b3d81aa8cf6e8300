"""Assembly: the entry of a cell becomes the objects of the model, and they are checked together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar, cast

from dwell.cellfile.cell_form import LINK_KEYS, NODE_KEYS, OBJECTIVE, STAND_IN, TRACE
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import Entry
from dwell.cellfile.traces import Source, Tables
from dwell.errors import Fault
from dwell.estimators import registry as estimators
from dwell.model import (
    Caps,
    Chain,
    ControllerSettings,
    Disturbance,
    Execution,
    Fabric,
    Flow,
    Link,
    LinkDisturbance,
    LiveSettings,
    Node,
    NodeDisturbance,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Replicas,
    Servo,
    Targets,
    Task,
    Trace,
    Weights,
)
from dwell.model.bounds import CLASS_PATH, require
from dwell.model.declaration import declared_fields, made_at
from dwell.model.fabric import accelerator_tiers
from dwell.model.frozen import FrozenDict
from dwell.model.objective import TARGET, latency_target_ms
from dwell.model.process import DRAWN, UnreadTrace
from dwell.model.replicated import Replicated
from dwell.model.semantics import (
    CellParts,
    UnreadNames,
    find_faults,
    find_unregistered,
    nearest,
    nearest_of,
)
from dwell.policies import registry as policies

T = TypeVar("T")

#: Keys of the whole cell that a Problem has by their names.
WINDOWS = ("window_cycles", "warmup_windows")
#: Classes that a process at fault is of.
PROCESSES = frozenset(DRAWN.values())


@dataclass(slots=True)
class Assembly:
    """The construction of a Problem from the entry of a cell.

    Parameters
    ----------
    entry : Entry
        Entry of a cell without its faulty values.
    tables : dict of Source to TraceTable, optional
        Less the sources at fault; where None, traces are named and not read.
    faults : Faults
        Holds the faults so far, takes those found here.
    home : str, optional
        `Problem.folder`.
    """

    entry: Entry
    tables: Tables | None
    faults: Faults
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
        """Return the problem, or None after at least one fault."""
        entry = self.entry
        nodes = {name: self._made(node, name) for name, node in entry.nodes.items()}
        tasks = {name: self._task(name, task) for name, task in entry.tasks.items()}
        links, flows = list(self._links()), list(self._flows())
        timing = self._timing()
        objective = self._objective(nodes, timing.chains if timing is not None else {})
        controller = self._section("controller", ControllerSettings)
        servo: Servo | None = self._made(self.entry.servo)
        live, scenarios = self._live(timing), self._scenarios()
        named, every = entry.candidates.named, self._made(entry.candidates.every)
        candidates, replicated = self._candidates(named)
        called = name if entry.name is None else entry.name
        parts = CellParts(
            nodes=nodes,
            links=links,
            links_complete=len(dict(links)) == len(entry.links or ()),
            tasks=tasks,
            flows=flows,
            scales=dict(entry.scales or {}),
            chains=timing.chains if timing is not None else {},
            candidates=candidates,
            replicated=replicated,
            broken_candidates=[name for name, moves in named.items() if moves is None],
            every_placement=every,
            scenarios=scenarios,
            controller=controller,
            tiers=objective.tiers if objective is not None else {},
            latency=objective.latency if objective is not None else None,
            live=live,
        )
        self._assume(parts)
        # A record names what its machine had.
        if not self.faults.is_record:
            self._add(unregistered(parts, called))
        self._judge(parts)
        if self.faults or timing is None or objective is None or controller is None or live is None:
            return None
        fabric, pipeline = self._fabric(parts), self._pipeline(parts, timing)
        if fabric is None or pipeline is None:
            return None
        return self.faults.attempt(
            "",
            Problem,
            name=called,
            pipeline=pipeline,
            fabric=fabric,
            candidates=_placements(named, candidates, replicated, pipeline.tasks),
            objective=objective,
            scenarios={name: tuple(item for _, item in items) for name, items in scenarios.items()},
            controller=controller,
            servo=servo,
            live=live,
            every_placement=every,
            folder=self.home,
            **{name: entry.values[name] for name in WINDOWS if name in entry.values},
        )

    def _fabric(self, parts: CellParts) -> Fabric | None:
        links = {link.name: link for _, link in parts.links}
        return self.faults.attempt("", Fabric, nodes=_without_none(parts.nodes), links=links)

    def _pipeline(self, parts: CellParts, timing: Pipeline) -> Pipeline | None:
        flows = tuple(flow for _, flow in parts.flows)
        return self.faults.attempt(
            "", replace, timing, tasks=_without_none(parts.tasks), flows=flows
        )

    # ------------------------------------------------------------------ entries and values

    def _made(self, entry: Entry | None, *first: object, **further: object) -> Any:
        """Return an entry's object of the model, or None after a fault.

        The model supplies defaults for absent values; `further` replaces values of the entry.
        """
        if entry is None:
            return None
        return self._make(entry, entry.shape.kind, *first, **{**entry.values, **further})

    def _make(
        self, entry: Entry, kind: Callable[..., T], *first: object, **values: object
    ) -> T | None:
        given = {name: self._value(value) for name, value in values.items()}
        given = {name: value for name, value in given.items() if value is not None}
        make = partial(made_at, entry.path, entry.shape.kind, kind, *first, **given)
        return self.faults.attempt("", make)

    def _value(self, value: object) -> Any:
        """Return what a value that was read is in the model."""
        if isinstance(value, Entry):
            if value.shape is TRACE:
                return self._trace(value)
            made = self._made(value)
            return STAND_IN if made is None and value.shape.kind in PROCESSES else made
        if isinstance(value, dict):
            made = {name: self._value(item) for name, item in value.items()}
            return {name: item for name, item in made.items() if item is not None}
        return value

    def _trace(self, entry: Entry) -> Process:
        if self.tables is None:
            return UnreadTrace(FrozenDict(entry.values))
        table = self.tables.get(Source.of(entry))
        return Trace(table, entry.column) if table is not None else STAND_IN

    def _section(self, name: str, kind: Any) -> Any:
        entry = self.entry.values.get(name)
        return kind() if entry is None else self._made(entry)

    # ----------------------------------------------------------------- fabric and pipeline

    def _links(self) -> Iterator[tuple[str, Link]]:
        for entry in self.entry.links or ():
            link = self._made(entry, both_ways=None)
            if link is not None:
                yield entry.path, link
                if entry.both_ways:
                    yield entry.path, replace(link, source=link.target, target=link.source)

    def _task(self, name: str, entry: Entry | None) -> Task | None:
        if entry is None:
            return None
        on = {node: self._execution(entry, execution) for node, execution in entry.on.items()}
        return cast(Task | None, self._made(entry, name, on=on, workers=None))

    def _execution(self, task: Entry, entry: Entry | None) -> Execution:
        if entry is None:  # at fault; the task may run there all the same
            return Execution(STAND_IN)
        workers = entry.workers if entry.workers is not None else task.workers
        return self._made(entry, workers=workers) or Execution(STAND_IN)

    def _flows(self) -> Iterator[tuple[str, Flow]]:
        for entry in self.entry.flows or ():
            if entry is not None and (flow := self._made(entry)) is not None:
                yield entry.path, flow

    def _timing(self) -> Pipeline | None:
        """Return the pipeline without its tasks and flows."""
        entry = self.entry
        scales = {
            name: STAND_IN if scale is None else scale
            for name, scale in (entry.scales or {}).items()
        }
        given = {one.name: entry.values.get(one.name) for one in declared_fields(Pipeline)}
        given["deadline_ms"] = entry.period_ms if entry.deadline_ms is None else entry.deadline_ms
        return self._make(entry, Pipeline, **{**given, "tasks": {}, "flows": (), "scales": scales})

    # --------------------------------------------------- scenarios, objective, controller

    def _scenarios(self) -> dict[str, list[tuple[str, Disturbance]]]:
        scenarios = self.entry.scenarios or {}
        return {name: list(self._disturbances(items or ())) for name, items in scenarios.items()}

    def _disturbances(self, entries: Sequence[Entry | None]) -> Iterator[tuple[str, Disturbance]]:
        for entry in entries:
            if entry is None:
                continue
            if (entry.node is None) == (entry.link is None):
                if not self.faults.touches(entry.path):
                    has = "neither" if entry.node is None else "both"
                    message = f"needs `node` or `link` and has {has}; give one of them"
                    self.faults.add(entry.path, message)
                continue
            self._only(entry, LINK_KEYS if entry.link is None else NODE_KEYS)
            first = self.faults.attempt(entry.path, self._disturbance, entry)
            if first is None:
                continue
            yield entry.path, first
            if isinstance(first, LinkDisturbance) and entry.both_ways:
                yield entry.path, replace(first, source=first.target, target=first.source)

    def _only(self, entry: Entry, others: Sequence[str]) -> None:
        what = "links" if entry.link is None else "nodes"
        for key in others:
            if entry.values.get(key) is not None:
                path = f"{entry.path}.{key}"
                self.faults.add(path, f"belongs to a disturbance of {what}; remove it")

    def _disturbance(self, entry: Entry) -> Disturbance | None:
        # Faulty episodes shall not also cause a fault about another disturbance of the same name.
        doubtful = entry.episodes is not None and self.faults.touches(entry.episodes.path)
        given: dict[str, object] = {"episodes": None} if doubtful else {}
        others = (*LINK_KEYS, "link") if entry.link is None else ("both_ways", *NODE_KEYS, "link")
        values = {**entry.values, **dict.fromkeys(others), **given}
        if entry.link is None:
            return self._make(entry, NodeDisturbance, **values)
        source, arrow, target = entry.link.partition("->")
        good = bool(arrow and source.strip() and target.strip())
        require(good, "link", entry.link, "two node names and an arrow, as `R1->E`")
        ends = {"source": source.strip(), "target": target.strip()}
        return self._make(entry, LinkDisturbance, **values, **ends)

    def _objective(
        self, nodes: Mapping[str, Node | None], chains: Mapping[str, Chain]
    ) -> Objective | None:
        entry = self.entry.objective or Entry(OBJECTIVE, "objective", {})
        chain = chains.get(entry.latency) if entry.latency is not None else None
        target_ms = latency_target_ms(self.entry.deadline_ms or self.entry.period_ms, chain)
        given = entry.targets.values if entry.targets is not None else {}
        if chain is not None and chain.is_bounded and "latency_ms" not in given:
            place = f"chains.{entry.latency}.max_age_ms"
            bound = f"{TARGET} to be the target of latency; or give objective.targets.latency_ms"
            self.faults.attempt("", require, TARGET.holds(target_ms), place, target_ms, bound)
            if self.faults.at(place):
                return None
        tiers = entry.tiers
        if tiers is None:
            tiers = {name: node.tier for name, node in nodes.items() if node is not None}
        targets = self._make(entry, Targets, **{"latency_ms": target_ms, **given})
        weights, caps = self._made(entry.weights), self._made(entry.caps)
        if targets is None:
            return None
        return self._make(
            entry,
            Objective,
            weights=weights or Weights(),
            targets=targets,
            caps=caps or Caps(),
            tiers=tiers,
            accelerators=accelerator_tiers(nodes, tiers) if entry.accelerators else {},
            latency=entry.latency,
        )

    def _candidates(
        self, named: Mapping[str, Any]
    ) -> tuple[dict[str, dict[str, str]], dict[str, Replicated]]:
        """Return the readable candidates: plain placements, and replicas."""
        plain: dict[str, dict[str, str]] = {}
        replicated: dict[str, Replicated] = {}
        for name, moves in named.items():
            if isinstance(moves, Entry):
                made = self.faults.attempt(
                    moves.path, Replicated, **{**moves.values, "replicas": tuple(moves.replicas)}
                )
                replicated |= {name: made} if made is not None else {}
            elif moves is not None:
                plain[name] = moves
        return plain, replicated

    def _live(self, timing: Pipeline | None) -> LiveSettings | None:
        live: LiveSettings | None = self._section("live", LiveSettings)
        if live is not None and timing is not None:
            self.faults.attempt("", live.require_in_time, timing.deadline_ms)
        return live

    # --------------------------------------------------------------------------- meaning

    def _judge(self, parts: CellParts) -> None:
        """Add the faults of meaning, except consequences of other faults."""
        for name, moves in parts.candidates.items():
            for task_name, node in moves.items():
                task = parts.tasks.get(task_name)
                if task is not None and task.anchored and node in task.on:
                    self.faults.add(
                        f"candidates.{name}.{task_name}",
                        f"{task_name} is anchored to {node}, in every candidate; leave it out",
                    )
        known = all(
            link.source in parts.nodes and link.target in parts.nodes for _, link in parts.links
        )
        # Only if every link is good can a link be missing.
        parts.links_complete = parts.links_complete and known and not self.faults.at("links")
        parts.links = _forward(parts.links, parts.nodes)
        self._add(find_faults(parts))

    def _add(self, faults: Iterable[Fault]) -> None:
        for fault in faults:
            if not self.faults.at(fault.path):
                self.faults.add(fault.path, fault.message)

    def _assume(self, parts: CellParts) -> None:
        """Take all names for declared where the section that declares them could not be read."""
        for section in ("nodes", "tasks", "scales", "candidates"):
            if self.faults.at(section):
                setattr(parts, section, UnreadNames())


def unknown_names(policy: str | None, estimator: str | None, cell: Problem) -> Iterator[Fault]:
    """Yield a fault, at ``policy`` or ``estimator``, for each that a cell could not run with."""
    known = [*policies.names(), *cell.candidates]
    if policy is not None and policy not in known and not CLASS_PATH.holds(policy):
        hint = nearest_of(policy, known, "policies")
        yield Fault("policy", f"unknown policy {policy!r}; {hint}")
    if estimator is not None and not is_estimator(estimator):
        hint = nearest(estimator, estimators.names())
        yield Fault("estimator", f"unknown estimator {estimator!r}; {hint}")


def is_estimator(name: str) -> bool:
    """Whether a name names an estimator or a class."""
    return name in estimators.names() or CLASS_PATH.holds(name)


def unregistered(parts: CellParts, name: str) -> list[Fault]:
    """Return the faults in names: of policies, estimators, columns and the cell."""
    known = policies.names(), estimators.names(), estimators.shadowing()
    return list(find_unregistered(parts, name, *known))


def _without_none(parts: Mapping[str, T | None]) -> dict[str, T]:
    """Return the parts without faults."""
    return {name: part for name, part in parts.items() if part is not None}


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


def _placements(
    names: Iterable[str],
    plain: Mapping[str, Mapping[str, str]],
    replicated: Mapping[str, Replicated],
    tasks: Mapping[str, Task],
) -> dict[str, Placement]:
    """Return the placements of all candidates, in the order of the file."""
    placed = {name: _complete(moves, tasks) for name, moves in plain.items()}
    both = {
        name: Replicas({member: placed[member] for member in one.replicas}, one.after_ms)
        for name, one in replicated.items()
    }
    return {name: both[name] if name in both else placed[name] for name in names}
