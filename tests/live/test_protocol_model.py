"""The protocol's models: nothing goes wrong, every rule is needed, the code does the same."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import partial
from types import ModuleType
from typing import Any

import pytest

from docs.protocol import copies, fallbacks, gate, orders, states
from docs.protocol.checker import Rules, Step, explore, stuck, without
from dwell.control import Guard
from dwell.model import Problem
from tests.live.small_world import World, canonical

MODELS = {
    "copies": copies,
    "fallbacks": fallbacks,
    "gate": gate,
    "orders": orders,
    "states": states,
}
#: The case that shows that a rule is needed, where that is not the first.
SHOWN = {
    **{("gate", rule): 1 for rule in ("run", "boot", "heard", "equal")},
    ("orders", "proof"): 1,
    ("orders", "fresh proof"): 1,
    ("orders", "answer"): 1,
    ("states", "early"): 1,
    ("states", "hello"): 1,
    ("states", "number"): 3,
    ("states", "later"): 4,
    ("states", "asked"): 4,
    ("states", "stamped"): 4,
}
WALKS = 6
STEPS = 24


@pytest.mark.parametrize(
    ("model", "limits"),
    [
        *((copies, limits) for limits in copies.CASES),
        *((fallbacks, limits) for limits in fallbacks.CASES),
        *((gate, limits) for limits in gate.CASES),
        *((orders, limits) for limits in orders.CASES),
        *((states, limits) for limits in states.CASES),
    ],
    ids=[
        *(f"copies {i}" for i, _ in enumerate(copies.CASES)),
        *(f"fallbacks {i}" for i, _ in enumerate(fallbacks.CASES)),
        *(f"gate {i}" for i, _ in enumerate(gate.CASES)),
        *(f"orders {i}" for i, _ in enumerate(orders.CASES)),
        *(f"states {i}" for i, _ in enumerate(states.CASES)),
    ],
)
def test_nothing_goes_wrong_and_there_is_always_a_way_back(model: ModuleType, limits: Any) -> None:
    successors: Callable[[Any], Iterator[Step[Any]]] = partial(model.successors, limits=limits)
    found = explore(model.initial(), successors)
    assert len(found.numbers) > 1_000
    assert stuck(found, model.good) == []


@pytest.mark.parametrize(
    ("name", "rule"), [(name, rule) for name, model in MODELS.items() for rule in model.RULES]
)
def test_every_rule_is_needed(name: str, rule: str) -> None:
    model = MODELS[name]
    limits = getattr(model, "CASES", (model.LIMITS,))
    # It keeps two controllers from pulling the cell to and fro; terms alone keep it safe.
    needless = rule == "charge"
    looked_at = limits if needless else [limits[SHOWN.get((name, rule), 0)]]
    cases = [partial(model.successors, limits=one) for one in looked_at]
    assert (without(rule, model.initial(), cases, model.good) is None) == needless


# --------------------------------------------------------------------------- model and code


@pytest.fixture(scope="module")
def problem() -> Problem:
    fallbacks = orders.FALLBACK, orders.OTHER
    return canonical(fallbacks=fallbacks, initial=orders.WANTED)


#: What to kill so that the guard leaves a placement for the first of its other fallbacks.
ENDS = {orders.WANTED: "planning@E", orders.FALLBACK: "perception@R1", orders.OTHER: "perception@E"}


class Mirror:
    """Does to a real cell what happens in the model."""

    def __init__(self, problem: Problem) -> None:
        self.world = World(problem)
        self.period_ms = problem.pipeline.period_ms
        self.guard_cycles = problem.controller.guard_cycles
        self.world.run(30 * self.period_ms)
        self._probing = True

    def _probes(self, on: bool) -> None:
        """Have probes come through, or not: they do by themselves once somebody wants to leave."""
        if on != self._probing:
            (self.world.start if on else self.world.kill)("planning@E.shadow")
        self._probing = on

    def follow(self, label: str) -> None:
        """Have happen what a step of the model is called after."""
        words = label.split()
        world = self.world
        if label == "the guard moves the cell":
            self._probes(False)
            while world.stamper.guard.resting:
                world.run(self.period_ms)
            worker = ENDS[world.stamper.placement]
            world.kill(worker)
            world.run((self.guard_cycles + 3) * self.period_ms)
            world.start(worker)
        elif label == "the stamper starts again":
            self._probes(False)
            world.kill("stamper@R1")
            world.run(self.period_ms)
            world.start("stamper@R1")
        elif label.endswith("is heard of"):
            # Probes go through a placement that somebody has asked for.
            if not self._probing:
                self.order("A", orders.WANTED, int(words[4]))
            self._probes(True)
            world.run((world.stamper.guard.probation.needed + 10) * self.period_ms)
        elif label.endswith("arrives"):
            self.order(words[3], words[-2], int(words[6]))
        world.run(30 * self.period_ms)

    def order(self, controller: str, placement: str, term: int) -> None:
        """Send an order, whoever was in charge before."""
        self.world.run(1_100)
        self.world.order(placement, term=term, controller=controller)

    @property
    def now(self) -> orders.Told:
        """What the real stamper says of itself."""
        stamper = self.world.stamper
        return orders.Told(stamper.term, stamper.placement, stamper.guard.on_fallback)


@pytest.mark.parametrize("seed", range(WALKS))
def test_the_stamper_does_what_the_model_does(problem: Problem, seed: int) -> None:
    """A walk through the model that prefers what changes the cell, and the same of a real one."""
    rng = random.Random(seed)
    # Leases run out between orders here: who is in charge is left out.
    rules = Rules(frozenset({"charge"}))
    limits = orders.Limits(fires=3, crashes=2, lapses=0, whims=0)
    mirror, state, followed = Mirror(problem), orders.initial(), []
    assert mirror.now == state.now
    for _ in range(STEPS):
        steps = [
            step
            for step in orders.successors(state, rules, limits)
            if step.state != state or "arrives" in step.label
        ]
        if not steps:
            break
        step = rng.choice(steps)
        mirror.follow(step.label)
        followed.append(step.label)
        state = step.state
        assert mirror.now == state.now, "; ".join(followed)
    assert state.now.term > 1, "a walk on which nothing happened"
    cycles = mirror.world.cycles
    assert cycles == sorted(set(cycles))


class MirroredGuard:
    """Does to a real guard what happens in the model; g = 2, and P = 1."""

    def __init__(self) -> None:
        self.guard = Guard(
            fallbacks.FALLBACKS,
            patience_ns=2,
            probe_cycles=8,
            placement=fallbacks.WANTED,
        )
        self.heard = dict.fromkeys(fallbacks.FALLBACKS, True)
        self.cycle = -1

    def _release(self) -> None:
        self.cycle += 1
        self.guard.released(self.cycle, self.cycle)

    def _look(self) -> bool:
        found = self.guard.check(self.cycle, self.heard)
        if found is not None:
            self.guard.adopt(found, fallback=True)
        return found is not None

    def follow(self, label: str) -> None:
        """Have happen what a step of the model is called after."""
        name = label.split(maxsplit=1)[0]
        if label == "a cycle completes":
            # As many as make a return hold.
            for _ in range(10):
                self._release()
                self.guard.completed(self.cycle, self.cycle)
        elif label.startswith("the guard moves"):
            while not self._look():
                self._release()
        elif label == "the guard rests":
            for _ in range(4):
                self._release()
                assert not self._look()
            assert self.guard.resting
        elif label == "the rest is over":
            while self.guard.resting:
                self._release()
            # It is over when the guard would fire again.
            for _ in range(3):
                self._release()
        elif label.startswith("an order"):
            self.guard.adopt(label.rsplit(maxsplit=1)[-1])
        elif "is heard" in label:
            self.heard[name] = not self.heard[name]


def test_the_guard_does_what_the_model_does() -> None:
    """Random walks through the model, and the same of a real guard."""
    rng, moves = random.Random(1), 0
    limits = fallbacks.Limits(faults=12, orders=4)
    for _ in range(200):
        mirror, state, followed = MirroredGuard(), fallbacks.initial(), list[str]()
        while len(followed) < 60:
            steps = list(fallbacks.successors(state, limits=limits))
            if rng.random() < 0.7:
                steps = [step for step in steps if not step.fault] or steps
            if not steps:
                break
            step = rng.choice(steps)
            mirror.follow(step.label)
            followed.append(step.label)
            state = step.state
            real = mirror.guard.placement, mirror.guard.on_fallback
            assert real == (state.at, state.own), "; ".join(followed)
        moves += sum("the guard moves" in label for label in followed)
    assert moves > 1_000
