from __future__ import annotations

from dwell_lab.chaos.stalls import StallDetector


def test_the_worst_stall_of_a_time_and_of_the_other_cpus() -> None:
    stalls = StallDetector()
    stalls.stalls += [(0, 5_000_000, 0), (10_000_000, 40_000_000, 1), (50_000_000, 60_000_000, 0)]
    assert stalls.worst_ms(0, 100_000_000) == 30
    assert stalls.worst_ms(0, 100_000_000, but=[1]) == 10
    assert stalls.worst_ms(41_000_000, 49_000_000) == 0
    assert stalls.worst_ms(39_000_000, 49_000_000) == 30
