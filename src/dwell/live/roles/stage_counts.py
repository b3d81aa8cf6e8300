"""Times and counts of stages: workers write them, agents read them, a controller adds them up.

A worker keeps one row per cycle in mapped memory, which outlives the worker: the state of each
input and the bytes of each output. It also keeps the times of its last jobs. Once per second its
agent adds up the last two blocks of cycles and sends the sums. A block begins at a multiple of its
length, so both ends of a flow count the same messages without a comparison of clocks.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from dwell.live.wire.messages import Header, InputCounts, Load, OutputCounts, StageCounts, Stamp
from dwell.live.wire.wiring import Role, roles
from dwell.model import Placement, Problem
from dwell.model.number_arrays import Ints

#: Run and number of a cycle or of a block.
Key: TypeAlias = tuple[int, int]

#: States of an input: missing, waiting for a job, and three final states.
ABSENT, WAITING, TAKEN, REPLACED, DROPPED = range(5)
#: Names of the final states in the status.
ENDS = "taken", "replaced", "dropped"
#: Counts of a stage in the status.
COUNTS = "jobs", "replaced", "dropped"
#: Time between two reports of an agent.
REPORT_NS = 1_000_000_000
#: Number of blocks kept by a worker (rows) and by a controller (sums).
BLOCKS, KEPT_BLOCKS = 4, 6
#: Least number of jobs from which their median may be the reason in a headline.
LEAST_JOBS = 3
#: Places in the head: run, newest cycle, number of inputs in each final state (at the places of
#: these states), and number of jobs.
RUN, NEWEST, *_, JOBS, HEAD = range(7)
#: Column of the cycle; the columns of outputs and inputs follow.
CYCLE = 0


def block_cycles(problem: Problem) -> int:
    """Return the length of a block: a window, or the cycles between two reports if that is more."""
    return max(problem.window_cycles, math.ceil(REPORT_NS / problem.pipeline.period_ns))


def book_path(folder: Path, who: str) -> Path:
    """Return the file with a worker's rows."""
    return folder / f"{who}.stages"


def _stages(problem: Problem, tasks: Iterable[str]) -> list[str]:
    """Return ``TASK@NODE`` for some tasks and all nodes that may run them."""
    return [f"{task}@{node}" for task in tasks for node in problem.pipeline.tasks[task].on]


class StageBook:
    """Rows of one worker; see the module.

    `memory` returns the buffer of the rows, by its size in bytes. Raises a ValueError if the
    buffer has another size.
    """

    def __init__(
        self, problem: Problem, task: str, node: str, memory: Callable[[int], Any] = bytearray
    ) -> None:
        self._block = block_cycles(problem)
        begins = _stages(problem, (flow.source for flow in problem.pipeline.inputs(task)))
        ends = _stages(problem, (flow.target for flow in problem.pipeline.outputs(task)))
        self._outputs = {name: 1 + place for place, name in enumerate(ends)}
        self._first_input = 1 + len(ends)
        self._inputs = {name: self._first_input + place for place, name in enumerate(begins)}
        count, width = BLOCKS * self._block, self._first_input + len(begins)
        sizes = HEAD, len(ends), 2 * count, count * width
        numbers = np.frombuffer(memory(8 * sum(sizes)), np.int64)
        self._head, self._sent_bytes, jobs, rows = np.split(numbers, np.cumsum(sizes[:3]))
        #: Newest known cycle at the end of each of the last jobs, and the time of the job.
        self._jobs: Ints = jobs.reshape(count, 2)
        self._rows: Ints = rows.reshape(count, width)

    def begin(self) -> None:
        """Clear the inputs that a previous worker, which has died, left waiting."""
        states = self._rows[:, self._first_input :]
        states[states == WAITING] = ABSENT

    def _row(self, stamp: Stamp) -> Ints | None:
        """Return the row of a cycle; None if a later cycle has it."""
        head, (run, cycle) = self._head, stamp.key
        if head[RUN] != run:
            head[RUN], head[NEWEST], self._rows[:], self._jobs[:] = run, 0, 0, 0
        row: Ints = self._rows[cycle % len(self._rows)]
        if row[CYCLE] != cycle:
            if cycle < row[CYCLE] <= head[NEWEST]:
                return None
            row[:] = 0
            row[CYCLE] = cycle
        return row

    def arrived(self, header: Header) -> None:
        """Count an input that has arrived; copies are ignored."""
        column, row = self._inputs.get(f"{header.source}@{header.node}"), self._row(header.stamp)
        if column is not None and row is not None:
            self._head[NEWEST] = header.stamp.cycle
            if row[column] == ABSENT:
                row[column] = WAITING

    def ended(self, headers: Iterable[Header], state: int) -> None:
        """Count the final state of inputs; only waiting inputs become replaced or dropped."""
        for header in headers:
            column = self._inputs.get(f"{header.source}@{header.node}")
            if column is None:
                continue
            row = self._row(header.stamp)
            if row is not None:
                if row[column] != WAITING and (state != TAKEN or row[column] == TAKEN):
                    continue
                row[column] = state
            self._head[state] += 1

    def ran(self, stamp: Stamp, exec_ns: int) -> None:
        """Count a job and its time."""
        head = self._head
        self._row(stamp)
        head[NEWEST] = max(head[NEWEST], stamp.cycle)
        self._jobs[head[JOBS] % len(self._jobs)] = head[NEWEST], max(exec_ns, 1)
        head[JOBS] += 1

    def sent(self, stamp: Stamp, target: str, payload_bytes: int) -> None:
        """Count an output to ``TASK@NODE``."""
        column = self._outputs[target]
        if (row := self._row(stamp)) is not None:
            row[column] = 1 + payload_bytes
        self._sent_bytes[column - 1] += payload_bytes

    def report(self, who: str) -> Iterator[StageCounts]:
        """Yield the sums of the second newest block, then of the newest block."""
        run, newest = self._head[RUN].item(), self._head[NEWEST].item()
        blocks, of_jobs = self._rows[:, CYCLE] // self._block, self._jobs[:, 0] // self._block
        for block in range(max(newest // self._block - 1, 0), newest // self._block + 1):
            rows = self._rows[blocks == block]
            exec_ns = np.sort(self._jobs[(of_jobs == block) & (self._jobs[:, 1] > 0), 1]).tolist()
            jobs, states = len(exec_ns), rows[:, self._first_input :]
            replaced, dropped = ((states == end).any(axis=1) for end in (REPLACED, DROPPED))
            yield StageCounts(
                *(who, run, block),
                jobs=jobs,
                median_ns=exec_ns[jobs // 2] if jobs else 0,
                p95_ns=exec_ns[(95 * jobs - 1) // 100] if jobs else 0,
                replaced=replaced.sum().item(),
                dropped=dropped.sum().item(),
                inputs=tuple(self._input(rows, name) for name in self._inputs),
                outputs=tuple(self._output(rows, name) for name in self._outputs),
                totals=tuple(self._head[TAKEN : DROPPED + 1].tolist()),
            )

    def _input(self, rows: Ints, name: str) -> InputCounts:
        states = rows[:, self._inputs[name]].tolist()
        return InputCounts(name, *map(states.count, (TAKEN, REPLACED, DROPPED, WAITING)))

    def _output(self, rows: Ints, name: str) -> OutputCounts:
        column = self._outputs[name]
        sizes = rows[:, column][rows[:, column] > 0]
        total = self._sent_bytes[column - 1].item()
        return OutputCounts(name, len(sizes), (sizes - 1).sum().item(), total)


def read_books(problem: Problem, there: Iterable[Role], folder: Path) -> Iterator[StageCounts]:
    """Yield the sums of a node's workers and standbys from the files in its state folder."""
    for role in there:
        if role.kind in ("worker", "standby"):
            memory = _reads(book_path(folder, role.who))
            # The file may not exist yet, or be from another cell file.
            with suppress(OSError, ValueError):
                yield from StageBook(problem, role.task, role.node, memory).report(role.who)


def _reads(path: Path) -> Callable[[int], bytes]:
    return lambda _: path.read_bytes()


class StageTable:
    """Sums of all workers of a cell by block, from the agents' reports.

    A worker and its standbys count together. `newest` is run and number of the newest cycle.
    """

    def __init__(self, problem: Problem) -> None:
        self._size, self._period_ns = block_cycles(problem), problem.pipeline.period_ns
        self._rates = problem.pipeline.rates
        # Jobs of the source per message of a flow.
        self._jobs_per_message = {
            (source, target): every // self._rates[source]
            for (source, target), every in problem.pipeline.message_rates.items()
        }
        #: Time after the report of a sent message until the message counts as lost if it has not
        #: arrived: D, plus the time until the receiver's next report.
        self._settled_ns = problem.pipeline.deadline_ns + 5 * REPORT_NS // 4
        #: Node of each worker, and the possible targets of its outputs.
        self._known: dict[str, tuple[str, list[str]]] = {}
        self._workers: dict[str, list[str]] = defaultdict(list)
        for role in roles(problem):
            if role.kind in ("worker", "standby"):
                outputs = (flow.target for flow in problem.pipeline.outputs(role.task))
                self._known[role.who] = role.node, _stages(problem, outputs)
                self._workers[f"{role.task}@{role.node}"].append(role.who)
        self._of: dict[Key, dict[str, StageCounts]] = {}
        # Last change of a worker's outputs in a block.
        self._sent_ns: dict[tuple[Key, str], int] = {}

    def take(self, load: Load, newest: Key, at_ns: int) -> None:
        """Add the sums of a node's workers, except for blocks far from the newest cycle."""
        run, latest = newest[0], newest[1] // self._size
        for one in load.stages:
            key = one.run, one.block
            near = one.run == run and latest - KEPT_BLOCKS < one.block <= latest + 1
            said = load.node, [output.target for output in one.outputs]
            if not near or self._known.get(one.who) != said:
                continue
            of = self._of.setdefault(key, {})
            if one.who not in of or of[one.who].outputs != one.outputs:
                self._sent_ns[key, one.who] = at_ns
            of[one.who] = one
        for key in [key for key in self._of if key[0] != run or key[1] <= latest - KEPT_BLOCKS]:
            for who in self._of.pop(key):
                del self._sent_ns[key, who]

    def slow(self, placement: Placement, newest: Key) -> Iterator[dict[str, Any]]:
        """Yield the stages of a placement whose median job takes longer than from job to job."""
        for task, node in placement.sites:
            name = f"{task}@{node}"
            one = next(self._recent(name, newest), None)
            if one is not None and one.median_ns > self._rates[task] * self._period_ns:
                inputs = one.jobs + one.replaced + one.dropped
                took = {"stage": name, "exec_ms": one.median_ns / 1e6}
                yield {**took, "replaced": one.replaced, "inputs": inputs}

    def withholds(self, source: str, target: str, newest: Key) -> bool:
        """Whether recent jobs of ``TASK@NODE`` have ended without an output to a task."""
        share = self._jobs_per_message[source.partition("@")[0], target]
        for one in self._recent(source, newest):
            outputs = (end for end in one.outputs if end.target.partition("@")[0] == target)
            # The agent may have read the rows between a job's end and its output.
            if one.jobs > share * (1 + sum(end.sent for end in outputs)):
                return True
        return False

    def _recent(self, name: str, newest: Key) -> Iterator[StageCounts]:
        """Yield the sums of ``TASK@NODE`` in the last blocks with enough jobs, newest first."""
        run, latest = newest[0], newest[1] // self._size
        for block in range(latest + 1, latest - 2, -1):
            of = self._of.get((run, block), {})
            known = (of[who] for who in self._workers[name] if who in of)
            yield from (one for one in known if one.jobs >= LEAST_JOBS)

    def status(
        self, newest: Key, now_ns: int, span_ns: Callable[[int, int], int]
    ) -> dict[str, Any]:
        """Return times and counts of the last block that all agents have reported.

        `span_ns` returns the time between the releases of two cycles, by their numbers.
        """
        lag = math.ceil((REPORT_NS + self._settled_ns) / self._period_ns)
        key = newest[0], (newest[1] - lag) // self._size - 1
        of = self._of.get(key, {})
        first = key[1] * self._size
        seconds = span_ns(first, first + self._size) / 1e9 if of else 1.0
        stages: dict[str, list[StageCounts]] = {}
        for name, workers in self._workers.items():
            if sums := [of[who] for who in workers if who in of]:
                stages[name] = sums
        flows: dict[str, Any] = {}
        for source, sums in stages.items():
            settled = all(now_ns - self._sent_ns[key, one.who] >= self._settled_ns for one in sums)
            for outputs in zip(*(one.outputs for one in sums), strict=True):
                target = outputs[0].target
                ends = [end for one in stages.get(target, ()) for end in one.inputs]
                inputs = [end for end in ends if end.source == source]
                flow = _flow(outputs, inputs, settled=settled)
                if flow["sent"] or flow["bytes_total"]:
                    payload_bytes = sum(one.payload_bytes for one in outputs)
                    flows[f"{source}->{target}"] = {**flow, "bytes_per_s": payload_bytes / seconds}
        return {
            "stages": {name: _stage(sums) for name, sums in stages.items()},
            "flows": flows,
            "counted_cycles": (first, first + self._size - 1) if of else None,
        }


def _stage(sums: Sequence[StageCounts]) -> dict[str, Any]:
    """Return a stage for the status; its times come from the worker with the most jobs."""
    most = max(sums, key=lambda one: one.jobs)
    totals = np.sum([one.totals for one in sums], axis=0).tolist()
    return {
        "exec_median_ms": most.median_ns / 1e6 if most.jobs else None,
        "exec_p95_ms": most.p95_ns / 1e6 if most.jobs else None,
        **{name: sum(getattr(one, name) for one in sums) for name in COUNTS},
        "inputs_total": dict(zip(ENDS, totals, strict=True)),
    }


def _flow(
    outputs: Sequence[OutputCounts], inputs: Sequence[InputCounts], *, settled: bool
) -> dict[str, int]:
    """Return the states of a flow's messages; `settled` counts missing messages as lost."""
    ends = {name: sum(getattr(one, name) for one in inputs) for name in ENDS}
    waiting = sum(one.waiting for one in inputs)
    there = sum(ends.values()) + waiting
    # The receiver may have reported later than the sender.
    sent = max(sum(one.sent for one in outputs), there)
    missing = sent - there
    return {
        "sent": sent,
        **ends,
        "lost": missing if settled else 0,
        "in_flight": waiting if settled else waiting + missing,
        "bytes_total": sum(one.total_bytes for one in outputs),
    }
