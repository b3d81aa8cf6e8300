"""What a fault has cost, beside what was promised."""

from __future__ import annotations

import pytest

from dwell.testbed.chaos.strike import Outcome, beyond


@pytest.mark.parametrize(
    ("lost", "lost_after", "bound", "said"),
    [
        (4, 0, 4, []),
        (5, 0, 4, ["5 consecutive cycles lost by it, not 4"]),
        (
            9,
            6,
            4,
            ["9 consecutive cycles lost by it, not 4", "6 consecutive cycles lost after it, not 4"],
        ),
        (-1, 5, 4, ["5 consecutive cycles lost after it, not 4"]),
        (90, 90, None, []),
    ],
)
def test_more_cycles_than_the_bound_are_said(
    lost: int, lost_after: int, bound: int | None, said: list[str]
) -> None:
    outcome = Outcome("kill all of E", 1, 0.5, lost=lost, lost_after=lost_after, bound=bound)
    assert beyond(outcome) == said
