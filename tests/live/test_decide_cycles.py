"""Decisions of a live cell that come more often than windows close."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import polars as pl
import polars.testing
import pytest

import dwell
from dwell.control.windows import missed_cycles, seen_l95_ms
from dwell.cost import cost, hamming
from dwell.live.roles.health import PATIENCE_NS
from dwell.model import FrozenDict, Problem, QoS
from dwell.model.instants import NEVER_NS
from tests.live.memory_transport import NetworkConditions
from tests.live.replayed import SYNCHRONOUS, Clocks, messages_of, recorded, replay, simulate
from tests.live.small_world import MS, Alternating, Recorded, Staying, World, canonical, columns
from tests.reference.derivation import require_derived

W = 20
DATED = "tests.live.replayed:Dated"
CONTROLLER = "controller@E"


def often(every: int, **settings: object) -> Problem:
    """The canonical cell with windows of 20 cycles and more decisions."""
    given = {"min_dwell": 0, "estimator": "profile", "min_improvement": 0.0, **settings}
    return canonical(W, decide_cycles=every, **given)


# ------------------------------------------------------------------------- as in the simulator


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("deadline_ms", [100 / 3, 150])
def test_a_simulated_run_is_decided_on_in_the_same_way_live(
    deadline_ms: float, seed: int, tmp_path: Path
) -> None:
    draw = Random(seed)
    scenario = draw.choice(["robot-cpu-stress", "network-impairment", "edge-cpu-stress"])
    problem = often(
        draw.randint(1, W - 1),
        estimator=DATED,
        initial=draw.choice(["LOC", "SO", "HYB"]),
        order_lead_cycles=2,
        fallbacks=(),
    )
    problem = replace(problem, pipeline=replace(problem.pipeline, deadline_ms=deadline_ms))
    played = simulate(problem, scenario, windows=20, seed=seed)
    _, controller, _, _, rows = replay(played, SYNCHRONOUS, messages_of(played, Clocks()))
    live, simulated = recorded(tmp_path, controller, rows), played.run
    count = live.decisions.height
    # The last one closes with a release that is not in the record.
    assert count >= simulated.decisions.height - 1 > 15
    columns = [name for name in simulated.decisions.columns if name in live.decisions.columns]
    pl.testing.assert_frame_equal(
        live.decisions.select(columns), simulated.decisions.select(columns)[:count], abs_tol=1e-6
    )
    assert live.windows.height >= simulated.windows.height - 1
    windows = simulated.windows[: live.windows.height]
    columns = [name for name in windows.columns if not name.startswith("shadow_")]
    pl.testing.assert_frame_equal(
        live.windows.select(columns), windows.select(columns), abs_tol=1e-6
    )


# --------------------------------------------------------------------------- what is recorded


def disturbed(problem: Problem, out: Path, seed: int) -> tuple[Path, Recorded]:
    """A cell in memory whose links are slow at random where it is, and its record."""
    draw = Random(seed)
    world = Recorded(problem, out, policy="dtp")
    for _ in range(10):
        world.run(draw.uniform(1_000, 3_000))
        slow = NetworkConditions(delay_ns=draw.randint(20, 90) * MS)
        other = "R2" if world.stamper.placement == "LOC" else "E"
        rules = [world.network.impair(slow, *way) for way in (("R1", other), (other, "R1"))]
        world.run(draw.uniform(500, 2_000))
        for rule in rules:
            world.network.heal(rule)
    return world.finish(), world


@pytest.mark.parametrize("seed", range(4))
def test_every_decision_derives_again_from_the_tables(seed: int, tmp_path: Path) -> None:
    draw = Random(seed)
    every = draw.choice([1, 3, 5, 7, 19, 20])
    dwell_cycles = draw.choice([0, 0, 3, 25])
    problem = often(every, min_dwell_cycles=dwell_cycles, fallbacks=())
    folder, world = disturbed(problem, tmp_path, seed)
    run = dwell.open_run(folder)
    latency, release = (run.cycles[name] for name in ("latency_ns", "release_ns"))
    latency_ns = latency.fill_null(NEVER_NS).to_numpy()
    release_ns = np.append(release.to_numpy(), release[-1] + world.stamper.place.period_ns)
    placed = run.cycles["placement"].cast(str).to_list()
    ends = (run.windows["first_cycle"] + W - 1).to_list()
    assert run.decisions.height > 20
    for row in run.decisions.iter_rows(named=True):
        last, cycles = row["last_cycle"], row["cycles"]
        begin = last
        while begin and placed[begin - 1] == placed[last]:
            begin -= 1
        # The last W cycles under the placement in force, and a multiple of d of them.
        assert row["incumbent"] == placed[last]
        assert (last + 1 - begin) % every == 0
        assert cycles == min(W, last + 1 - begin)
        assert row["window"] == sum(end < last for end in ends)
        looked = slice(last + 1 - cycles, last + 1)
        grace_ns = max(release_ns[last + 1], release_ns[last] + problem.pipeline.deadline_ns)
        age_ns = grace_ns - release_ns[looked]
        l95_ms, _ = seen_l95_ms(latency_ns[looked], age_ns, problem.censor_ms)
        missed = missed_cycles(latency_ns[looked], age_ns, problem.pipeline.deadline_ns)
        assert row[f"est_l95_ms_{row['incumbent']}"] == float(l95_ms)
        assert row[f"est_violation_rate_{row['incumbent']}"] == missed / cycles
        if every < W:
            assert row["seen_l95_ms"] == float(l95_ms)
    require_derived(folder, "dtp")
    # N_min and d are between two moves, which is what bounds the moves in any K windows.
    least = max(dwell_cycles, 0) + every
    moves = [cycle for cycle in range(1, len(placed)) if placed[cycle] != placed[cycle - 1]]
    assert len(moves) > 2
    assert min(later - before for before, later in pairwise(moves)) >= least
    assert max(sum(first <= move < first + 10 * W for move in moves) for first in moves) <= -(
        -10 * W // least
    )


def test_windows_run_on_over_moves_and_pay_for_them(tmp_path: Path) -> None:
    folder, world = disturbed(often(5, fallbacks=()), tmp_path, 7)
    run = dwell.open_run(folder)
    problem, windows = world.problem, run.windows
    assert windows["first_cycle"].to_list() == [W * i for i in range(windows.height)]
    assert windows["lead"].sum() == 0
    assert windows["mixed"].any()
    assert not windows["mixed"].all()
    placed, places = run.cycles["placement"].cast(str).to_list(), problem.candidates
    moved = [0.0, *(hamming(places[b], places[a]) for a, b in pairwise(placed))]
    for row in windows.iter_rows(named=True):
        used = FrozenDict({name: row[f"u_{name}"] for name in problem.fabric.resources})
        qos = QoS(row["seen_l95_ms"], row["seen_violation_rate"], used)
        alone = cost(qos, places["LOC"], places["LOC"], problem.objective)
        first = row["first_cycle"]
        switching = problem.objective.weights.switching * sum(moved[first : first + W])
        assert row["cost"] == pytest.approx(alone + switching, abs=1e-12)
    # What was decided on after the last window is recorded too, as lead.
    assert run.cycles.height == run.decisions["last_cycle"][-1] + 1
    assert run.cycles["lead"].sum() == run.cycles.height - W * windows.height


def test_the_guards_move_and_an_outage_of_the_stamper_begin_a_window(tmp_path: Path) -> None:
    problem = often(5, fallbacks=("LOC",), initial="SO")
    world = Recorded(problem, tmp_path, policy="SO")
    world.run(2_500)
    world.network.freeze("perception@E")
    world.run(2_500)
    world.kill("stamper@R1")
    world.run(700)
    world.start("stamper@R1")
    world.network.thaw("perception@E")
    world.run(4_000)
    run = dwell.open_run(world.finish())
    cycles, windows = run.cycles, run.windows
    placed, numbers = cycles["placement"].cast(str).to_list(), cycles["number"].to_list()
    (fell,) = run.decisions.filter(pl.col("reason") == "guard", pl.col("migrated"))[
        "last_cycle", "window"
    ].rows()
    (down,) = [i for i in range(1, len(numbers)) if numbers[i] > numbers[i - 1] + 1]
    assert placed[fell[0] : fell[0] + 2] == ["SO", "LOC"]
    firsts = windows["first_cycle"].to_list()
    assert firsts[fell[1]] == fell[0] + 1
    assert down in firsts
    assert firsts.index(down) > fell[1]
    # Every other window follows the one before it, also over the way back.
    apart = [first for before, first in pairwise(firsts) if first != before + W]
    assert set(apart) == {fell[0] + 1, down} - {0}
    for row in run.decisions.filter(pl.col("cycles") > 0).iter_rows(named=True):
        looked = range(row["last_cycle"] + 1 - row["cycles"], row["last_cycle"] + 1)
        assert len({(placed[cycle], cycle >= down) for cycle in looked}) == 1


# ------------------------------------------------------------------------------ what is missed


def decided(world: World) -> list[tuple[int, int]]:
    """Last cycles of the decisions, and how many cycles they looked at."""
    return columns(world, "decisions", "last_cycle", "cycles")


def test_a_controller_that_was_killed_makes_up_no_decisions() -> None:
    for seed in range(3):
        draw = Random(seed)
        every = draw.randint(1, 9)
        world = World(often(every, fallbacks=()), policy=Alternating("LOC", "SO", "HYB"))
        world.run(draw.uniform(4_000, 6_000))
        world.kill(CONTROLLER)
        before = len(columns(world, "cycles", "cycle")), len(decided(world))
        world.run(draw.uniform(1_000, 3_000))
        number = world.stamper.cycle
        world.start(CONTROLLER)
        world.run(6_000)
        known = [row for row, *_ in columns(world, "cycles", "cycle")]
        numbers = [number for (number,) in columns(world, "cycles", "number")]
        assert known == list(range(len(known)))
        assert numbers[before[0]] >= number - 1
        later = decided(world)[before[1] :]
        assert len(later) > 3
        # The first one looks at d cycles that this controller has heard of.
        assert later[0] == (before[0] + every - 1, every)
        lasts = [last for last, _ in decided(world)]
        assert all(last >= first + every for first, last in pairwise(lasts))


@pytest.mark.parametrize("every", [1, 3, 5])
def test_a_controller_that_was_frozen_or_deaf_misses_decisions(every: int) -> None:
    for deaf in (False, True):
        world = World(often(every, fallbacks=()), policy=Staying())
        world.run(4_000)
        count, begun = len(decided(world)), world.stamper.cycle
        if deaf:
            cuts = [world.network.cut("*", who) for who in (CONTROLLER, "agent@E")]
        else:
            world.network.freeze(CONTROLLER)
        world.run(1_500)
        ended = world.stamper.cycle
        if deaf:
            for cut in cuts:
                world.network.heal(cut)
        else:
            world.network.thaw(CONTROLLER)
        world.run(3_000)
        during = [last for last, _ in decided(world)[count - W :] if begun < last < ended - 2]
        # One at most looks at what it has heard of late.
        assert len(during) <= 1
        lasts = [last for last, _ in decided(world)]
        assert all((last - lasts[0]) % every == 0 for last in lasts)
        heard = [known for (known,) in columns(world, "cycles", "heard")]
        assert all(2 * sum(heard[last + 1 - every : last + 1]) >= every for last in lasts)
        assert sum(last >= ended for last in lasts) * every > 60


def test_an_order_that_is_refused_leaves_the_decisions_in_step() -> None:
    world = World(often(5, fallbacks=()), policy=Alternating("SO", "LOC"))
    world.run(2_000)
    world.kill("perception@E")
    world.run(9_000)
    rows = columns(world, "decisions", "last_cycle", "migrated", "refused")
    refused = [last for last, _, why in rows if why is not None]
    assert len(refused) >= 2
    # An order is under way until it is given up.
    pending = PATIENCE_NS // world.stamper.place.period_ns
    assert all(later - before > pending for before, later in pairwise(refused))
    moves = [cycle for cycle, _, _ in world.stamper.moves]
    since = [last for last in refused if last > moves[-1]]
    first = world.cycles[0]
    assert all((last + 1 + first - moves[-1]) % 5 == 0 for last in since)


# ------------------------------------------------------------------------------- what is shown


def test_the_status_shows_what_the_last_decision_looked_at() -> None:
    world = World(often(5, fallbacks=()), policy=Staying())
    world.run(3_750)
    window, rows = world.status["window"], decided(world)
    assert window["last_cycle"] > rows[-1][0]
    assert window["cycles"] == W
    assert window["number"] == window["last_cycle"] // W
    assert window["age_ms"] < 6 * world.problem.pipeline.period_ms
    assert (window["decided"], window["reason"]) == ("LOC", "hold")
