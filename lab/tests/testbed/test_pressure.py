"""The rule that tells the machine from its nodes' quotas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest

from dwell_lab.testbed.pressure import Rule, Sample, Span, judged

NS = 1_000_000_000
RULE = Rule()


def samples(
    seconds: float,
    *,
    idle: float = 0.4,
    stolen: float = 0.0,
    used: float = 0.4,
    probe_ms: float = 1.0,
    late: int = 0,
) -> list[Sample]:
    """A machine of one CPU that goes on evenly, ten samples a second."""
    return [
        Sample(
            at_ns=round(step * NS / 10),
            idle_s={0: step * idle / 10},
            stolen_s={0: step * stolen / 10},
            used_s={"E": step * used / 10},
            waited_s=step / 10,
            probe_ms={0: probe_ms},
            packets={"R1-E": 50},
            late={"R1-E": late},
            late_ms={"R1-E": 0.1},
        )
        for step in range(round(10 * seconds) + 1)
    ]


def spans(count: int, *, warmup: int = 0, **more: Any) -> list[Span]:
    return [
        Span(number, number * NS, (number + 1) * NS, number < warmup, **more)
        for number in range(count)
    ]


def broken(found: Mapping[str, Any]) -> list[Sequence[str]]:
    return [row["broken"] for row in found["windows"]]


def test_a_machine_with_time_left_is_no_bottleneck() -> None:
    # PSI says that something waits all the time: it waits for its quota.
    found = judged(samples(4), spans(4), RULE)
    assert broken(found) == [[], [], [], []]
    assert not found["failed"]
    assert found["windows"][0]["psi"] == pytest.approx(1.0)
    assert found["windows"][0]["used"] == {"E": pytest.approx(0.4)}


@pytest.mark.parametrize(
    ("what", "fault"),
    [
        ({"idle": 0.01}, "CPU 0 full"),
        ({"stolen": 0.05}, "CPU 0 stolen"),
        ({"probe_ms": 12.0}, "CPU 0 stalled"),
        ({"late": 2}, "link R1-E late"),
    ],
)
def test_each_part_of_the_rule_excludes(what: dict[str, Any], fault: str) -> None:
    found = judged(samples(3, **what), spans(3), RULE)
    assert broken(found) == [[fault]] * 3
    assert found["excluded"] == [0, 1, 2]
    assert found["failed"]
    assert found["why"] == f"{fault} in 3"


def test_a_stressed_node_has_to_get_its_quota() -> None:
    stressed = spans(3, stressed={"E": 0.8})
    assert broken(judged(samples(3, used=0.79), stressed, RULE)) == [[], [], []]
    assert broken(judged(samples(3, used=0.6), stressed, RULE)) == [["E starved"]] * 3
    # One that is not may want less.
    assert broken(judged(samples(3, used=0.6), spans(3), RULE)) == [[], [], []]


def test_a_window_is_judged_by_its_own_time_only() -> None:
    calm = samples(10)
    worst = [
        replace(one, probe_ms={0: 50.0}) if 4.05 * NS < one.at_ns < 4.95 * NS else one
        for one in calm
    ]
    found = judged(worst, spans(10), RULE)
    assert found["excluded"] == [4]


def test_up_to_one_in_twenty_may_be_excluded_and_the_warm_up_does_not_count() -> None:
    def stalled(windows: Sequence[int], count: int, warmup: int) -> dict[str, Any]:
        found = [
            replace(one, probe_ms={0: 50.0}) if one.at_ns / NS - 0.5 in windows else one
            for one in samples(count)
        ]
        return judged(found, spans(count, warmup=warmup), RULE)

    assert not stalled([7], 20, 0)["failed"]
    assert stalled([7], 20, 0)["excluded"] == [7]
    assert stalled([7], 19, 0)["failed"]
    assert stalled([0, 1], 24, 3)["excluded"] == []
    assert stalled([0, 1], 24, 0)["failed"]


def test_what_was_not_measured_is_excluded() -> None:
    found = judged(samples(1.9), spans(4), RULE)
    assert broken(found)[2:] == [["not measured"], ["not measured"]]
    assert judged([], spans(2), RULE)["failed"]
    assert not judged([], [], RULE)["failed"]


def test_how_fast_the_machine_was_is_kept_and_decides_nothing() -> None:
    took = [
        replace(one, work_ms={0: 0.1 + 0.1 * (i % 2)} if i else {})
        for i, one in enumerate(samples(1))
    ]
    found = judged(took, spans(1), RULE)
    assert found["windows"][0]["work_ms"] == {"0": pytest.approx(0.15)}
    assert broken(found) == [[]]
    assert judged(samples(1), spans(1), RULE)["windows"][0]["work_ms"] == {}
