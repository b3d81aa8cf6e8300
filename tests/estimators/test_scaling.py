"""Scaling: an upper bound is an upper bound, in simulated cells with queues and contention."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.errors import ProblemError
from dwell.estimators import Evidence, Scaling
from dwell.model import (
    Constant,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Placement,
    Problem,
    QoS,
    Task,
    Uniform,
)
from dwell.sim import Realisation, draw, simulate_realisation
from tests.cells.generated import make_problem
from tests.cells.rated import with_rates
from tests.estimators.windows import Row, window
from tests.reference.rates import Rates

MS = 1_000_000
PERIOD_MS = 20.0
Ints = NDArray[np.int64]


# ------------------------------------------------------------------- cells with true ratios


@dataclass(frozen=True)
class Case:
    """A cell, one draw of it, and what is known: ratios and bounds that hold in every cycle."""

    problem: Problem
    real: Realisation
    ratios: Mapping[tuple[str, str, str], float]
    bounds_ms: Mapping[str, float]
    names: tuple[str, ...]


class Witness(Scaling):
    """A Scaling that keeps what it said of each window; copies of it are itself.

    `completed` says of the cycles of every window whether all of their jobs had completed.
    """

    def __deepcopy__(self, memo: object) -> Witness:
        return self

    def start(self, problem: Problem) -> None:
        super().start(problem)
        self.first_ns: list[int] = []
        self.completed: list[NDArray[np.bool_]] = []
        self.said: list[dict[str, QoS]] = []

    def learn(self, evidence: Evidence) -> None:
        super().learn(evidence)
        self.first_ns.append(int(evidence.release_ns[0]))
        assert (evidence.placement == evidence.placement[-1]).all()
        self.completed.append(np.all(evidence.cycles.end_ns >= 0, axis=1))

    def estimate(self, **shown: object) -> dict[str, QoS]:
        self.said.append(super().estimate(**shown))  # type: ignore[arg-type]
        return self.said[-1]


class Replay:
    """A policy that decides as it was told."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.initial = names, names[0]

    def start(self, problem: Problem) -> None:
        self.next = iter(self.names)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(self.next)


def make_case(seed: int, *, rates: bool = False) -> Case:
    """Make a cell in which things wait for each other, and a realisation with exact ratios."""
    rng = Random(seed)
    nodes = [
        Node(
            name,
            "edge",
            cores=rng.choice([1, 2, 3]),
            scheduler=rng.choice(["fair", "fifo", "priority"]),
            accelerators={"gpu": 1} if rng.random() < 0.3 else {},
        )
        for name in ("N0", "N1", "N2")[: rng.randint(2, 3)]
    ]
    names = [f"T{i}" for i in range(rng.randint(1, 5))]
    order = rng.sample(names, len(names))
    density = rng.choice([0.3, 0.6, 1.0])
    flows = [
        Flow(a, b, rng.choice([0, 1000, 10_000]))
        for a, b in itertools.combinations(order, 2)
        if rng.random() < density
    ]
    targets = {flow.target for flow in flows}
    tasks = [make_task(name, nodes, name not in targets, rng) for name in names]
    links = [
        Link(
            a.name,
            b.name,
            Uniform(0.1, rng.choice([0.2, 2.0, 15.0])),
            rate_mbps=rng.choice([math.inf, 100.0, 20.0]),
            in_order=rng.random() < 0.5,
        )
        for a, b in itertools.permutations(nodes, 2)
    ]
    scenario = [
        LinkDisturbance(link.source, link.target, add_delay_ms=Uniform(0.0, 5.0))
        for link in links
        if rng.random() < 0.3
    ]
    stressed = [
        NodeDisturbance(node.name, at_s=0.1, for_s=0.5, stress_threads=rng.randint(1, 4))
        for node in nodes
        if rng.random() < 0.3
    ]
    placed = {
        f"C{i}": {task.name: rng.choice(list(task.on)) for task in tasks}
        for i in range(rng.randint(2, 4))
    }
    problem = make_problem(
        nodes,
        tasks,
        flows,
        links=links,
        candidates=placed,
        scenario=[*scenario, *stressed],
        period_ms=PERIOD_MS,
        deadline_ms=rng.choice([5.0, 12.0, 20.0]),
        window_cycles=rng.choice([1, 5, 20, 30]),
    )
    if rates:
        problem = with_rates(problem, rng)
        controller = replace(problem.controller, decide_cycles=problem.window_cycles)
        problem = replace(problem, controller=controller)
    windows = rng.randint(2, 5)
    drawn = draw(problem, scenario="disturbed", seed=seed, windows=windows)
    factors = {site: rng.choice([1, 2, 3, 6]) for site in drawn.sites}
    # Multiples of 6 ns, so that stretching by threads over cores leaves whole numbers.
    demand = {
        name: 6 * np.array([rng.randint(1, MS) for _ in range(drawn.cycles)]) for name in names
    }
    exec_ns = np.array([demand[task] * factors[task, node] for task, node in drawn.sites])
    return Case(
        problem,
        replace(drawn, exec_ns=exec_ns),
        {
            (task, here, there): factors[task, there]
            * stretch(problem, task, there)
            / (factors[task, here] * stretch(problem, task, here))
            for (task, here), (other, there) in itertools.product(drawn.sites, repeat=2)
            if task == other
        },
        {
            link: max(
                (
                    int(delays_ns(drawn, i).max())
                    for i, hop in enumerate(drawn.hops)
                    if hop[2] == link
                ),
                default=0,
            )
            / MS
            for link in problem.fabric.links
        },
        tuple(rng.choice(list(placed)) for _ in range(windows + 1)),
    )


def make_task(name: str, nodes: list[Node], source: bool, rng: Random) -> Task:
    feasible = rng.sample(nodes, rng.randint(1, len(nodes)))
    on = {
        node.name: Execution(
            Constant(1.0),
            threads=rng.choice([1, 1, 2, 3]),
            workers=rng.choice([1, 2]),
            accelerator="gpu" if node.accelerators and rng.random() < 0.5 else None,
        )
        for node in feasible
    }
    offset_ms = rng.choice([0.0, 3.0]) if source else 0.0
    return Task(name, on, depth=rng.choice([0, 0, 1]), offset_ms=offset_ms)


def stretch(problem: Problem, task: str, node_name: str) -> float:
    """Times as long that a job takes where it has more threads than its node has cores."""
    node, execution = problem.fabric.nodes[node_name], problem.pipeline.tasks[task].on[node_name]
    return max(1.0, execution.threads / node.cores) if execution.accelerator is None else 1.0


def delays_ns(real: Realisation, hop: int) -> Ints:
    """Propagation of every message of a hop; extra delays are on all the time here."""
    extra = [real.extra_ns[i] for i, (mine, _) in enumerate(real.layers) if mine == hop]
    total: Ints = sum(extra, start=real.delay_ns[hop])
    return total


def queue_free_ns(case: Case, placement: Placement) -> list[float]:
    """Latency of each cycle if nothing ever waited for anything: recursion, cycle by cycle.

    It is NaN for idle cycles.
    """
    problem, real = case.problem, case.real
    pipeline, sites = problem.pipeline, {site: i for i, site in enumerate(real.sites)}
    hops = {hop: delays_ns(real, i) for i, hop in enumerate(real.hops)}

    def ready(task: str, cycle: int) -> float:
        inputs = [flow for flow in pipeline.flows if flow.target == task and not flow.sampled]
        if not inputs:
            return pipeline.tasks[task].offset_ms * MS
        return max(done(flow.source, cycle) + sent(flow, cycle) for flow in inputs)

    def done(task: str, cycle: int) -> float:
        node = placement.first[task]
        ran = real.exec_ns[sites[task, node], cycle] * stretch(problem, task, node)
        return ready(task, cycle) + float(ran)

    def sent(flow: Flow, cycle: int) -> float:
        here, there = placement[flow.source], placement[flow.target]
        if here == there:
            return 0.0
        link = problem.fabric.links[f"{here}->{there}"]
        transmission = round(flow.payload_bytes * 8000 / link.rate_mbps)
        return transmission + int(hops[flow.source, flow.target, link.name][cycle])

    sinks = [t for t in pipeline.tasks if not any(flow.source == t for flow in pipeline.flows)]
    rates = Rates(pipeline)
    return [
        max((done(sink, cycle) for sink in sinks if rates.is_due(sink, cycle)), default=math.nan)
        for cycle in range(real.cycles)
    ]


def play(case: Case, ratios: Mapping[tuple[str, str, str], float]) -> Witness:
    """Return what Scaling said at the windows of a run."""
    witness = Witness(case.problem, ratios, case.bounds_ms)
    simulate_realisation(case.problem, case.real, policy=Replay(case.names), estimator=witness)
    return witness


def underestimates(case: Case, witness: Witness) -> list[tuple[int, str, float, float]]:
    """Return window, candidate, bound and truth wherever a bound is below the truth.

    Cycles with a job that waited or was replaced count as 0: its work is not known.
    """
    problem, W = case.problem, case.problem.window_cycles
    found = []
    for name, placement in problem.candidates.items():
        latency = queue_free_ns(case, placement)
        shown = zip(witness.first_ns, witness.completed, witness.said, strict=True)
        for k, (first_ns, completed, said) in enumerate(shown):
            first = int(np.searchsorted(case.real.release_ns, first_ns))
            window = np.array(latency[first : first + W])
            due = ~np.isnan(window)
            cycles = np.sort(np.where(completed, window, 0.0)[due])
            l95_ms = min(cycles[math.ceil(len(cycles) * 95 / 100) - 1] / MS, problem.censor_ms)
            missed = float((cycles > problem.pipeline.deadline_ms * MS).mean())
            # Bounds are in milliseconds, to whole nanoseconds.
            if said[name].l95_ms < l95_ms - 1e-9:
                found.append((k, name, said[name].l95_ms, l95_ms))
            if said[name].violation_rate < missed - 1e-12:
                found.append((k, name, said[name].violation_rate, missed))
    return found


@given(st.integers(0, 10**9))
def test_with_true_ratios_it_never_underestimates(seed: int) -> None:
    """L95 and V_D are no less than those of the window's cycles, each queue-free.

    So of all cycles of the active placement of which every job has completed, and of the others
    nothing is said: of a job that waited or was replaced the work is not known, and counts as the
    longest that is.
    """
    case = make_case(seed)
    witness = play(case, case.ratios)
    assert len(witness.said) == len(witness.first_ns) > 0
    assert underestimates(case, witness) == []


@pytest.mark.parametrize("seed", range(12))
def test_with_several_rates_it_never_underestimates_either(seed: int) -> None:
    case = make_case(seed, rates=True)
    witness = play(case, case.ratios)
    assert len(witness.said) > 0
    assert underestimates(case, witness) == []


@pytest.mark.parametrize("rates", [False, True])
def test_bounds_are_no_trivial_ones(rates: bool) -> None:
    """In half of the windows and more a bound is finite and within twice the truth."""
    close = total = 0
    for seed in range(20):
        case = make_case(seed, rates=rates)
        witness = play(case, case.ratios)
        for name, placement in case.problem.candidates.items():
            longest = float(np.nanmax(queue_free_ns(case, placement))) / MS
            for said in witness.said:
                total += 1
                close += said[name].l95_ms <= 2 * longest
    assert close > total / 2


def test_with_a_false_ratio_it_can_be_wrong() -> None:
    wrong = 0
    for seed in range(20):
        case = make_case(seed)
        false = {key: ratio / 2 for key, ratio in case.ratios.items()}
        wrong += bool(underestimates(case, play(case, false)))
    assert wrong > 5


def test_with_a_false_bound_it_can_be_wrong() -> None:
    wrong = 0
    for seed in range(20):
        case = make_case(seed)
        too_low = replace(case, bounds_ms={link: ms / 2 for link, ms in case.bounds_ms.items()})
        wrong += bool(underestimates(case, play(too_low, case.ratios)))
    assert wrong > 0


# --------------------------------------------------------------------------------- by hand


def chain() -> Problem:
    """A on R, B on R or E; 100 kB up, 1 kB down at 100 Mbit/s."""
    both = {"R": Execution(Constant(8.0)), "E": Execution(Constant(4.0))}
    return make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("A", {"R": Execution(Constant(2.0))}), Task("B", both)],
        [Flow("A", "B", 100_000)],
        links=[Link("R", "E", Constant(1.5), rate_mbps=100.0)],
        candidates={"LOC": {}, "OFF": {"B": "E"}},
        period_ms=40.0,
        window_cycles=4,
    )


def row(begin_ms: float, first: float, second: float) -> Row:
    at = begin_ms + first
    return [begin_ms, at], [at, at + second], [at]


def estimate(scaling: Scaling) -> dict[str, QoS]:
    nothing = dict.fromkeys(scaling.problem.fabric.nodes, 0.0)
    return scaling.estimate(observed=QoS(1.0, 0.0, nothing), incumbent="LOC", own=nothing)


def test_by_hand() -> None:
    scaling = Scaling(chain(), {("B", "R", "E"): 0.75}, {"R->E": 3.0})
    assert estimate(scaling)["OFF"].l95_ms == 2.0 + 8.0 + 1.5 + 4.0
    rows = [row(40.0 * i, 2.0 + i, 8.0) for i in range(4)]
    scaling.learn(window(rows, close_ms=160.0))
    shown = estimate(scaling)
    assert shown["LOC"].l95_ms == 5.0 + 8.0
    assert shown["OFF"].l95_ms == 5.0 + 8.0 + 3.0 + 6.0
    assert shown["OFF"].utilisation == pytest.approx({"R": 3.5 / 40, "E": 6 / 40})


def test_ratios_and_bounds_that_are_not_given_are_as_declared() -> None:
    scaling = Scaling(chain())
    scaling.learn(window([row(40.0 * i, 2.0, 10.0) for i in range(4)], close_ms=160.0))
    assert estimate(scaling)["OFF"].l95_ms == 2.0 + 8.0 + 1.5 + 10.0 * 4 / 8


@pytest.mark.parametrize("given", [True, False])
def test_of_a_job_that_has_not_completed_the_work_counts_as_the_longest_that_is_known(
    given: bool,
) -> None:
    """Not as infinite: else what waits where it runs would wait everywhere."""
    ratios = {("B", "R", "E"): 0.75} if given else {}
    scaling = Scaling(chain(), ratios, {"R->E": 3.0} if given else {})
    rows = [row(40.0 * i, 2.0, 8.0 + i) for i in range(4)]
    rows[3] = ([120.0, None], [None, None], [None])
    scaling.learn(window(rows, close_ms=160.0))
    shown = estimate(scaling)["OFF"]
    assert shown.l95_ms == (2.0 + 3.0 + 0.75 * 10.0 + 8.0 if given else 2.0 + 9.5 + 9.0 * 4 / 8)
    assert shown.violation_rate == 0.0


def test_cycles_of_an_earlier_placement_are_left_out() -> None:
    scaling = Scaling(chain())
    rows = [row(40.0 * i, 2.0, 90.0 if i < 2 else 8.0) for i in range(4)]
    scaling.learn(window(rows, close_ms=160.0, placement=[1, 1, 0, 0]))
    assert estimate(scaling)["LOC"].l95_ms == 10.0


def test_what_is_seen_to_take_nothing_is_as_declared_elsewhere() -> None:
    """Nothing is no part of anything: no ratio says what it takes there."""
    none, some = Execution(Constant(0.0)), Execution(Constant(4.0))
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("B", {"R": none, "E": some})],
        candidates={"LOC": {}, "OFF": {"B": "E"}},
        window_cycles=2,
    )
    scaling = Scaling(problem)
    scaling.learn(window([([0.0], [0.0], [])] * 2, close_ms=200.0))
    assert estimate(scaling)["OFF"].l95_ms == 4.0
    scaling.learn(window([([0.0], [4.0], [])] * 2, close_ms=200.0, placement=[1, 1]))
    assert estimate(scaling)["LOC"].l95_ms == 0.0


def two_edges() -> Problem:
    """B on R, E or F; nothing goes over links."""
    on = {node: Execution(Constant(ms)) for node, ms in (("R", 8.0), ("E", 4.0), ("F", 2.0))}
    return make_problem(
        [Node("R", "robot"), Node("E", "edge"), Node("F", "edge")],
        [Task("B", on)],
        candidates={"LOC": {}, "OFF": {"B": "E"}, "FAR": {"B": "F"}},
        period_ms=40.0,
        window_cycles=20,
    )


def test_what_needs_more_here_needs_as_much_more_where_it_was_not_measured() -> None:
    scaling = Scaling(two_edges())
    rows: list[Row] = [([40.0 * i], [40.0 * i + (8.0 if i < 8 else 12.0)], []) for i in range(20)]
    # On R as declared, on E three times as much.
    scaling.learn(window(rows, close_ms=800.0, placement=[0] * 8 + [1] * 12))
    shown = estimate(scaling)
    assert {name: qos.l95_ms for name, qos in shown.items()} == pytest.approx(
        {"LOC": 8.0, "OFF": 12.0, "FAR": 6.0}
    )


@pytest.mark.parametrize(
    ("ratios", "bounds_ms", "message"),
    [
        ({("B", "R", "X"): 1.0}, {}, r"ratios\['B', 'R', 'X'\]: is of no task on two of its nodes"),
        ({("C", "R", "E"): 1.0}, {}, "known: A on R, B on R, B on E"),
        ({("B", "R", "E"): -1.0}, {}, r"ratios\['B', 'R', 'E'\]: -1.0 is not allowed"),
        ({("B", "R", "E"): math.nan}, {}, "nan is not allowed; it must be a number from 0 to 1e9"),
        ({}, {"E->R": 1.0}, r"bounds_ms\['E->R'\]: is of no link; "),
        ({}, {"R->E": math.inf}, r"bounds_ms\['R->E'\]: inf is not allowed"),
    ],
)
def test_what_is_wrong_is_named(
    ratios: Mapping[tuple[str, str, str], float], bounds_ms: Mapping[str, float], message: str
) -> None:
    with pytest.raises(ProblemError, match=message):
        Scaling(chain(), ratios, bounds_ms)


def test_all_that_is_wrong_is_named_at_once() -> None:
    with pytest.raises(ProblemError) as caught:
        Scaling(chain(), {("B", "R", "E"): -1.0, ("A", "R", "E"): 1.0}, {"E->R": 1.0})
    assert len(caught.value.faults) == 3
