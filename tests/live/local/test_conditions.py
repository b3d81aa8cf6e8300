"""Conditions on their way to a link's process, and the delays drawn from them."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from dwell.errors import ProblemError
from dwell.live.local.conditions import Conditions, Draws, delays_ns
from dwell.model import (
    AR1,
    Constant,
    Exponential,
    Gamma,
    LogNormal,
    Normal,
    Process,
    Trace,
    TraceTable,
    Uniform,
)

PROCESSES = [
    Constant(3.0),
    Uniform(1.0, 9.0),
    Normal(25.0, 5.0),
    LogNormal(8.0, 0.4),
    Gamma(8.0, 0.5),
    Exponential(4.0),
    AR1(20.0, 0.2, 0.9),
]


@pytest.mark.parametrize("process", PROCESSES, ids=lambda process: type(process).__name__)
def test_conditions_arrive(process: Process) -> None:
    sent = Conditions(process, (Normal(25.0, 5.0), Constant(4.0)), (0.5, 1.0), loss=0.1)
    assert pickle.loads(pickle.dumps(sent)) == sent


@pytest.mark.parametrize("shares", [(1.0,), (1.0, 1.5), (1.0, math.nan)])
def test_each_added_delay_has_a_share(shares: tuple[float, ...]) -> None:
    with pytest.raises(ProblemError, match="shares"):
        Conditions(add_delays_ms=(Normal(25.0, 5.0), Constant(4.0)), shares=shares)


@pytest.mark.parametrize("process", PROCESSES, ids=lambda process: type(process).__name__)
def test_delays_have_the_mean_of_their_process(process: Process) -> None:
    count = 4_000
    drawn = np.array(list(islice(delays_ns(process, np.random.default_rng(1)), count))) / 1e6
    # Even values with a correlation of 0.9 are worth a twentieth of as many.
    error = float(drawn.std()) / math.sqrt(count / 20)
    assert drawn.mean() == pytest.approx(process.expectation, abs=5 * error + 1e-6)
    assert drawn.min() >= 0


def test_a_process_with_memory_remembers() -> None:
    values = np.array(list(islice(delays_ns(AR1(20.0, 0.2, 0.9), np.random.default_rng(2)), 4_000)))
    assert np.corrcoef(values[:-1], values[1:])[0, 1] > 0.8


def test_a_trace_is_replayed_in_order_and_begins_again() -> None:
    rows = [1.0, 2.0, 3.0, 4.0, 5.0]
    trace = Trace(TraceTable("file", {"ms": np.array(rows)}), "ms")
    arrived = pickle.loads(pickle.dumps(trace))
    drawn = [value / 1e6 for value in islice(delays_ns(arrived, np.random.default_rng(3)), 10)]
    begin = rows.index(drawn[0])
    assert drawn == (rows[begin:] + rows[:begin]) * 2


def test_a_loss_of_more_than_1_is_refused() -> None:
    with pytest.raises(ProblemError, match="loss"):
        Conditions(loss=1.001)


def test_of_a_loss_of_1_every_message_is_lost() -> None:
    draws = Draws((1, 0))
    draws.apply(Conditions(loss=1.0))
    assert all(draws.lose() for _ in range(10_000))


def test_a_stream_goes_on_while_its_share_changes() -> None:
    process = AR1(20.0, 0.2, 0.9)
    plain, changing = Draws((1, 0)), Draws((1, 0))
    for draws in (plain, changing):
        draws.apply(Conditions(add_delays_ms=(Constant(2.0), process), shares=(0.0, 1.0)))
    whole = [plain.delay_ns() for _ in range(9)]
    found = []
    for share in (1.0, 0.0, 0.5):
        changing.apply(replace(changing.conditions, shares=(1.0, share)))
        found += [(changing.delay_ns() - 2_000_000, share) for _ in range(3)]
    expected = [delay * share for delay, (_, share) in zip(whole, found, strict=True)]
    assert [delay for delay, _ in found] == pytest.approx(expected, abs=1)


def test_a_delay_that_64_bits_do_not_hold_is_for_ever() -> None:
    drawn = list(islice(delays_ns(LogNormal(1e9, 100.0), np.random.default_rng(1)), 100_000))
    assert 0 <= min(drawn) < max(drawn) <= 1 << 62
    trace = Trace(TraceTable("far.csv", {"ms": np.array([1e300])}), "ms")
    assert next(delays_ns(trace, np.random.default_rng(1))) == 1 << 62
