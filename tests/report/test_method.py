"""Scenarios in words."""

from __future__ import annotations

import numpy as np
import pytest

from dwell.model import (
    Constant,
    Disturbance,
    Episodes,
    Exponential,
    LinkDisturbance,
    LogNormal,
    NodeDisturbance,
    Normal,
    Process,
    Trace,
    TraceTable,
    Uniform,
)
from dwell.report.method import describe_scenario

EPISODES = Episodes("edge", every_s=Exponential(30.0), for_s=Uniform(2.0, 10.0))
TABLE = TraceTable(file="delays.csv", columns={"delay_ms": np.array([1.0, 3.0])})


@pytest.mark.parametrize(
    ("scenario", "text"),
    [
        ((), "nothing"),
        ((NodeDisturbance("R1", stress_threads=4),), "4 threads of foreign work on R1"),
        (
            (LinkDisturbance("R1", "E", loss=0.005), LinkDisturbance("E", "R1", loss=0.005)),
            "0.5 % of the messages lost on R1→E and E→R1",
        ),
        (
            (NodeDisturbance("E", at_s=20, for_s=10, down=True),),
            "an outage from 20 s for 10 s on E",
        ),
        (
            (LinkDisturbance("R1", "E", rate_mbps=10.0, at_s=5),),
            "a rate of 10 Mbit/s from 5 s on R1→E",
        ),
        (
            (NodeDisturbance("E", stress_threads=16, episodes=EPISODES),),
            "16 threads of foreign work, in episodes (off 30 s, on 6 s in the mean) on E",
        ),
        (
            (NodeDisturbance("E", at_s=20, for_s=380, ramp_s=190, stress_threads=16),),
            "16 threads of foreign work from 20 s for 380 s, growing for 190 s and falling "
            "likewise on E",
        ),
        (
            (LinkDisturbance("R1", "E", loss=0.02, ramp_s=60),),
            "2.0 % of the messages lost, growing for 60 s on R1→E",
        ),
    ],
)
def test_scenarios(scenario: tuple[Disturbance, ...], text: str) -> None:
    assert describe_scenario(scenario) == text


@pytest.mark.parametrize(
    ("delay", "text"),
    [
        (Constant(2.0), "2 ms"),
        (Normal(25.0, 5.0), "25 ± 5 ms (normal)"),
        (Uniform(1.0, 5.2), "1 to 5.2 ms"),
        (LogNormal(0.7, 0.3), "0.7 ms (lognormal, cv 0.3)"),
        (Trace(TABLE, "delay_ms"), "2 ms (replayed from delays.csv)"),
    ],
)
def test_delays(delay: Process, text: str) -> None:
    scenario = (LinkDisturbance("R1", "E", add_delay_ms=delay),)
    assert describe_scenario(scenario) == f"{text} more delay a message on R1→E"
