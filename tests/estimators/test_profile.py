"""Profile against closed forms and against Monte Carlo of its own.

Windows are long where a quantile has a closed form: the mean of the L95 of short ones is another
number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dwell.errors import MetricError, ProblemError
from dwell.estimators import Profile
from dwell.model import (
    AR1,
    Caps,
    Constant,
    Execution,
    Exponential,
    Flow,
    Link,
    LogNormal,
    Node,
    Problem,
    Process,
    QoS,
    Quota,
    Task,
    Trace,
    TraceTable,
    Uniform,
)
from tests.cells.generated import make_problem

R1, E, R2 = Node("R1", "robot", 4), Node("E", "edge", 8), Node("R2", "robot", 4)


def fixed(ms: float, threads: int = 1, accelerator: str | None = None) -> Execution:
    return Execution(Constant(ms), threads=threads, accelerator=accelerator)


#: Cycles of a long window.
LONG = 4000


def chain(
    *stages: Process,
    deadline_ms: float | None = None,
    period_ms: float = 1000.0,
    window_cycles: int = LONG,
) -> Problem:
    """One task after another on one node, without any message."""
    tasks = [Task(f"T{i}", {"R1": Execution(stage)}) for i, stage in enumerate(stages)]
    flows = [Flow(f"T{i}", f"T{i + 1}") for i in range(len(stages) - 1)]
    return make_problem(
        [R1],
        tasks,
        flows,
        period_ms=period_ms,
        deadline_ms=deadline_ms,
        window_cycles=window_cycles,
    )


def across(
    link: Link, *, payload_bytes: int = 0, deadline_ms: float = 100.0, window_cycles: int = LONG
) -> Problem:
    """Two tasks of 1 ms on R1; in SO the second is on E, behind the link."""
    return make_problem(
        [R1, E],
        [Task("A", {"R1": fixed(1.0)}), Task("B", {"R1": fixed(1.0), "E": fixed(1.0)})],
        [Flow("A", "B", payload_bytes)],
        links=[link],
        candidates={"LOC": {}, "SO": {"B": "E"}},
        period_ms=100.0,
        deadline_ms=deadline_ms,
        window_cycles=window_cycles,
    )


def seen(**utilisation: float) -> QoS:
    return QoS(1.0, 0.0, utilisation)


# ----------------------------------------------------------------------------------- constants


def test_constants_by_hand() -> None:
    tasks = [
        Task("sensing", {"R1": fixed(3)}),
        Task("perception", {"R1": fixed(18), "E": fixed(6)}),
        Task("planning", {"R2": fixed(9), "E": fixed(4)}),
        Task("control", {"R2": fixed(2)}),
    ]
    flows = [
        Flow("sensing", "perception", 60_000),
        Flow("perception", "planning", 2_000),
        Flow("planning", "control", 500),
    ]
    pairs = [(a.name, b.name) for a in (R1, E, R2) for b in (R1, E, R2) if a is not b]
    links = [Link(a, b, Constant(0.5), rate_mbps=100.0) for a, b in pairs]
    problem = make_problem(
        [R1, E, R2],
        tasks,
        flows,
        links=links,
        candidates={
            "LOC": {},
            "SO": {"perception": "E", "planning": "E"},
            "HYB": {"perception": "E"},
        },
        period_ms=40.0,
        deadline_ms=25.0,
    )
    profile = Profile(problem, samples=50)
    # 60 kB at 100 Mbit/s take 4.8 ms, 2 kB 0.16 ms, 500 B 0.04 ms.
    assert profile.l95_ms == {
        "LOC": pytest.approx(3 + 18 + 0.66 + 9 + 2, abs=1e-6),
        "SO": pytest.approx(3 + 5.3 + 6 + 4 + 0.54 + 2, abs=1e-6),
        "HYB": pytest.approx(3 + 5.3 + 6 + 0.66 + 9 + 2, abs=1e-6),
    }
    assert profile.violation_rate == {"LOC": 1.0, "SO": 0.0, "HYB": 1.0}
    assert profile.own["LOC"] == {
        "R1": pytest.approx(21 / 160),
        "E": 0.0,
        "R2": pytest.approx(11 / 160),
    }
    assert profile.own["SO"] == {
        "R1": pytest.approx(3 / 160),
        "E": pytest.approx(10 / 320),
        "R2": pytest.approx(2 / 160),
    }


def test_a_latency_equal_to_the_deadline_is_met() -> None:
    # In binary floating point 0.1 + 0.2 is more than 0.3.
    stages = (Constant(0.1), Constant(0.2))
    met = Profile(chain(*stages, period_ms=1.0, deadline_ms=0.3), samples=5)
    assert met.violation_rate == {"LOC": 0.0}
    missed = Profile(chain(*stages, period_ms=1.0, deadline_ms=0.299999), samples=5)
    assert missed.violation_rate == {"LOC": 1.0}


def test_a_fan_in_takes_the_longest_branch_and_sources_their_offset() -> None:
    tasks = [
        Task("camera", {"R1": fixed(5)}),
        Task("lidar", {"R1": fixed(4)}, offset_ms=7.0),
        Task("fuse", {"R1": fixed(2)}),
        Task("log", {"R1": fixed(30)}),
    ]
    flows = [Flow("camera", "fuse"), Flow("lidar", "fuse")]
    # `log` is source and sink at once; the last sink ends the cycle.
    problem = make_problem([R1], tasks, flows)
    assert Profile(problem, samples=3).l95_ms == {"LOC": 30.0}
    shorter = make_problem([R1], tasks[:3], flows)
    assert Profile(shorter, samples=3).l95_ms == {"LOC": 7 + 4 + 2}


def test_one_task_alone() -> None:
    assert Profile(chain(Constant(7.0)), samples=1).l95_ms == {"LOC": 7.0}


# ---------------------------------------------------------------------------------- randomness


def test_the_quantile_of_a_sum_of_two_exponentials() -> None:
    profile = Profile(chain(Exponential(10.0), Exponential(10.0)), samples=200_000)
    closed = stats.gamma.ppf(0.95, 2, scale=10.0)
    assert profile.l95_ms["LOC"] == pytest.approx(closed, rel=0.01)


def test_percentiles_are_never_added() -> None:
    profile = Profile(chain(Exponential(10.0), Exponential(10.0)), samples=20_000)
    added = 2 * stats.expon.ppf(0.95, scale=10.0)
    assert profile.l95_ms["LOC"] < 0.85 * added


def test_the_quantile_of_a_fan_in_of_exponentials() -> None:
    tasks = [Task(name, {"R1": Execution(Exponential(10.0))}) for name in "ABC"]
    problem = make_problem([R1], tasks, period_ms=1000.0, window_cycles=LONG)
    # The maximum of three is below x with probability (1 - exp(-x / 10))^3.
    closed = -10 * math.log(1 - 0.95 ** (1 / 3))
    profile = Profile(problem, samples=200_000)
    assert profile.l95_ms["LOC"] == pytest.approx(closed, rel=0.01)


def test_violations_of_an_exponential() -> None:
    profile = Profile(chain(Exponential(10.0), deadline_ms=20.0), samples=200_000)
    assert profile.violation_rate["LOC"] == pytest.approx(math.exp(-2), rel=0.03)


def test_a_dag_against_monte_carlo_of_its_own() -> None:
    link = Link("R1", "E", LogNormal(2.0, 0.5), rate_mbps=80.0)
    back = Link("E", "R1", Uniform(0.5, 1.5), rate_mbps=80.0)
    problem = make_problem(
        [R1, E],
        [
            Task("A", {"R1": Execution(LogNormal(3.0, 0.3))}, scale="scene"),
            Task("B", {"R1": Execution(Exponential(8.0))}, scale="scene"),
            Task("C", {"E": Execution(Uniform(1.0, 3.0))}),
            Task("D", {"R1": fixed(2.0)}),
        ],
        [Flow("A", "B"), Flow("A", "C", 20_000), Flow("B", "D"), Flow("C", "D", 1_000)],
        links=[link, back],
        scales={"scene": AR1(1.0, 0.4, 0.9)},
        # Cycles do not overlap.
        period_ms=1000.0,
        deadline_ms=100.0,
        window_cycles=LONG,
    )
    rng = np.random.default_rng(99)
    n = 200_000
    sigma, sigma_d, sigma_s = (math.sqrt(math.log(1 + cv**2)) for cv in (0.3, 0.5, 0.4))
    scene = rng.lognormal(-(sigma_s**2) / 2, sigma_s, n)
    a = rng.lognormal(math.log(3) - sigma**2 / 2, sigma, n) * scene
    b = rng.exponential(8.0, n) * scene
    delay = rng.lognormal(math.log(2) - sigma_d**2 / 2, sigma_d, n)
    there = a + 2.0 + delay + rng.uniform(1, 3, n) + 0.1 + rng.uniform(0.5, 1.5, n)
    latency = np.maximum(a + b, there) + 2.0
    profile = Profile(problem, samples=200_000)
    assert profile.l95_ms["LOC"] == pytest.approx(np.quantile(latency, 0.95), rel=0.015)
    assert profile.violation_rate["LOC"] == pytest.approx((latency > 100).mean(), abs=1e-3)


def test_scales_are_shared_by_the_tasks_that_name_them() -> None:
    tasks = [Task(name, {"R1": fixed(10.0)}, scale="scene") for name in "AB"]
    flows = [Flow("A", "B")]
    scene = {"scene": Uniform(0.0, 2.0)}
    problem = make_problem([R1], tasks, flows, scales=scene, window_cycles=LONG)
    # 20 * U(0, 2), and not the sum of two independent uniforms.
    profile = Profile(problem, samples=100_000)
    assert profile.l95_ms["LOC"] == pytest.approx(38.0, rel=0.01)


def test_columns_of_one_trace_share_their_rows() -> None:
    table = TraceTable("rows.csv", {"a": np.arange(100.0), "b": 99.0 - np.arange(100.0)})
    together = chain(Trace(table, "a"), Trace(table, "b"))
    assert Profile(together, samples=1000).l95_ms == {"LOC": 99.0}
    other = TraceTable("other.csv", {"b": 99.0 - np.arange(100.0)})
    # A file of its own begins at a row of its own.
    apart = chain(Trace(table, "a"), Trace(other, "b"))
    assert Profile(apart, samples=1000).l95_ms["LOC"] != 99.0


def test_a_scale_from_the_same_trace_has_the_mean_of_the_product() -> None:
    table = TraceTable("rows.csv", {"a": np.array([1.0, 3.0]), "s": np.array([1.0, 2.0])})
    problem = make_problem(
        [R1],
        [Task("A", {"R1": Execution(Trace(table, "a"))}, scale="scene")],
        scales={"scene": Trace(table, "s")},
        window_cycles=10,
    )
    assert Profile(problem, samples=100).own["LOC"]["R1"] == pytest.approx(3.5 / 400)


def test_the_sample_cycles_are_fixed() -> None:
    problem = chain(Exponential(10.0), LogNormal(5.0, 0.5))
    one, other = Profile(problem), Profile(problem)
    assert (one.l95_ms, one.violation_rate) == (other.l95_ms, other.violation_rate)
    assert Profile(problem, seed=5).l95_ms != one.l95_ms


def test_candidates_share_their_draws() -> None:
    stage = LogNormal(10.0, 0.5)
    problem = make_problem(
        [R1, E],
        [Task("A", {"R1": Execution(stage)}), Task("B", {"R1": fixed(1.0), "E": fixed(2.0)})],
        candidates={"LOC": {}, "SO": {"B": "E"}},
    )
    # B is never the longest branch, wherever it runs.
    profile = Profile(problem, samples=500)
    assert profile.l95_ms["LOC"] == profile.l95_ms["SO"]


def test_adding_a_task_shifts_nobody_elses_draws() -> None:
    first = Task("A", {"R1": Execution(Exponential(10.0))})
    early = Task("0", {"R1": Execution(Uniform(0.0, 1e-9))})
    alone = Profile(make_problem([R1], [first]), samples=500)
    behind = Profile(make_problem([R1], [early, first]), samples=500)
    assert alone.l95_ms == behind.l95_ms


# --------------------------------------------------------------------------------------- nodes


@pytest.mark.parametrize(
    ("node", "threads", "accelerator", "expected_ms", "own"),
    [
        (Node("R1", "robot", 4), 2, None, 10.0, 10 * 2 / 400),
        (Node("R1", "robot", 4), 4, None, 10.0, 10 * 4 / 400),
        (Node("R1", "robot", 4), 8, None, 20.0, 10 * 8 / 400),
        (Node("R1", "robot", 1), 3, None, 30.0, 10 * 3 / 100),
        (Node("R1", "robot", 4, "fifo"), 8, None, 20.0, 10 * 8 / 400),
        (Node("R1", "robot", 4, "priority", background=1.0), 2, None, 13.333334, 10 * 2 / 400),
        (Node("R1", "robot", 4, "priority", background=1.0), 8, None, 26.666667, 10 * 8 / 400),
        (Node("R1", "robot", 4, accelerators={"gpu": 1}), 8, "gpu", 10.0, 0.0),
    ],
)
def test_jobs_wider_than_their_node(
    node: Node, threads: int, accelerator: str | None, expected_ms: float, own: float
) -> None:
    problem = make_problem([node], [Task("A", {"R1": fixed(10.0, threads, accelerator)})])
    profile = Profile(problem, samples=10)
    assert profile.l95_ms["LOC"] == pytest.approx(expected_ms, abs=1e-6)
    assert profile.own["LOC"]["R1"] == pytest.approx(own)


def on_gpu(count: int = 1) -> Problem:
    """Return a task of 30 ms that may run on the gpu of E, beside one that always does."""
    nodes = [R1, Node("E", "edge", accelerators={"gpu": count})]
    gpu = fixed(30.0, 4, "gpu")
    tasks = [Task("A", {"R1": fixed(10.0), "E": gpu}), Task("B", {"E": gpu})]
    return make_problem(nodes, tasks, candidates={"LOC": {"A": "R1"}, "OFF": {"A": "E"}})


@pytest.mark.parametrize("count", [1, 2])
def test_own_work_on_an_accelerator_is_by_its_places(count: int) -> None:
    own = Profile(on_gpu(count), samples=10).own
    assert [own[name]["E.gpu"] for name in ("LOC", "OFF")] == [0.3 / count, 0.6 / count]
    assert [own[name]["E"] for name in ("LOC", "OFF")] == [0.0, 0.0]


def test_foreign_load_of_an_accelerator_is_what_is_not_own() -> None:
    profile = Profile(on_gpu(), samples=10)
    seen = QoS(50.0, 0.0, {"R1": 0.1, "E": 0.0, "E.gpu": 0.5})
    own = {"R1": 0.1, "E": 0.0, "E.gpu": 0.3}
    estimates = profile.estimate(observed=seen, incumbent="LOC", own=own)
    assert estimates["OFF"].utilisation["E.gpu"] == pytest.approx(0.2 + 0.6)


@pytest.mark.parametrize("known", [("used",), ("own",), ()])
def test_an_accelerator_that_was_not_measured_is_in_no_estimate(known: tuple[str, ...]) -> None:
    profile = Profile(on_gpu(), samples=10)
    nodes = {"R1": 0.1, "E": 0.0}
    used, own = ({**nodes, "E.gpu": 0.3} if one in known else nodes for one in ("used", "own"))
    estimates = profile.estimate(observed=QoS(50.0, 0.0, used), incumbent="LOC", own=own)
    assert all(tuple(one.utilisation) == ("R1", "E") for one in estimates.values())


@pytest.mark.parametrize(
    ("exec_ms", "threads", "expected_ms"),
    [
        # 1.6 ms of one core in every 4 ms.
        (1.0, 1, 1.0),
        (1.6, 1, 1.6),
        (1.7, 1, 4.1),
        (3.2, 1, 5.6),
        (18.0, 1, 11 * 4 + 0.4),
        # Two threads empty the bucket twice as fast.
        (0.8, 2, 0.8),
        (1.0, 2, 4.2),
    ],
)
def test_jobs_under_a_quota(exec_ms: float, threads: int, expected_ms: float) -> None:
    node = Node("R1", "robot", 4, quota=Quota(0.4, 4.0))
    problem = make_problem([node], [Task("A", {"R1": fixed(exec_ms, threads)})])
    profile = Profile(problem, samples=10)
    assert profile.l95_ms["LOC"] == pytest.approx(expected_ms, abs=1e-6)
    # Utilisation is relative to the quota: 0.4 of a core, over a period of 100 ms.
    assert profile.own["LOC"]["R1"] == pytest.approx(exec_ms * threads / (100 * 0.4))


def test_a_quota_that_is_wide_enough_changes_nothing() -> None:
    node = Node("R1", "robot", 4, quota=Quota(2.0, 4.0))
    problem = make_problem([node], [Task("A", {"R1": fixed(18.0, 2)})])
    assert Profile(problem, samples=10).l95_ms["LOC"] == 18.0


# --------------------------------------------------------------------------------------- links


def test_a_lost_message_is_a_latency_at_the_bound() -> None:
    problem = across(Link("R1", "E", Constant(1.0), loss=0.1), deadline_ms=20.0)
    profile = Profile(problem, samples=100_000)
    assert profile.l95_ms == {"LOC": 2.0, "SO": 200.0}
    assert profile.uncut_l95_ms == {"LOC": 2.0, "SO": math.inf}
    assert profile.violation_rate["LOC"] == 0.0
    assert profile.violation_rate["SO"] == pytest.approx(0.1, abs=0.005)
    rare = across(Link("R1", "E", Constant(1.0), loss=0.02), deadline_ms=20.0)
    assert Profile(rare, samples=100_000).l95_ms["SO"] == 3.0


@pytest.mark.parametrize("window_cycles", [100, 400])
@pytest.mark.parametrize(
    ("deadline_ms", "cap_ms", "bound"),
    [
        (20.0, math.inf, 200.0),
        (60.0, math.inf, 240.0),
        (60.0, 300.0, 300.0),
        (60.0, 300.0000004, 300.0),
        (60.0, 9.0, 240.0),
    ],
)
def test_the_bound_is_four_deadlines_two_periods_or_the_cap(
    window_cycles: int, deadline_ms: float, cap_ms: float, bound: float
) -> None:
    link = Link("R1", "E", Constant(1.0), loss=0.5)
    problem = across(link, deadline_ms=deadline_ms, window_cycles=window_cycles)
    problem = replace(problem, objective=replace(problem.objective, caps=Caps(latency_ms=cap_ms)))
    assert problem.censor_ms == bound
    assert Profile(problem, samples=100).l95_ms["SO"] == bound


def test_what_is_cut_is_known_uncut() -> None:
    slow = across(Link("R1", "E", Constant(500.0)), deadline_ms=60.0)
    profile = Profile(slow, samples=100)
    assert (profile.l95_ms["SO"], profile.uncut_l95_ms["SO"]) == (240.0, 502.0)
    observed = QoS(1.0, 0.0, {"R1": 0.0, "E": 0.0})
    estimates = profile.estimate(observed=observed, incumbent="LOC", own={"R1": 0.0, "E": 0.0})
    assert (estimates["SO"].l95_ms, estimates["SO"].uncut_l95_ms) == (240.0, 502.0)
    assert estimates["LOC"].cut_from_ms is None


def test_retransmission_by_hand() -> None:
    # 12 500 bytes at 100 Mbit/s take 1 ms; every failure costs that once more, and 20 ms.
    link = Link("R1", "E", Constant(0.5), rate_mbps=100.0, loss=0.2, retransmit_ms=20.0)
    problem = across(link, payload_bytes=12_500, deadline_ms=100.0)
    profile = Profile(problem, samples=200_000)
    # P(attempts > 1) = 0.2, P(> 2) = 0.04: the 95th percentile has one failure.
    assert profile.l95_ms["SO"] == pytest.approx(1 + 1.5 + 21 + 1)
    # 3.5 + 21 k > 100 from five failures on.
    assert profile.violation_rate["SO"] == pytest.approx(0.2**5, rel=0.25)


# --------------------------------------------------------------------------------- utilisation

BUSY = make_problem(
    [Node("R1", "robot", 1), Node("E", "edge", 2)],
    [Task("A", {"R1": fixed(10.0)}), Task("B", {"R1": fixed(40.0), "E": fixed(20.0)})],
    candidates={"LOC": {}, "SO": {"B": "E"}},
    links=[Link("R1", "E", Constant(1.0))],
)


@pytest.mark.parametrize(
    ("used", "own", "loc", "so"),
    [
        ({"R1": 0.5, "E": 0.0}, {"R1": 0.5, "E": 0.0}, (0.5, 0.0), (0.1, 0.1)),
        ({"R1": 0.75, "E": 0.25}, {"R1": 0.5, "E": 0.0}, (0.75, 0.25), (0.35, 0.35)),
        ({"R1": 1.0, "E": 1.0}, {"R1": 0.1, "E": 0.0}, (1.0, 1.0), (1.0, 1.0)),
        # More own work than was seen is no foreign load, and not less than none.
        ({"R1": 0.1, "E": 0.0}, {"R1": 0.5, "E": 0.3}, (0.5, 0.0), (0.1, 0.1)),
    ],
)
def test_foreign_load_stays_where_it_is(
    used: Mapping[str, float],
    own: Mapping[str, float],
    loc: tuple[float, float],
    so: tuple[float, float],
) -> None:
    estimates = Profile(BUSY, samples=10).estimate(observed=seen(**used), incumbent="LOC", own=own)
    assert list(estimates) == ["LOC", "SO"]
    for name, expected in [("LOC", loc), ("SO", so)]:
        shares = estimates[name].utilisation
        assert (shares["R1"], shares["E"]) == pytest.approx(expected)


def test_the_work_that_is_done_is_whatever_it_is_said_to_be() -> None:
    profile = Profile(BUSY, samples=10)
    work = [("SO", [("R1", 0.2), ("E", 0.9)])]
    shares = profile.with_work(
        profile.see(seen(R1=0.75, E=0.25), "LOC", {"R1": 0.5, "E": 0.0}), work
    )
    assert shares == {"SO": {"R1": pytest.approx(0.45), "E": 1.0}}


@given(*[st.floats(0, 2)] * 4)
def test_estimated_utilisation_is_a_share(r1: float, e: float, own_r1: float, own_e: float) -> None:
    own = {"R1": own_r1, "E": own_e}
    estimates = PROFILE.estimate(observed=seen(R1=r1, E=e), incumbent="SO", own=own)
    for name, qos in estimates.items():
        assert all(0 <= share <= 1 for share in qos.utilisation.values())
        assert all(qos.utilisation[n] >= PROFILE.own[name][n] for n in ("R1", "E"))
        assert qos.l95_ms == PROFILE.l95_ms[name]
        assert qos.violation_rate == PROFILE.violation_rate[name]


PROFILE = Profile(BUSY, samples=10)


def test_more_nodes_than_the_fabrics_are_ignored() -> None:
    more = PROFILE.estimate(
        observed=seen(R1=0.5, E=0.5, laptop=1.0), incumbent="LOC", own={"R1": 0.0, "E": 0.0}
    )
    assert set(more["LOC"].utilisation) == {"R1", "E"}


# -------------------------------------------------------------------------------------- errors


def test_missing_nodes_are_named() -> None:
    with pytest.raises(MetricError, match=r"observed\.utilisation has nothing for node E"):
        PROFILE.estimate(observed=seen(R1=0.1), incumbent="LOC", own={"R1": 0.0, "E": 0.0})
    with pytest.raises(MetricError, match="own has nothing for node R1"):
        PROFILE.estimate(observed=seen(R1=0.1, E=0.1), incumbent="LOC", own={"E": 0.0})


@pytest.mark.parametrize("samples", [0, -1])
def test_samples_are_checked(samples: int) -> None:
    with pytest.raises(ProblemError, match=f"samples: {samples} is not allowed"):
        Profile(BUSY, samples=samples)
