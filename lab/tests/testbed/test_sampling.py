"""Counters of the machine and of nodes, read again and again."""

from __future__ import annotations

import os
import time
from itertools import pairwise

import pytest

from dwell.errors import LiveError
from dwell_lab.testbed.pressure import Rule
from dwell_lab.testbed.sampling import Sampler, cpu_times, rate_hz
from tests.waiting import wait_until

CPU = min(os.sched_getaffinity(0))


def test_idle_and_stolen_time_are_those_of_the_cpus_asked_for() -> None:
    idle_s, stolen_s = cpu_times([CPU])
    assert idle_s.keys() == stolen_s.keys() == {CPU}
    assert idle_s[CPU] > 0
    later_s, _ = cpu_times([CPU])
    assert later_s[CPU] >= idle_s[CPU]
    assert cpu_times([100_000]) == ({}, {})


def test_samples_are_taken_until_it_is_left() -> None:
    used = iter(range(0, 10**12, 10**7))
    counts = [{1: 10, 2: 5}, {1: 30, 3: 99}]
    used_ns, switches = {"E": lambda: next(used)}, {"E": lambda: counts.pop(0)}
    sampler = Sampler([CPU], used_ns, switches, {}, time.monotonic_ns, Rule())
    with sampler:
        wait_until(lambda: len(sampler.samples) >= 3)
    taken = len(sampler.samples)
    assert not sampler.trouble
    for one, next_ in pairwise(sampler.samples):
        assert next_.at_ns > one.at_ns
        assert next_.used_s["E"] == pytest.approx(one.used_s["E"] + 0.01)
        assert next_.idle_s[CPU] >= one.idle_s[CPU]
    # Threads that are not there at both looks do not count.
    assert sampler.wakes_hz["E"] > 0
    assert counts == []
    assert sampler.links() == {}
    assert len(sampler.samples) == taken


def test_what_cannot_be_read_ends_the_samples_and_not_the_run() -> None:
    def gone() -> int:
        raise LiveError("the group of E is gone")

    with Sampler([CPU], {"E": gone}, {}, {}, time.monotonic_ns, Rule()) as sampler:
        wait_until(lambda: bool(sampler.trouble))
    assert sampler.trouble == "the group of E is gone"
    assert sampler.samples == []


def test_a_rate_is_of_what_is_there_at_both_looks() -> None:
    assert rate_hz({1: 10, 2: 5}, {1: 30, 3: 99}, 4.0) == 5.0
