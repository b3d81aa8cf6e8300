"""Assembly: the entry of a cell becomes the objects of the model, and they are checked together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from dwell.io.entries import (
    BurstsEntry,
    CellEntry,
    ControllerEntry,
    DisturbanceEntry,
    Entry,
    LinkEntry,
    NodeEntry,
    ObjectiveEntry,
    ProcessEntry,
    TaskEntry,
)
from dwell.io.faults import Faults
from dwell.io.traces import Source, Tables
from dwell.model import (
    AR1,
    Bursts,
    Caps,
    Constant,
    ControllerSettings,
    Disturbance,
    Execution,
    Exponential,
    Fabric,
    Flow,
    Gamma,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Normal,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Quota,
    Targets,
    Task,
    Trace,
    Uniform,
    Weights,
)
from dwell.model.bounds import LARGEST
from dwell.model.meaning import Parts, find_faults
from dwell.model.problem import POLICIES

__all__ = ["Assembly"]

NAMED: Mapping[str, type[Process]] = {
    "uniform": Uniform,
    "normal": Normal,
    "lognormal": LogNormal,
    "gamma": Gamma,
    "exponential": Exponential,
    "ar1": AR1,
}

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
    tables : dict of Source to TraceTable
        Less the sources at fault.
    faults : Faults
        Holds the faults so far, takes those found here.
    """

    entry: CellEntry
    tables: Tables
    faults: Faults

    def problem(self, name: str) -> Problem | None:
        """Return the problem, or None beside at least one fault.

        Parameters
        ----------
        name : str
            For a cell that does not name itself.
        """
        entry = self.entry
        nodes = {name: self._node(name, node) for name, node in entry.nodes.items()}
        tasks = {name: self._task(name, task) for name, task in entry.tasks.items()}
        links = list(self._links())
        flows = list(self._flows())
        pipeline = self._pipeline()
        objective = self._objective(entry.objective or ObjectiveEntry(), nodes)
        controller = self._controller()
        scenarios = dict(self._scenarios())
        moves = {name: move for name, move in entry.candidates.items() if move is not None}
        parts = Parts(
            nodes=nodes,
            links=self._between_known(links, nodes),
            links_complete=not self.faults.touches("links"),
            tasks=tasks,
            flows=flows,
            scales=dict(entry.scales or {}),
            candidates=moves,
            broken_candidates=[name for name, move in entry.candidates.items() if move is None],
            scenarios=scenarios,
            controller=controller,
            tiers=objective.tiers if objective is not None else (),
            reserved=POLICIES,
        )
        self._resolve_missing(parts)
        for fault in find_faults(parts):
            if not self.faults.at(fault.path):
                self.faults.add(fault.path, fault.message)
        if pipeline is None or objective is None or controller is None or self.faults:
            return None
        whole = {name: task for name, task in tasks.items() if task is not None}
        return self.faults.attempt(
            "",
            lambda: Problem(
                name=entry.name or name,
                pipeline=Pipeline(
                    tasks=whole,
                    flows=tuple(flow for _, flow in flows),
                    period_ms=pipeline.period_ms,
                    deadline_ms=pipeline.deadline_ms,
                    release_jitter_ms=pipeline.release_jitter_ms,
                    scales=pipeline.scales,
                ),
                fabric=Fabric(
                    nodes={name: node for name, node in nodes.items() if node is not None},
                    links={link.name: link for _, link in links},
                ),
                candidates={
                    name: Placement(
                        (task, move.get(task) or next(iter(whole[task].on))) for task in whole
                    )
                    for name, move in moves.items()
                },
                objective=objective,
                scenarios={
                    name: tuple(item for _, item in items) for name, items in scenarios.items()
                },
                controller=controller,
                **_given(
                    window_cycles=entry.window_cycles, warmup_windows=entry.warmup_windows
                ),
            ),
        )

    # ------------------------------------------------------------------------- processes

    def _process(self, entry: ProcessEntry, path: str) -> Process:
        if entry.constant is not None:
            return Constant(entry.constant)
        if entry.trace is not None:
            table = self.tables.get(Source.of(entry.trace))
            return Trace(table, entry.trace.column) if table is not None else STAND_IN
        for name, kind in NAMED.items():
            values: Entry | None = getattr(entry, name)
            if values is not None:
                arguments = values.model_dump(exclude_none=True)
                return self.faults.attempt(path, lambda: kind(**arguments)) or STAND_IN
        return STAND_IN

    def _maybe(self, entry: ProcessEntry | None, path: str) -> Process | None:
        return self._process(entry, path) if entry is not None else None

    def _bursts(self, entry: BurstsEntry | None, path: str, **more: object) -> Bursts | None:
        if entry is None:
            return None
        every_ms = self._process(entry.every_ms, f"{path}.every_ms")
        for_ms = self._process(entry.for_ms, f"{path}.for_ms")
        return self.faults.attempt(path, lambda: Bursts(every_ms, for_ms, **_given(**more)))

    # ---------------------------------------------------------------------------- fabric

    def _node(self, name: str, entry: NodeEntry | None) -> Node | None:
        if entry is None:
            return None
        path = f"nodes.{name}"
        burst, quota = entry.bursts, entry.quota
        bursts = self._bursts(burst, f"{path}.bursts", threads=burst.threads) if burst else None
        return self.faults.attempt(
            path,
            lambda: Node(
                name,
                entry.tier,
                **_given(
                    cores=entry.cores,
                    scheduler=entry.scheduler,
                    accelerators=entry.accelerators,
                    bursts=bursts,
                    quota=Quota(quota.cpu, quota.period_ms) if quota else None,
                ),
            ),
        )

    def _links(self) -> Iterator[tuple[str, Link]]:
        for index, entry in enumerate(self.entry.links or ()):
            path = f"links[{index}]"
            if entry is None:
                continue
            there = self._link(path, entry)
            if there is None:
                continue
            yield path, there
            if entry.both_ways:
                yield path, self._reversed(there)

    def _link(self, path: str, entry: LinkEntry) -> Link | None:
        delay_ms = self._process(entry.delay_ms, f"{path}.delay_ms")
        burst = entry.bursts
        bursts = None
        if burst is not None:
            extra = self._maybe(burst.add_delay_ms, f"{path}.bursts.add_delay_ms")
            bursts = self._bursts(burst, f"{path}.bursts", add_delay_ms=extra)
        return self.faults.attempt(
            path,
            lambda: Link(
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
            ),
        )
