"""Waiting until a machine is idle, on counters that are made up."""

from __future__ import annotations

import pytest

from dwell_lab.testbed.idle import Counters, Idle, Quiet, sample, wait_until_idle

QUIET = Quiet(busy=0.1, waiting=0.2, for_s=2.0, patience_s=9.0)


class Machine:
    """A machine with two CPUs, whose load is told for every stretch."""

    def __init__(self, *loads: tuple[float, float | None]) -> None:
        self.loads = list(loads)
        self.at_s = self.busy = 0.0
        self.waited_s: float | None = 0.0

    def read(self) -> Counters:
        return Counters(self.at_s, self.busy, 200 * self.at_s, self.waited_s)

    def sleep(self, seconds: float) -> None:
        busy, waiting = self.loads.pop(0)
        self.at_s += seconds
        self.busy += 200 * seconds * busy
        if waiting is None or self.waited_s is None:
            self.waited_s = None
        else:
            self.waited_s += seconds * waiting


def wait(*loads: tuple[float, float | None]) -> Idle:
    machine = Machine(*loads)
    return wait_until_idle(QUIET, read=machine.read, sleep=machine.sleep)


def test_an_idle_machine_is_waited_for_once() -> None:
    assert wait((0.05, 0.0)) == Idle(True, 2.0, 0.05, 0.0)


def test_load_and_pressure_are_waited_out() -> None:
    assert wait((0.5, 0.0), (0.05, 0.5), (0.02, 0.1)) == Idle(True, 6.0, 0.02, 0.1)


def test_patience_ends() -> None:
    assert wait(*[(0.9, 0.9)] * 9) == Idle(False, 10.0, 0.9, 0.9)


def test_a_kernel_without_pressure_is_judged_by_its_load() -> None:
    assert wait((0.5, None), (0.05, None)) == Idle(True, 4.0, 0.05, None)


def test_this_machine_has_counters() -> None:
    first, second = sample(), sample()
    assert second.at_s >= first.at_s
    assert second.all >= first.all > first.busy > 0


@pytest.mark.parametrize("busy", [0.1, 0.10001])
def test_the_bound_itself_is_idle(busy: float) -> None:
    assert wait((busy, 0.0), (0.0, 0.0)).waited_s == (2.0 if busy == 0.1 else 4.0)
