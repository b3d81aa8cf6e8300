"""CoreTimes: how long a window's cycles, and all other work, used CPUs and accelerators."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from dwell.live.roles.cycle_ledger import UNKNOWN, Ledger, LiveCycle, by_site
from dwell.live.roles.loads import NodeLoad
from dwell.model import Problem
from dwell.model.fabric import accelerator_name
from dwell.model.number_arrays import Floats

#: Least share of a window in which a hook must have measured an accelerator.
HOOKED_SHARE = 0.5


class CoreTimes:
    """See the module; `loads` takes the agents' reports, by node."""

    def __init__(self, problem: Problem, ledger: Ledger) -> None:
        self._ledger, self._pipeline = ledger, problem.pipeline
        self._candidates = problem.candidates
        self._nodes, self._resources = problem.fabric.nodes, problem.fabric.resources
        self.loads = {node: NodeLoad() for node in self._nodes}
        self._accelerated = {name: self._accelerators(name) for name in self._candidates}

    def core_ns(self, cycles: Sequence[LiveCycle], close_ns: int) -> Floats:
        """Core-nanoseconds of every resource in a window: all, own, shadows; shape (3, resources).

        A node's own work is the CPU time of its jobs, if jobs report it. Messages and beats of
        their processes do not count as own work, because no candidate's estimate contains them.
        The busy time of accelerators comes from a hook if their node has one kind of accelerator
        and the hook measured it long enough; otherwise from the cell's jobs. Unknown values are
        NaN.
        """
        jobs_ns = self._spent_ns(cycles)
        by_jobs = self._accelerator_ns(cycles) if len(self._resources) > len(self.loads) else {}
        used = np.zeros((3, len(self._resources)))
        hooked: dict[str, float] = {}
        for column, (node, load) in enumerate(self.loads.items()):
            begin_ns, end_ns = self._ledger.span_ns(node, cycles[0], close_ns)
            *counted_ns, busy_ns, told_ns = load.at(end_ns) - load.at(begin_ns)
            used[:, column] = counted_ns
            if jobs_ns:
                used[1, column] = jobs_ns[node]
            kinds = self._nodes[node].accelerators.items()
            if len(kinds) == 1 and told_ns >= HOOKED_SHARE * (end_ns - begin_ns):
                ((kind, count),) = kinds
                busy = count * (close_ns - cycles[0].at_ns) * busy_ns / told_ns
                hooked[accelerator_name(node, kind)] = busy
        for column, name in enumerate(self._resources):
            if column >= len(self.loads):
                own_ns, shadow_ns = by_jobs.get(name, (0.0, 0.0))
                busy_ns = hooked.get(name, own_ns + shadow_ns)
                used[:, column] = busy_ns, own_ns, shadow_ns
        return used

    def forget(self, before: LiveCycle) -> None:
        """Drop load reports that only earlier cycles need."""
        for node, load in self.loads.items():
            load.forget(self._ledger.span_ns(node, before, before.at_ns)[0])

    def _spent_ns(self, cycles: Sequence[LiveCycle]) -> Counter[str]:
        """Return the reported CPU time of the cycles' jobs, by node.

        Tasks on an accelerator are left out: profiles do not count their CPU time as work.
        """
        spent = Counter[str]()
        for cycle in cycles:
            # Several sinks may report one job.
            for hop in by_site(cycle.hops).values():
                execution = self._ledger.execution(hop)
                on_cpu = execution is not None and execution.accelerator is None
                if hop.cpu_ns != UNKNOWN and on_cpu:
                    spent[hop.node] += hop.cpu_ns
        return spent

    def _accelerator_ns(self, cycles: Iterable[LiveCycle]) -> dict[str, tuple[float, float]]:
        """Return the time that jobs of the cycles, and of their shadows, used each accelerator.

        Waiting for the accelerator counts, as the time runs from start to end of the job. The
        first value is NaN for an accelerator of the placement for which no job reported a time.
        """
        own, shadow, placed = Counter[str](), Counter[str](), set[str]()
        for cycle in cycles:
            placed |= self._accelerated[cycle.placement]
            for (is_shadow, *_), hop in self._ledger.known_jobs(cycle).items():
                execution = self._ledger.execution(hop)
                if execution is None or execution.accelerator is None or hop.ended_ns == UNKNOWN:
                    continue
                spent = shadow if is_shadow else own
                spent[execution.resource(hop.node)] += self._ledger.work_ns(hop)
        known: dict[str, float] = {**own, **dict.fromkeys(placed - own.keys(), math.nan)}
        return {name: (known.get(name, 0.0), shadow[name]) for name in {*known, *shadow}}

    def _accelerators(self, candidate: str) -> frozenset[str]:
        """Return the resource names of the accelerators that a candidate's tasks run on."""
        placed = self._candidates[candidate].sites
        executions = ((self._pipeline.tasks[task].on[node], node) for task, node in placed)
        used = (one.resource(node) for one, node in executions if one.accelerator is not None)
        return frozenset(used)
