"""Phases of a run, from what was done to it, and what each has shown."""

from __future__ import annotations

import itertools
import math

from hypothesis import given
from hypothesis import strategies as st

from dwell.model import (
    Constant,
    Disturbance,
    Episodes,
    Fabric,
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Normal,
    Scenario,
)
from dwell.model.disturbed import Disturbed, disturbed
from dwell.report.phases import CALM, phase_rows, phases
from dwell.report.run_header import RunHeader
from tests.cells.late_cycles import late_run, without_late_cycles
from tests.report.live_runs import PLAYED, TRACKING, live_run

FABRIC = Fabric({"R1": Node("R1", "robot"), "E": Node("E", "edge")}, {})
DELAY = Normal(25.0, 5.0)
SCENARIO: Scenario = (
    NodeDisturbance("R1", stress_threads=2, at_s=6.0, for_s=22.0),
    LinkDisturbance("R1", "E", at_s=42.01, for_s=22.0, add_delay_ms=DELAY, loss=0.02),
    LinkDisturbance("E", "R1", at_s=42.04, for_s=22.0, add_delay_ms=DELAY, loss=0.02),
    NodeDisturbance("E", stress_threads=2, at_s=78.0),
)


def test_both_ways_of_a_link_are_one_disturbance() -> None:
    assert [(one.kind, one.what) for one in disturbed(SCENARIO, FABRIC)] == [
        ("robot stress", "R1: 2 busy threads"),
        ("network impairment", "E–R1: +25 ms, loss 2 %"),
        ("edge stress", "E: 2 busy threads"),
    ]


def test_what_is_down_or_has_a_rate_is_told_so() -> None:
    items: list[Disturbance] = [
        NodeDisturbance("E", down=True),
        LinkDisturbance("R1", "E", rate_mbps=5.0),
        LinkDisturbance("R1", "E"),
    ]
    told = {(one.kind, one.what) for one in disturbed(items, FABRIC)}
    assert ("edge outage", "E: down") in told
    assert ("network impairment", "E–R1: 5 Mbit/s") in told


def test_episodes_are_left_out() -> None:
    episodes = Episodes("rare", Constant(5.0), Constant(1.0))
    assert disturbed([NodeDisturbance("E", stress_threads=1, episodes=episodes)], FABRIC) == []


def test_phases_begin_and_end_with_what_is_on() -> None:
    found = phases(disturbed(SCENARIO, FABRIC), 116.0)
    assert [phase.name for phase in found] == [
        CALM, "robot stress", CALM, "network impairment", CALM, "edge stress",
    ]  # fmt: skip
    assert found[-1].end_s == 116.0
    assert found[1].begin_s == 6.0


events = st.lists(
    st.builds(
        lambda begin, length, kind: Disturbed(begin, begin + length, kind, kind),
        st.floats(0, 100),
        st.one_of(st.just(math.inf), st.floats(0.1, 50)),
        st.sampled_from(("robot stress", "edge stress")),
    ),
    max_size=6,
)


@given(events, st.floats(1, 120))
def test_phases_cover_the_run_without_gaps(happened: list[Disturbed], end_s: float) -> None:
    found = phases(happened, end_s)
    assert found[0].begin_s == 0.0
    assert found[-1].end_s == end_s
    for before, after in itertools.pairwise(found):
        assert before.end_s == after.begin_s
        assert before.name != after.name


def test_a_phase_has_its_moves_shares_losses_and_error() -> None:
    run = live_run(scenario="demo", seed=1, played=PLAYED, tracking=TRACKING)
    calm, stress, after = phase_rows(run, RunHeader.of(run))
    assert (calm.migrations, calm.guard_moves) == (0, 0)
    assert (stress.migrations, stress.guard_moves) == (1, 1)
    assert stress.shares == {"SO": 10 / 11, "LOC": 1 / 11}
    assert calm.rms_mm == 3.0
    assert stress.rms_px == 8.0
    assert (calm.lost, after.lost) == (0, 1)


def test_cycles_after_the_last_window_are_in_no_phase() -> None:
    run = late_run()
    header = RunHeader.of(run)
    (calm,) = phase_rows(run, header)
    assert (calm.cycles, calm.violation_rate) == (20, 1.0)
    assert str(phase_rows(without_late_cycles(run), header)) == str([calm])
