"""Pipeline: tasks, the flows between them, a period and a deadline."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model.bounds import LARGEST, MAX_COUNT, PERIOD_MS, TIME_MS, Bound, require
from dwell.model.chain import Chain, behind
from dwell.model.declaration import declared, key
from dwell.model.fabric import accelerator_name
from dwell.model.frozen import FrozenDict, require_names, shortened
from dwell.model.live import require_callable_name
from dwell.model.placement import Nodes
from dwell.model.process import Constant, Process
from dwell.model.ros_topics import RosTopic
from dwell.model.task_rates import rates_of

#: Workers of a task on a node, and the task's default for each of its nodes.
WORKERS = Bound(1, MAX_COUNT, whole=True)
STANDBY = Bound(0, 1, whole=True)
EVERY = Bound(1, 10_000, whole=True)
#: Largest deadline, in periods.
LONGEST_DEADLINE = 64


@declared()
class Execution:
    """How a task runs on one of its feasible nodes."""

    exec_ms: Process = key(
        "Execution time of an undisturbed job, with all its threads, ms.",
        tier="first",
    )
    threads: int = key(
        "Cores that a job can use at once; with fewer cores it takes longer by the ratio.",
        Bound(1, MAX_COUNT, whole=True),
        default=1,
        tier="first",
    )
    workers: int = key(
        "Jobs of this task that may run there at a time.", WORKERS, default=1, usual="the task's"
    )
    accelerator: str | None = key(
        "Kind of accelerator that it runs on instead of the CPU.", default=None
    )
    standby: int = key(
        "Further workers that a live node keeps, to take over when the first is silent.",
        STANDBY,
        default=0,
        is_rare=True,
    )

    def resource(self, node: str) -> str:
        """Return the name of its resource on a node: the CPU's, or a kind of accelerator."""
        return node if self.accelerator is None else accelerator_name(node, self.accelerator)


@declared()
class Task:
    """A static stage of the pipeline, a vertex of the DAG."""

    name: str
    on: Mapping[str, Execution] = key(
        "Nodes it can run on, and how; one anchors it, more make it relocatable.",
        tier="first",
    )
    depth: int = key(
        "Complete input sets that may wait for a worker, 0 without a bound; beyond it the oldest "
        "cycle is replaced.",
        Bound(0, MAX_COUNT, whole=True),
        default=0,
        named="input",
        tier="first",
    )
    priority: int = key(
        "Larger runs first on a node with the priority scheduler.",
        Bound(-1000, 1000, whole=True),
        default=0,
    )
    scale: str | None = key(
        "Name under `scales` of a factor on its execution times on every node.",
        default=None,
        tier="measured",
    )
    every: int | None = key(
        "Cycles from one run to the next of a task without waited inputs.",
        EVERY,
        default=None,
        usual="1, or the rate of its waited inputs",
    )
    offset_ms: float = key(
        "Start after the cycle's release of a task without waited inputs, ms.",
        TIME_MS,
        default=0.0,
    )
    start_ms: float = key(
        "Time that a new worker needs before its first job, ms.",
        TIME_MS,
        default=0.0,
        tier="measured",
    )
    state_bytes: int = key(
        "State that a cold migration carries over the link, bytes.",
        Bound(0, 1e15, whole=True),
        default=0,
        tier="measured",
    )
    run: str | None = key(
        "Class or function of a live worker, as `package.module:Name`.",
        default=None,
        digested="code",
        tier="first",
    )
    ros2: RosTopic | None = key(
        "ROS 2 topic that a source task reads, in place of `run`.",
        default=None,
        digested="code",
        tier="first",
    )
    warmup_jobs: int = key(
        "First jobs of a live worker that do not count in times of stages and in estimators.",
        Bound(0, MAX_COUNT, whole=True),
        default=0,
        is_rare=True,
        tier="measured",
    )

    def __post_init__(self) -> None:
        if self.run is not None:
            require_callable_name("run", self.run)
        if self.ros2 is not None:
            require(
                self.run is None, "run", self.run, "left out next to `ros2`: either is the code"
            )
        require(len(self.on) > 0, "on", dict(self.on), "at least one node")

    @property
    def anchored(self) -> bool:
        """Whether only one node can run it."""
        return len(self.on) == 1


@declared()
class Flow:
    """A precedence edge: messages from one task to another."""

    source: str = key("Task that sends.", named="from", tier="first")
    target: str = key("Task that receives.", named="to", tier="first")
    payload_bytes: int = key(
        "Payload of a message, bytes.",
        Bound(0, 1e12, whole=True),
        default=0,
        named="bytes",
        tier="first",
    )
    sampled: bool = key(
        "Whether the target does not wait for it, but takes the newest message that has arrived.",
        default=False,
    )


@declared()
class Pipeline:
    """Tasks and flows of a control loop with its timing."""

    tasks: Mapping[str, Task] = key("Stages of the pipeline by name.", tier="first")
    flows: tuple[Flow, ...] = key(
        "What tasks send to one another: a directed acyclic graph.", tier="first"
    )
    period_ms: float = key("Time between two releases (P), ms.", PERIOD_MS, tier="first")
    deadline_ms: float = key(
        f"Latency beyond which a cycle is missed (D, at most {LONGEST_DEADLINE} P), ms.",
        Bound(1e-6, LARGEST),
        usual="P",
        tier="first",
    )
    release_jitter_ms: Process = key(
        "Added to the instant of every release, ms.",
        default_factory=lambda: Constant(0.0),
        tier="measured",
    )
    scales: Mapping[str, Process] = key(
        "Factors by name, one per cycle, on execution times, as the complexity of the scene.",
        default_factory=FrozenDict,
        tier="measured",
    )
    chains: Mapping[str, Chain] = key(
        "Chains of tasks whose data age is measured, by name.",
        default_factory=FrozenDict,
    )
    phase_ms: float | None = key(
        "Offset of all its releases, with their deadlines and windows, ms; less than P.",
        TIME_MS,
        default=None,
        usual="0, or the fleet's `phases`",
        is_rare=True,
    )

    def __post_init__(self) -> None:
        longest_ms = LONGEST_DEADLINE * self.period_ms
        bound = f"at most {LONGEST_DEADLINE} period_ms = {longest_ms:g}"
        require(self.deadline_ms <= longest_ms, "deadline_ms", self.deadline_ms, bound)
        bound = f"less than period_ms = {self.period_ms:g}"
        require(self.first_release_ms < self.period_ms, "phase_ms", self.phase_ms, bound)
        require_names("tasks", self.tasks)

    def __repr__(self) -> str:
        ways = [shortened(way, " -> ") for way in self.ways()]
        return (
            f"<Pipeline: {shortened(ways, '; ')}; period {self.period_ms:g} ms, "
            f"deadline {self.deadline_ms:g} ms>"
        )

    def __str__(self) -> str:
        """Return its flows as ways: ``a → b → d; c → b``."""
        return "; ".join(" → ".join(way) for way in self.ways())

    @property
    def first_release_ms(self) -> float:
        """Instant of the first release without jitter: `phase_ms`, or 0 if it is None."""
        return self.phase_ms or 0.0

    @property
    def period_ns(self) -> int:
        """P in whole nanoseconds."""
        return round(self.period_ms * 1e6)

    @property
    def deadline_ns(self) -> int:
        """D in whole nanoseconds."""
        return round(self.deadline_ms * 1e6)

    @property
    def open_cycles(self) -> int:
        """Largest number of cycles whose deadlines are open: D / P, rounded up; at least 1."""
        return max(-(-self.deadline_ns // self.period_ns), 1)

    def inputs(self, task: str) -> tuple[Flow, ...]:
        """Flows into a task."""
        return tuple(flow for flow in self.flows if flow.target == task)

    def waited(self, task: str) -> tuple[Flow, ...]:
        """Flows into a task that it waits for: all except sampled flows."""
        return tuple(flow for flow in self.inputs(task) if not flow.sampled)

    def outputs(self, task: str) -> tuple[Flow, ...]:
        """Flows out of a task."""
        return tuple(flow for flow in self.flows if flow.source == task)

    @property
    def sinks(self) -> tuple[str, ...]:
        """Tasks without outputs."""
        return tuple(name for name in self.tasks if not self.outputs(name))

    @property
    def rates(self) -> dict[str, int]:
        """Cycles from one run of each task to its next."""
        return rates_of(self.tasks, self.flows)

    @property
    def has_rates(self) -> bool:
        """Whether some task does not run in each cycle, or some flow is sampled."""
        every = (task.every or 1 for task in self.tasks.values())
        return any(flow.sampled for flow in self.flows) or max(every) > 1

    @property
    def sink_rates(self) -> dict[str, tuple[int, ...]]:
        """Rates of the sinks to which waited flows lead from each task, or of the task if a sink.

        Only tasks with such a sink determine the latency and the outcome of a cycle.
        """
        rates, found = self.rates, dict[str, set[int]]()
        for name in reversed(self.topological()):
            outputs = self.outputs(name)
            waited = [found[flow.target] for flow in outputs if not flow.sampled]
            found[name] = set().union(*waited) if outputs else {rates[name]}
        return {name: tuple(sorted(found[name])) for name in self.tasks}

    @property
    def sink_cycles(self) -> int:
        """Cycles from one run to the next of the slowest sink."""
        if not any(task.every for task in self.tasks.values()):
            return 1
        rates = self.rates
        return max(rates[name] for name in self.sinks)

    @property
    def due_interval(self) -> int:
        """Most cycles from a cycle in which a sink is due to the next such cycle."""
        if not any(task.every for task in self.tasks.values()):
            return 1
        rates = self.rates
        return min(rates[name] for name in self.sinks)

    @property
    def has_idle_cycles(self) -> bool:
        """Whether no sink is due in some cycles."""
        return self.due_interval > 1

    def chain_cycles(self, chain: Chain) -> int:
        """Cycles from one origin to the next that a chain's actuations may differ by.

        This is the largest rate of the tasks on the ways from the chain's first task to its last.
        """
        on_ways = behind(chain.source, self.flows) | {chain.source}
        rates = self.rates
        return max(
            rates[name]
            for name in on_ways
            if name == chain.target or chain.target in behind(name, self.flows)
        )

    @property
    def message_rates(self) -> dict[tuple[str, str], int]:
        """Cycles from one message of each flow to its next, by source and target.

        A waited flow has messages in the cycles in which its target runs, a sampled flow in the
        cycles in which its source runs.
        """
        rates = self.rates
        return {
            (one.source, one.target): rates[one.source if one.sampled else one.target]
            for one in self.flows
        }

    def diverging(self, active: Mapping[str, Nodes], other: Mapping[str, str]) -> frozenset[str]:
        """Return the tasks on another node under `other`, and all tasks downstream of them.

        A shadow through `other` runs these tasks and shares the rest with the cycle under `active`.
        A task with two copies is always on another node. Sampled flows do not count.
        """
        found: set[str] = set()
        for name in self.topological():
            behind = any(flow.source in found for flow in self.waited(name))
            if active[name] != other[name] or behind:
                found.add(name)
        return frozenset(found)

    def topological(self) -> tuple[str, ...]:
        """Return the tasks in topological order; tasks on a cycle are left out."""
        waiting = {name: len(self.inputs(name)) for name in self.tasks}
        order: list[str] = [name for name, count in waiting.items() if count == 0]
        for name in order:
            for flow in self.outputs(name):
                waiting[flow.target] -= 1
                if waiting[flow.target] == 0:
                    order.append(flow.target)
        return tuple(order)

    def ways(self) -> tuple[tuple[str, ...], ...]:
        """Return paths that contain every flow exactly once and every task at least once."""
        left = {name: [flow.target for flow in self.outputs(name)] for name in self.tasks}
        found: list[tuple[str, ...]] = []
        for name in self.topological():
            alone = not self.inputs(name) and not self.outputs(name)
            while left[name] or alone:
                way, alone = [name], False
                while left[way[-1]]:
                    way.append(left[way[-1]].pop(0))
                found.append(tuple(way))
        return tuple(found)
