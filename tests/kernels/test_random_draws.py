"""What a scenario does to nodes and links, as it is drawn and as messages then meet it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from random import Random

import numpy as np
import pytest

import dwell
from dwell.errors import ProblemError
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import LinkSegment, NodeChange, Realisation
from dwell.model import (
    Bursts,
    Constant,
    Disturbance,
    Episodes,
    Execution,
    Exponential,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Problem,
    Task,
    Uniform,
)
from dwell.model.scenario import MAX_LAYERS, RAMP_STEPS
from dwell.sim import draw
from tests.cells.dynamic import dynamic_problem
from tests.cells.generated import MS, make_problem, random_problem

S = 1000 * MS
LINK = Link("R", "E", Constant(1.0), rate_mbps=100.0, loss=0.1)
WIND = Episodes("wind", Exponential(3.0), Uniform(0.5, 2.0))


def cell(*scenario: Disturbance, link: Link = LINK) -> Problem:
    """Return a task on R that sends to one on E, every 100 ms, on a link both ways."""
    return make_problem(
        [Node("R", "robot", 4), Node("E", "edge", 4)],
        [
            Task("send", {"R": Execution(Constant(2.0))}),
            Task("receive", {"E": Execution(Constant(3.0))}),
        ],
        [Flow("send", "receive", 12_500)],
        links=[link, replace(link, source="E", target="R")],
        scenario=scenario,
        window_cycles=10,
    )


def drawn(
    *scenario: Disturbance, seed: int = 1, windows: int = 100, link: Link = LINK
) -> Realisation:
    return draw(cell(*scenario, link=link), scenario="disturbed", seed=seed, windows=windows)


def changes(realisation: Realisation, node: str) -> list[NodeChange]:
    return [change for change in realisation.node_changes if change.node == node]


def segments(realisation: Realisation, link: str = "R->E") -> list[LinkSegment]:
    return [segment for segment in realisation.link_segments if segment.link == link]


def at(realisation: Realisation, at_s: float, link: str = "R->E") -> LinkSegment:
    """Return the state of a link at an instant."""
    return [part for part in segments(realisation, link) if part.at_ns <= round(at_s * S)][-1]


# ---------------------------------------------------------------------------------- episodes


def test_a_node_is_stressed_in_its_episodes_only() -> None:
    stress = NodeDisturbance("R", at_s=20, for_s=50, stress_threads=3, episodes=WIND)
    found = changes(drawn(stress), "R")
    assert [change.threads for change in found] == [3, 0] * (len(found) // 2)
    assert len(found) > 10
    assert found[0].at_ns > 20 * S
    assert found[-1].at_ns <= 70 * S
    assert changes(drawn(stress), "E") == []


def test_what_has_a_name_comes_and_goes_together() -> None:
    """Both directions of a link, another link's other fault, and a node."""
    there = LinkDisturbance("R", "E", loss=0.2, episodes=WIND)
    back = LinkDisturbance("E", "R", down=True, episodes=WIND)
    stress = NodeDisturbance("E", stress_threads=2, episodes=WIND)
    other = NodeDisturbance("R", stress_threads=2, episodes=replace(WIND, name="rain"))
    realisation = drawn(there, back, stress, other)
    instants = [part.at_ns for part in segments(realisation)][1:]
    assert len(instants) > 20
    assert [part.at_ns for part in segments(realisation, "E->R")][1:] == instants
    assert [change.at_ns for change in changes(realisation, "E")] == instants
    assert [part.down for part in segments(realisation, "E->R")][:5] == [
        False,
        True,
        False,
        True,
        False,
    ]
    assert {change.at_ns for change in changes(realisation, "R")}.isdisjoint(instants)


def test_both_ways_is_one_fault() -> None:
    problem = dynamic_problem()
    realisation = draw(problem, scenario="bursts", seed=4, windows=60)

    def rough(link: str) -> list[int]:
        parts = itertools.pairwise(segments(realisation, link))
        return [part.at_ns for before, part in parts if before.loss != part.loss]

    assert len(rough("R1->E")) > 4
    assert rough("E->R1") == rough("E->R2") == rough("R2->E") == rough("R1->E")
    assert rough("R1->R2") == []


def test_episodes_depend_on_their_name_and_the_seed_alone() -> None:
    stress = NodeDisturbance("R", stress_threads=3, episodes=WIND)
    rest: list[Disturbance] = [
        NodeDisturbance("E", stress_threads=1, episodes=replace(WIND, name="rain")),
        LinkDisturbance("R", "E", add_delay_ms=Constant(2.0), ramp_s=10),
        NodeDisturbance("R", at_s=1e6, stress_threads=5),
    ]
    alone = changes(drawn(stress), "R")
    assert changes(drawn(*rest, stress), "R") == alone
    assert changes(drawn(stress, *rest), "R") == alone
    assert changes(drawn(stress, seed=2), "R") != alone
    assert changes(drawn(replace(stress, episodes=replace(WIND, name="rain"))), "R") != alone
    moved = changes(drawn(replace(stress, at_s=5.0)), "R")
    assert [change.at_ns - 5 * S for change in moved][:20] == pytest.approx(
        [change.at_ns for change in alone][:20], abs=1
    )


def test_episodes_leave_other_draws_alone() -> None:
    """Those of the link's own bursts, and of every message."""
    bursts = Bursts(Exponential(200.0), Constant(20.0), add_delay_ms=Exponential(3.0))
    link = replace(LINK, delay_ms=Exponential(4.0), bursts=bursts)
    plain = drawn(link=link)
    stormy = drawn(LinkDisturbance("R", "E", add_delay_ms=Constant(9), episodes=WIND), link=link)
    assert (stormy.delay_ns == plain.delay_ns).all()
    assert (stormy.extra_ns[0] == plain.extra_ns[0]).all()
    assert {part.at_ns for part in segments(plain)} < {part.at_ns for part in segments(stormy)}


# ------------------------------------------------------------------------------------- ramps


def test_threads_along_a_ramp_are_rounded_to_whole_ones() -> None:
    found = changes(drawn(NodeDisturbance("E", 10, 80, stress_threads=4, ramp_s=31)), "E")
    assert [(change.at_ns / S, change.threads) for change in found if change.at_ns < 60 * S] == [
        *((10 + step, round(4 * step / 31)) for step in range(1, 32)),
        (59, 4),
    ]
    levels = {change.at_ns // S: change.threads for change in found}
    assert (levels[13], levels[14], levels[21], levels[22], levels[41]) == (0, 1, 1, 2, 4)
    assert (levels[85], levels[86], levels[89]) == (1, 0, 0)


def test_loss_and_rate_along_a_ramp() -> None:
    item = LinkDisturbance("R", "E", 10, 80, loss=0.31, rate_mbps=20.0, ramp_s=31)
    realisation = drawn(item)
    for at_s, steps in ((5, 0), (10.5, 0), (11, 1), (25.1, 15), (41, 31), (59.1, 30), (89.5, 0)):
        found = at(realisation, at_s)
        share = steps / RAMP_STEPS
        assert found.loss == pytest.approx(1 - 0.9 * (1 - 0.31 * share))
        # What grows evenly is the time that a bit takes.
        assert 1 / found.rate_mbps == pytest.approx((1 - share) / 100 + share / 20)
        assert found.layers == ()
    assert at(realisation, 45).rate_mbps == 20.0
    assert at(realisation, 5).rate_mbps == 100.0


def test_a_rate_along_a_ramp_where_the_link_has_none() -> None:
    realisation = drawn(
        LinkDisturbance("R", "E", rate_mbps=20.0, ramp_s=31), link=replace(LINK, rate_mbps=math.inf)
    )
    assert at(realisation, 0.5).rate_mbps == math.inf
    assert at(realisation, 10.5).rate_mbps == pytest.approx(62.0)
    assert at(realisation, 99).rate_mbps == 20.0


def test_a_rate_above_the_links_own_changes_nothing() -> None:
    realisation = drawn(LinkDisturbance("R", "E", rate_mbps=500.0, ramp_s=31))
    assert {part.rate_mbps for part in segments(realisation)} == {100.0}


def test_layers_of_a_ramp_add_up_to_its_share() -> None:
    delay = LinkDisturbance("R", "E", 10, 80, add_delay_ms=Exponential(7.0), ramp_s=31)
    steady, realisation = drawn(replace(delay, ramp_s=0)), drawn(delay)
    whole = steady.extra_ns[0]
    assert [layer for _, layer in realisation.layers] == [0, 1, 2, 3, 4]
    assert (realisation.extra_ns >= 0).all()
    for at_s, steps in ((10.5, 0), (11, 1), (20, 10), (40.5, 30), (41, 31), (88.5, 1)):
        on = at(realisation, at_s).layers
        extra = realisation.extra_ns[list(on)].sum(axis=0)
        assert np.abs(extra - whole * steps / RAMP_STEPS).max() < len(on) + 1
    assert (realisation.extra_ns.sum(axis=0) == whole).all()


def test_messages_meet_the_strength_at_the_begin_of_their_transmission() -> None:
    """2 ms on R, 1 ms of transmission, 1 ms of delay, 3 ms on E; then 62 ms more, in 31 steps."""
    slow = LinkDisturbance("R", "E", 10, 80, add_delay_ms=Constant(62.0), ramp_s=31)
    run = dwell.simulate(
        cell(slow, link=replace(LINK, loss=0.0)),
        scenario="disturbed",
        policy="LOC",
        seed=1,
        windows=100,
    )
    latency_ns = run.cycles["latency_ns"].to_numpy()
    sent_ns = run.cycles["release_ns"].to_numpy() + 2 * MS
    since_ns = np.minimum(sent_ns - 10 * S, 90 * S - sent_ns - 1)
    steps = np.clip(since_ns // S, 0, 31)
    assert set(steps) == set(range(32))
    np.testing.assert_allclose(latency_ns, 7 * MS + 2 * MS * steps, atol=5)


def test_one_disturbance_twice_counts_twice() -> None:
    item = LinkDisturbance("R", "E", add_delay_ms=Constant(2.0), loss=0.5)
    realisation = drawn(item, item)
    part = at(realisation, 50)
    assert part.layers == (0, 1)
    assert part.loss == pytest.approx(1 - 0.9 * 0.25)


@pytest.mark.parametrize(("ramp_s", "most"), [(0.0, MAX_LAYERS), (1.0, MAX_LAYERS // 5)])
def test_a_link_has_as_many_extra_delays_as_a_number_has_bits(ramp_s: float, most: int) -> None:
    items: Sequence[LinkDisturbance] = [
        LinkDisturbance("R", "E", 0, 2, add_delay_ms=Constant(1.0), ramp_s=ramp_s)
    ] * most
    realisation = drawn(*items, windows=2)
    rows = (realisation.extra_ns[list(part.layers), 0] for part in segments(realisation))
    # A ramp that falls as soon as it has grown stops a step short of its full strength.
    share = 1 - (ramp_s > 0) / RAMP_STEPS
    assert max(row.sum() for row in rows) == pytest.approx(most * MS * share, abs=5 * most)
    with pytest.raises(ProblemError, match="one too many on R->E") as caught:
        drawn(*items, items[0])
    (fault,) = caught.value.faults
    assert fault.path == f"scenarios.disturbed[{most}].add_delay_ms"


# --------------------------------------------------------------------------- the scenarios


@pytest.mark.parametrize("name", ["step", "drift", "bursts", "flapping", "mixture"])
def test_dynamic_scenarios_can_be_drawn_and_differ_by_seed(name: str) -> None:
    problem = dynamic_problem()
    one, again, other = (draw(problem, scenario=name, seed=seed, windows=300) for seed in (1, 1, 2))
    assert (one.node_changes.table == again.node_changes.table).all()  # type: ignore[attr-defined]
    assert (one.link_segments.table == again.link_segments.table).all()  # type: ignore[attr-defined]
    assert not np.array_equal(one.exec_ns, other.exec_ns)


def test_episodes_take_their_share_of_the_time() -> None:
    """Of 60 runs, which begin with a time off: p (1 - tau (1 - exp(-T / tau)) / T)."""
    off_s, on_s, total_s = 15.0, 5.0, 100.0
    episodes = Episodes("fault", Exponential(off_s), Exponential(on_s))
    shares = []
    for seed in range(60):
        realisation = drawn(LinkDisturbance("R", "E", down=True, episodes=episodes), seed=seed)
        parts = segments(realisation)
        ends = [part.at_ns for part in parts[1:]] + [round(total_s * S)]
        pairs = zip(parts, ends, strict=True)
        down = [min(end, total_s * S) - part.at_ns for part, end in pairs if part.down]
        shares.append(sum(down) / S / total_s)
    tau = 1 / (1 / off_s + 1 / on_s)
    expected = on_s / (off_s + on_s) * (1 - tau / total_s * (1 - math.exp(-total_s / tau)))
    error = float(np.std(shares)) / math.sqrt(len(shares))
    assert np.mean(shares) == pytest.approx(expected, abs=4 * error)


@pytest.mark.parametrize("name", ["bursts", "mixture", "step"])
def test_a_drawn_scenario_without_episodes_is_the_same_realisation(name: str) -> None:
    problem = dynamic_problem()
    seed, windows = 3, 120
    episodes = draw(problem, scenario=name, seed=seed, windows=windows)
    plain = Drawing(problem, name, seed=seed, windows=windows).episodes()
    assert all(item.episodes is None for item in plain)
    told = replace(problem, scenarios={**problem.scenarios, "plain": plain})
    again = draw(told, scenario="plain", seed=seed, windows=windows)
    # Delays are drawn by the disturbance's number, which is another one; not when they are on.
    assert (again.node_changes.table == episodes.node_changes.table).all()  # type: ignore[attr-defined]
    down = [[part.at_ns for part in one.link_segments] for one in (episodes, again)]
    assert down[0] == down[1]


# ------------------------------------------------------------------------------ some at a time


@pytest.mark.parametrize("taken", [(1, 1, 298), (7,), (150, 150), (299, 1)])
@pytest.mark.parametrize(
    "problem", [dynamic_problem(), random_problem(Random(17))], ids=lambda problem: problem.name
)
def test_windows_that_are_taken_one_after_another_are_those_of_the_run(
    problem: Problem, taken: tuple[int, ...]
) -> None:
    scenario = list(problem.scenarios)[-1]
    whole = draw(problem, scenario=scenario, seed=5, windows=300)
    drawing = Drawing(problem, scenario, seed=5, windows=300)
    begin = 0
    for windows in taken:
        part = drawing.take(windows)
        end = begin + windows * problem.window_cycles
        assert (part.windows, part.cycles) == (windows, end - begin)
        np.testing.assert_array_equal(part.release_ns, whole.release_ns[begin : end + 1])
        for rows in ("exec_ns", "delay_ns", "extra_ns"):
            np.testing.assert_array_equal(getattr(part, rows), getattr(whole, rows)[:, begin:end])
        for table in ("node_changes", "link_segments"):
            assert list(getattr(part, table)) == list(getattr(whole, table))
        begin = end
    with pytest.raises(ValueError, match="more than are left"):
        drawing.take(301 - sum(taken))
