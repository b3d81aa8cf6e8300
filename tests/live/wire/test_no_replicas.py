"""Live cells refuse replicas."""

from __future__ import annotations

from dataclasses import replace

import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.wire.wiring import wire
from dwell.model import Replicas


def test_live_refuses_replicas_by_name() -> None:
    cell = dwell.load("examples/live/cell.yaml")
    (first, one), (second, other) = list(cell.candidates.items())[:2]
    both = Replicas({first: one, second: other})
    with pytest.raises(LiveError, match=r"candidates.BOTH.replicas.*live has no replicas yet"):
        wire(replace(cell, candidates={**cell.candidates, "BOTH": both}))
