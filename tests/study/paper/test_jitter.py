"""Jitter of the links as an axis."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from dwell.model import Uniform
from dwell.study import Interval
from dwell.study.family import Comparative
from dwell.study.paper import Chapter, Runner
from dwell.study.paper.jitter import (
    BASE_MS,
    CLASSES,
    ENVELOPES_MS,
    FEW_MS,
    PERIODS_MS,
    Turn,
    chapter,
    enveloped,
    timed,
    turning_point,
    verdict,
)
from tests.study.paper.small_cell import SCALE, make_cell

INF = math.inf
WITHIN, NEVER, ALWAYS = Interval(4.0, 3.0, 5.0), Interval(0.0, 0.0, 0.0), Interval(INF, INF, INF)
OPEN, FEW = Interval(8.0, 4.0, INF), Interval(4.0, math.nan, math.nan)


@pytest.mark.parametrize(
    ("excess", "expected"),
    [
        ([-1.0, -1.0, 1.0], math.sqrt(10 * 100)),
        ([-1.0, -3.0, 1.0], 10 * 10**0.75),
        ([-1.0, 1.0, 1.0], math.sqrt(10)),
        ([-1.0, 0.0, 1.0], 10.0),
        # It turns where the excess stays.
        ([1.0, -1.0, 1.0], math.sqrt(10 * 100)),
        ([0.0, 0.0, 1.0], 0.0),
        ([-1.0, 1.0, -1.0], INF),
    ],
)
def test_turning_point(excess: list[float], expected: float) -> None:
    assert turning_point([1.0, 10.0, 100.0], np.array(excess)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (WITHIN, WITHIN, "yes"),
        (WITHIN, ALWAYS, "in part"),
        (WITHIN, OPEN, "in part"),
        (NEVER, ALWAYS, "no"),
        (NEVER, OPEN, "not shown"),
        (FEW, FEW, "not shown"),
    ],
)
def test_the_answer_follows_from_where_it_turns(
    first: Interval, second: Interval, expected: str
) -> None:
    turns = [
        Turn(scenario, at) for scenario, at in (("baseline", first), ("robot-cpu-stress", second))
    ]
    assert verdict(turns, {"cost": {}, "violation_rate": {}}).answer == expected


def test_costs_and_misses_are_told_by_the_envelopes_at_which_they_were_shown() -> None:
    said: Mapping[float, Comparative] = {
        0.1: "higher",
        1.0: "lower",
        2.0: "lower",
        4.0: "no difference shown",
        8.0: "lower",
    }
    shown: Mapping[str, Mapping[str, Mapping[float, Comparative]]]
    shown = {"cost": {"baseline": said}, "violation_rate": {"baseline": {1.0: "higher"}}}
    outcome = verdict([Turn("baseline", WITHIN)], shown)
    assert "in baseline less at 1 to 2 ms and at 8 ms and more at 0.1 ms" in outcome.verdict
    assert outcome.evidence == (
        "The widest envelope at which J of SO is below that of LOC, seed by seed: up to 4.0 [3.0, "
        "5.0] ms in baseline.",
        "V_D of SO against that of LOC in baseline: lower at no envelope, higher at 1 ms.",
    )


@pytest.mark.parametrize(
    ("at", "words"),
    [
        (WITHIN, "up to 4.0 [3.0, 5.0] ms"),
        (NEVER, "at no envelope"),
        (ALWAYS, "up to 32 ms and beyond"),
        (FEW, "up to 4.0 ms"),
        (Interval(INF, 20.0, INF), "up to 20.0 ms at least"),
        (Interval(INF, math.nan, math.nan), "up to 32 ms and beyond"),
        (Interval(0.0, math.nan, math.nan), "at no envelope"),
    ],
)
def test_a_turn_in_words(at: Interval, words: str) -> None:
    assert str(Turn("baseline", at)) == words


def test_an_envelope_is_on_every_link_and_its_mean_is_the_same() -> None:
    problem = make_cell()
    for point, alone in zip(
        enveloped(problem, ENVELOPES_MS),
        enveloped(problem, ENVELOPES_MS, spread=False),
        strict=True,
    ):
        (width,) = point.values.values()
        for link, other in zip(
            point.problem.fabric.links.values(), alone.problem.fabric.links.values(), strict=True
        ):
            assert link.delay_ms == Uniform(BASE_MS, BASE_MS + float(width))
            assert link.bursts is None
            assert other.delay_ms.value == pytest.approx(BASE_MS + float(width) / 2)  # type: ignore[attr-defined]


def test_deadline_and_target_go_with_the_period() -> None:
    for point, period_ms in zip(timed(make_cell()), PERIODS_MS, strict=True):
        assert point.problem.pipeline.deadline_ms == period_ms
        assert point.problem.objective.targets.latency_ms == period_ms


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Chapter:
    folder = tmp_path_factory.mktemp("jitter")
    return chapter(make_cell(), SCALE, Runner(folder, processes=1))


def test_every_value_and_policy_has_a_row(written: Chapter) -> None:
    tables = {table.slug: table.frame for table in written.tables}
    assert tables["jitter"].height == len(FEW_MS) * 5
    assert tables["jitter-classes"].height == len(CLASSES) * 5
    assert tables["jitter-periods"].height == len(PERIODS_MS) * 6
    assert tables["jitter-variation"].height == len(FEW_MS) * 3


def test_a_wide_envelope_is_worse_for_whoever_offloads(written: Chapter) -> None:
    table = next(table.frame for table in written.tables if table.slug == "jitter")
    mine = table.filter(table["policy"] == "SO").sort("envelope_ms")
    assert mine["violation_rate"][-1] > mine["violation_rate"][0]
    assert mine["l95_ms"][-1] > mine["l95_ms"][0] + 10
