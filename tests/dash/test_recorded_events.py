"""Times with disturbances on a time line."""

from __future__ import annotations

import math

from dwell.dash.recorded_events import Band, bands_of, disturbed_at, merged
from dwell.model import LinkDisturbance, NodeDisturbance


def test_bands_end_with_the_run_and_have_the_place_and_the_text() -> None:
    scenario = (
        NodeDisturbance(node="E", at_s=1.0, for_s=math.inf, stress_threads=2),
        LinkDisturbance(source="R", target="E", at_s=2.0, for_s=1.0, down=True),
        NodeDisturbance(node="R", at_s=20.0, stress_threads=1),
    )
    assert bands_of(scenario, lambda at_s: 10 * at_s, 9.0) == [
        Band(10.0, 90.0, "E", "2 busy threads"),
        Band(20.0, 30.0, "R->E", "down"),
    ]


def test_overlapping_times_are_one_and_separate_times_stay() -> None:
    bands = [Band(0.0, 2.0, "E", ""), Band(1.0, 1.5, "R", ""), Band(3.0, 4.0, "E", "")]
    assert merged(bands) == [(0.0, 2.0), (3.0, 4.0)]
    assert merged([]) == []


def test_all_disturbances_of_a_place_are_named() -> None:
    bands = [Band(0.0, 2.0, "R->E", "+5 ms"), Band(1.0, 3.0, "R->E", "loss 2 %")]
    assert disturbed_at(bands, 1.5) == {"R->E": "+5 ms, loss 2 %"}
    assert disturbed_at(bands, 2.0) == {"R->E": "loss 2 %"}
    assert disturbed_at(bands, 3.0) == {}
