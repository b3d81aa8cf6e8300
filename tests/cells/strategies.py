"""Strategies: cells of every kind that the model can hold, traces aside."""

from __future__ import annotations

import math
from typing import get_args

from hypothesis import strategies as st

from dwell.errors import ProblemError
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.model import (
    AR1,
    Bursts,
    Caps,
    Constant,
    ControllerSettings,
    Disturbance,
    Episodes,
    Execution,
    Exponential,
    Fabric,
    Flow,
    Gamma,
    Link,
    LinkDisturbance,
    LogNormal,
    MovingTarget,
    Node,
    NodeDisturbance,
    Normal,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Quota,
    Servo,
    Targets,
    Task,
    Uniform,
    Weights,
)
from dwell.model.fabric import Scheduler, accelerator_tiers
from dwell.model.objective import TIERS
from dwell.model.servo import Plant
from dwell.policies.registry import REGISTRY as POLICIES

# Names that YAML 1.1, numbers or paths might trip over.
NAMES = (
    "R1",
    "E",
    "no",
    "on",
    "NO",
    "true",
    "null",
    "1e3",
    "12:30",
    "n 2",
    "a.b",
    "x+-",
    "Łódź",
)


def _reals(
    low: float, high: float, *, exclude_min: bool = False, exclude_max: bool = False
) -> st.SearchStrategy[float]:
    return st.floats(low, high, exclude_min=exclude_min, exclude_max=exclude_max)


values = _reals(0, 1e9)
means = _reals(0, 1e9, exclude_min=True)
cvs = _reals(0, 100)


@st.composite
def uniforms(draw: st.DrawFn) -> Uniform:
    low, high = sorted((draw(values), draw(values)))
    return Uniform(low, high)


@st.composite
def autoregressions(draw: st.DrawFn) -> AR1:
    mean, cv, rho = draw(means), draw(cvs), draw(_reals(-0.999, 0.999))
    try:
        return AR1(mean, cv, rho)
    except ProblemError:  # not every correlation can be reached
        return AR1(mean, cv, 0.0)


def processes() -> st.SearchStrategy[Process]:
    """Every kind of process but traces, up to their bounds."""
    return st.one_of(
        st.builds(Constant, values),
        uniforms(),
        st.builds(Normal, _reals(-1e9, 1e9), values, values),
        st.builds(LogNormal, means, cvs),
        st.builds(Gamma, means, _reals(1e-6, 100)),
        st.builds(Exponential, means),
        autoregressions(),
    )


def _names(least: int, most: int, but: tuple[str, ...] = ()) -> st.SearchStrategy[list[str]]:
    known = [name for name in NAMES if name not in but]
    return st.lists(st.sampled_from(known), min_size=least, max_size=most, unique=True)


def _whole(low: int, high: int) -> st.SearchStrategy[int]:
    return st.integers(low, high)


durations = st.builds(Constant, _reals(0.01, 1e9)) | st.builds(Exponential, _reals(0.01, 1e9))
times = _reals(0, 1e9)


@st.composite
def _node(draw: st.DrawFn, name: str) -> Node:
    schedulers: tuple[Scheduler, ...] = ("fair", "fifo", "priority")
    cores, scheduler = draw(st.just(1) | _whole(1, 4096)), draw(st.sampled_from(schedulers))
    times = [_reals(0.001, 4096), _reals(1, 1000), _reals(0, 1000)]
    if cores == 1 and scheduler == "fair":
        times.append(_reals(0.001, 1000))
    return Node(
        name,
        draw(st.sampled_from(TIERS)),
        cores=cores,
        scheduler=scheduler,
        accelerators=draw(st.dictionaries(st.sampled_from(("gpu", "npu")), _whole(1, 4096))),
        bursts=draw(st.none() | st.builds(Bursts, durations, durations, _whole(0, 1_000_000))),
        quota=draw(st.none() | st.builds(Quota, *times)),
    )


@st.composite
def _link(draw: st.DrawFn, source: str, target: str) -> Link:
    bursts = st.builds(Bursts, durations, durations, add_delay_ms=processes())
    return Link(
        source,
        target,
        draw(processes()),
        rate_mbps=draw(st.just(math.inf) | _reals(1e-4, 1e12)),
        loss=draw(_reals(0, 1, exclude_max=True)),
        retransmit_ms=draw(st.none() | _reals(0.001, 1e9)),
        in_order=draw(st.booleans()),
        bursts=draw(st.none() | bursts),
    )


@st.composite
def _task(
    draw: st.DrawFn, name: str, nodes: dict[str, Node], scales: list[str], source: bool
) -> Task:
    feasible = draw(st.lists(st.sampled_from(sorted(nodes)), min_size=1, unique=True))
    on = {}
    for node in feasible:
        kinds = st.sampled_from((None, *nodes[node].accelerators))
        on[node] = Execution(
            draw(processes()),
            threads=draw(_whole(1, 1_000_000)),
            workers=draw(_whole(1, 1_000_000)),
            accelerator=draw(kinds),
        )
    return Task(
        name,
        on,
        depth=draw(_whole(0, 3) | st.just(1_000_000)),
        priority=draw(_whole(-1000, 1000)),
        scale=draw(st.sampled_from((None, *scales))),
        offset_ms=draw(times) if source else 0.0,
        start_ms=draw(times),
        state_bytes=draw(_whole(0, 10**15)),
    )


@st.composite
def _disturbance(draw: st.DrawFn, nodes: list[str], links: list[str]) -> Disturbance:
    at_s = draw(_reals(0, 1e8))
    for_s = draw(st.just(math.inf) | _reals(0, 1e12, exclude_min=True))
    down = draw(st.booleans())
    every, length = draw(durations), draw(durations)
    # Two of one name must be equal.
    name = f"{hash((at_s, every, length)) & 0xFFFFFFFF:x}"
    episodes = draw(st.sampled_from((None, Episodes(name, every, length))))
    ramp_s = 0.0 if down or episodes is not None else draw(_reals(0, min(for_s / 2, 1e9)))
    if not links or draw(st.booleans()):
        stress = draw(_whole(0, 1_000_000))
        node = draw(st.sampled_from(nodes))
        return NodeDisturbance(node, at_s, for_s, stress, down, episodes, ramp_s)
    source, target = draw(st.sampled_from(links)).split("->")
    return LinkDisturbance(
        source,
        target,
        at_s,
        for_s,
        draw(st.none() | processes()),
        draw(_reals(0, 1)),
        draw(st.just(math.inf) | _reals(1e-4, 1e12)),
        down,
        episodes,
        ramp_s,
    )


@st.composite
def _objective(draw: st.DrawFn, nodes: dict[str, Node]) -> Objective:
    cloud = draw(st.booleans())
    weight, target = _reals(0, 1e9), _reals(1e-9, 1e9)
    cap = st.just(math.inf) | _reals(0, 1e12, exclude_min=True)
    tiers = {name: node.tier for name, node in nodes.items()}
    if draw(st.booleans()):
        tiers = draw(st.dictionaries(st.sampled_from(sorted(nodes)), st.sampled_from(TIERS)))
    accelerators = accelerator_tiers(nodes, tiers) if draw(st.booleans()) else {}
    return Objective(
        Weights(
            draw(_reals(1e-9, 1e9)),
            draw(weight),
            draw(weight),
            draw(weight),
            draw(weight),
            draw(weight) if cloud else None,
        ),
        Targets(draw(target), draw(target), draw(target), draw(target) if cloud else None),
        Caps(draw(cap), draw(cap)),
        tiers,
        accelerators,
    )


@st.composite
def _controller(draw: st.DrawFn, nodes: list[str], candidates: list[str]) -> ControllerSettings:
    some = st.sampled_from(candidates)
    most = 1 / max(len(candidates) - 1, 1)
    return ControllerSettings(
        on=draw(st.none() | st.sampled_from(nodes)),
        policy=draw(st.sampled_from(list(POLICIES)) | some),
        initial=draw(st.none() | some),
        min_dwell=draw(_whole(0, 1_000_000)),
        min_improvement=draw(_reals(0, 1e9)),
        escape=draw(st.booleans()),
        estimator=draw(st.sampled_from(list(ESTIMATORS))),
        shadow_fraction=draw(_reals(0, most)),
        half_life_windows=draw(_reals(0, 1e6, exclude_min=True)),
        migration=draw(st.sampled_from(("warm", "cold"))),
        guard_cycles=draw(_whole(2, 1_000_000)),
        probe_cycles=draw(_whole(1, 1_000_000)),
        fallbacks=tuple(draw(st.lists(some, max_size=2))),
        order_delay_ms=draw(times),
        order_lead_cycles=draw(_whole(0, 1_000_000)),
        close_grace_ms=draw(times),
    )


@st.composite
def _servo(draw: st.DrawFn, period_ms: float) -> Servo:
    plant = draw(st.sampled_from(get_args(Plant)))
    damping = draw(_reals(1e-9, 1e6)) if plant == "double-integrator" else 0.0
    period_s = draw(_reals(max(2 * period_ms / 1e3, 1e-5), 1e9))
    return Servo(
        plant,
        draw(_reals(0, 1e6, exclude_min=True)),
        MovingTarget(draw(_reals(1e-6, 1e6)), period_s),
        damping,
    )


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    """Valid problems; every pair of nodes has its links, so that any placement can be chosen."""
    nodes = {name: draw(_node(name)) for name in draw(_names(1, 3))}
    links = [draw(_link(a, b)) for a in nodes for b in nodes if a != b]
    scales = {name: draw(processes()) for name in draw(_names(0, 2))}
    names = draw(_names(1, 4))
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    chosen = [pair for pair in pairs if draw(st.booleans())]
    targets = {target for _, target in chosen}
    tasks = {
        name: draw(_task(name, nodes, list(scales), source=name not in targets)) for name in names
    }
    candidates = {
        name: Placement({task: draw(st.sampled_from(list(tasks[task].on))) for task in tasks})
        for name in draw(_names(1, 3, but=tuple(POLICIES)))
    }
    items = _disturbance(list(nodes), [link.name for link in links])
    period_ms = draw(_reals(1e-3, 1e9))
    return Problem(
        name=draw(_names(1, 1))[0],
        pipeline=Pipeline(
            tasks,
            tuple(Flow(a, b, draw(_whole(0, 10**12))) for a, b in chosen),
            period_ms,
            draw(_reals(1e-6, min(64 * period_ms, 1e9))),
            draw(processes()),
            scales,
        ),
        fabric=Fabric(nodes, {link.name: link for link in links}),
        candidates=candidates,
        objective=draw(_objective(nodes)),
        scenarios={name: tuple(draw(st.lists(items, max_size=2))) for name in draw(_names(0, 2))},
        controller=draw(_controller(list(nodes), list(candidates))),
        window_cycles=draw(_whole(1, int(min(1_000_000, 9.1e12 / period_ms)))),
        warmup_windows=draw(_whole(0, 1_000_000)),
        servo=draw(st.none() | _servo(period_ms)),
    )
