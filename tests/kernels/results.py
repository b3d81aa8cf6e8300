"""Prints digests of what the kernel computes: the same by every compiler, on every processor.

``python -m tests.kernels.results``
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from random import Random

import numpy as np
import polars

import dwell
from dwell.kernels import library, servo_loop
from dwell.model import MovingTarget, QoS, Servo
from tests.cells.generated import Scheduler, random_problem, random_stamps

ROOT = Path(__file__).parents[2]
EVERY: tuple[Scheduler, ...] = ("fair", "fifo", "priority", "turns")
#: Random cells. Number 12 would take twice as long as all others together, and reaches no line or
#: branch of the kernel that the others and the kernel's tests do not reach.
CELLS = tuple(case for case in range(40) if case != 12)


class Stamps:
    """A policy that names one candidate after another."""

    def __init__(self, names: list[str]) -> None:
        self.names = names[::-1]

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Return the next name."""
        return self.names.pop()


def servo_loops() -> Iterator[bytes]:
    """Yield holds and integrals of random loops."""
    rng = np.random.default_rng(7)
    for case in range(200):
        n = int(rng.integers(0, 300))
        released = np.arange(n) * 0.03
        actuated = np.sort(released + rng.exponential(0.04, n))
        gain = 30.0 if case % 2 else rng.uniform(1, 60)
        target = MovingTarget(40.0, 2 * np.pi / rng.uniform(1, 9))
        if case % 2:
            servo = Servo("double-integrator", gain, target, damping=8.0)
        else:
            servo = Servo("integrator", gain, target)
        instants = np.minimum(released, actuated), actuated
        status, integrals, states = servo_loop.follow(servo, *instants, 0.5, 0.03 * n)
        yield bytes([status])
        yield states.tobytes()
        yield integrals.tobytes()


def examples() -> Iterator[bytes]:
    """Yield the tables of the examples' scenarios, under policies that stay and that move."""
    for name in ("canonical", "fan-in", "cloud"):
        problem = dwell.load(ROOT / "examples" / f"{name}.yaml")
        for scenario in problem.scenarios:
            for policy, guard in ((problem.initial, False), ("dtp", True), ("cusum", False)):
                run = dwell.simulate(
                    problem, scenario=scenario, policy=policy, guard=guard, seed=3, windows=9
                )
                yield from map(text, (run.cycles, run.windows, run.decisions))


def random_cells() -> Iterator[bytes]:
    """Yield the tables of random cells that move in every window."""
    for case in CELLS:
        rng = Random(case)
        problem = random_problem(rng, schedulers=EVERY, orders=bool(case % 2))
        policy = Stamps(random_stamps(rng, problem, 13))
        run = dwell.simulate(
            problem, scenario="disturbed", policy=policy, seed=case, windows=12, jobs=True
        )
        yield from map(text, (run.cycles, run.windows, run.decisions, run.jobs))


def text(table: polars.DataFrame) -> bytes:
    """Return the values of a table, each to its last digit."""
    return table.write_csv().encode()


def digest(parts: Iterator[bytes]) -> str:
    """Return one digest of all."""
    made = hashlib.sha256()
    for part in parts:
        made.update(part)
    return made.hexdigest()


if __name__ == "__main__":
    print(library.compiler())
    for kind in (servo_loops, examples, random_cells):
        print(kind.__name__, digest(kind()))
