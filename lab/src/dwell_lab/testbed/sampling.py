"""Sampling: reads the counters of the machine and of a testbed ten times a second."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import psutil

from dwell.errors import LiveError
from dwell.live.local.child import Started
from dwell_lab.testbed.forwarder import LATE_MS, Passed
from dwell_lab.testbed.idle import waited_s
from dwell_lab.testbed.link import TunLink
from dwell_lab.testbed.pressure import Rule, Sample
from dwell_lab.testbed.probe import Probe

EVERY_S = 0.1
#: Counts of a link that are summed up over all samples.
TOTALS = ("bursts", "delay_ns", "squares", "held", "vanished")


class Sampler(Started):
    """Context manager that takes samples in a separate thread.

    Parameters
    ----------
    cpus : collection of int
        CPUs that nodes use.
    used_ns : mapping of str to callable
        Functions that return the CPU time of a node so far, by node.
    switches : mapping of str to callable
        Functions that return how often each thread of a node has slept so far, by node.
    links : mapping of str to TunLink
        Links by name. Every sample reads and resets their counters.
    clock : callable
        The run's clock, ns.
    prefix : sequence of str
        Command prefix of the probes.
    """

    def __init__(
        self,
        cpus: Collection[int],
        used_ns: Mapping[str, Callable[[], int]],
        switches: Mapping[str, Callable[[], Mapping[int, int]]],
        links: Mapping[str, TunLink],
        clock: Callable[[], int],
        rule: Rule,
        prefix: Sequence[str] = (),
    ) -> None:
        self.samples: list[Sample] = []
        super().__init__()
        #: The error that ended the sampling, if any.
        self.trouble = ""
        self._totals: defaultdict[tuple[str, str], Passed] = defaultdict(Passed)
        self._switches = dict(switches)
        self._begun: dict[str, tuple[Mapping[int, int], float]] = {}
        #: Wakes per second of all threads of a node; available after `stop`.
        self.wakes_hz: dict[str, float] = {}
        self._cpus, self._used_ns, self._links = sorted(cpus), dict(used_ns), dict(links)
        self._clock = clock
        self._first_late = next((i for i, ms in enumerate(LATE_MS) if ms >= rule.late_ms), 0) + 1
        self._probes = [Probe(cpu, prefix) for cpu in self._cpus]
        self._stopped = threading.Event()

    def _start(self) -> None:
        for probe in self._probes:
            self._stack.enter_context(probe)
        # Counting reads about a hundred files, one per thread; so only at the start and the end.
        for node, read in self._switches.items():
            self._begun[node] = read(), time.monotonic()
        thread = threading.Thread(target=self._run, name="sampler", daemon=True)
        thread.start()
        self._stack.callback(thread.join)

    def stop(self) -> None:
        """Stop sampling, and compute `wakes_hz`."""
        self._stopped.set()
        super().stop()
        for node, (before, begun_s) in self._begun.items():
            after, lasted_s = self._switches[node](), time.monotonic() - begun_s
            self.wakes_hz[node] = round(rate_hz(before, after, lasted_s), 1)

    def _run(self) -> None:
        due_s = time.monotonic()
        try:
            while not self._stopped.wait(max(due_s - time.monotonic(), 0.0)):
                self.samples.append(self._sample())
                due_s = max(due_s + EVERY_S, time.monotonic())
        except (LiveError, OSError) as error:
            # The run continues; windows without samples are excluded.
            self.trouble = str(error)

    def _sample(self) -> Sample:
        idle_s, stolen_s = cpu_times(self._cpus)
        at_ns = self._clock()
        used_s = {node: read() / 1e9 for node, read in self._used_ns.items()}
        probed = {probe.cpu: probe.read() for probe in self._probes}
        passed: dict[str, list[Passed]] = {}
        for name, link in self._links.items():
            ways = link.read()
            passed[name] = list(ways.values())
            for way, counted in ways.items():
                for total in TOTALS:
                    so_far = getattr(self._totals[way], total)
                    setattr(self._totals[way], total, so_far + getattr(counted, total))
        return Sample(
            at_ns=at_ns,
            idle_s=idle_s,
            stolen_s=stolen_s,
            used_s=used_s,
            waited_s=waited_s(),
            probe_ms={cpu: one.max_ms for cpu, one in probed.items()},
            work_ms={cpu: one.work_ms for cpu, one in probed.items() if one.work_ms is not None},
            packets={name: sum(one.packets for one in ways) for name, ways in passed.items()},
            late={
                name: sum(sum(one.late[self._first_late :]) for one in ways)
                for name, ways in passed.items()
            },
            late_ms={
                name: max((one.late_max_ms for one in ways), default=0.0)
                for name, ways in passed.items()
            },
        )

    def links(self) -> dict[str, Any]:
        """Return statistics of the sampled delays by direction, as a JSON document."""
        statistics = {}
        for (source, target), total in self._totals.items():
            delay_ms = {
                "mean": round(total.delay_mean_ms, 4),
                "std": round(total.delay_std_ms, 4),
            }
            statistics[f"{source}->{target}"] = {
                "messages": total.bursts,
                "delay_ms": delay_ms if total.bursts else None,
                "held": total.held,
                "vanished": total.vanished,
            }
        return statistics


def rate_hz(before: Mapping[int, int], after: Mapping[int, int], lasted_s: float) -> float:
    """Return the sum of the rates of counters by thread, per second.

    Only threads in both readings count.
    """
    both = after.keys() & before.keys()
    return sum(after[thread] - before[thread] for thread in both) / max(lasted_s, 1e-9)


def cpu_times(cpus: Collection[int]) -> tuple[dict[int, float], dict[int, float]]:
    """Return the idle and the stolen seconds of CPUs since the machine's start."""
    times = enumerate(psutil.cpu_times(percpu=True))
    known = {cpu: spent for cpu, spent in times if cpu in cpus}
    idle_s = {cpu: spent.idle + spent.iowait for cpu, spent in known.items()}
    return idle_s, {cpu: spent.steal for cpu, spent in known.items()}
