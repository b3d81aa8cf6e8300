"""The simulator against the second, slow one, over problems made at random.

The environment variable DWELL_EXAMPLES sets how many problems of each kind are tried.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from random import Random
from typing import Any

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

import dwell
from dwell.control import Controller
from dwell.control import guard as control_guard
from dwell.estimators import Evidence, Instants
from dwell.kernels import arrays as sim_arrays
from dwell.kernels.advance import play as advance_to_end
from dwell.kernels.arrays import CellArrays, lay_out, ordered_flows
from dwell.kernels.codes import Status
from dwell.kernels.random_draws import draw_shadows
from dwell.kernels.realisation import LinkSegment, NodeChange, Realisation
from dwell.model import (
    Constant,
    ControllerSettings,
    Execution,
    Flow,
    FrozenDict,
    Link,
    Node,
    Problem,
    QoS,
    Task,
)
from dwell.sim import tables as sim_tables
from dwell.sim.tables import make_tables
from tests.cells.generated import (
    MS,
    Scheduler,
    make_problem,
    make_realisation,
    random_problem,
    random_stamps,
)
from tests.cells.rated import with_chains, with_rates
from tests.cells.replicated import with_replicas
from tests.kernels.parts import attempt_uniform as kernel_uniform
from tests.reference import guard as reference_guard
from tests.reference import simulator as reference_simulator
from tests.reference.algorithm_1 import price, switching
from tests.reference.cancelled import Cancelled
from tests.reference.chains import over_age
from tests.reference.rates import Rates, earlier_cycles
from tests.reference.replicas import second
from tests.reference.simulator import (
    ITSELF,
    NEAR_NS,
    SHADOW,
    CycleResult,
    Look,
    Result,
    Usage,
    WindowResult,
    attempt_uniform,
    control,
    nanoseconds,
    shadow_stamp,
    simulate,
)

# Instant of a job or a message of a cycle in which there is none.
NOT_DUE = -2
EXAMPLES = int(os.environ.get("DWELL_EXAMPLES", "24"))
# Of the problems that take longer: those with shadows, and those in which orders take time.
LONGER = int(os.environ.get("DWELL_EXAMPLES", "12"))
#: One in so many is among the few; `make test-all` tries the others.
ONE_IN = 2
FAIR_TOLERANCE_NS = NEAR_NS
# Core time of a job that foreign threads interfered with is a sum of floats.
WORK_TOLERANCE_NS = 1
# Cycles of a window in cells that decide between the closes of windows.
LONGEST_WINDOW = 12
MOST_EXCLUDED = 0.15
EVERY: tuple[Scheduler, ...] = ("fair", "fifo", "priority", "turns")


@pytest.fixture(autouse=True)
def _small_ring(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the ring of cycles in flight begin so small that it has to grow."""
    monkeypatch.setattr(sim_arrays, "RING_START", 1)


class Replay:
    """A policy that says its names one after another, whatever it sees."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self.next = iter(self.names)

    def start(self, problem: Problem) -> None:
        """Begin again."""
        self.next = iter(self.names)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Say the next name."""
        return next(self.next)


class Fickle(Replay):
    """A policy that goes on to its next name where one is held back, too."""

    def __deepcopy__(self, memo: object) -> Fickle:
        return self  # it is not put back to what it was


class Level:
    """An estimator that expects the same of every candidate."""

    names: tuple[str, ...] = ()

    def start(self, problem: Problem) -> None:
        """Get to know the candidates."""
        self.names = tuple(problem.candidates)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Expect what was observed."""
        return dict.fromkeys(self.names, observed)


class Probe(Level):
    """One that asks for shadow jobs and keeps everything it is given."""

    def __init__(self, shadow_fraction: float | Mapping[str, float]) -> None:
        self.shadow_fraction = shadow_fraction
        self.evidence: list[Evidence] = []
        self.observed: list[QoS] = []
        self.own: list[Mapping[str, float]] = []

    def __deepcopy__(self, memo: object) -> Probe:
        return self  # what the simulator's copy sees is what the test looks at

    def start(self, problem: Problem) -> None:
        """Forget everything."""
        super().start(problem)
        self.evidence, self.observed, self.own = [], [], []

    def learn(self, evidence: Evidence) -> None:
        """Keep a window's evidence."""
        self.evidence.append(evidence)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Keep what was observed."""
        self.observed.append(observed)
        self.own.append(own)
        return super().estimate(observed=observed, incumbent=incumbent, own=own)


@dataclass(frozen=True)
class Case:
    """A problem, a realisation of it, and a candidate for every decision.

    By the active candidate, a share of the cycles is also sent through each alternative. Where it
    is `guarded`, the cell's guard acts; what it holds back is decided again, unless the policy is
    `fickle`.
    """

    problem: Problem
    real: Realisation
    names: tuple[str, ...]
    fractions: Mapping[str, float] = field(default_factory=dict)
    guarded: bool = False
    fickle: bool = False


@dataclass(frozen=True)
class Played:
    """What a run left behind; `arrived` by cell, cycle, source and target.

    `work_ns` is the core time of jobs that are done, by cell, cycle and task. `taken` are the
    cycles of the values that jobs got, by cycle, source and target.
    """

    cycles: pl.DataFrame
    jobs: pl.DataFrame
    windows: pl.DataFrame
    decisions: pl.DataFrame | None = None
    probe: Probe | None = None
    arrived: Mapping[tuple[int, int, str, str], int] | None = None
    core_ns: NDArray[np.float64] | None = None
    work_ns: Mapping[tuple[int, int, str], int] | None = None
    taken: Mapping[tuple[int, str, str], int] | None = None


def make_case(
    seed: int,
    schedulers: Sequence[Scheduler],
    *,
    whole_ms: bool = False,
    orders: bool = False,
    in_order: bool = False,
    rates: bool = False,
    replicas: bool = False,
) -> Case:
    rng = Random(seed)
    problem = random_problem(rng, schedulers=schedulers, whole_ms=whole_ms, orders=orders)
    if in_order:
        problem = with_order(problem, Random(seed), whole_ms=whole_ms)
    if rates:
        problem = with_rates(problem, Random(f"{seed} rates"))
    if replicas:
        problem = with_replicas(problem, Random(f"{seed} replicas"), whole_ms=whole_ms)
    else:
        problem = with_deadline(problem, Random(f"{seed} deadline"), whole_ms=whole_ms)
    windows = rng.randint(3, 10) if orders else rng.randint(2, 8)
    names = tuple(random_stamps(rng, problem, windows))
    real = dwell.draw(problem, scenario="disturbed", seed=seed, windows=windows)
    share = rng.choice([0.0, 0.1, 0.3, 1.0]) / len(problem.candidates) if orders else 0.0
    fractions: dict[str, float] = {}
    if share:
        # Of the largest share, none to all under each candidate.
        parts = [rng.choice([0.0, 0.2, 1.0, 1.0]) for _ in problem.candidates]
        parts[rng.randrange(len(parts))] = 1.0
        named = zip(problem.candidates, parts, strict=True)
        fractions = {name: share * part for name, part in named}
    case = Case(problem, real, names, fractions)
    return deciding_often(case, Random(f"{seed} decides")) if orders else case


def deciding_often(case: Case, rng: Random) -> Case:
    """Let two cases in three decide more often than windows close, in windows of another length."""
    cycles = case.real.cycles
    least = case.problem.pipeline.sink_cycles + 1
    lengths = [w for w in range(least, LONGEST_WINDOW + 1) if cycles % w == 0 and cycles > w]
    if not lengths or rng.random() < 1 / 3:
        return case
    width = rng.choice(lengths)
    every = rng.randint(least - 1, width - 1)
    problem = replace(
        case.problem,
        window_cycles=width,
        controller=replace(case.problem.controller, decide_cycles=every),
    )
    return replace(
        case,
        problem=problem,
        real=replace(case.real, windows=cycles // width),
        names=tuple(random_stamps(rng, problem, cycles // every + 1)),
    )


def with_deadline(problem: Problem, rng: Random, *, whole_ms: bool) -> Problem:
    """Let one problem in two have a deadline of one to eight periods."""
    pipeline = problem.pipeline
    if rng.random() < 0.5:
        return problem
    deadline_ms = pipeline.period_ms * rng.uniform(1, 8)
    deadline_ms = math.ceil(deadline_ms) if whole_ms else deadline_ms
    return replace(problem, pipeline=replace(pipeline, deadline_ms=deadline_ms))


def with_order(problem: Problem, rng: Random, *, whole_ms: bool) -> Problem:
    """Let all links keep order and lose messages, and most of them send what is lost again."""
    links = {}
    for name, link in problem.fabric.links.items():
        timeout_ms = problem.pipeline.period_ms * rng.choice([0.1, 0.5, 2.0, 6.0])
        timeout_ms = max(1.0, round(timeout_ms)) if whole_ms else timeout_ms
        links[name] = replace(
            link,
            loss=rng.choice([0.02, 0.2, 0.5]),
            retransmit_ms=rng.choice([timeout_ms, timeout_ms, timeout_ms, None]),
            in_order=True,
        )
    return replace(problem, fabric=replace(problem.fabric, links=links))


def jittered(case: Case, rng: Random, *, whole_ms: bool) -> Case:
    """Delay the releases of a case, up to some periods, each by another time."""
    pipeline, real = case.problem.pipeline, case.real
    longest_ms = pipeline.period_ms * rng.choice([0.3, 1.0, 2.5])
    late_ms = [rng.uniform(0, longest_ms) for _ in real.release_ns]
    late_ns = np.rint(np.round(late_ms) * MS if whole_ms else np.array(late_ms) * MS)
    release_ns = np.maximum.accumulate(real.release_ns + late_ns.astype(np.int64))
    deadline_ms = rng.choice([pipeline.deadline_ms, max(pipeline.period_ms, pipeline.deadline_ms)])
    problem = replace(case.problem, pipeline=replace(pipeline, deadline_ms=deadline_ms))
    return replace(case, problem=problem, real=replace(real, release_ns=release_ns))


def make_guarded(
    seed: int,
    schedulers: Sequence[Scheduler],
    *,
    whole_ms: bool = False,
    orders: bool = False,
    in_order: bool = False,
    rates: bool = False,
    replicas: bool = False,
) -> Case:
    """Make a case whose cell has a guard."""
    of = {"whole_ms": whole_ms, "orders": orders, "in_order": in_order, "rates": rates}
    case = make_case(seed, schedulers, **of, replicas=replicas)
    rng = Random(seed)
    names = list(case.problem.plain_candidates)
    settings = replace(
        case.problem.controller,
        decide_cycles=case.problem.window_cycles,
        fallbacks=tuple(rng.sample(names, rng.randint(1, len(names)))),
        guard_cycles=rng.choice([2, 2, 3, 4]),
        probe_cycles=rng.choice([1, 2, 2, 6]),
    )
    problem = replace(case.problem, controller=settings)
    if rates:
        problem = with_chains(problem, Random(f"{seed} chains"))
    windows = rng.randint(6, 14)
    real = dwell.draw(problem, scenario="disturbed", seed=seed, windows=windows)
    stamps = tuple(random_stamps(rng, problem, windows))
    case = replace(case, problem=problem, real=real, names=stamps, guarded=True)
    return deciding_often(case, Random(f"{seed} decides")) if orders else case


def script(case: Case) -> list[str]:
    # One name more: the last window closes with a decision too.
    return [*case.names[1:], case.names[0]]


def play(case: Case) -> Played:
    probe = Probe(case.fractions) if case.fractions else None
    run = dwell.simulate_realisation(
        case.problem,
        case.real,
        policy=(Fickle if case.fickle else Replay)(script(case)),
        estimator=probe or Level(),
        jobs=True,
        guard=case.guarded,
    )
    assert run.jobs is not None
    return Played(run.cycles, run.jobs, run.windows, run.decisions, probe)


def reference(case: Case) -> Result:
    names = list(case.problem.plain_candidates)
    # What is drawn does not depend on what a cycle runs under.
    most = max(case.fractions.values(), default=0.0)
    sent = [
        cycle
        for cycle in range(case.real.cycles)
        if shadow_stamp(cycle, names[0], names, most) is not None
    ]
    shadows = draw_shadows(case.problem, case.real, np.array(sent, int), others=case.guarded)
    return control(
        case.problem,
        case.real,
        script(case),
        shadows=shadows if case.fractions or case.guarded else None,
        fractions=case.fractions,
        guarded=case.guarded,
        fickle=case.fickle,
    )


# ------------------------------------------------------------------------------- differences


def differences(case: Case, found: Played, result: Result, tolerance_ns: int) -> Iterator[str]:
    """Say in what a run differs from the reference."""
    yield from cycle_differences(found.cycles, result, tolerance_ns)
    yield from lead_differences(case, found.cycles, result)
    yield from job_differences(found.jobs, result, tolerance_ns)
    yield from window_differences(case, found.windows, result, tolerance_ns)
    if found.decisions is not None:
        yield from decision_differences(case, found.decisions, result, tolerance_ns)
    if found.probe is not None:
        yield from probe_differences(case, found.probe, result, tolerance_ns)
    if found.arrived is not None:
        yield from arrival_differences(found.arrived, result, tolerance_ns)
    if found.core_ns is not None:
        yield from core_differences(case, found.core_ns, result)
    if found.work_ns is not None:
        yield from work_differences(found.work_ns, result)
    if found.taken is not None:
        yield from taken_differences(found.taken, result)


def differs(found: int | None, expected: int | None, tolerance_ns: int) -> bool:
    if found is None or expected is None:
        return found is not expected
    return abs(found - expected) > tolerance_ns


def cycle_differences(cycles: pl.DataFrame, result: Result, tolerance_ns: int) -> Iterator[str]:
    rows = list(cycles.iter_rows(named=True))
    assert [row["cycle"] for row in rows] == list(range(len(rows)))
    if len(rows) != len(result.cycles):
        yield f"{len(rows)} cycles, expected {len(result.cycles)}"
    for row, expected, (active, _) in zip(rows, result.cycles, result.stamps, strict=False):
        where = f"cycle {row['cycle']}"
        if row["placement"] != active:
            yield f"{where}: under {row['placement']}, expected {active}"
        if row["outcome"] != expected.outcome:
            yield f"{where}: outcome {row['outcome']}, expected {expected.outcome}"
        if differs(row["latency_ns"], expected.latency_ns, tolerance_ns):
            yield f"{where}: latency_ns {row['latency_ns']}, expected {expected.latency_ns}"
        parts = [row[column] for column in ("compute_ns", "queue_ns", "network_ns")]
        if not is_split(parts, expected, tolerance_ns):
            yield f"{where}: split into {parts}, expected {set(expected.splits)}"


def lead_differences(case: Case, cycles: pl.DataFrame, result: Result) -> Iterator[str]:
    width = case.problem.window_cycles
    firsts = [window.first_cycle for window in result.windows]
    within = {cycle for first in firsts for cycle in range(first, first + width)}
    end = max(within, default=-1)
    for cycle, lead, missed in cycles.select("cycle", "lead", "missed").rows():
        if lead != (cycle not in within):
            yield f"cycle {cycle}: lead is {lead}"
        if missed and cycle > end:
            yield f"cycle {cycle}: missed after the last window"


def is_split(parts: Sequence[int | None], expected: CycleResult, tolerance_ns: int) -> bool:
    if not expected.splits:
        return all(part is None for part in parts)
    # Each part is a sum of differences along a path.
    return any(
        not any(
            differs(*pair, 4 * tolerance_ns) for pair in zip(parts, astuple(split), strict=True)
        )
        for split in expected.splits
    )


def job_differences(jobs: pl.DataFrame, result: Result, tolerance_ns: int) -> Iterator[str]:
    rows = {
        (
            row.get("shadow", False),
            row["cycle"],
            second(row["task"]) if row.get("second") else row["task"],
        ): row
        for row in jobs.iter_rows(named=True)
    }
    assert len(rows) == len(jobs)
    known = {(False, *key): job for key, job in result.jobs.items()}
    known |= {(True, *key): job for key, job in result.shadow_jobs.items()}
    for key in sorted(rows.keys() ^ known.keys()):
        yield f"job {key}: {'unexpected' if key in rows else 'missing'}"
    for key in sorted(rows.keys() & known.keys()):
        row, expected = rows[key], known[key]
        for column in ("node", "outcome"):
            if row[column] != getattr(expected, column):
                yield f"job {key}: {column} {row[column]}, expected {getattr(expected, column)}"
        for column in ("ready_ns", "start_ns", "end_ns"):
            value = getattr(expected, column)
            if differs(row[column], value, tolerance_ns):
                yield f"job {key}: {column} {row[column]}, expected {value}"


def arrival_differences(
    arrived: Mapping[tuple[int, int, str, str], int], result: Result, tolerance_ns: int
) -> Iterator[str]:
    for key in sorted(arrived.keys() | result.arrived.keys()):
        found, expected = arrived.get(key), result.arrived.get(key)
        if differs(found, expected, tolerance_ns):
            yield f"arrival {key}: {found}, expected {expected}"


def taken_differences(taken: Mapping[tuple[int, str, str], int], result: Result) -> Iterator[str]:
    """Compare the cycles of the values that jobs got."""
    expected = {
        (cycle, source, target): value
        for (cycle, target), job in result.jobs.items()
        for source, value in job.taken.items()
    }
    for key in sorted(taken.keys() | expected.keys()):
        if taken.get(key) != expected.get(key):
            yield f"value of {key}: {taken.get(key)}, expected {expected.get(key)}"


def work_differences(work_ns: Mapping[tuple[int, int, str], int], result: Result) -> Iterator[str]:
    jobs = {(ITSELF, *key): job for key, job in result.jobs.items()}
    jobs |= {(SHADOW, *key): job for key, job in result.shadow_jobs.items()}
    expected = {key: float(job.core) for key, job in jobs.items() if job.outcome == "done"}
    if work_ns.keys() != expected.keys():
        yield f"core time of jobs {work_ns.keys() ^ expected.keys()}"
    for key in work_ns.keys() & expected.keys():
        if abs(work_ns[key] - expected[key]) > WORK_TOLERANCE_NS:
            yield f"job {key}: core time {work_ns[key]}, expected {expected[key]}"


def window_differences(
    case: Case, windows: pl.DataFrame, result: Result, tolerance_ns: int
) -> Iterator[str]:
    too_old = over_age(case.problem, result, case.real.release_ns.tolist())
    if len(windows) != len(result.windows):
        yield f"{len(windows)} windows, expected {len(result.windows)}"
    for row, expected in zip(windows.iter_rows(named=True), result.windows, strict=False):
        where = f"window {row['window']}"
        first, last = expected.first_cycle, expected.first_cycle + case.problem.window_cycles
        if row["first_cycle"] != first:
            yield f"{where}: first_cycle {row['first_cycle']}, expected {first}"
        # Every deadline has passed at the close, so that nothing else is missed.
        deadline_ns = nanoseconds(case.problem.pipeline.deadline_ms)
        known = {k: c.latency_ns for k, c in enumerate(result.cycles) if c.outcome != "idle"}
        counted = [k for k in range(first, last) if k in known]
        late = {k for k in counted if (known[k] or 0) > deadline_ns or known[k] is None}
        late |= {k for k in counted if k in too_old and too_old[k] <= expected.close_ns}
        missed = len(late) / len(counted)
        for column in ("violation_rate", "seen_violation_rate"):
            if row[column] not in (missed, None):
                yield f"{where}: {column} {row[column]}, expected {missed}"
        if row["overtaken"] != (overtaken := sum(overtaken_in(case, result)[first:last])):
            yield f"{where}: overtaken {row['overtaken']}, expected {overtaken}"
        placed = [active for active, _ in result.stamps[first:last]]
        if (row["placement"], row["mixed"]) != (placed[0], len(set(placed)) > 1):
            yield f"{where}: {row['placement']}, mixed {row['mixed']}, expected {placed}"
        if row["cost"] is not None:
            yield from cost_differences(case, row, expected, result, tolerance_ns)
        copies = sum(result.late.get(k, 0) for k in range(first, last))
        if row.get("late_copies", copies) != copies:
            yield f"{where}: late_copies {row['late_copies']}, expected {copies}"
        sent = sum(other is not None for _, other in result.stamps[first:last])
        if row.get("shadow_cycles", 0) != sent:
            yield f"{where}: shadow_cycles {row['shadow_cycles']}, expected {sent}"
        for name in case.problem.fabric.resources:
            busy, _, shadow = shares(case, expected, name)
            for column, value in ((f"u_{name}", busy), (f"shadow_{name}", shadow)):
                if abs(row.get(column, 0.0) - value) > 1e-6:
                    yield f"{where}: {column} {row[column]}, expected {value}"


def overtaken_in(case: Case, result: Result) -> list[bool]:
    """Whether each cycle has completed after a later one."""
    releases = case.real.release_ns.tolist()
    known = zip(releases, (cycle.latency_ns for cycle in result.cycles), strict=False)
    ends = [math.inf if latency is None else release + latency for release, latency in known]
    return [
        end < math.inf and any(later < end for later in ends[i + 1 :]) for i, end in enumerate(ends)
    ]


def cost_differences(
    case: Case, row: Mapping[str, Any], window: WindowResult, result: Result, tolerance_ns: int
) -> Iterator[str]:
    """Compare J of a window: of its L95, with each move that took effect in it."""
    problem = case.problem
    l95_ms = l95_ns_of(case, window.first_cycle, problem.window_cycles, window) / 1e6
    if abs(row["seen_l95_ms"] - l95_ms) * 1e6 > tolerance_ns + 1:
        yield f"window {row['window']}: seen_l95_ms {row['seen_l95_ms']}, expected {l95_ms}"
    used = {name: row[f"u_{name}"] for name in problem.fabric.resources}
    seen = QoS(row["seen_l95_ms"], row["seen_violation_rate"], FrozenDict(used))
    cycles = range(max(window.first_cycle, 1), window.first_cycle + problem.window_cycles)
    moves = [(result.stamps[k][0], result.stamps[k - 1][0]) for k in cycles]
    switched = sum(switching(*(problem.candidates[name] for name in move)) for move in moves)
    here = problem.candidates[row["placement"]]
    alone = price(seen, here, here, problem.objective)
    expected = alone + problem.objective.weights.switching * switched
    if not math.isclose(row["cost"], expected, rel_tol=1e-9):
        yield f"window {row['window']}: cost {row['cost']}, expected {expected}"


def decision_differences(
    case: Case, decisions: pl.DataFrame, result: Result, tolerance_ns: int
) -> Iterator[str]:
    """Compare the decisions, and the moves of the guard among them."""
    by_guard = (pl.col("reason") == "guard").alias("by_guard")
    columns = "window", "last_cycle", "cycles", "incumbent", "placement"
    found = decisions.select(*columns, by_guard).rows()
    for row, expected in itertools.zip_longest(found, map(astuple, result.decisions)):
        if row != expected:
            yield f"decision {row}, expected {expected}"
    if case.fractions:
        return  # the incumbent's entry is an estimate, not what was observed
    looks = {look.last: look for look in result.looks}
    for row in decisions.filter(pl.col("cycles") > 0).iter_rows(named=True):
        look = looks[row["last_cycle"]]
        where, name = f"decision on cycle {look.last}", row["incumbent"]
        l95_ns = l95_ns_of(case, look.first, look.last + 1 - look.first, look)
        if differs(round(row[f"est_l95_ms_{name}"] * 1e6), l95_ns, tolerance_ns):
            yield f"{where}: L95 {row[f'est_l95_ms_{name}']} ms, expected {l95_ns} ns"
        for resource in case.problem.fabric.resources:
            busy, *_ = parts_of(
                case, look.opened, look.closed, (look.first, look.close_ns), resource
            )
            found_busy = row[f"est_u_{resource}_{name}"]
            if abs(found_busy - busy) > 1e-6:
                yield f"{where}: u of {resource} {found_busy}, expected {busy}"


def shares(case: Case, window: WindowResult, resource: str) -> tuple[float, float, float]:
    """Shares of a node's cores, or of its accelerators, in a window: busy, own and shadow."""
    span = window.first_cycle, window.close_ns
    return parts_of(case, window.opened, window.closed, span, resource)


def parts_of(
    case: Case,
    before_all: Mapping[str, Usage],
    after_all: Mapping[str, Usage],
    span: tuple[int, int],
    resource: str,
) -> tuple[float, float, float]:
    """Shares of a resource from the release of a cycle to an instant: busy, own and shadow."""
    opened, closed = before_all[resource], after_all[resource]
    span_ns = span[1] - int(case.real.release_ns[span[0]])
    capacity = case.problem.fabric.resources[resource].capacity
    busy, own, shadow = (
        min(1.0, float(after - before) / (capacity * span_ns))
        for before, after in zip(astuple(opened), astuple(closed), strict=True)
    )
    return busy, own, shadow


def core_differences(case: Case, core_ns: NDArray[np.float64], result: Result) -> Iterator[str]:
    """Compare what resources had done when windows began and ended: (2, windows, 4, resources)."""
    for k, window in enumerate(result.windows):
        for i, name in enumerate(case.problem.fabric.resources):
            for when, usage in enumerate((window.opened[name], window.closed[name])):
                found = core_ns[when, k, :3, i].tolist()
                expected = [float(value) for value in astuple(usage)]
                # Rounded up to whole nanoseconds, work may take a little more time than it is.
                if any(abs(a - b) > 1e-6 * b + 1 for a, b in zip(found, expected, strict=True)):
                    yield f"window {k}: {name} has done {found}, expected {expected}"


def probe_differences(case: Case, probe: Probe, result: Result, tolerance_ns: int) -> Iterator[str]:
    """Compare what an estimator was given with what was known at each decision."""
    seen = seen_looks(case, result)
    if not len(probe.evidence) == len(probe.observed) == len(seen):
        yield f"{len(probe.evidence)} stretches were learnt from, expected {len(seen)}"
    rows = zip(probe.evidence, probe.observed, probe.own, seen, strict=False)
    for evidence, observed, own, look in rows:
        where = f"decision on cycle {look.last}"
        for name in case.problem.fabric.resources:
            span = look.begin, look.close_ns
            busy, *expected = parts_of(case, look.begun, look.closed, span, name)
            if abs(own[name] - sum(expected)) > 1e-6:
                yield f"{where}: own work on {name} {own[name]}, expected {expected}"
            if abs(observed.utilisation[name] - busy) > 1e-6:
                yield f"{where}: busy {name} {observed.utilisation[name]}, expected {busy}"
        l95_ns = l95_ns_of(case, look.first, look.last + 1 - look.first, look)
        if differs(round(observed.l95_ms * 1e6), l95_ns, tolerance_ns):
            yield f"{where}: L95 {observed.l95_ms} ms, expected {l95_ns} ns"
        stretch = range(look.begin, look.last + 1)
        yield from evidence_differences(case, evidence, look, stretch, result, tolerance_ns)
        earlier = evidence.earlier
        stretch = range(max(look.begin - earlier_cycles(case.problem), 0), look.begin)
        if bool(stretch) != (earlier is not None):
            yield f"{where}: earlier evidence {earlier}, expected {stretch}"
        elif earlier is not None:
            yield from evidence_differences(case, earlier, look, stretch, result, tolerance_ns)


def seen_looks(case: Case, result: Result) -> list[Look]:
    """Return the looks at whose instant the controller's node was up."""
    host = case.problem.controller_node
    changes = [change for change in case.real.node_changes if change.node == host]

    def up(look: Look) -> bool:
        return not any([c.down for c in changes if c.at_ns <= look.close_ns][-1:])

    return [look for look in result.looks if up(look)]


def l95_ns_of(case: Case, first: int, count: int, closed: WindowResult | Look) -> int:
    """L95 of some cycles, as known at the close of a window or a decision."""
    rates, seen = Rates(case.problem.pipeline), []
    for k in range(first, first + count):
        sinks = rates.due_sinks(k)
        if not sinks:
            continue
        jobs = [closed.known.get((ITSELF, k, name)) for name in sinks]
        ends = [job.end_ns for job in jobs if job is not None and job.outcome == "done"]
        done = len(ends) == len(sinks)
        end = max(ns for ns in ends if ns is not None) if done else closed.close_ns
        seen.append(end - int(case.real.release_ns[k]))
    l95 = sorted(seen)[math.ceil(0.95 * len(seen)) - 1]
    return min(l95, round(case.problem.censor_ms * 1e6))


def evidence_differences(
    case: Case,
    evidence: Evidence,
    look: Look,
    cycles: range,
    result: Result,
    tolerance_ns: int,
) -> Iterator[str]:
    """Compare the evidence of some cycles with what was known of them at a decision."""
    where = f"evidence of {cycles} at cycle {look.last}"
    names = list(case.problem.candidates)
    first, last = cycles.start, cycles.stop
    stamps = result.stamps[first:last]
    if evidence.close_ns != look.close_ns:
        yield f"{where}: close_ns {evidence.close_ns}, expected {look.close_ns}"
    if evidence.release_ns.tolist() != case.real.release_ns[first:last].tolist():
        yield f"{where}: release_ns {evidence.release_ns}"
    if [names[i] for i in evidence.placement] != [active for active, _ in stamps]:
        yield f"{where}: placement {evidence.placement}, expected {stamps}"
    others = [names[i] if i >= 0 else None for i in evidence.shadow_placement]
    if others != [other for _, other in stamps]:
        yield f"{where}: shadow_placement {evidence.shadow_placement}, expected {stamps}"
    assert evidence.shadows is not None
    for cell, instants in ((ITSELF, evidence.cycles), (SHADOW, evidence.shadows)):
        known = known_instants(case, instants, look, cycles, cell, result)
        for name, found, expected, matters in known:
            assert found.shape == expected.shape
            # What is unknown in one is unknown in the other.
            same = (found < 0) == (expected < 0)
            near_ns = WORK_TOLERANCE_NS if name == "work_ns" else tolerance_ns
            if not (~matters | same & (abs(found - expected) <= near_ns)).all():
                yield f"{where}: {name} of cell {cell} {found}, expected {expected}"
            if name != "work_ns" and (found > evidence.close_ns).any():
                yield f"{where}: {name} of cell {cell} {found} after the close"


def known_instants(
    case: Case, found: Instants, look: Look, cycles: range, cell: int, result: Result
) -> Iterator[tuple[str, NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]]:
    """What evidence says, and what was known, for each kind of instants, and what matters."""
    pipeline, rows = case.problem.pipeline, list(case.problem.pipeline.tasks)
    flows = [(flow, flow.source, flow.target) for flow in pipeline.flows]
    if case.problem.replicas:
        rows += map(second, pipeline.tasks)
        flows += [(flow, second(flow.source), second(flow.target)) for flow in pipeline.flows]
    first, rates = cycles.start, Rates(pipeline)
    due = [[rates.is_due(row.partition("/")[0], k) for row in rows] for k in cycles]
    ready, ended, started, work = (np.where(due, -1, NOT_DUE) for _ in range(4))
    for (whose, cycle, row), job in look.known.items():
        if whose == cell and cycle in cycles:
            at = cycle - first, rows.index(row)
            ready[at] = job.ready_ns
            if job.start_ns is not None:
                started[at] = job.start_ns
            if job.outcome == "done" and job.end_ns is not None:
                ended[at], work[at] = job.end_ns, round(job.core)
    arrived = np.array(
        [
            [
                look.arrived.get(
                    (cell, k, source, target),
                    -1 if rates.carries(flow, k) else NOT_DUE,
                )
                for flow, source, target in flows
            ]
            for k in cycles
        ],
        np.int64,
    ).reshape(len(cycles), -1)
    jobs_matter, messages_matter = np.ones_like(ready, np.bool_), np.ones_like(arrived, np.bool_)
    for k in cycles if cell == ITSELF else ():
        copies = Cancelled(case.problem, look, result, k, int(case.real.release_ns[k]))
        for i, row in enumerate(rows):
            jobs_matter[k - first, i] = copies.has_job(row)
            if copies.has_job(row) and copies.is_cancelled(row):
                for table in (ready, ended, started, work):
                    table[k - first, i] = NOT_DUE
        for i, (flow, source, target) in enumerate(flows):
            matters, is_cancelled = copies.message(flow, source, target)
            messages_matter[k - first, i] = matters
            if matters and is_cancelled:
                arrived[k - first, i] = NOT_DUE
    assert found.start_ns is not None
    assert found.work_ns is not None
    yield "ready_ns", found.ready_ns, ready, jobs_matter
    yield "end_ns", found.end_ns, ended, jobs_matter
    yield "start_ns", found.start_ns, started, jobs_matter
    yield "work_ns", found.work_ns, work, jobs_matter
    yield "arrived_ns", found.arrived_ns, arrived, messages_matter


def examine(case: Case, tolerance_ns: int) -> list[str] | None:
    """Return how the two differ; None where the case is excluded."""
    found = play(case)
    result = reference(case)
    if tolerance_ns and result.closest_ns is not None:
        return None
    return list(differences(case, found, result, tolerance_ns))


# ------------------------------------------------------------------------------ random stamps


def random_shadow_stamps(rng: Random, case: Case) -> tuple[list[str], list[str | None]]:
    """Return what every cycle runs under, and what it is also sent through."""
    names = list(case.problem.candidates)
    stamps = [rng.choice(names) for _ in range(case.real.cycles)]
    share = rng.choice([0.1, 0.5, 1.0])
    plain = list(case.problem.plain_candidates)
    others = [rng.choice(plain) if rng.random() < share else None for _ in range(case.real.cycles)]
    pairs = zip(stamps, others, strict=True)
    return stamps, [other if other != active else None for active, other in pairs]


def play_stamped(
    case: Case, shadows: Realisation, stamps: Sequence[str], others: Sequence[str | None]
) -> Played:
    """Play a realisation with given stamps, without a controller."""
    problem, real = case.problem, case.real
    arrays = lay_out([(problem, real)], log_jobs=True, shadows=[shadows])
    codes: dict[str | None, int] = {name: i for i, name in enumerate(problem.candidates)}
    codes[None] = -1
    arrays.tables.stamps[0] = [codes[name] for name in stamps]
    arrays.tables.stamps[1] = [codes[name] for name in others]
    assert advance_to_end(arrays) == Status.FINISHED
    # Nothing is decided: no candidate has to be priced.
    controller = Controller(problem, problem.initial, Level())

    def never(at_ns: int) -> bool:
        return False

    tables, _ = make_tables(
        sim_tables.PlayedRealisation(problem, real, controller, CellArrays(arrays), never),
        jobs=True,
    )
    flows = [(flow.source, flow.target) for flow in ordered_flows(problem.pipeline)]
    if problem.replicas:
        flows += [(second(source), second(target)) for source, target in flows]
    log = arrays.tables.log_arrived.reshape(2, real.cycles, len(flows)).tolist()
    arrived = {
        (cell, cycle, *flow): at_ns
        for cell, cycles in enumerate(log)
        for cycle, row in enumerate(cycles)
        for flow, at_ns in zip(flows, row, strict=True)
        if at_ns >= 0
    }
    core_ns = np.stack([arrays.tables.opened[0], arrays.tables.closed[0]])
    work = arrays.tables.log["work_ns"].reshape(2, real.cycles, -1)
    names = list(problem.pipeline.tasks)
    names += [second(name) for name in names] if problem.replicas else []
    work_ns = {
        (cell, cycle, names[i]): int(work[cell, cycle, i])
        for cell, cycle, i in np.argwhere(work >= 0).tolist()
    }
    sampled = [(i, flow) for i, flow in enumerate(ordered_flows(problem.pipeline)) if flow.sampled]
    values = arrays.tables.log_taken.reshape(2, real.cycles, -1)[0] if sampled else np.empty((0, 0))
    taken = {
        (cycle, flow.source, flow.target): int(row[i])
        for cycle, row in enumerate(values)
        for i, flow in sampled
        if row[i] >= 0
    }
    cycles, jobs, windows = (tables[name]() for name in ("cycles", "jobs", "windows"))
    return Played(
        *(cycles, jobs, windows),
        arrived=arrived,
        core_ns=core_ns,
        work_ns=work_ns,
        taken=taken,
    )


def examine_stamped(seed: int, case: Case, tolerance_ns: int) -> list[str] | None:
    """As `examine`, with random stamps and shadow stamps."""
    shadows = draw_shadows(case.problem, case.real)
    stamps, others = random_shadow_stamps(Random(seed), case)
    found = play_stamped(case, shadows, stamps, others)
    result = simulate(case.problem, case.real, stamps, shadows=shadows, shadow_stamps=others)
    if tolerance_ns and result.closest_ns is not None:
        return None
    return list(differences(case, found, result, tolerance_ns))


# -------------------------------------------------------------------------------------- tests


@pytest.fixture(params=["few", "the others"])
def part(request: pytest.FixtureRequest) -> str:
    """Which of the problems are tried."""
    return str(request.param)


def compare(
    part: str,
    schedulers: Sequence[Scheduler],
    tolerance_ns: int = 0,
    *,
    whole_ms: bool = False,
    orders: bool = False,
    stamped: bool = False,
    guarded: bool = False,
    jitter: bool = False,
    in_order: bool = False,
    rates: bool = False,
    replicas: bool = False,
) -> None:
    excluded = 0
    failures: list[str] = []
    examples = -(-LONGER // 2) if guarded else LONGER if orders or replicas else EXAMPLES
    few = -(-examples // ONE_IN)
    seeds = range(few) if part == "few" else range(few, examples)
    for seed in seeds:
        make = make_guarded if guarded else make_case
        how = {"whole_ms": whole_ms, "orders": orders, "in_order": in_order, "rates": rates}
        case = make(seed, schedulers, **how, **({"replicas": True} if replicas else {}))
        if replicas and not case.problem.replicas:
            continue
        if rates and not case.problem.pipeline.has_rates:
            continue
        if jitter:
            case = jittered(case, Random(seed), whole_ms=whole_ms)
        found = (
            examine_stamped(seed, case, tolerance_ns) if stamped else examine(case, tolerance_ns)
        )
        if found is None:
            excluded += 1
        elif found:
            failures.append(f"{make.__name__}({seed}, {schedulers}, {how}): {found[:3]}")
    assert not failures, f"{len(failures)} of {len(seeds)} differ:\n" + "\n".join(failures[:10])
    assert excluded <= math.ceil(MOST_EXCLUDED * len(seeds))


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
@pytest.mark.parametrize("in_order", [False, True], ids=["free", "in-order"])
def test_replicas_equal_to_the_nanosecond(part: str, in_order: bool, whole_ms: bool) -> None:
    how = {"whole_ms": whole_ms, "in_order": in_order, "replicas": True}
    compare(part, ("fifo", "priority"), **how, orders=whole_ms is in_order)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
def test_shadows_of_replicas_equal_to_the_nanosecond(part: str, whole_ms: bool) -> None:
    how = {"whole_ms": whole_ms, "in_order": whole_ms, "replicas": True}
    compare(part, ("fifo", "priority"), **how, orders=True, stamped=True)


def test_replicas_on_shared_cores_equal_to_the_nanosecond(part: str) -> None:
    compare(part, EVERY, FAIR_TOLERANCE_NS, orders=True, replicas=True)


@pytest.mark.usefixtures("_early_health")
@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
def test_replicas_with_a_guard_equal_to_the_nanosecond(part: str, whole_ms: bool) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True, guarded=True, replicas=True)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
@pytest.mark.parametrize("stamped", [False, True], ids=["decided", "stamped"])
def test_several_rates_equal_to_the_nanosecond(part: str, stamped: bool, whole_ms: bool) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, stamped=stamped, rates=True)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole"])
@pytest.mark.parametrize("stamped", [False, True], ids=["decided", "stamped"])
def test_several_rates_under_orders_equal_to_the_nanosecond(
    part: str, stamped: bool, whole_ms: bool
) -> None:
    how = {"whole_ms": whole_ms, "stamped": stamped, "orders": True, "in_order": whole_ms}
    compare(part, ("fifo", "priority"), **how, rates=True)


@pytest.mark.parametrize("jitter", [False, True], ids=["", "jitter"])
def test_several_rates_with_a_guard_equal_to_the_nanosecond(part: str, jitter: bool) -> None:
    compare(part, ("fifo", "priority"), orders=True, guarded=True, jitter=jitter, rates=True)


@pytest.mark.parametrize("schedulers", [("fair",), ("turns",)], ids="-".join)
def test_several_rates_on_shared_cores_equal_to_the_nanosecond(
    part: str, schedulers: Sequence[Scheduler]
) -> None:
    tolerance_ns = FAIR_TOLERANCE_NS if "fair" in schedulers else 0
    compare(part, schedulers, tolerance_ns, rates=True)


@pytest.mark.parametrize(
    "schedulers",
    [("fifo",), ("priority",), ("fifo", "priority"), ("turns",)],
    ids="-".join,
)
def test_equal_to_the_nanosecond_without_processor_sharing(
    part: str, schedulers: Sequence[Scheduler]
) -> None:
    compare(part, schedulers)


@pytest.mark.parametrize(
    "schedulers", [("fifo",), ("priority",), ("turns",)], ids=lambda names: names[0]
)
def test_equal_where_many_events_fall_on_the_same_instant(
    part: str, schedulers: Sequence[Scheduler]
) -> None:
    compare(part, schedulers, whole_ms=True)


@pytest.mark.parametrize("schedulers", [("fair",), EVERY], ids="-".join)
def test_equal_to_the_microsecond_with_processor_sharing(
    part: str, schedulers: Sequence[Scheduler]
) -> None:
    compare(part, schedulers, FAIR_TOLERANCE_NS)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole-ms"])
def test_shadows_equal_to_the_nanosecond_without_processor_sharing(
    part: str, whole_ms: bool
) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True, stamped=True)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole-ms"])
def test_shadows_given_up_early_equal_to_the_nanosecond_without_processor_sharing(
    part: str, whole_ms: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim_arrays, "GIVEN_UP_AFTER", 0)
    monkeypatch.setattr(reference_simulator, "GIVEN_UP_AFTER", 0)
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True, stamped=True)


def test_shadows_equal_to_the_microsecond_with_processor_sharing(part: str) -> None:
    compare(part, EVERY, FAIR_TOLERANCE_NS, orders=True, stamped=True)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole-ms"])
def test_orders_equal_to_the_nanosecond_without_processor_sharing(
    part: str, whole_ms: bool
) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True)


def test_orders_equal_to_the_microsecond_with_processor_sharing(part: str) -> None:
    compare(part, EVERY, FAIR_TOLERANCE_NS, orders=True)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole-ms"])
def test_release_jitter_equal_to_the_nanosecond_without_processor_sharing(
    part: str, whole_ms: bool
) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, jitter=True)
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True, jitter=True)


def test_release_jitter_equal_to_the_microsecond_with_processor_sharing(part: str) -> None:
    compare(part, EVERY, FAIR_TOLERANCE_NS, jitter=True)
    compare(part, EVERY, FAIR_TOLERANCE_NS, orders=True, jitter=True)


@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole-ms"])
def test_links_that_keep_order_equal_to_the_nanosecond_without_processor_sharing(
    part: str, whole_ms: bool
) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, in_order=True)
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True, in_order=True)


@pytest.mark.parametrize("given_up_after", [64, 0])
def test_links_that_keep_order_with_shadows_equal_to_the_nanosecond(
    part: str, given_up_after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim_arrays, "GIVEN_UP_AFTER", given_up_after)
    monkeypatch.setattr(reference_simulator, "GIVEN_UP_AFTER", given_up_after)
    compare(part, ("fifo", "priority"), whole_ms=True, orders=True, stamped=True, in_order=True)


@pytest.fixture
def _early_health(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let few cycles make health."""
    monkeypatch.setattr(control_guard, "HEALTH_WINDOWS", 2)
    monkeypatch.setattr(reference_guard, "HEALTHY_WINDOWS", 2)


@pytest.mark.usefixtures("_early_health")
@pytest.mark.parametrize("jitter", [False, True], ids=["periodic", "jitter"])
@pytest.mark.parametrize("whole_ms", [False, True], ids=["continuous", "whole-ms"])
def test_the_guard_equal_to_the_nanosecond_without_processor_sharing(
    part: str, whole_ms: bool, jitter: bool
) -> None:
    compare(part, ("fifo", "priority"), whole_ms=whole_ms, orders=True, guarded=True, jitter=jitter)


@pytest.mark.usefixtures("_early_health")
def test_links_that_keep_order_with_the_guard_equal_to_the_nanosecond(part: str) -> None:
    compare(part, ("fifo", "priority"), whole_ms=True, orders=True, guarded=True, in_order=True)


@pytest.mark.usefixtures("_early_health")
def test_the_guard_equal_to_the_microsecond_with_processor_sharing(part: str) -> None:
    compare(part, EVERY, FAIR_TOLERANCE_NS, orders=True, guarded=True)


def test_cycles_are_stamped_as_decided() -> None:
    for seed in range(min(EXAMPLES, 100)):
        case = make_case(seed, EVERY)
        controller = case.problem.controller_node
        if any(change.down and change.node == controller for change in case.real.node_changes):
            continue
        pipeline = case.problem.pipeline
        late = pipeline.deadline_ms > pipeline.period_ms
        if late or pipeline.release_jitter_ms != Constant(0.0):
            continue  # an order comes after cycles that were released before the last deadline
        expected = [name for name in case.names for _ in range(case.problem.window_cycles)]
        assert play(case).cycles["placement"].to_list() == expected


# ------------------------------------------------------------------- the page, word by word


def task(
    name: str,
    ms: float,
    node: str = "R",
    *,
    threads: int = 1,
    accelerator: str | None = None,
    priority: int = 0,
    offset_ms: float = 0.0,
    start_ms: float = 0.0,
    workers: int = 1,
) -> Task:
    execution = Execution(Constant(ms), threads=threads, accelerator=accelerator, workers=workers)
    on = {node: execution}
    return Task(name, on, priority=priority, offset_ms=offset_ms, start_ms=start_ms)


def by_hand(
    nodes: Sequence[Node],
    tasks: Sequence[Task],
    flows: Sequence[Flow] = (),
    *,
    links: Sequence[Link] = (),
    changes: Sequence[NodeChange] = (),
    segments: Sequence[LinkSegment] = (),
    period_ms: float = 100,
    windows: int = 1,
) -> Case:
    controller = ControllerSettings(on=nodes[0].name)
    problem = make_problem(
        nodes, tasks, flows, links=links, period_ms=period_ms, controller=controller
    )
    real = make_realisation(problem, windows=windows, node_changes=changes, segments=segments)
    return Case(problem, real, ("LOC",) * windows)


FIFO = Node("R", "robot", scheduler="fifo")
PRIORITY = Node("R", "robot", scheduler="priority")
EDGE = Node("E", "edge")
UP = Link("R", "E", Constant(1))
DOWN = Link("E", "R", Constant(1))
RESTART = (NodeChange(0, "E", 0, True), NodeChange(2 * MS, "E", 0, False))
OUTAGE = (
    LinkSegment(0, "R->E", False, 0, 1000, ()),
    LinkSegment(int(2.5 * MS), "R->E", True, 0, 1000, ()),
)

BY_HAND = {
    "no flows": by_hand([FIFO], [task("A", 1)]),
    "hand-overs to two tasks, declared against the order of the tasks": by_hand(
        [FIFO],
        [task("A", 1), task("B", 2), task("C", 4)],
        [Flow("A", "C"), Flow("A", "B")],
    ),
    "hand-overs to two tasks on an accelerator": by_hand(
        [Node("R", "robot", accelerators={"gpu": 1})],
        [task("A", 1), task("B", 2, accelerator="gpu"), task("C", 4, accelerator="gpu")],
        [Flow("A", "C"), Flow("A", "B")],
    ),
    "a waiting job of the same task is ready before a hand-over": by_hand(
        [FIFO],
        [task("A", 10), task("B", 1)],
        [Flow("A", "B")],
        period_ms=5,
        windows=8,
    ),
    "two sources released at once, the second of higher priority": by_hand(
        [PRIORITY], [task("A", 3), task("B", 2, priority=1)]
    ),
    "a hand-over of higher priority than the next job of the same task": by_hand(
        [PRIORITY],
        [task("A", 10), task("B", 3, priority=1)],
        [Flow("A", "B")],
        period_ms=5,
        windows=8,
    ),
    "preempted at the instant at which it has its execution time": by_hand(
        [Node("R", "robot", cores=2, scheduler="priority")],
        [task("A", 4, priority=1), task("B", 4), task("C", 5, threads=2, priority=2)],
        [Flow("A", "C")],
    ),
    "a delayed source and a message at once": by_hand(
        [FIFO, Node("E", "edge")],
        [task("A", 7, "E"), task("B", 3, offset_ms=8), task("C", 4)],
        [Flow("A", "C")],
        links=[DOWN],
    ),
    "a message and a delayed source at once": by_hand(
        [FIFO, Node("E", "edge")],
        [task("A", 7, "E"), task("B", 3), task("C", 4, offset_ms=8)],
        [Flow("A", "B")],
        links=[DOWN],
    ),
    "a source starts at the instant at which a restarted worker is ready": by_hand(
        [FIFO, EDGE],
        [task("A", 3, "E", offset_ms=3, start_ms=11)],
        period_ms=10,
        windows=4,
        changes=RESTART,
    ),
    "a message arrives at the instant at which a restarted worker is ready": by_hand(
        [FIFO, EDGE],
        [task("A", 2), task("B", 3, "E", start_ms=11)],
        [Flow("A", "B")],
        links=[UP],
        period_ms=10,
        windows=4,
        changes=RESTART,
    ),
    "a message waits for its transmission when the link goes down": by_hand(
        [Node("R", "robot", cores=2), EDGE],
        [task("A", 1), task("B", 1), task("C", 1, "E"), task("D", 1, "E")],
        [Flow("A", "C", 250_000), Flow("B", "D", 250_000)],
        links=[replace(UP, rate_mbps=1000)],
        segments=OUTAGE,
    ),
    "a message would begin its transmission after the run": by_hand(
        [FIFO, EDGE],
        [task("A", 1), task("B", 1, "E")],
        [Flow("A", "B", 250_000)],
        links=[replace(UP, rate_mbps=100)],
        segments=[
            LinkSegment(0, "R->E", False, 0, 100, ()),
            LinkSegment(15 * MS, "R->E", True, 0, 100, ()),
        ],
        period_ms=10,
        windows=2,
    ),
    "a loss on a link after another loss": by_hand(
        [FIFO, EDGE, Node("F", "cloud")],
        [task("A", 1), task("B", 1, "E"), task("C", 1, "F"), task("D", 1, "F")],
        [Flow("A", "C", 250_000), Flow("A", "D", 250_000), Flow("A", "B")],
        links=[replace(UP, target="F", rate_mbps=1000), UP],
        segments=[
            LinkSegment(0, "R->F", False, 0, 1000, ()),
            LinkSegment(int(2.5 * MS), "R->F", True, 0, 1000, ()),
        ],
        changes=[NodeChange(0, "E", 0, True)],
    ),
    "an offset of a whole number": by_hand(
        [FIFO, EDGE],
        [task("A", 2, offset_ms=3), task("B", 3, "E", offset_ms=0)],
        [Flow("A", "B")],
        links=[UP],
    ),
    "a message waits for ever before another branch is lost": by_hand(
        [FIFO, EDGE, Node("F", "cloud")],
        [task("A", 1), task("B", 1, "E"), task("C", 10, "F"), task("D", 1, "F")],
        [Flow("A", "B"), Flow("C", "D")],
        links=[replace(UP, retransmit_ms=5.0)],
        segments=[LinkSegment(0, "R->E", True, 0, 1000, ())],
        changes=[NodeChange(3 * MS, "F", 0, True)],
    ),
    "messages wait for one that waits for ever before another branch is lost": by_hand(
        [FIFO, EDGE, Node("F", "cloud", cores=9)],
        [task("A", 1), task("B", 1, "E"), task("C", 30, "F", workers=9), task("D", 1, "F")],
        [Flow("A", "B"), Flow("C", "D")],
        links=[replace(UP, retransmit_ms=5.0, in_order=True)],
        segments=[
            LinkSegment(0, "R->E", False, 1.0, 1000, ()),
            LinkSegment(2 * MS, "R->E", False, 0, 1000, ()),
            LinkSegment(6 * MS, "R->E", True, 0, 1000, ()),
        ],
        changes=[NodeChange(20 * MS, "F", 0, True)],
        period_ms=2,
        windows=20,
    ),
    "an output is lost as another one makes a job take the place of one of its own cycle": by_hand(
        [FIFO, EDGE],
        [task("A", 1), replace(task("B", 25), depth=1), task("C", 1, "E")],
        [Flow("A", "B"), Flow("A", "C")],
        links=[replace(UP, loss=0.9)],
        period_ms=10,
        windows=8,
    ),
    "two jobs end within a nanosecond, against their order of events": by_hand(
        [Node("R", "robot", cores=3, scheduler="fifo", background=0.0625)],
        [
            task("A", 1),
            task("B", 0.999977, offset_ms=2.3e-5),
            task("C", 2, threads=2),
            task("D", 2),
            task("E", 9),
        ],
        [Flow("A", "C"), Flow("B", "D")],
    ),
    "the controller's node is down": by_hand(
        [EDGE, FIFO],
        [task("A", 1, "R"), task("B", 2, "E")],
        period_ms=10,
        windows=4,
        changes=[NodeChange(15 * MS, "E", 0, True), NodeChange(25 * MS, "E", 0, False)],
    ),
}


def test_a_message_that_waits_for_ever_is_the_first_loss_of_those_behind_it() -> None:
    found = play(BY_HAND["messages wait for one that waits for ever before another branch is lost"])
    # Message 0 is lost at 1 and would be sent again at 6; message 1 was sent at 3, message 2 at 5.
    assert found.cycles["outcome"].to_list()[:3] == ["in_flight"] * 3


@pytest.mark.parametrize("name", BY_HAND)
def test_equal_on_cases_made_by_hand(name: str) -> None:
    assert examine(BY_HAND[name], 0) == []


def test_an_own_job_begins_where_a_shadow_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim_arrays, "GIVEN_UP_AFTER", 0)
    monkeypatch.setattr(reference_simulator, "GIVEN_UP_AFTER", 0)
    both = {"E": Execution(Constant(1)), "R": Execution(Constant(250))}
    problem = make_problem(
        [FIFO, EDGE],
        [task("A", 10), Task("B", both), Task("C", {"E": Execution(Constant(1))})],
        [Flow("A", "B"), Flow("B", "C")],
        links=[UP],
        candidates={"OFF": {}, "LOC": {"B": "R"}},
    )
    case = Case(problem, make_realisation(problem, windows=6), ("OFF",) * 6)
    stamps, others = ["OFF"] * 6, ["LOC"] * 6
    found = play_stamped(case, case.real, stamps, others)
    result = simulate(problem, case.real, stamps, shadows=case.real, shadow_stamps=others)
    assert list(differences(case, found, result, 0)) == []


def test_attempts_draw_the_same_numbers() -> None:
    rng = Random(1)
    for _ in range(200):
        key, cycle, attempt = rng.getrandbits(64), rng.getrandbits(20), rng.getrandbits(6)
        assert kernel_uniform(key, cycle, attempt) == attempt_uniform(key, cycle, attempt)
