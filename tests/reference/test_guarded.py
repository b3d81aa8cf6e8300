"""The guard of the simulator against the second one, on cells that fail often."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

import dwell
from dwell.model import (
    Constant,
    ControllerSettings,
    Disturbance,
    Episodes,
    Execution,
    Exponential,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Process,
    Task,
)
from tests.cells.generated import make_problem
from tests.reference.test_against import (
    EXAMPLES,
    LONGER,
    ONE_IN,
    Case,
    differences,
    examine,
    make_guarded,
    play,
    reference,
)

NODES = ("R", "E", "F")
CANDIDATES = ("LOC", "ONE", "TWO", "ALL")


class _Maker:
    """One cell in the making: three tasks, of which candidates have two wherever they like.

    In steps of a period's tenth many events fall on the same instant.
    """

    def __init__(self, seed: int) -> None:
        self.rng = Random(seed)
        self.seed = seed
        self.stepped = self.rng.random() < 0.6
        self.period_ms = self.rng.choice([10.0, 100 / 3, 500.0, 1000.0])
        self.links = [
            Link(
                source,
                target,
                self.process(self.periods(1, 1)),
                loss=self.rng.choice([0.0, 0.0, 0.0, 0.05, 0.3]),
                retransmit_ms=self.rng.choice([None, None, self.period_ms]),
            )
            for source in NODES
            for target in NODES
            if source != target
        ]

    def periods(self, low: int, high: int) -> float:
        """Return a time between some tenths of a period, ms."""
        rng = self.rng
        steps = rng.randint(low, high) if self.stepped else rng.uniform(low, high)
        return self.period_ms * steps / 10

    def process(self, mean: float) -> Process:
        return Constant(mean) if self.stepped else Exponential(mean)

    def task(self, name: str, nodes: tuple[str, ...]) -> Task:
        longest = self.rng.choice([1, 1, 1, 3, 12])
        on = {node: Execution(self.process(self.periods(1, longest))) for node in nodes}
        return Task(
            name,
            on,
            start_ms=self.rng.choice([0.0, 0.0, self.periods(1, 50)]),
            state_bytes=self.rng.choice([0, 0, 1000]),
        )

    def disturbance(self, number: int) -> Disturbance:
        """Let a node or a link fail: once, or in episodes."""
        rng = self.rng
        once = rng.random() < 0.4
        lengths = [self.periods(low, high) / 1e3 for low, high in ((50, 300), (5, 150))]
        every_s, for_s = (self.process(length) for length in lengths)
        episodes = None if once else Episodes(f"episodes {number}", every_s, for_s)
        at_s = self.periods(0, 600) / 1e3 if once else 0.0
        lasts_s = self.periods(10, 600) / 1e3 if once else self.periods(300, 3000) / 1e3
        if rng.random() < 0.5:
            node = rng.choice(("R", "E", "E", "F", "F"))
            return NodeDisturbance(node, at_s, lasts_s, down=True, episodes=episodes)
        link = rng.choice(self.links)
        down = rng.random() < 0.5
        return LinkDisturbance(
            link.source,
            link.target,
            at_s,
            lasts_s,
            down=down,
            loss=0.0 if down else rng.choice([0.5, 1.0, 1.0]),
            episodes=episodes,
        )

    def storm(self) -> list[Disturbance]:
        """Let all links lose everything for a while, so that one fallback fails after another."""
        at_s, lasts_s = (self.periods(*span) / 1e3 for span in ((0, 600), (100, 500)))
        return [
            LinkDisturbance(link.source, link.target, at_s, lasts_s, loss=1.0)
            for link in self.links
        ]

    def controller(self) -> ControllerSettings:
        rng = self.rng
        return ControllerSettings(
            on=rng.choice(NODES),
            migration=rng.choice(["warm", "warm", "cold"]),
            order_delay_ms=rng.choice([0.0, self.periods(1, 20)]),
            order_lead_cycles=rng.choice([0, 0, 1, 3]),
            close_grace_ms=rng.choice([0.0, 0.0, self.periods(1, 30)]),
            fallbacks=tuple(rng.sample(CANDIDATES, rng.choice([1, 2, 3, 4, 4]))),
            guard_cycles=rng.choice([2, 2, 3, 4]),
            probe_cycles=rng.choice([1, 1, 2, 3, 5]),
        )

    def case(self) -> Case:
        rng = self.rng
        sense = ("R", "E") if rng.random() < 0.2 else ("R",)
        tasks = [self.task("S", sense), self.task("P", NODES), self.task("A", NODES)]
        candidates = {
            name: {task.name: rng.choice(list(task.on)) for task in tasks} for name in CANDIDATES
        }
        disturbances = [self.disturbance(number) for number in range(rng.randint(1, 5))]
        if rng.random() < 0.5:
            disturbances += self.storm()
        problem = make_problem(
            [Node(name, "edge", cores=2, scheduler="fifo") for name in NODES],
            tasks,
            [Flow("S", "P", 1000), Flow("P", "A", 1000)],
            links=self.links,
            candidates=candidates,
            period_ms=self.period_ms,
            deadline_ms=rng.choice([0.5 * self.period_ms, self.period_ms, self.periods(10, 80)]),
            scenario=disturbances,
            window_cycles=rng.choice([1, 2, 3, 8]),
            controller=self.controller(),
        )
        every = rng.randint(1, problem.window_cycles)
        often = replace(problem.controller, decide_cycles=every)
        problem = replace(problem, controller=often)
        windows = rng.randint(40, 160) // problem.window_cycles
        real = dwell.draw(problem, scenario="disturbed", seed=self.seed, windows=windows)
        wishes: list[str] = []
        while len(wishes) < real.cycles // every:
            wishes += [rng.choice(CANDIDATES)] * rng.randint(1, 12)
        names = (problem.initial, *wishes)
        share = rng.choice([0.0, 0.0, 0.1])
        return Case(
            problem,
            real,
            names,
            dict.fromkeys(problem.candidates, share) if share else {},
            guarded=True,
            fickle=rng.random() < 0.5,
        )


@pytest.fixture(params=["few", "the others"])
def seeds(request: pytest.FixtureRequest) -> range:
    """Seeds of the cells that are tried."""
    few = -(-LONGER // ONE_IN)
    return range(few) if request.param == "few" else range(few, EXAMPLES)


def test_the_guard_of_failing_cells_equal_to_the_nanosecond(seeds: range) -> None:
    found = {seed: examine(_Maker(seed).case(), 0) for seed in seeds}
    failures = [f"seed {seed}: {differing[:3]}" for seed, differing in found.items() if differing]
    assert not failures, f"{len(failures)} of {len(seeds)} differ:\n" + "\n".join(failures[:10])


def test_a_cycle_that_completes_after_many_others_is_the_newest() -> None:
    # An overloaded cell: cycles complete more than ten seconds after their release.
    case = make_guarded(0, ("fifo", "priority"), orders=True)
    pipeline, controller = case.problem.pipeline, case.problem.controller
    tasks = {**pipeline.tasks, "T0": replace(pipeline.tasks["T0"], offset_ms=430.0)}
    problem = replace(
        case.problem,
        pipeline=replace(pipeline, tasks=tasks),
        controller=replace(controller, decide_cycles=1),
    )
    real = dwell.draw(problem, scenario="disturbed", seed=0, windows=case.real.windows)
    case = replace(case, problem=problem, real=real)
    assert list(differences(case, play(case), reference(case), 0)) == []
