"""The agent: what it says of its node's accelerator."""

from __future__ import annotations

from dwell.live.host.agent import Gauge
from dwell.live.roles.loads import NodeLoad
from dwell.live.wire.messages import Load
from tests.waiting import wait_until


def test_a_gauge_tells_shares_only() -> None:
    value: list[object] = [0.25]
    gauge = Gauge(lambda: value[0], every_s=0.001)  # type: ignore[arg-type,return-value]
    wait_until(lambda: gauge.value() == 0.25)
    for wrong, words in (
        (37, "ValueError: 37 is no share from 0 to 1"),
        (float("nan"), "ValueError: nan is no share"),
        (None, "TypeError: "),
    ):
        value[0] = wrong
        wait_until(lambda words=words: words in gauge.trouble())  # type: ignore[misc]
        assert gauge.value() == -1.0
    value[0] = 1
    wait_until(lambda: gauge.value() == 1.0)
    assert gauge.trouble() == ""


def test_an_accelerator_counts_as_long_as_it_was_busy() -> None:
    load = NodeLoad()
    for at_ns, busy in ((0, -1.0), (100, 0.5), (300, 1.0), (400, -1.0)):
        load.report(Load("E", 1, at_ns, 0, 0, 0, busy))
    assert load.at(400)[3] - load.at(0)[3] == 250
    assert load.at(200)[3] - load.at(0)[3] == 150
    # Of the last 100 the hook said nothing.
    assert load.at(400)[4] - load.at(0)[4] == 300
