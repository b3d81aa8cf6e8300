"""Statistics of samples, and doubts about them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dwell.calibration.profile_file import Measurement
from dwell.model.number_arrays import Floats
from dwell.model.order_statistic import percentile

# Bounds beyond which a measurement is doubtful. Threads of the kernel preempted a busy loop on its
# own core about 4 times per second; on a shared core it was preempted 250 times per second.
STEAL = 0.01
PREEMPTIONS = 5
PREEMPTIONS_PER_S = 25
LOAD_PER_CPU = 0.5
CORES_USED = 0.9
OVERHEAD = 0.01


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of n samples, in ms; `lag1` is None for one sample or for equal samples."""

    n: int
    mean: float
    median: float
    p95: float
    p99: float
    max: float
    cv: float
    lag1: float | None


def describe(samples: Floats) -> Statistics:
    """Return statistics of at least one sample, in order of measurement.

    Percentiles are samples, never interpolated (see `percentile`). `cv` is the standard deviation
    (divisor n) divided by the mean. `lag1` is the correlation of neighbours: the sum of
    (x[i] - m)(x[i+1] - m) divided by the sum of (x[i] - m)^2.
    """
    mean = float(samples.mean())
    centred = samples - mean
    square = float(centred @ centred)
    lag1 = None
    if len(samples) > 1 and np.ptp(samples) > 0:
        lag1 = float(centred[:-1] @ centred[1:]) / square
    return Statistics(
        n=len(samples),
        mean=mean,
        median=percentile(samples, 50),
        p95=percentile(samples, 95),
        p99=percentile(samples, 99),
        max=float(samples.max()),
        cv=(square / len(samples)) ** 0.5 / mean if mean > 0 else 0.0,
        lag1=lag1,
    )


def find_doubts(measurement: Measurement) -> Iterator[str]:
    """Yield doubts about a measurement, each as a sentence without a full stop."""
    about = measurement.about
    yield from _disturbed(about.get("conditions") or {})
    if about.get("kind") == "task":
        yield from _unlike_a_job(measurement)
    if about.get("late"):
        yield (
            f"{about['late']} of {len(measurement.samples)} began late, because the ones before "
            "took longer than the period"
        )


def _disturbed(conditions: Mapping[str, Any]) -> Iterator[str]:
    """Yield doubts for the machine's other work."""
    if not conditions:
        return
    if (conditions["steal"] or 0.0) > STEAL:
        yield f"the hypervisor took {conditions['steal']:.1%} of the time for others (steal)"
    if _preempted(conditions):
        yield (
            f"its threads were taken off their cores {conditions['preemptions']} times in "
            f"{conditions['cpu_s']:.3g} s of CPU time (involuntary context switches): something "
            "else ran there, or it has more threads than it was given cores"
        )
    if conditions["load"] > LOAD_PER_CPU * conditions["cpus"]:
        yield (
            f"the machine was not idle when it began: load {conditions['load']:.2f} "
            f"on {conditions['cpus']} CPUs"
        )


def _preempted(conditions: Mapping[str, Any]) -> bool:
    usual = PREEMPTIONS_PER_S * float(conditions.get("cpu_s", 0))
    return int(conditions.get("preemptions", 0)) >= max(PREEMPTIONS, usual)


def _unlike_a_job(measurement: Measurement) -> Iterator[str]:
    """Yield reasons why the samples may not be execution times as `exec_ms` means them."""
    about = measurement.about
    # A preempted task waited for its core, so low use of cores proves nothing.
    if about["cores_used"] < CORES_USED and not _preempted(about.get("conditions") or {}):
        yield (
            f"it used {about['cores_used']:.2f} cores: the rest of its time it waited (sleep, "
            "input and output, an accelerator, another process), which a cell would take for CPU "
            "work unless it names an `accelerator`"
        )
    median = percentile(measurement.samples, 50)
    if about["empty_wall_ms"] > OVERHEAD * median:
        yield (
            f"timing alone takes {about['empty_wall_ms'] * 1e3:.2f} µs, more than "
            f"{OVERHEAD:.0%} of the median: time several of its runs as one"
        )
