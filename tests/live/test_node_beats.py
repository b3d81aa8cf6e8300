"""Beats of a node: its agent sends them for all processes, and a dead agent costs no cycle."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from dwell.model import Problem
from tests.live.memory_transport import MemoryTransport
from tests.live.small_world import MS, World, canonical, on

NODES = ("R1", "E", "R2")


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC", "HYB", "SO"))


def running(problem: Problem, candidate: str, phase: float = 0.0) -> World:
    world = World(on(problem, candidate), policy=candidate)
    world.run((40 + phase) * problem.pipeline.period_ms)
    assert world.stamper.placement == candidate
    return world


def lost(world: World) -> int:
    """Most consecutive cycles that were lost; the last two may be on their way."""
    cycles = [*world.cycles, world.stamper.cycle - 2]
    return max(later - earlier - 1 for earlier, later in pairwise(cycles))


def oldest_ms(world: World, *nodes: str) -> float:
    """Age of the oldest beat of the nodes' workers, as the stamper knows it."""
    detector, now_ns = world.stamper.pulse.detector, world.network.now_ns
    ages = {
        who: age_ns / MS
        for who, beat, age_ns in detector.everybody(now_ns)
        if beat.node in nodes and not who.endswith(".shadow") and "@" in who
        if not who.startswith(("agent", "controller"))
    }
    assert len(ages) > 1
    return max(ages.values())


# ------------------------------------------------------------------------------- what holds


@pytest.mark.parametrize(("how", "phase"), [("kill", 0.6), ("freeze", 0.0)])
@pytest.mark.parametrize("candidate", ["LOC", "SO", "HYB"])
@pytest.mark.parametrize("node", NODES)
def test_an_agent_that_dies_costs_no_cycle(
    problem: Problem, node: str, candidate: str, how: str, phase: float
) -> None:
    period_ms = problem.pipeline.period_ms
    world = running(problem, candidate, phase)
    end = world.kill if how == "kill" else world.network.freeze
    end(f"agent@{node}")
    patience_ms = (problem.controller.guard_cycles - 1) * period_ms
    for _ in range(40):
        world.run(period_ms / 4)
        # The guard would find each fallback whole.
        assert oldest_ms(world, node) <= patience_ms + 1
    assert lost(world) == 0
    if how == "kill":
        world.start(f"agent@{node}")
    else:
        world.network.thaw(f"agent@{node}")
    world.run(20 * period_ms)
    assert (lost(world), world.stamper.moves) == (0, [])


@pytest.mark.parametrize("node", NODES)
def test_without_an_agent_its_node_is_guarded_as_before(problem: Problem, node: str) -> None:
    """A second fault costs what it costs alone."""
    period_ms = problem.pipeline.period_ms
    for worker, candidate in (("perception@E", "SO"), ("planning@R2", "LOC")):
        world = running(problem, candidate)
        world.kill(f"agent@{node}")
        world.run(5 * period_ms)
        world.kill(worker)
        world.run(20 * period_ms)
        assert 0 < lost(world) <= problem.controller.guard_cycles
        assert world.stamper.placement != candidate


#: Most cycles that a cut costs: docs/faults.md.
CUTS = {
    ("R1->E", "SO"): 3,
    ("E->R1", "SO"): 0,
    ("E->R2", "SO"): 3,
    ("R2->E", "SO"): 0,
    ("R1->R2", "LOC"): 3,
    ("R2->R1", "LOC"): 0,
    ("R1->E R2->E", "SO"): 3,
    ("R1->E E->R1", "SO"): 3,
    ("E->R2 R2->E", "SO"): 3,
    ("R1->R2 R2->R1", "LOC"): 3,
}


@pytest.mark.parametrize(("ways", "candidate"), CUTS)
def test_a_cut_costs_few_cycles(problem: Problem, ways: str, candidate: str) -> None:
    period_ms = problem.pipeline.period_ms
    for phase in (0.0, 0.6):
        world = running(problem, candidate, phase)
        rules = [world.network.cut(*way.split("->")) for way in ways.split()]
        world.run(30 * period_ms)
        assert lost(world) <= CUTS[ways, candidate], phase
        for rule in rules:
            world.network.heal(rule)
        world.run(10 * period_ms)
        assert not any(world.stamper.guard.presence.missing(candidate, world.network.now_ns))


def test_a_process_is_heard_within_a_period_and_a_half(problem: Problem) -> None:
    world = running(problem, "SO")
    for _ in range(60):
        world.run(7.3)
        assert oldest_ms(world, *NODES) <= 1.5 * problem.pipeline.period_ms


# ------------------------------------------------------------------------------- few messages


def heard_per_second(
    problem: Problem, monkeypatch: pytest.MonkeyPatch, *, node: str = ""
) -> Counter[str]:
    """Count the deliveries of a cell at rest by kind, without the agent of a node if one is named.

    Copies to the relay count as ``relay``.
    """
    world = running(problem, "LOC")
    if node:
        world.kill(f"agent@{node}")
        world.run(1_000)
    counts: Counter[str] = Counter()
    receivers = MemoryTransport.receivers

    def count(self: MemoryTransport, key: str) -> object:
        counts[world.keys.word(key)] += 1
        return receivers(self, key)

    monkeypatch.setattr(MemoryTransport, "receivers", count)
    world.network.rewire()
    world.run(100)
    counts.clear()
    world.run(1_000)
    monkeypatch.undo()
    return counts


def test_at_rest_beats_take_few_messages(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = heard_per_second(problem, monkeypatch)
    per_second = 1e3 / problem.pipeline.period_ms
    # The agents' beats to the stamper and between nodes; the controller's, every five periods.
    assert counts["beats"] <= 8 * per_second
    assert counts["beat"] <= per_second
