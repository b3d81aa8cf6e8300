"""A probe that runs."""

from __future__ import annotations

import time

from dwell_lab.testbed.probe import Lateness, Probe
from lab.tests.testbed.machine import CPU
from tests.waiting import PATIENCE_S


def test_a_probe_tells_how_late_it_was_and_what_its_work_took() -> None:
    probe = Probe(CPU)
    probe.start()
    try:
        found: list[Lateness] = []
        until_s = time.monotonic() + PATIENCE_S
        while not any(one.work_ms for one in found):
            assert time.monotonic() < until_s
            time.sleep(0.05)
            found.append(probe.read())
        assert found[-1].max_ms > 0
    finally:
        probe.stop()
