"""Clocks that are wrong on purpose."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.local.clocks import ClockFile, wrong_clock

NODES = ("R1", "E")


class Clock:
    def __init__(self) -> None:
        self.now_ns = 1_000_000_000_000

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def true() -> Clock:
    return Clock()


@pytest.fixture
def file(tmp_path: Path, true: Clock) -> ClockFile:
    return ClockFile(tmp_path / "clocks", NODES, true)


def clock_at(node: str, file: ClockFile, true: Clock) -> Clock:
    return wrong_clock(true, file.path, node)  # type: ignore[return-value]


def test_jumps_add_up_and_are_of_one_node(file: ClockFile, true: Clock) -> None:
    robot, edge = clock_at("R1", file, true), clock_at("E", file, true)
    assert (robot(), edge()) == (true(), true())
    file.set("E", jump_ns=500)
    assert file.set("E", jump_ns=-2_000) == -1_500
    assert (robot(), edge()) == (true(), true() - 1_500)


def test_a_drift_goes_on_from_where_the_clock_is(file: ClockFile, true: Clock) -> None:
    robot = clock_at("R1", file, true)
    file.set("R1", jump_ns=1_000, drift_ppb=100_000)
    assert robot() == true() + 1_000
    true.now_ns += 10_000_000_000
    assert robot() == true() + 1_000 + 1_000_000
    before_ns = robot()
    file.set("R1")
    assert robot() == before_ns
    true.now_ns += 10_000_000_000
    assert robot() == before_ns + 10_000_000_000


def test_what_is_no_file_of_clocks(file: ClockFile, true: Clock, tmp_path: Path) -> None:
    with pytest.raises(LiveError, match="no node R7"):
        clock_at("R7", file, true)
    with pytest.raises(LiveError, match="no node R7"):
        file.set("R7")
    with pytest.raises(LiveError, match="cannot be read"):
        wrong_clock(true, tmp_path / "nothing", "R1")
    other = tmp_path / "other"
    other.write_bytes(b"x" * 200)
    with pytest.raises(LiveError, match="no file of clocks"):
        wrong_clock(true, other, "R1")
