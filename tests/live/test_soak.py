"""The soak's judgement: a leak is found, noise is none, and what is not shown is not passed."""

from __future__ import annotations

import random

import pytest

from tests.live.soak import BOUNDS, CONTROLLER_MB, Rows, slope_of, table


def rows_of(an_hour_mb: float, *, minutes: float, who: str = "planning@E", seed: int = 1) -> Rows:
    """Memory that grows, with steps of the allocator on it; a file more now and then."""
    draw, found = random.Random(seed), []
    for turn in range(round(minutes * 6)):
        at_s = 10.0 * turn
        rss_mb = 100 + an_hour_mb * at_s / 3_600 + draw.choice([0.0, 0.25])
        found.append((at_s, {"rss_mb": rss_mb, "fds": 20.0 + draw.choice([0, 1]), "threads": 9.0}))
    return {who: found}


def wrong(rows: Rows, minutes: float) -> list[str]:
    lines, well = table(rows, minutes)
    found = [line for line in lines[2:] if not line.endswith("|  |")]
    assert well == (not found)
    return found


@pytest.mark.parametrize("minutes", [10, 60])
def test_a_leak_is_found(minutes: int) -> None:
    (line,) = wrong(rows_of(BOUNDS["rss_mb"] + 6, minutes=minutes), minutes)
    assert line.startswith("| planning@E | rss_mb |")
    assert line.endswith("| grows |")


def test_what_is_steady_passes() -> None:
    assert wrong(rows_of(0.0, minutes=60), 60) == []
    assert wrong(rows_of(BOUNDS["rss_mb"] / 2, minutes=60), 60) == []
    assert wrong(rows_of(CONTROLLER_MB / 2, minutes=60, who="controller@E"), 60) == []


def test_files_that_leak_are_found_and_a_step_is_none() -> None:
    rows = rows_of(0.0, minutes=60)
    (seen,) = rows.values()
    for at_s, found in seen:
        found["fds"] += at_s > 2_000
    assert wrong(rows, 60) == []
    for at_s, found in seen:
        found["fds"] += at_s // 900
    (line,) = wrong(rows, 60)
    assert line.startswith("| planning@E | fds |")


def test_what_an_hour_does_not_show_is_not_passed() -> None:
    rows = rows_of(BOUNDS["rss_mb"] - 0.01, minutes=60)
    (line,) = wrong(rows, 60)
    assert line.endswith("| may grow |")
    assert wrong(rows, 10) == []


def test_intervals_hold_the_slope() -> None:
    held = 0
    for seed in range(200):
        (seen,) = rows_of(3.0, minutes=30, seed=seed).values()
        slope = slope_of([at_s for at_s, _ in seen], [found["rss_mb"] for _, found in seen])
        held += slope.low <= 3.0 <= slope.high
    assert held >= 180


def test_too_few_looks_make_no_slope() -> None:
    with pytest.raises(ValueError, match="a slope takes 24"):
        slope_of([0.0] * 23, [0.0] * 23)
