"""What the machine did meanwhile, as Linux counts it."""

from __future__ import annotations

import os
import time

import pytest

from dwell.calibration import machine_conditions
from dwell.calibration.machine_conditions import MachineCounters, processor


def burn(seconds: float) -> None:
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


def test_work_of_this_process_is_counted() -> None:
    counters = MachineCounters(os.sched_getaffinity(0))
    burn(0.2)
    found = counters.conditions()
    assert found.cpu_s >= 0.2
    assert found.cpus == os.cpu_count()
    assert found.preemptions >= 0
    assert found.steal is None or 0 <= found.steal <= 1
    assert processor()


PROC = {
    "/proc/stat": "cpu  9 9\ncpu0 10 0 10 60 0 0 0 20 0 0\ncpu1 5 0 5 85 0 0 0 5 0 0\n",
    "/proc/cpuinfo": "processor\t: 0\ncpu MHz\t\t: 2100.5\n\nprocessor\t: 1\ncpu MHz\t\t: 800\n",
}


def test_stolen_time_is_that_of_the_cores_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    text = dict(PROC)
    monkeypatch.setattr(machine_conditions, "text_of", lambda path: text.get(path, ""))
    counters = MachineCounters([1])
    later = text["/proc/stat"].replace("cpu1 5 0 5 85 0 0 0 5", "cpu1 6 0 5 86 0 0 0 7")
    text["/proc/stat"] = later
    found = counters.conditions()
    assert found.steal == 0.5
    assert found.frequency_mhz == (800.0, 800.0)
    assert found.governor is None


def test_what_linux_does_not_say_is_not_made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_conditions, "text_of", lambda path: "")
    found = MachineCounters([0]).conditions()
    assert (found.steal, found.governor, found.frequency_mhz) == (None, None, (None, None))
    assert processor() == os.uname().machine
