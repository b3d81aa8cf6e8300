"""Pressure: a fixed rule for whether the machine was the bottleneck of a testbed in a window.

A window counts if the machine granted every node its quota on demand. PSI cannot decide this:
it also counts processes that wait for other processes of their node, or for their own quota, and so
is high whenever a node is stressed. PSI and the speed of the CPUs (``work_ms``) are recorded, but
decide nothing. The criteria, for the CPUs of nodes (`Rule` has the numbers):

``full``
    The CPU was hardly idle during stretches of 0.2 s, together over a tenth of the window. Nodes
    alone cannot fill a CPU, because a part of every CPU is never allotted (see `allotment`).
``stolen``
    The hypervisor gave the CPU to other machines.
``stalled``
    A probe on the CPU, outside all nodes, was later than nodes and their quotas can explain.
``starved``
    A node that was stressed all the time, and thus used all CPU time it could, got less than its
    quota.
``late links``
    Too many packets left their link late.

The rule was fixed before any campaign, and does not depend on the results of a policy.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from statistics import fmean
from typing import Any

from dwell.calibration.machine_conditions import STOLEN_MOST


@dataclass(frozen=True, slots=True)
class Rule:
    """Limits that decide which windows are excluded, and which runs have failed.

    Parameters
    ----------
    idle_least : float
        Idle share of a stretch below which a CPU counts as full.
    stretch_s : float
        Length of a stretch.
    full_most : float
        Largest share of a window in which a CPU may be full.
    stolen_most : float
        Largest share of a window that may be stolen from a CPU.
    stall_ms : float
        Largest lateness of a probe.
    quota_least : float
        Smallest share of its quota that a stressed node must get.
    late_ms, late_most : float
        Lateness from which a packet is late, and largest share of late packets.
    excluded_most : float
        Largest share of excluded windows after the warm-up; a run with more has failed.
    """

    idle_least: float = 0.05
    stretch_s: float = 0.2
    full_most: float = 0.1
    stolen_most: float = STOLEN_MOST
    stall_ms: float = 10.0
    quota_least: float = 0.9
    late_ms: float = 2.0
    late_most: float = 0.01
    excluded_most: float = 0.05


@dataclass(frozen=True, slots=True)
class Sample:
    """Counters of the machine at an instant, and lateness since the previous sample.

    Parameters
    ----------
    at_ns : int
        Instant on the clock of the run.
    idle_s, stolen_s : mapping of int to float
        Idle and stolen time since the machine's start, by CPU.
    used_s : mapping of str to float
        CPU time of each node so far.
    waited_s : float or None
        PSI: time in which some task waited for a CPU; None if the kernel does not report it.
    probe_ms : mapping of int to float
        Largest lateness of each CPU's probe since the previous sample.
    work_ms : mapping of int to float
        Mean CPU time of the probe's fixed work since the previous sample, by CPU.
    packets, late : mapping of str to int
        Numbers of packets, and of late packets, since the previous sample, by link.
    late_ms : mapping of str to float
        Largest lateness of a packet since the previous sample, by link.
    """

    at_ns: int
    idle_s: Mapping[int, float]
    stolen_s: Mapping[int, float]
    used_s: Mapping[str, float] = field(default_factory=dict)
    waited_s: float | None = None
    probe_ms: Mapping[int, float] = field(default_factory=dict)
    work_ms: Mapping[int, float] = field(default_factory=dict)
    packets: Mapping[str, int] = field(default_factory=dict)
    late: Mapping[str, int] = field(default_factory=dict)
    late_ms: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Span:
    """The time span of a window.

    Parameters
    ----------
    begin_ns, end_ns : int
        Instants on the clock of the samples.
    stressed : mapping of str to float
        Capacity in cores of the nodes that were stressed throughout the window.
    """

    number: int
    begin_ns: int
    end_ns: int
    warmup: bool = False
    stressed: Mapping[str, float] = field(default_factory=dict)


def judged(samples: Sequence[Sample], spans: Sequence[Span], rule: Rule) -> dict[str, Any]:
    """Judge the windows of a run, by samples in the order of time.

    Returns
    -------
    dict
        Document for JSON with ``rule``; ``windows``, one row per window with its number,
        ``broken`` (broken parts of the rule) and the measurements; ``excluded``, the numbers of the
        windows after the warm-up that break the rule; their ``share``; ``failed``; ``why``.
    """
    instants = [sample.at_ns for sample in samples]
    rows = [_row(_covering(samples, instants, span), span, rule) for span in spans]
    counted = [row for row, span in zip(rows, spans, strict=True) if not span.warmup]
    excluded = [row["window"] for row in counted if row["broken"]]
    share = len(excluded) / len(counted) if counted else 0.0
    failed = share > rule.excluded_most
    return {
        "rule": asdict(rule),
        "excluded": excluded,
        "share": round(share, 4),
        "failed": failed,
        "why": _why(counted) if excluded else "",
        "windows": rows,
    }


def _why(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return the number of windows that break each part of the rule, most frequent first."""
    counts = Counter(fault for row in rows for fault in row["broken"])
    return ", ".join(f"{fault} in {count}" for fault, count in counts.most_common())


def _row(inside: Sequence[Sample], span: Span, rule: Rule) -> dict[str, Any]:
    """Return the measurements of a window, and the parts of the rule that they break."""
    if len(inside) < 2:
        return {"window": span.number, "broken": ["not measured"]}
    first, last = inside[0], inside[-1]
    lasted_s = (last.at_ns - first.at_ns) / 1e9
    # The lateness in a sample belongs to the time since the previous sample.
    since = inside[1:]
    full = {str(cpu): _full(inside, cpu, rule) for cpu in first.idle_s}
    stolen = {
        str(cpu): (last.stolen_s[cpu] - stolen_s) / lasted_s
        for cpu, stolen_s in first.stolen_s.items()
    }
    probe_ms = {str(cpu): max(one.probe_ms[cpu] for one in since) for cpu in last.probe_ms}
    used = {node: (last.used_s[node] - spent) / lasted_s for node, spent in first.used_s.items()}
    links = {}
    for name in last.packets:
        packets, late = (
            sum(getattr(one, what)[name] for one in since) for what in ("packets", "late")
        )
        worst_ms = max(one.late_ms[name] for one in since)
        links[name] = {"packets": packets, "late": late, "worst_ms": round(worst_ms, 3)}
    broken = [f"CPU {cpu} full" for cpu, share in full.items() if share > rule.full_most]
    broken += [f"CPU {cpu} stolen" for cpu, share in stolen.items() if share > rule.stolen_most]
    broken += [f"CPU {cpu} stalled" for cpu, late_ms in probe_ms.items() if late_ms > rule.stall_ms]
    broken += [
        f"{node} starved"
        for node, capacity in span.stressed.items()
        if node in used and used[node] < rule.quota_least * capacity
    ]
    broken += [
        f"link {name} late"
        for name, it in links.items()
        if it["late"] > rule.late_most * max(it["packets"], 1)
    ]
    waited = None
    if first.waited_s is not None and last.waited_s is not None:
        waited = round((last.waited_s - first.waited_s) / lasted_s, 4)
    return {
        "window": span.number,
        "broken": broken,
        "psi": waited,
        "full": _rounded(full),
        "stolen": _rounded(stolen),
        "probe_ms": _rounded(probe_ms),
        "work_ms": _means([one.work_ms for one in since]),
        "used": _rounded(used),
        "links": links,
    }


def _means(took: Sequence[Mapping[int, float]]) -> dict[str, float]:
    cpus = sorted(set().union(*took))
    return _rounded({str(cpu): fmean(one[cpu] for one in took if cpu in one) for cpu in cpus})


def _rounded(values: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in values.items()}


def _covering(samples: Sequence[Sample], instants: Sequence[int], span: Span) -> Sequence[Sample]:
    """Return the samples of a window, with the last sample before it and the first after it."""
    if not samples or instants[-1] <= span.begin_ns or instants[0] >= span.end_ns:
        return ()
    begin = max(bisect_right(instants, span.begin_ns) - 1, 0)
    return samples[begin : bisect_left(instants, span.end_ns) + 1]


def _full(samples: Sequence[Sample], cpu: int, rule: Rule) -> float:
    """Return the share of time that a CPU was full."""
    stretches: list[Sample] = [samples[0]]
    for one in samples[1:]:
        if one.at_ns - stretches[-1].at_ns >= 0.95e9 * rule.stretch_s:
            stretches.append(one)
    if len(stretches) == 1:
        stretches.append(samples[-1])
    full_ns = 0
    for before, after in pairwise(stretches):
        idle_s = after.idle_s[cpu] - before.idle_s[cpu]
        lasted_ns = after.at_ns - before.at_ns
        if idle_s * 1e9 < rule.idle_least * lasted_ns:
            full_ns += lasted_ns
    return full_ns / (stretches[-1].at_ns - stretches[0].at_ns)
