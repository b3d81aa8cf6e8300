"""Ages of chains and of cycles in the objective of a live cell."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import polars as pl
import polars.testing
import pytest

from dwell.live.commands.live import status_lines
from dwell.model import Caps, Chain, MissCap, Problem, Targets, Weights
from tests.live.rated_cells import P_MS, SLOW, rated, sampling, world_of
from tests.live.replayed import SYNCHRONOUS, Clocks, messages_of, recorded, replay, simulate
from tests.live.small_world import Alternating, Staying, World, canonical, columns


def aged(problem: Problem, latency: str | None) -> Problem:
    """Let a cell weigh its mean age, and cap its misses; the age of a chain may be its latency."""
    chains = problem.pipeline.chains or {"see": Chain("sensing", "control", 150)}
    targets = Targets(latency_ms=100, age_ms=60.0)
    objective = replace(
        problem.objective,
        weights=Weights(age=1.0),
        targets=targets,
        latency=latency,
        caps=Caps(misses=MissCap(1, 20)),
    )
    return replace(problem, pipeline=replace(problem.pipeline, chains=chains), objective=objective)


@pytest.mark.parametrize(
    ("seed", "every", "latency"), [(0, 20, "see"), (1, 5, "see"), (2, 5, None)]
)
def test_a_simulated_run_with_ages_in_j_is_decided_on_in_the_same_way_live(
    seed: int, every: int, latency: str | None, tmp_path: Path
) -> None:
    settings = {"min_dwell": 0, "min_improvement": 0.0, "order_lead_cycles": 2, "fallbacks": ()}
    initial = Random(seed).choice(["LOC", "SO", "HYB"])
    cell = canonical(
        20, decide_cycles=every, estimator="tests.live.replayed:Dated", initial=initial, **settings
    )
    windows = 15 if every == 20 else 6
    played = simulate(aged(cell, latency), "robot-cpu-stress", windows=windows, seed=seed)
    _, controller, _, _, rows = replay(played, SYNCHRONOUS, messages_of(played, Clocks()))
    live, simulated = recorded(tmp_path, controller, rows), played.run
    count = live.decisions.height
    assert count >= simulated.decisions.height - 1 > 10
    assert {"est_age_ms_LOC", "est_misses_LOC", "seen_age_ms"} <= {*live.decisions.columns}
    names = [name for name in simulated.decisions.columns if name in live.decisions.columns]
    pl.testing.assert_frame_equal(
        live.decisions.select(names), simulated.decisions.select(names)[:count], abs_tol=1e-6
    )
    known = simulated.windows[: live.windows.height]
    names = [name for name in known.columns if not name.startswith("shadow_")]
    pl.testing.assert_frame_equal(live.windows.select(names), known.select(names), abs_tol=1e-6)
    cycles = [name for name in simulated.cycles.columns if name.startswith("chain_")]
    assert len(cycles) == 2 * (latency is not None)
    known = simulated.cycles[: live.cycles.height].select("missed", *cycles)
    assert live.cycles.select("missed", *cycles).equals(known)


def test_the_age_of_a_sampled_picture_takes_the_place_of_the_latency() -> None:
    chains = {"see-act": {"from": "camera", "to": "act", "max_age_ms": 500}}
    problem = aged(sampling(chains=chains), "see-act")
    world = world_of(problem, policy=Staying())
    world.run(1_000)
    names = "seen_l95_ms", "age_l95_see-act", "l95_ms", "seen_age_ms"
    steady = columns(world, "windows", *names)[1:]
    assert len(steady) >= 3
    for seen_ms, l95_ms, latency_ms, age_ms in steady:
        assert seen_ms == l95_ms > 10 * latency_ms / 2 > 0
        # Commands are SLOW to a picture, and the age grows until the next one.
        assert age_ms == pytest.approx(l95_ms - 10 * (SLOW - 1) / 2 + 5, abs=0.5)
    status = world.status["window"]
    assert status["mean_age_ms"] > 0
    assert status["predicted"]["LOC"]["age_ms"] > 0


@pytest.mark.parametrize("every", [SLOW, 2 * SLOW])
def test_the_status_has_ages_and_reaction_times_of_chains(every: int) -> None:
    chains = {"see-act": {"from": "camera", "to": "act", "max_age_ms": 40}}
    problem = sampling(chains=chains)
    controller = replace(problem.controller, decide_cycles=every, min_dwell_cycles=0)
    frequent = replace(problem, window_cycles=2 * SLOW, controller=controller)
    world = world_of(frequent, policy=Staying())
    world.run(1_500)
    names = "age_l95_see-act", "age_missed_see-act", "reaction_l95_see-act"
    steady = {*columns(world, "windows", *names)[2:]}
    assert len(steady) == 1
    assert world.status["window"]["cycles"] == 2 * SLOW
    assert world.status["window"]["ages"] == dict(zip(names, *steady, strict=True))
    (age_ms, *_), *_ = steady
    assert f"L95 of data age: see-act {age_ms:.1f} ms" in status_lines(world.status)


def test_the_headline_names_the_chain_whose_data_are_too_old() -> None:
    chains = {
        "see-act": {"from": "camera", "to": "act", "max_age_ms": 40},
        "feel": {"from": "imu", "to": "act"},
    }
    world = world_of(sampling(chains=chains), policy=Staying())
    world.run(1_500)
    assert world.status["health"] == "degraded"
    assert "see-act's max_age_ms (40)" in world.status["headline"]
    assert "feel" not in world.status["headline"]


def test_a_recorded_age_without_a_picture_counts_from_the_picture_before() -> None:
    chains = {"see-act": {"from": "camera", "to": "act"}}
    problem = aged(sampling(chains=chains), "see-act")
    world = world_of(problem, policy=Staying())
    world.run(400)
    # The first jobs of a restarted worker have no picture.
    world.kill("control@R")
    world.start("control@R")
    world.run(800)
    rows = columns(world, "cycles", "release_ns", "chain_latency_ns", "chain_age_ns")
    known = [row for row in rows if row[1] is not None]
    (first_ns, first_age_ns), *_ = [(at + after, age) for at, after, age in known]
    assert first_age_ns == first_ns
    ages_ms = [age / 1e6 for _, _, age in known]
    # In a cycle the age grows by a period, or there is a newer picture.
    grown = [later - before for before, later in pairwise(ages_ms)]
    newer = -(SLOW - 1) * P_MS
    assert {round(step / P_MS) * P_MS for step in grown} == {P_MS, newer}


def test_a_decision_after_a_move_knows_the_picture_before_it() -> None:
    chains = {"see-act": {"from": "camera", "to": "act", "max_age_ms": 100}}
    world = world_of(sampling(chains=chains), policy=Staying())
    world.network.cut(key=f"{world.keys.root}/value/**")
    world.run(1_000)
    # A window ends every 20 cycles; the first jobs after a move have no picture.
    for placement in ("AWAY", "LOC") * 3:
        world.pin(placement)
        world.run(150)
    assert len(world.stamper.moves) == 6
    rows = columns(world, "decisions", "reason", "seen_violation_rate")
    # The rows of the operator's own moves have seen no window.
    seen = [rate for reason, rate in rows if reason != "pinned"]
    assert {*seen} == {0.0}
    assert len(seen) > 20


def by_window(problem: Problem) -> Problem:
    """Return a cell that decides at the end of each window."""
    controller = replace(problem.controller, decide_cycles=problem.window_cycles)
    return replace(problem, controller=controller)


def test_data_that_are_too_old_count_between_windows() -> None:
    chains = {"see-act": {"from": "camera", "to": "act", "max_age_ms": 50}}
    world = world_of(by_window(sampling(chains=chains)), policy=Staying())
    world.run(795)
    world.pin("AWAY")
    world.run(800)
    rows = columns(world, "cycles", "number", "lead", "missed")[SLOW:]
    lead = [missed for number, lead, missed in rows if lead and not number % SLOW]
    assert lead == [True] * len(lead)
    assert len(lead) >= 2


def test_a_reaction_that_ends_before_a_window_does_not_count_in_it() -> None:
    chains = {"fuse": {"from": "lidar", "to": "arm"}}
    problem = by_window(rated(idle=True, chains=chains))
    # Some commands take effect after the end of their window.
    exec_ms = dict.fromkeys(problem.pipeline.tasks, 1.0) | {"fuse": 18.0}
    world = World(problem, exec_ms=exec_ms, policy=Alternating("LOC", "EDGE"))
    world.run(3_000)
    names = "lead", "reaction_l95_fuse"
    windows = columns(world, "windows", *names)
    # No command falls in the single cycle between two windows.
    assert sum(lead == 1 for lead, _ in windows) > 5
    assert max(after_ms for _, after_ms in windows) < 1.5 * SLOW * P_MS


def test_the_mean_age_of_a_chain_counts_commands_of_cycles_that_waited_for_long() -> None:
    # A command every 15 ms in cycles of 10 ms: cycles wait, and take ever newer pictures.
    on = {node: {"exec_ms": 1} for node in ("R", "E")}
    changes = {
        "deadline_ms": 640,
        "tasks": {"camera": {"on": {"R": {"exec_ms": 1}}}, "act": {"every": 1, "on": on}},
        "flows": [{"from": "camera", "to": "act", "sampled": True}],
        "chains": {"see-act": {"from": "camera", "to": "act", "max_age_ms": 20}},
        "candidates": {"LOC": {"act": "R"}, "EDGE": {"act": "E"}},
        "controller": {"on": "E", "initial": "LOC"},
    }
    problem = aged(rated(**changes), "see-act")
    world = World(problem, exec_ms={"camera": 1.0, "act": 15.0}, policy=Staying())
    world.run(1_500)
    *_, (l95_ms, age_ms) = columns(world, "windows", "l95_ms", "seen_age_ms")[:6]
    assert l95_ms > 400
    assert age_ms == pytest.approx(30.4, abs=0.2)
