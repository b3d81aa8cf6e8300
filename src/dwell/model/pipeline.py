"""Pipeline: tasks, the flows between them, a period and a deadline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from dwell.model.bounds import (
    BYTES,
    DEADLINE_MS,
    DEPTH,
    HANDED_MS,
    PERIOD_MS,
    PRIORITY,
    STANDBY,
    STATE_BYTES,
    THREADS,
    TIME_MS,
    WORKERS,
    require,
)
from dwell.model.fabric import accelerator_name
from dwell.model.frozen import FrozenDict, require_names, shortened
from dwell.model.live import require_callable_name
from dwell.model.process import Constant, Process


@dataclass(frozen=True, slots=True)
class Execution:
    """A task on one of its feasible nodes: execution time, threads and workers.

    Parameters
    ----------
    exec_ms : Process
        Time one job needs there when nothing disturbs it, milliseconds.
    threads : int
        Cores the job can use at once; `exec_ms` is the time with all of them, and on a node with
        fewer it takes so many times as long.
    workers : int
        Jobs of this task that may run there at the same time.
    accelerator : str, optional
        Kind of accelerator the job runs on instead of the CPU.
    standby : int
        Further workers that a live node keeps, to take over when the first is silent.
    before_ms, after_ms : float
        What of `exec_ms` other threads of its worker do before and after its own. Only where
        threads take turns (`Quota.tick_ms`) does it matter: each of them waits for its own.
    """

    exec_ms: Process
    threads: int = 1
    workers: int = 1
    accelerator: str | None = None
    standby: int = 0
    before_ms: float = 0.0
    after_ms: float = 0.0

    def __post_init__(self) -> None:
        HANDED_MS.check("before_ms", self.before_ms)
        HANDED_MS.check("after_ms", self.after_ms)
        STANDBY.check("standby", self.standby)
        THREADS.check("threads", self.threads)
        WORKERS.check("workers", self.workers)

    def resource(self, node: str) -> str:
        """Name of what it works on, on a node: the node's, for its CPU, or that of a kind."""
        return node if self.accelerator is None else accelerator_name(node, self.accelerator)


@dataclass(frozen=True, slots=True)
class Task:
    """A static stage of the pipeline, a vertex of the DAG.

    Parameters
    ----------
    on : mapping of str to Execution
        Feasible nodes (N_v); one makes the task anchored, more make it relocatable.
    depth : int
        How many complete input sets may wait for a worker: 0 is no bound (``input: queue``), 1 is
        ``input: latest``; beyond it the oldest cycle is replaced.
    priority : int
        Larger runs first on a ``priority`` node.
    scale : str, optional
        Name of the per-cycle process that multiplies the execution time on every node.
    offset_ms : float
        Start of a source after the cycle's release; 0 for any other task.
    start_ms : float
        Time a new worker needs before its first job.
    state_bytes : int
        State that a cold migration carries over the link.
    run : str, optional
        ``module:Name`` of the class or function that a live worker runs.
    """

    name: str
    on: Mapping[str, Execution]
    depth: int = 0
    priority: int = 0
    scale: str | None = None
    offset_ms: float = 0.0
    start_ms: float = 0.0
    state_bytes: int = 0
    run: str | None = None

    def __post_init__(self) -> None:
        if self.run is not None:
            require_callable_name("run", self.run)
        require(len(self.on) > 0, "on", dict(self.on), "at least one node")
        DEPTH.check("input", self.depth)
        PRIORITY.check("priority", self.priority)
        TIME_MS.check("offset_ms", self.offset_ms)
        TIME_MS.check("start_ms", self.start_ms)
        STATE_BYTES.check("state_bytes", self.state_bytes)
        object.__setattr__(self, "on", FrozenDict(self.on))

    @property
    def anchored(self) -> bool:
        """Whether one node only can run it."""
        return len(self.on) == 1


@dataclass(frozen=True, slots=True)
class Flow:
    """A precedence edge with the payload that travels along it."""

    source: str
    target: str
    payload_bytes: int = 0

    def __post_init__(self) -> None:
        BYTES.check("bytes", self.payload_bytes)


@dataclass(frozen=True, slots=True)
class Pipeline:
    """Tasks and flows of a control loop with its timing.

    Parameters
    ----------
    tasks : mapping of str to Task
        In the file's order.
    flows : tuple of Flow
        Any directed acyclic graph.
    period_ms, deadline_ms : float
        P and D, with D at most P.
    release_jitter_ms : Process
        Added to every nominal release instant.
    scales : mapping of str to Process
        Per-cycle factors that tasks may name.
    """

    tasks: Mapping[str, Task]
    flows: tuple[Flow, ...]
    period_ms: float
    deadline_ms: float
    release_jitter_ms: Process = field(default_factory=lambda: Constant(0.0))
    scales: Mapping[str, Process] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        PERIOD_MS.check("period_ms", self.period_ms)
        DEADLINE_MS.check("deadline_ms", self.deadline_ms)
        bound = f"at most period_ms = {self.period_ms:g}"
        require(self.deadline_ms <= self.period_ms, "deadline_ms", self.deadline_ms, bound)
        require_names("tasks", self.tasks)
        object.__setattr__(self, "tasks", FrozenDict(self.tasks))
        object.__setattr__(self, "flows", tuple(self.flows))
        object.__setattr__(self, "scales", FrozenDict(self.scales))

    def __repr__(self) -> str:
        chains = [shortened(chain, " -> ") for chain in self.chains()]
        return (
            f"<Pipeline: {shortened(chains, '; ')}; period {self.period_ms:g} ms, "
            f"deadline {self.deadline_ms:g} ms>"
        )

    def __str__(self) -> str:
        """Return its flows as chains: ``a → b → d; c → b``."""
        return "; ".join(" → ".join(chain) for chain in self.chains())

    def inputs(self, task: str) -> tuple[Flow, ...]:
        """Flows into a task."""
        return tuple(flow for flow in self.flows if flow.target == task)

    def outputs(self, task: str) -> tuple[Flow, ...]:
        """Flows out of a task."""
        return tuple(flow for flow in self.flows if flow.source == task)

    def diverging(self, active: Mapping[str, str], other: Mapping[str, str]) -> frozenset[str]:
        """Tasks that run elsewhere under `other`, or have such a task before them.

        What a cycle that runs under `active` cannot share with a shadow sent through `other`.
        """
        found: set[str] = set()
        for name in self.topological():
            behind = any(flow.source in found for flow in self.inputs(name))
            if active[name] != other[name] or behind:
                found.add(name)
        return frozenset(found)

    def topological(self) -> tuple[str, ...]:
        """Tasks so that every flow points forward; tasks on a cycle are left out."""
        waiting = {name: len(self.inputs(name)) for name in self.tasks}
        order: list[str] = [name for name, count in waiting.items() if count == 0]
        for name in order:
            for flow in self.outputs(name):
                waiting[flow.target] -= 1
                if waiting[flow.target] == 0:
                    order.append(flow.target)
        return tuple(order)

    def chains(self) -> tuple[tuple[str, ...], ...]:
        """Paths that have every flow once among their steps, and every task at least once."""
        left = {name: [flow.target for flow in self.outputs(name)] for name in self.tasks}
        found: list[tuple[str, ...]] = []
        for name in self.topological():
            alone = not self.inputs(name) and not self.outputs(name)
            while left[name] or alone:
                chain, alone = [name], False
                while left[chain[-1]]:
                    chain.append(left[chain[-1]].pop(0))
                found.append(tuple(chain))
        return tuple(found)
