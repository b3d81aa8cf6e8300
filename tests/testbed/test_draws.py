"""What is drawn along one direction of a link."""

from __future__ import annotations

import pytest

from dwell.model import (
    AR1,
    Constant,
)
from dwell.testbed.conditions import to_json
from dwell.testbed.draws import Draws


def test_a_stream_goes_on_while_its_share_changes() -> None:
    process = AR1(20.0, 0.2, 0.9)
    plain, changing = Draws((1, 0)), Draws((1, 0))
    for draws in (plain, changing):
        draws.apply(to_json({"add_delays_ms": (Constant(2.0), process), "shares": (0.0, 1.0)}))
    whole = [plain.delay_ns() for _ in range(9)]
    found = []
    for share in (1.0, 0.0, 0.5):
        changing.apply(to_json({"shares": (1.0, share)}))
        found += [(changing.delay_ns() - 2_000_000, share) for _ in range(3)]
    expected = [delay * share for delay, (_, share) in zip(whole, found, strict=True)]
    assert [delay for delay, _ in found] == pytest.approx(expected, abs=1)
