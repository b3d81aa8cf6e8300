"""Shadow jobs by hand, in milliseconds, and what an estimator is told about them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import dwell
from dwell.estimators import Evidence
from dwell.kernels.advance import play as advance_to_end
from dwell.kernels.arrays import lay_out
from dwell.kernels.codes import Status
from dwell.kernels.random_draws import draw_shadows
from dwell.kernels.realisation import NodeChange
from dwell.model import (
    AR1,
    Constant,
    ControllerSettings,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Normal,
    Problem,
    Process,
    QoS,
    Quota,
    Task,
    Uniform,
)
from dwell.model.shadow_plan import shadow_stamps
from tests.cells.generated import MS, Scheduler, make_problem, make_realisation
from tests.cells.many import many
from tests.reference.simulator import ITSELF, SHADOW, shadow_stamp, simulate
from tests.reference.test_against import (
    EXAMPLES,
    Case,
    Played,
    Probe,
    Replay,
    differences,
    make_case,
    play_stamped,
    random_shadow_stamps,
)

CANONICAL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
R, E = Node("R", "robot"), Node("E", "edge")
MOVES = {"LOC": {"B": "R"}, "OFF": {"B": "E"}}


def task(name: str, ms: float, *nodes: str, **more: Any) -> Task:
    return Task(name, {node: Execution(Constant(ms)) for node in nodes or ("R",)}, **more)


def cell(
    tasks: Sequence[Task],
    flows: Sequence[Flow],
    *,
    moves: Mapping[str, Mapping[str, str]] = MOVES,
    cores: int = 1,
    edge: Node = E,
    period_ms: float = 100,
    window_cycles: int = 1,
    **link: Any,
) -> Problem:
    """Return a problem on R and E with links of 1 ms in both directions."""
    return make_problem(
        [replace(R, cores=cores), edge],
        tasks,
        flows,
        links=[Link("R", "E", Constant(1), **link), Link("E", "R", Constant(1), **link)],
        candidates=moves,
        period_ms=period_ms,
        window_cycles=window_cycles,
        controller=ControllerSettings(on="R"),
    )


def play(
    problem: Problem,
    *,
    windows: int = 1,
    active: str = "LOC",
    others: Sequence[str | None] = ("OFF",),
    changes: Sequence[NodeChange] = (),
    exec_ms: dict[tuple[str, str], Sequence[float]] | None = None,
) -> Played:
    """Play cycles under `active` that are also sent through `others`, as the reference does."""
    real = make_realisation(problem, windows=windows, node_changes=changes)
    shadows = make_realisation(problem, windows=windows, exec_ms=exec_ms)
    case = Case(problem, real, (active,) * windows)
    stamps = [active] * real.cycles
    other = [others[k % len(others)] for k in range(real.cycles)]
    found = play_stamped(case, shadows, stamps, other)
    result = simulate(problem, real, stamps, shadows=shadows, shadow_stamps=other)
    assert list(differences(case, found, result, 0)) == []
    return found


def jobs(found: Played, *, shadow: bool, cycle: int = 0) -> dict[str, tuple[str, float, float]]:
    """Node, start and end of the jobs of a cycle or of its shadow, milliseconds."""
    mine = found.jobs.filter((pl.col("cycle") == cycle) & (pl.col("shadow") == shadow))
    return {
        row["task"]: (row["node"], row["start_ns"] / MS, row["end_ns"] / MS)
        for row in mine.iter_rows(named=True)
    }


def arrivals(found: Played, *, cell: int, cycle: int = 0) -> dict[str, float]:
    assert found.arrived is not None
    return {
        f"{source}->{target}": at_ns / MS
        for (whose, k, source, target), at_ns in found.arrived.items()
        if (whose, k) == (cell, cycle)
    }


def latencies(found: Played) -> list[float | None]:
    return [None if ns is None else ns / MS for ns in found.cycles["latency_ns"]]


# ----------------------------------------------------------------------------------- by hand


SIDE_BY_SIDE = cell(
    [task("S", 2), task("B", 4, "R", "E"), task("D", 10, "E"), task("K", 1)],
    [Flow("S", "B"), Flow("B", "K"), Flow("D", "K")],
)


def test_a_shadow_job_has_what_the_cycle_itself_leaves_of_the_cpu() -> None:
    # B' reaches E at 3 and stands still until D has its 10 ms.
    found = play(SIDE_BY_SIDE)
    assert jobs(found, shadow=True) == {"B": ("E", 3, 14)}
    assert jobs(found, shadow=False) == {
        "S": ("R", 0, 2),
        "B": ("R", 2, 6),
        "D": ("E", 0, 10),
        "K": ("R", 11, 12),
    }
    assert latencies(found) == latencies(play(SIDE_BY_SIDE, others=[None])) == [12]


def test_two_tasks_on_one_core_with_a_shadow() -> None:
    # R has 40 ms of every cycle for itself: B' goes on where it was when K has run.
    problem = cell(
        [task("A", 30), task("B", 30, "R", "E"), task("K", 1)],
        [Flow("A", "K"), Flow("B", "K")],
        period_ms=70,
    )
    found = play(problem, active="OFF", others=["LOC"])
    assert jobs(found, shadow=False) == {
        "A": ("R", 0, 30),
        "B": ("E", 0, 30),
        "K": ("R", 31, 32),
    }
    assert jobs(found, shadow=True) == {"B": ("R", 0, 61)}
    assert latencies(found) == [32]
    # As a placement, both run at half speed.
    assert latencies(play(problem, others=[None])) == [61]


STRESS = [NodeChange(0, "E", 1, False)]


def test_a_shadow_job_beside_a_stress_thread_is_as_slow_as_a_real_one() -> None:
    problem = cell(
        [task("S", 2), task("B", 4, "R", "E"), task("K", 1)], [Flow("S", "B"), Flow("B", "K")]
    )
    found = play(problem, changes=STRESS)
    assert jobs(found, shadow=True) == {"B": ("E", 3, 11)}
    assert jobs(play(problem, active="OFF", changes=STRESS), shadow=False)["B"] == ("E", 3, 11)


def test_a_shadow_job_shares_with_a_stress_thread_what_own_jobs_leave() -> None:
    # D has half of E until 20, as without B', which has a quarter: 4 ms from 3 to 19.
    found = play(SIDE_BY_SIDE, changes=STRESS)
    assert jobs(found, shadow=False)["D"] == ("E", 0, 20)
    assert jobs(found, shadow=True) == {"B": ("E", 3, 19)}


@pytest.mark.parametrize("scheduler", ["fifo", "priority"])
def test_an_own_job_takes_its_core_from_a_shadow_job_at_once(scheduler: Any) -> None:
    # B' runs from 3 on; D takes E from 6 to 10, whatever priority B' has, and B' keeps its 3 ms.
    problem = cell(
        [
            task("S", 2),
            task("B", 8, "R", "E", priority=9),
            task("D", 4, "E", offset_ms=6),
            task("K", 1),
        ],
        [Flow("S", "B"), Flow("B", "K"), Flow("D", "K")],
        edge=replace(E, scheduler=scheduler),
    )
    found = play(problem)
    assert jobs(found, shadow=False)["D"] == ("E", 6, 10)
    assert jobs(found, shadow=True) == {"B": ("E", 3, 15)}


@pytest.mark.parametrize(("ms", "ended"), [(4, 16), (6, 16), (8, 22)])
def test_a_shadow_job_uses_up_the_quota_of_own_jobs(ms: float, ended: float) -> None:
    # E has 10 ms of core time in every 20. B' is there from 3 on, D from 12 on for 4 ms: with 8 ms
    # of B' before, D is stopped at 14, until the next period.
    problem = cell(
        [task("S", 2), task("B", ms, "R", "E"), task("D", 4, "E", offset_ms=12), task("K", 1)],
        [Flow("S", "B"), Flow("B", "K"), Flow("D", "K")],
        edge=replace(E, quota=Quota(0.5, 20.0)),
    )
    found = play(problem)
    assert jobs(found, shadow=True) == {"B": ("E", 3, 3 + ms)}
    assert jobs(found, shadow=False)["D"] == ("E", 12, ended)


def on_accelerator(ms: float, *, offset_ms: float = 0.0) -> Problem:
    """Five tasks of 10 ms on one accelerator of E, of which B would be another, of `ms` there."""
    gpu = {"E": Execution(Constant(10), accelerator="gpu")}
    five = [Task(f"G{i}", gpu, offset_ms=offset_ms) for i in range(5)]
    on = {"R": Execution(Constant(4)), "E": Execution(Constant(ms), accelerator="gpu")}
    return cell(
        [task("S", 2), Task("B", on), task("K", 1), *five],
        [Flow("S", "B"), Flow("B", "K")],
        edge=replace(E, accelerators={"gpu": 1}),
        window_cycles=2,
    )


@pytest.mark.parametrize(
    ("ms", "offset_ms", "expected"),
    [
        # G0 to G4 run from 0 to 50 and again from 100: B' fits between them, or never begins.
        (50, 0, [(50, 100), (150, 200)]),
        (51, 0, [None, None]),
        # Until it is known that they come 30 ms after the release they count as due at once; from
        # then on B', which is there at 103, may end before they come.
        (20, 30, [(80, 100), (103, 123)]),
        (28, 30, [(80, 108), (180, 208)]),
    ],
)
def test_a_shadow_job_begins_on_an_accelerator_where_no_own_job_is_due(
    ms: float, offset_ms: float, expected: list[tuple[float, float] | None]
) -> None:
    found = play(on_accelerator(ms, offset_ms=offset_ms), windows=2)
    shadow = found.jobs.filter(pl.col("shadow") & (pl.col("cycle") < 2))
    times = [
        None if start is None or end is None else (start / MS, end / MS)
        for start, end in shadow.select("start_ns", "end_ns").rows()
    ]
    assert times == expected
    own = found.jobs.filter(~pl.col("shadow") & pl.col("task").cast(str).str.starts_with("G"))
    first = [offset_ms * MS + 100 * MS * k for k in range(4)]
    assert own["start_ns"].to_list() == [at + 10 * MS * i for at in first for i in range(5)]


def test_a_shadow_has_execution_times_of_its_own() -> None:
    # 6 ms instead of 4, from when D has ended.
    found = play(SIDE_BY_SIDE, exec_ms={("B", "E"): [6], ("B", "R"): [50], ("S", "R"): [50]})
    assert jobs(found, shadow=True) == {"B": ("E", 3, 16)}
    assert latencies(found) == [12]


def test_what_reaches_the_sink_of_a_shadow_is_discarded() -> None:
    # D is shared, and K is behind B: its input from D is sent a second time, too.
    found = play(SIDE_BY_SIDE)
    assert arrivals(found, cell=SHADOW) == {"S->B": 3, "B->K": 15, "D->K": 11}
    assert arrivals(found, cell=ITSELF) == {"S->B": 2, "B->K": 6, "D->K": 11}
    assert found.jobs.filter(pl.col("task") == "K")["shadow"].to_list() == [False]


ONE_LINK = cell(
    [task("S", 2), task("D", 1, "E"), task("B", 4, "R", "E"), task("K", 1, "E")],
    [Flow("S", "B", 8000), Flow("S", "D", 8000), Flow("B", "K"), Flow("D", "K")],
    rate_mbps=8,
    window_cycles=2,
)


def test_a_shadow_message_shares_the_rate_of_the_link() -> None:
    # 8000 bytes take 8 ms. S sends D its input first (2 to 10), then the shadow's (10 to 18); the
    # output of B waits behind it from 6 to 18. K goes before B' on E.
    found = play(ONE_LINK)
    assert arrivals(found, cell=ITSELF) == {"S->B": 2, "S->D": 11, "B->K": 19, "D->K": 12}
    assert arrivals(found, cell=SHADOW) == {"S->B": 19, "B->K": 24, "D->K": 12}
    assert jobs(found, shadow=True) == {"B": ("E", 19, 24)}
    assert latencies(found)[0] == 20
    assert latencies(play(ONE_LINK, others=[None]))[0] == 13


CHAIN = cell(
    [task("S", 1), task("A", 2, "R", "E"), task("B", 3, "R", "E"), task("K", 1)],
    [Flow("S", "A"), Flow("A", "B"), Flow("B", "K")],
    moves={
        "LOC": {"A": "R", "B": "R"},
        "LATE": {"A": "R", "B": "E"},
        "EARLY": {"A": "E", "B": "R"},
        "SAME": {"A": "R", "B": "R"},
    },
    cores=2,
)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ("LATE", {"B": ("E", 4, 7)}),
        # B of the shadow runs where the cycle's own does, but not on the same input.
        ("EARLY", {"A": ("E", 2, 4), "B": ("R", 5, 8)}),
        ("SAME", {}),
    ],
)
def test_a_shadow_shares_the_jobs_before_the_first_that_is_placed_elsewhere(
    other: str, expected: Mapping[str, tuple[str, float, float]]
) -> None:
    found = play(CHAIN, others=[other])
    assert jobs(found, shadow=True) == expected
    assert latencies(found) == [7]


def test_a_relocatable_source_of_a_shadow_starts_at_the_release_after_its_offset() -> None:
    problem = cell(
        [task("B", 3, "R", "E", offset_ms=2), task("K", 1)], [Flow("B", "K")], window_cycles=2
    )
    found = play(problem)
    assert [jobs(found, shadow=True, cycle=k)["B"] for k in (0, 1)] == [
        ("E", 2, 5),
        ("E", 102, 105),
    ]


def test_a_task_without_flows_has_no_shadow() -> None:
    found = play(cell([task("B", 3, "R", "E"), task("K", 1)], []))
    assert jobs(found, shadow=True) == {}


def test_shadow_workers_are_others_than_the_cycles_own() -> None:
    # One worker each. Under OFF the cycle's own B runs on E as the shadow of the one before does;
    # on two cores neither waits for the other.
    problem = cell(
        [task("S", 1), task("B", 15, "R", "E"), task("K", 1)],
        [Flow("S", "B"), Flow("B", "K")],
        period_ms=10,
        window_cycles=2,
    )
    problem = replace(
        problem,
        fabric=replace(problem.fabric, nodes={"R": R, "E": replace(E, cores=2)}),
    )
    real = make_realisation(problem, windows=1)
    case = Case(problem, real, ("LOC",))
    found = play_stamped(case, real, ["LOC", "OFF"], ["OFF", None])
    assert jobs(found, shadow=True) == {"B": ("E", 2, 17)}
    # S takes twice its 1 ms, as it shares R with the B of the cycle before.
    starts = found.jobs.filter((pl.col("task") == "B") & (pl.col("node") == "E"))["start_ns"]
    assert starts.to_list() == [2 * MS, 13 * MS]


def test_what_depends_on_a_lost_shared_job_is_lost_to_the_shadow() -> None:
    # A takes 25 ms every 10 and keeps the newest only; B' runs for the cycles that get through.
    problem = cell(
        [task("S", 1), task("A", 25, depth=1), task("B", 1, "R", "E"), task("K", 1)],
        [Flow("S", "A"), Flow("A", "B"), Flow("B", "K")],
        period_ms=10,
        window_cycles=12,
    )
    found = play(problem)
    ended = found.jobs.filter((pl.col("task") == "A") & (pl.col("outcome") == "done"))["cycle"]
    shadow = found.jobs.filter("shadow")
    assert 0 < len(ended) < 12
    assert shadow["cycle"].to_list() == ended.to_list()
    assert set(shadow["task"]) == {"B"}
    assert "replaced" in found.cycles["outcome"].to_list()


def test_a_crash_loses_the_half_of_a_join_that_a_shadow_has() -> None:
    # Inputs of B' arrive at 2 and at 6; E is down from 3 to 4. The cycle itself knows nothing of E.
    problem = cell(
        [task("S", 1), task("T", 5), task("B", 2, "R", "E"), task("K", 1)],
        [Flow("S", "B"), Flow("T", "B"), Flow("B", "K")],
        cores=2,
        window_cycles=2,
    )
    changes = [NodeChange(3 * MS, "E", 0, True), NodeChange(4 * MS, "E", 0, False)]
    found = play(problem, changes=changes)
    assert jobs(found, shadow=True) == {}
    assert arrivals(found, cell=SHADOW) == {"S->B": 2, "T->B": 6}
    assert jobs(found, shadow=True, cycle=1) == {"B": ("E", 106, 108)}
    assert latencies(found) == [8, 8]


def test_a_shadow_that_is_lost_costs_the_cycle_nothing() -> None:
    changes = [NodeChange(5 * MS, "E", 0, True), NodeChange(6 * MS, "E", 0, False)]
    problem = cell(
        [task("S", 2), task("B", 4, "R", "E"), task("K", 1)], [Flow("S", "B"), Flow("B", "K")]
    )
    found = play(problem, changes=changes)
    assert found.jobs.filter("shadow").select("task", "start_ns", "end_ns", "outcome").rows() == [
        ("B", 3 * MS, 5 * MS, "node_down")
    ]
    assert found.cycles["outcome"].to_list() == ["done"]
    assert latencies(found) == [7]
    assert found.windows["violation_rate"].to_list() == [0]


def test_more_shadows_than_cycles_may_be_in_flight() -> None:
    # B' takes 30 ms every 10: after 300 cycles two hundred of them wait; the cycles are done.
    problem = cell(
        [task("S", 1), task("B", 1, "R", "E"), task("K", 1)],
        [Flow("S", "B"), Flow("B", "K")],
        period_ms=10,
        window_cycles=300,
    )
    found = play(problem, exec_ms={("B", "E"): [30] * 300})
    outcomes = found.jobs.filter("shadow")["outcome"].value_counts()
    assert dict(outcomes.iter_rows()) == {"done": 99, "in_flight": 201}
    assert set(latencies(found)) == {3.0}


def test_a_shadow_is_given_up_after_a_window_and_64_cycles() -> None:
    # B' takes 30 ms every 10: of the first cycles 3 k + 3 periods have passed when it ends, so that
    # from cycle 36 on it is given up after 74.
    problem = cell(
        [task("S", 1), task("B", 1, "R", "E"), task("K", 1)],
        [Flow("S", "B"), Flow("B", "K")],
        period_ms=10,
        window_cycles=10,
    )
    found = play(problem, windows=20, exec_ms={("B", "E"): [30] * 200})
    shadow = found.jobs.filter("shadow")
    assert shadow.filter(pl.col("outcome") == "done")["cycle"].to_list() == list(range(36))
    assert set(shadow["outcome"]) == {"done", "in_flight"}
    assert set(latencies(found)) == {3.0}


def test_shadows_that_never_end_take_bounded_room() -> None:
    problem = cell(
        [task("S", 1), task("D", 10, "E"), task("B", 1, "R", "E"), task("K", 1)],
        [Flow("S", "B"), Flow("B", "K")],
        period_ms=10,
        window_cycles=10,
    )
    real = make_realisation(problem, windows=100)
    arrays = lay_out([(problem, real)], shadows=[real])
    arrays.tables.stamps[1] = 1
    assert advance_to_end(arrays) == Status.FINISHED
    assert arrays.tables.clock["n_slots"].tolist() == [128]


@pytest.mark.parametrize("schedulers", [("fair",), ("fifo",), ("priority",)], ids=str)
def test_own_jobs_run_as_without_shadows(schedulers: Sequence[Scheduler]) -> None:
    sent = 0
    for seed in range(EXAMPLES):
        case = without_shared_means(make_case(seed, schedulers, orders=True))
        shadows = draw_shadows(case.problem, case.real)
        stamps, others = random_shadow_stamps(Random(seed), case)
        with_shadows = play_stamped(case, shadows, stamps, others)
        without = play_stamped(case, shadows, stamps, [None] * len(others))
        own = with_shadows.jobs.filter(~pl.col("shadow"))
        sent += len(with_shadows.jobs) - len(own)
        assert own.equals(without.jobs), f"make_case({seed}, {schedulers}, orders=True)"
        assert with_shadows.cycles.equals(without.cycles)
        assert with_shadows.core_ns is not None
        assert without.core_ns is not None
        # Own work, and what is busy without it and the shadows': stress and background.
        assert np.array_equal(with_shadows.core_ns[:, :, 1], without.core_ns[:, :, 1])
    assert sent > EXAMPLES


def without_shared_means(case: Case) -> Case:
    """Draw a case again without quotas, accelerators, bytes and order on links."""
    fabric, pipeline = case.problem.fabric, case.problem.pipeline
    nodes = {
        name: replace(node, quota=None, background_beside=None)
        for name, node in fabric.nodes.items()
    }
    tasks = {
        name: replace(task, on={at: replace(on, accelerator=None) for at, on in task.on.items()})
        for name, task in pipeline.tasks.items()
    }
    links = {name: replace(link, in_order=False) for name, link in fabric.links.items()}
    flows = tuple(replace(flow, payload_bytes=0) for flow in pipeline.flows)
    problem = replace(
        case.problem,
        fabric=replace(fabric, nodes=nodes, links=links),
        pipeline=replace(pipeline, tasks=tasks, flows=flows),
    )
    seed, windows = case.real.seed or 0, case.real.windows
    real = dwell.draw(problem, scenario="disturbed", seed=seed, windows=windows)
    return replace(case, problem=problem, real=real)


# ------------------------------------------------------------------------------ what it costs


class Quiet:
    """An estimator that asks for shadow jobs and learns nothing from them."""

    shadow_fraction = 1.0

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Expect what was observed, whatever it is."""
        return {"LOC": observed, "OFF": observed}


@pytest.mark.parametrize("estimator", [Probe(1.0), Quiet()], ids=["learns", "does not learn"])
def test_the_columns_of_a_window_say_what_shadows_cost(estimator: Probe | Quiet) -> None:
    real = make_realisation(ONE_LINK, windows=3)
    run = dwell.simulate_realisation(ONE_LINK, real, policy="LOC", estimator=estimator)
    # B' needs its 8000 bytes on the link and 4 ms of E a cycle; its output stays on E.
    expected = {
        "shadow_cycles": [2] * 3,
        "shadow_bytes": [16_000] * 3,
        "shadow_R": [0.0] * 3,
        "shadow_E": [0.04] * 3,
    }
    columns = run.windows.select("^shadow_.*$").to_dict(as_series=False)
    assert columns.keys() == expected.keys()
    for name, values in expected.items():
        assert columns[name] == pytest.approx(values)
    # D, K and the shadow are busy on E, but only D and K are the cell's own work.
    assert run.windows["u_E"].to_list() == pytest.approx([0.06] * 3)
    if isinstance(estimator, Probe):
        assert estimator.own[0] == pytest.approx({"R": 0.06, "E": 0.02 + 0.04})


def test_a_shadow_on_an_accelerator_is_neither_own_work_nor_foreign_load() -> None:
    # B moves to the gpu of E, which D has for 30 ms of every 100.
    gpu = Execution(Constant(30), accelerator="gpu")
    tasks = [
        task("S", 2),
        Task("B", {"R": Execution(Constant(4)), "E": gpu}),
        task("K", 1),
        Task("D", {"E": gpu}),
    ]
    problem = make_problem(
        [R, replace(E, accelerators={"gpu": 1})],
        tasks,
        [Flow("S", "B"), Flow("B", "K")],
        links=[Link("R", "E", Constant(1)), Link("E", "R", Constant(1))],
        candidates={"LOC": {"B": "R"}, "OFF": {"B": "E"}},
        window_cycles=2,
        controller=ControllerSettings(on="R"),
    )
    probe = Probe(1.0)
    real = make_realisation(problem, windows=3)
    run = dwell.simulate_realisation(problem, real, policy="LOC", estimator=probe)
    assert run.windows["u_E.gpu"].to_list() == pytest.approx([0.6] * 3)
    assert run.windows["shadow_E.gpu"].to_list() == pytest.approx([0.3] * 3)
    assert run.windows["shadow_E"].to_list() == [0.0] * 3
    assert probe.own[0] == pytest.approx({"R": 0.07, "E": 0.0, "E.gpu": 0.6})


def test_what_is_no_foreign_load_is_told_apart_from_what_is() -> None:
    probe = Probe(1.0)
    disturbed = replace(
        ONE_LINK, scenarios={"disturbed": (NodeDisturbance("E", 0.0, 99.0, stress_threads=1),)}
    )
    real = dwell.draw(disturbed, scenario="disturbed", seed=1, windows=3)
    dwell.simulate_realisation(disturbed, real, policy="LOC", estimator=probe)
    for observed, own in zip(probe.observed, probe.own, strict=True):
        # E is busy all the time; 6 ms of every 100 are ours.
        assert observed.utilisation["E"] == pytest.approx(1.0)
        assert own["E"] == pytest.approx(0.06)


# ---------------------------------------------------------------------------------- which cycles


@given(
    first=st.integers(0, 10**6),
    active=st.integers(0, 3),
    candidates=st.integers(1, 4),
    share=st.floats(1e-6, 1),
)
def test_cycles_are_chosen_by_the_golden_ratio(
    first: int, active: int, candidates: int, share: float
) -> None:
    fraction = share / max(candidates - 1, 1)
    active = min(active, candidates - 1)
    names = [str(i) for i in range(candidates)]
    others = [i for i in range(candidates) if i != active]
    stamps = shadow_stamps(first, first + 50, others, fraction)
    expected = [shadow_stamp(k, names[active], names, fraction) for k in range(first, first + 50)]
    assert [None if i < 0 else names[i] for i in stamps] == expected


@given(
    first=st.integers(0, 10**6),
    length=st.integers(1, 500),
    fraction=st.floats(1e-6, 1 / 3),
)
def test_every_alternative_gets_its_fraction_of_any_stretch(
    first: int, length: int, fraction: float
) -> None:
    stamps = shadow_stamps(first, first + length, [0, 2, 3], fraction)
    assert 1 not in stamps
    for other in (0, 2, 3):
        # The discrepancy of the sequence grows with the logarithm of the length.
        bound = 2.0 + math.log2(length) / 4
        assert abs(int((stamps == other).sum()) - fraction * length) <= bound


def test_every_window_sends_its_fraction_through_every_alternative() -> None:
    problem = dwell.load(CANONICAL)
    probe = Probe(0.1)
    policy = Replay(["LOC", "SO", "SO", "HYB", "HYB", "LOC", "LOC", "LOC"])
    dwell.simulate(problem, policy=policy, estimator=probe, seed=1, windows=8)
    assert len(probe.evidence) >= 7
    for evidence in probe.evidence:
        active = set(evidence.placement.tolist())
        assert len(active) == 1
        sent = [int((evidence.shadow_placement == i).sum()) for i in range(3)]
        assert all(9 <= sent[i] <= 11 for i in {0, 1, 2} - active)
        assert not any(sent[i] for i in active)


# ------------------------------------------------------------------------------- what it draws


def test_a_shadow_draws_its_own_times_and_shares_what_belongs_to_cycle_and_fabric() -> None:
    tasks = [
        Task("S", {"R": Execution(Constant(2.0))}, scale="scene"),
        Task(
            "B",
            {"R": Execution(Constant(3.0)), "E": Execution(LogNormal(4, 0.3))},
            scale="scene",
        ),
        task("K", 1),
    ]
    problem = make_problem(
        [R, E],
        tasks,
        [Flow("S", "B"), Flow("B", "K")],
        links=[
            Link("R", "E", LogNormal(1, 0.3), loss=0.1),
            Link("E", "R", LogNormal(1, 0.3), loss=0.1),
        ],
        candidates=MOVES,
        release_jitter_ms=LogNormal(1, 0.3),
        scales={"scene": AR1(1.0, 0.2, 0.9)},
        scenario=[
            NodeDisturbance("E", 0.1, 0.5, stress_threads=2),
            LinkDisturbance("R", "E", 0.2, 0.5, add_delay_ms=LogNormal(5, 0.3)),
        ],
    )
    real = dwell.draw(problem, scenario="disturbed", seed=3, windows=40)
    shadow = draw_shadows(problem, real)
    assert (shadow.release_ns == real.release_ns).all()
    assert list(shadow.node_changes) == list(real.node_changes)
    assert list(shadow.link_segments) == list(real.link_segments)
    assert (shadow.sites, shadow.hops, shadow.layers) == (real.sites, real.hops, real.layers)
    for row, site in enumerate(real.sites):
        same = (shadow.exec_ns[row] == real.exec_ns[row]).all()
        # The scale is that of the cycle; only what was drawn for the job differs.
        assert same == (site != ("B", "E"))
    drawn, original = shadow.exec_ns[real.sites.index(("B", "E"))], real.exec_ns
    scale = original[real.sites.index(("B", "R"))] / (3 * MS)
    path = drawn / scale
    assert abs(np.corrcoef(path, scale)[0, 1]) < 0.5
    assert (shadow.delay_ns != real.delay_ns).mean() > 0.9
    assert (shadow.extra_ns != real.extra_ns).mean() > 0.9
    assert set(shadow.loss_keys.tolist()).isdisjoint(real.loss_keys.tolist())


# ------------------------------------------------------------------- what a window leaves behind


@pytest.mark.parametrize("delay_ms", [1.0, 9_000.0])
@pytest.mark.parametrize("grace_ms", [0.0, 700.0])
def test_evidence_is_the_same_with_and_without_a_log_of_all_jobs(
    delay_ms: float, grace_ms: float
) -> None:
    problem = cell(
        [task("S", 1), task("B", 30, "R", "E"), task("C", 20, "R", "E"), task("K", 1)],
        [Flow("S", "B"), Flow("B", "C"), Flow("C", "K")],
        moves={"LOC": {}, "OFF": {"B": "E"}, "FAR": {"B": "E", "C": "E"}},
        window_cycles=50,
    )
    links = {
        name: replace(link, delay_ms=LogNormal(delay_ms, 0.5))
        for name, link in problem.fabric.links.items()
    }
    problem = replace(
        problem,
        fabric=replace(problem.fabric, links=links),
        controller=replace(problem.controller, close_grace_ms=grace_ms),
    )
    found = []
    for jobs in (False, True):
        probe = Probe(0.2)
        policy = Replay(["OFF", "OFF", "FAR", "LOC", "OFF", "OFF", "FAR", "FAR", "LOC"])
        run = dwell.simulate(problem, policy=policy, estimator=probe, seed=1, windows=9, jobs=jobs)
        found.append((probe.evidence, run.windows, run.cycles))
    (some, *tables), (every, *same) = found
    assert len(some) == len(every) >= 7
    assert all(one.equals(other) for one, other in zip(tables, same, strict=True))
    for one, other in zip(some, every, strict=True):
        for of, expected in ((one.cycles, other.cycles), (one.shadows, other.shadows)):
            assert of is not None
            assert expected is not None
            for name in ("ready_ns", "start_ns", "end_ns", "work_ns", "arrived_ns"):
                np.testing.assert_array_equal(getattr(of, name), getattr(expected, name))


def test_evidence_of_a_pipeline_without_flows_where_cycles_pile_up() -> None:
    busy = Task("S", {"R": Execution(Constant(50_000.0), workers=200)})
    problem = make_problem([R], [busy], [], candidates={"LOC": {}}, period_ms=100, window_cycles=50)
    probe = Probe(0.0)
    dwell.simulate(problem, policy="LOC", estimator=probe, seed=1, windows=4)
    assert len(probe.evidence) == 4
    for window in probe.evidence:
        assert (window.cycles.ready_ns[:, 0] == window.release_ns).all()
        assert (window.cycles.end_ns == -1).all()
        assert window.cycles.arrived_ns.shape == (50, 0)


# ------------------------------------------------------------------------- drawn where needed

LONG_MS: dict[str, Process] = {
    "lognormal": LogNormal(10.0, 0.4),
    "normal": Normal(10.0, 2.0, 0.0),
    "uniform": Uniform(5.0, 15.0),
    "ar1": AR1(10.0, 0.4, 0.9),
}


def drawn_problem(process: Process, **more: Any) -> Problem:
    """B on E takes what a process says, times a scale that the cycle brings."""
    tasks = [
        task("S", 1),
        Task("B", {"R": Execution(Constant(3.0)), "E": Execution(process)}, scale="scene"),
        task("K", 1),
    ]
    links = [
        Link("R", "E", LogNormal(1, 0.3), loss=0.1),
        Link("E", "R", LogNormal(1, 0.3), loss=0.1),
    ]
    return make_problem(
        [R, E],
        tasks,
        [Flow("S", "B"), Flow("B", "K")],
        links=links,
        candidates=MOVES,
        scales={"scene": AR1(1.0, 0.2, 0.9)},
        scenario=[LinkDisturbance("R", "E", 0.2, 900.0, add_delay_ms=LogNormal(5, 0.3))],
        **more,
    )


@pytest.mark.parametrize("kind", LONG_MS)
def test_shadows_that_are_drawn_by_need_take_as_long_as_if_all_were(kind: str) -> None:
    problem = drawn_problem(LONG_MS[kind])
    real = dwell.draw(problem, scenario="disturbed", seed=3, windows=1_000)
    sent = np.arange(0, real.cycles, 5)
    whole, some = draw_shadows(problem, real), draw_shadows(problem, real, sent)
    scale = real.exec_ns[real.sites.index(("B", "R"))][sent] / (3 * MS)
    site = real.sites.index(("B", "E"))
    pairs = [(whole.exec_ns[site][sent] / scale, some.exec_ns[site][sent] / scale)]
    for name in ("delay_ns", "extra_ns"):
        pairs += zip(getattr(whole, name)[:, sent], getattr(some, name)[:, sent], strict=True)
    for expected, drawn in pairs:
        assert ks_distance(expected, drawn) < 2.0 * np.sqrt(2 / len(sent))
        assert not np.array_equal(expected, drawn)
    # A process with a memory has it between the cycles that are sent.
    first, then = (np.log(pairs[0][1][part]) for part in (slice(-1), slice(1, None)))
    memory = 0.9**5 if kind == "ar1" else 0.0
    assert np.corrcoef(first, then)[0, 1] == pytest.approx(memory, abs=0.15)


def ks_distance(one: NDArray[np.generic], other: NDArray[np.generic]) -> float:
    """Greatest distance between two empirical distributions."""
    every = np.concatenate((one, other))
    ranks = [np.searchsorted(np.sort(of), every, side="right") / len(of) for of in (one, other)]
    return float(np.abs(ranks[0] - ranks[1]).max())


def test_what_is_drawn_of_a_shadow_does_not_depend_on_probes() -> None:
    problem = drawn_problem(LogNormal(10.0, 0.4))
    real = dwell.draw(problem, scenario="disturbed", seed=3, windows=40)
    sent = np.arange(3, real.cycles, 7)
    rest = np.setdiff1d(np.arange(real.cycles), sent)
    alone, both = draw_shadows(problem, real, sent), draw_shadows(problem, real, sent, others=True)
    whole = draw_shadows(problem, real)
    for name in ("exec_ns", "delay_ns", "extra_ns"):
        mine, with_others, of_all = (getattr(of, name) for of in (alone, both, whole))
        np.testing.assert_array_equal(with_others[:, sent], mine[:, sent])
        np.testing.assert_array_equal(with_others[:, rest], of_all[:, rest])
        assert not mine[:, rest].any()
    assert (alone.loss_keys == whole.loss_keys).all()
    assert alone.release_ns is real.release_ns


# ---------------------------------------------------------------------- nothing else changes


TABLES = ("cycles", "windows", "decisions")


@pytest.mark.parametrize("seed", range(6))
def test_without_shadow_stamps_everything_is_as_without_a_shadow(seed: int) -> None:
    case = make_case(seed, ("fair", "fifo", "priority"), orders=True)
    names = list(case.problem.candidates)
    stamps = [Random(seed).choice(names)] * case.real.cycles
    shadows = draw_shadows(case.problem, case.real)
    found = play_stamped(case, shadows, stamps, [None] * case.real.cycles)
    plain = dwell.simulate_realisation(
        case.problem, case.real, policy=stamps[0], jobs=True, by_window=True
    )
    assert plain.jobs is not None
    assert found.jobs.drop("shadow").equals(plain.jobs)
    assert found.cycles.equals(plain.cycles)
    of_nodes = [name for name in plain.windows.columns if name.startswith("u_")]
    assert found.windows.select(of_nodes).equals(plain.windows.select(of_nodes))


def test_a_fraction_of_nothing_changes_nothing() -> None:
    # Cycle 0 is always sent through the first alternative, which is the same placement here.
    problem = dwell.load(CANONICAL)
    names = {"LOC": "LOC", "SAME": "LOC", "SO": "SO", "HYB": "HYB"}
    problem = replace(
        problem, candidates={name: problem.candidates[old] for name, old in names.items()}
    )
    runs = [
        dwell.simulate(
            problem, policy="LOC", estimator=Probe(fraction), seed=2, windows=8, jobs=True
        )
        for fraction in (0.0, 1e-9)
    ]
    plain, tiny = runs
    assert plain.jobs is not None
    assert tiny.jobs is not None
    assert "shadow" not in plain.jobs.columns
    assert not [name for name in plain.windows.columns if name.startswith("shadow_")]
    assert tiny.jobs.drop("shadow").equals(plain.jobs)
    assert not tiny.jobs["shadow"].any()
    assert tiny.cycles.equals(plain.cycles)
    assert tiny.windows.select(plain.windows.columns).equals(plain.windows)


def test_a_run_with_shadows_is_determined_by_its_seed() -> None:
    problem = dwell.load(CANONICAL)
    one, again, other = (
        dwell.simulate(problem, policy="dtp", estimator=Probe(0.2), seed=seed, windows=8, jobs=True)
        for seed in (5, 5, 6)
    )
    for name in (*TABLES, "jobs"):
        assert getattr(one, name).equals(getattr(again, name)), name
    assert one.jobs is not None
    assert other.jobs is not None
    assert one.jobs["shadow"].any()
    assert not one.jobs.equals(other.jobs)


# ----------------------------------------------------------------------------------- evidence


SETTINGS: dict[str, dict[str, Any]] = {
    "plain": {},
    "orders take time": {"order_delay_ms": 250.0, "order_lead_cycles": 2},
    "grace": {"close_grace_ms": 2.0},
    "grace and cold": {"close_grace_ms": 2.0, "migration": "cold"},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_evidence_is_what_the_jobs_had_done_when_the_window_closed(name: str) -> None:
    problem = dwell.load(CANONICAL)
    problem = replace(problem, controller=replace(problem.controller, **SETTINGS[name]))
    probe = Probe(0.2)
    policy = Replay(["SO", "SO", "HYB", "LOC", "LOC", "HYB", *["LOC"] * 6])
    run = dwell.simulate(
        problem,
        scenario="edge-cpu-stress",
        policy=policy,
        estimator=probe,
        seed=4,
        windows=12,
        jobs=True,
    )
    assert len(probe.evidence) == len(run.windows) >= 5
    assert run.jobs is not None
    assert run.windows["placement"].n_unique() == 3
    first = run.windows["first_cycle"].to_list()
    gap = any(b - a != problem.window_cycles for a, b in itertools.pairwise(first))
    assert gap == (name != "plain" or problem.controller.order_delay_ms > 0)
    rows = {(k, t, s): row for k, t, s, *row in _instants(run.jobs)}
    unknown = 0
    for begin, evidence in zip(first, probe.evidence, strict=True):
        unknown += _check(problem, begin, evidence, rows)
        stop = begin + problem.window_cycles
        cycles = run.cycles[begin:stop]
        assert evidence.release_ns.tolist() == cycles["release_ns"].to_list()
        names = list(problem.candidates)
        assert [names[i] for i in evidence.placement] == cycles["placement"].to_list()
    assert unknown > 0


def _instants(jobs: pl.DataFrame) -> list[tuple[Any, ...]]:
    columns = ("cycle", "task", "shadow", "node", "ready_ns", "start_ns", "end_ns", "outcome")
    return jobs.select(columns).rows()


def _check(
    problem: Problem,
    begin: int,
    evidence: Evidence,
    rows: Mapping[tuple[int, str, bool], Sequence[Any]],
) -> int:
    """Compare a window's evidence with the jobs; return how many instants were not known yet."""
    unknown = 0
    close = evidence.close_ns
    for row, k in enumerate(range(begin, begin + problem.window_cycles)):
        for shadow, instants in ((False, evidence.cycles), (True, evidence.shadows)):
            assert instants is not None
            assert instants.start_ns is not None
            assert instants.work_ns is not None
            of = instants.ready_ns, instants.start_ns, instants.end_ns
            for column, name in enumerate(problem.pipeline.tasks):
                nothing = (None, None, None, None, "")
                _, ready, start, end, outcome = rows.get((k, name, shadow), nothing)
                known = [
                    -1 if ns is None or ns > close or not counts else ns
                    for ns, counts in ((ready, True), (start, True), (end, outcome == "done"))
                ]
                assert [table[row, column] for table in of] == known
                assert (instants.work_ns[row, column] < 0) == (known[-1] < 0)
                unknown += (end or 0) > close
            for column, flow in enumerate(problem.pipeline.flows):
                arrived = instants.arrived_ns[row, column]
                assert arrived <= close
                # These inputs are the only ones of their tasks: a job is ready when one arrives.
                _, ready, *_ = rows.get((k, flow.target, shadow), (None, None))
                if ready is not None and ready <= close:
                    assert arrived == ready
                assert ready is not None or shadow or arrived < 0
        if evidence.shadow_placement[row] < 0:
            assert evidence.shadows is not None
            assert (evidence.shadows.ready_ns[row] < 0).all()
            assert (evidence.shadows.arrived_ns[row] < 0).all()
    return unknown


@pytest.mark.parametrize("candidates", [21, 22, 100])
def test_of_many_candidates_every_one_is_measured(candidates: int) -> None:
    problem = many(candidates)
    run = dwell.simulate(problem, policy="dtp", seed=1, windows=4)
    names = list(problem.candidates)
    assert run.windows["shadow_cycles"].to_list() == [candidates] * 4
    last = run.decisions.row(-1, named=True)
    assert all(last[f"est_l95_ms_{name}"] > 0 for name in names)
    assert all(last[f"est_samples_{name}"] > 0 for name in names)
    assert all(last[f"est_age_windows_{name}"] < 4 for name in names)
