"""Settings that are allowed and seldom meant: each is said, and what is near it is not."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import Fault
from dwell.estimators import unplayed, warnings_of
from dwell.estimators.cell_warnings import longest_delay_s
from dwell.model import MovingTarget, Servo
from dwell.study.quality import actuations, track
from tests.cells.examples import CELLS, EXAMPLES

LINKS = [{"from": "R", "to": "E", "both_ways": True, "delay_ms": 1}]


def cell(**more: Any) -> dict[str, Any]:
    """Return a cell without a warning: three stages, two placements."""
    return {
        "dwell": 1,
        "period_ms": 100,
        "window_cycles": 10,
        "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
        "links": LINKS,
        "tasks": {
            "cam": {"on": {"R": {"exec_ms": 1}}},
            "see": {"on": {"R": {"exec_ms": 30}, "E": {"exec_ms": 10}}},
            "act": {"on": {"R": {"exec_ms": 1}}},
        },
        "flows": [{"from": "cam", "to": "see"}, {"from": "see", "to": "act"}],
        "candidates": {"LOC": {"see": "R"}, "SO": {"see": "E"}},
        **more,
    }


def on_one(node: Mapping[str, Any], tasks: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Return a cell of stages on one node, with a period of 10 ms."""
    return {
        "dwell": 1,
        "period_ms": 10,
        "nodes": {"E": {"tier": "edge", **node}},
        "tasks": {name: {**task, "on": {"E": task["on"]}} for name, task in tasks.items()},
        "candidates": {"SO": {}},
        **more,
    }


def stage(exec_ms: float, priority: int = 0, **on: Any) -> dict[str, Any]:
    return {"priority": priority, "on": {"exec_ms": exec_ms, **on}}


def warned(document: Mapping[str, Any]) -> list[Fault]:
    return list(warnings_of(from_document(document)))


def bursts(own_ms: float, threads: int = 4) -> dict[str, Any]:
    """Return a stage beside bursts that are on for a fifth of the time."""
    node = {"bursts": {"every_ms": 80, "for_ms": 20, "threads": threads}}
    return on_one(node, {"a": stage(own_ms)})


def gpu(exec_ms: float, count: int = 1) -> dict[str, Any]:
    both = stage(exec_ms, accelerator="gpu")
    return on_one({"accelerators": {"gpu": count}}, {"a": both, "b": both})


def five_on_a_gpu() -> dict[str, Any]:
    """Return five stages of 30 ms at P = 100 ms."""
    tasks = {name: stage(30, accelerator="gpu") for name in "abcde"}
    return {**on_one({"accelerators": {"gpu": 1}}, tasks), "period_ms": 100}


def by_priority(timer_ms: float) -> dict[str, Any]:
    tasks = {"timer": stage(timer_ms, 1), "rest": stage(0.5)}
    return on_one({"scheduler": "priority"}, tasks)


def quota(exec_ms: float, cpu: float) -> dict[str, Any]:
    return on_one({"cores": 4, "quota": {"cpu": cpu, "period_ms": 100}}, {"a": stage(exec_ms)})


def objective(targets: Any = None, weights: Any = None, caps: Any = None) -> dict[str, Any]:
    given = {"targets": targets, "weights": weights, "caps": caps}
    return cell(objective={name: value for name, value in given.items() if value is not None})


def servo(gain: float, delay_ms: float = 250) -> dict[str, Any]:
    links = [{"from": "R", "to": "E", "both_ways": True, "delay_ms": delay_ms / 2}]
    target = {"amplitude_mm": 10, "period_s": 8}
    return cell(links=links, servo={"plant": "integrator", "gain": gain, "target": target})


def guarded(**settings: Any) -> dict[str, Any]:
    return cell(controller={"guard_cycles": 5, **settings})


def watched(max_age_ms: float, objective: Any = None) -> dict[str, Any]:
    """Return a guarded chain of one rate, whose age is 14 ms on the edge server."""
    chains = {"seen": {"from": "cam", "to": "act", "max_age_ms": max_age_ms}}
    settings = {"guard_cycles": 2, "fallbacks": ["LOC"]}
    return cell(controller=settings, chains=chains, objective=objective or {"weights": {}})


def disturbed(*items: Mapping[str, Any]) -> dict[str, Any]:
    return cell(scenarios={"s": list(items)})


def prioritised(scheduler: str = "fair", **on: Any) -> dict[str, Any]:
    """Return two stages with different priorities on one node."""
    node = {"scheduler": scheduler, "cores": 4, "accelerators": {"gpu": 1}}
    return on_one(node, {"big": stage(2, **on), "rt": stage(1, priority=10, **on)})


def side_by_side(
    *jobs: tuple[float, int], scheduler: str = "fifo", cores: int = 8, **more: Any
) -> dict[str, Any]:
    """Return stages with a time and a number of threads each; P is 10 ms."""
    tasks = {f"t{i}": stage(ms, threads=threads) for i, (ms, threads) in enumerate(jobs)}
    return on_one({"scheduler": scheduler, "cores": cores, **more}, tasks)


def linked(**link: Any) -> dict[str, Any]:
    return cell(links=[{**LINKS[0], **link}])


LINK = {"link": "R->E"}


@pytest.mark.parametrize(
    ("document", "path", "words"),
    [
        (gpu(8), "candidates.SO", ("160% of gpu of E", "raise nodes.E.accelerators.gpu")),
        (gpu(12), "candidates.SO", ("240% of gpu of E: it can never keep pace",)),
        (gpu(4.6), "candidates.SO", ("92% of gpu of E: its jobs wait for each other",)),
        (five_on_a_gpu(), "candidates.SO", ("150% of gpu of E: it can never keep pace",)),
        (
            {**gpu(4), "objective": {"caps": {"utilisation": 0.7}}},
            "candidates.SO",
            ("80% of gpu of E, over the cap of 70%",),
        ),
        (quota(6, 0.5), "candidates.SO", ("120% of the quota of E", "nodes.E.quota.cpu")),
        (bursts(9.1), "candidates.SO", ("91% of the cores of E, of which bursts leave 84%",)),
        (
            on_one({"background": 0.3}, {"a": stage(8)}),
            "candidates.SO",
            ("80% of the cores of E, of which background leave 70%",),
        ),
        (by_priority(10), "candidates.SO", ("105% of the cores of E: it can never keep pace",)),
        # Wider than its node, a job is as much work under each scheduler.
        (on_one({"scheduler": "fifo"}, {"a": stage(3, threads=4)}), "candidates.SO", ("120%",)),
        (
            on_one(
                {"scheduler": "priority"},
                {"timer": stage(5, priority=1, threads=2), "rest": stage(1)},
            ),
            "candidates.SO",
            ("110% of the cores of E: it can never keep pace",),
        ),
        (objective(caps={"utilisation": 98}), "objective.caps.utilisation", ("0.98 instead",)),
        (objective({"robot": 70}), "objective.targets.robot", ("0.7 instead of 70?",)),
        (objective({"edge": 1.5}), "objective.targets.edge", ("1.5 is more than all cores",)),
        (quota(6, 60), "nodes.E.quota.cpu", ("0.6 instead of 60?",)),
        (
            objective({"robot": 0.0001}, {"robot": 10}),
            "objective.weights.robot",
            ("of J or more in every candidate", "raise targets.robot"),
        ),
        (objective(weights={"latency": 1000}), "objective.weights.latency", ("latency_ms",)),
        (
            cell(candidates={"A": {"see": "E"}, "B": {"see": "E"}}),
            "candidates.B",
            ("same placement as A",),
        ),
        (disturbed({"node": "R", "at_s": 1}), "scenarios.s[0]", ("does nothing to R",)),
        (disturbed({"node": "R", "down": True}, LINK), "scenarios.s[1]", ("nothing to R->E",)),
        (disturbed({**LINK, "add_delay_ms": 0}), "scenarios.s[0]", ("does nothing to R->E",)),
        (
            cell(nodes={"R": {"tier": "robot", "bursts": {"every_ms": 9, "for_ms": 1}},
                        "E": {"tier": "edge"}}),
            "nodes.R.bursts",
            ("give them threads",),
        ),
        (servo(6), "servo.gain", ("under SO", "261.8 at most")),
        (
            guarded(fallbacks=["SO"], initial="SO"),
            "controller.fallbacks",
            ("no fallback without E", "add LOC"),
        ),
        (watched(13), "chains.seen.max_age_ms", ("13 is tight for SO", "14.0 ms", "13.0 ms")),
        (
            watched(13, {"latency": "seen"}),
            "chains.seen.max_age_ms",
            ("13 is tight for SO", "two runs of act"),
        ),
        (
            {**watched(500, {"latency": "seen"}), "links": [{**LINKS[0], "delay_ms": 60}]},
            "controller.guard_cycles",
            ("2 is tight for SO", "132.0 ms"),
        ),
        (prioritised(), "tasks.rt.priority", ("no effect on E", "shares with big")),
        (prioritised("fifo"), "tasks.rt.priority", ("scheduler: priority",)),
        (
            prioritised("priority", accelerator="gpu"),
            "tasks.rt.priority",
            ("no effect on E.gpu", "shares with big"),
        ),
        (side_by_side((6, 5), (6, 5)), "candidates.SO", ("8 cores of E (t0: 5, t1: 5)", "12 ms")),
        (side_by_side((6, 5), (6, 5), scheduler="priority"), "candidates.SO", ("12 ms",)),
        # Only two of three fit.
        (side_by_side((7, 3), (7, 3), (7, 3)), "candidates.SO", ("at least 10.5 ms",)),
        # A wide one next to a narrow one: each task has one worker.
        (side_by_side((6, 7), (6, 2)), "candidates.SO", ("at least 12 ms",)),
        # Half of the node or more.
        (side_by_side((6, 5), (5, 4), (5, 4)), "candidates.SO", ("at least 11 ms",)),
        # More workers do not make room for a second job.
        (
            on_one({"scheduler": "fifo", "cores": 8}, {"a": stage(11, threads=5, workers=2)}),
            "candidates.SO",
            ("at least 11 ms",),
        ),
        (side_by_side((4, 5), (4, 5), background=2), "candidates.SO", ("at least 10.67 ms",)),
        (linked(rate_mbps=1e9), "links[0].rate_mbps", ("1000 instead of 1e+09",)),
        (
            disturbed({**LINK, "rate_mbps": 5e6}),
            "scenarios.s[0].rate_mbps",
            ("5 instead of 5e+06",),
        ),
        (
            cell(deadline_ms=13, live={"max_age_ms": 13.9}),
            "live.max_age_ms",
            ("13.9 is less", "of SO, 14 ms"),
        ),
        (
            linked(delay_ms={"uniform": {"low": 8, "high": 20}})
            | {"deadline_ms": 25, "live": {"max_age_ms": 27}},
            "live.max_age_ms",
            ("27 is less", "of SO, 28 ms"),
        ),
        (
            cell(controller={"decide_cycles": 5, "min_dwell_cycles": 4}),
            "controller.min_dwell_cycles",
            ("4 is less than decide_cycles = 5",),
        ),
        (
            cell(controller={"min_dwell_cycles": 1}),
            "controller.min_dwell_cycles",
            ("1 is less than decide_cycles",),
        ),
    ],
)  # fmt: skip
def test_what_is_never_meant_is_said(
    document: Mapping[str, Any], path: str, words: tuple[str, ...]
) -> None:
    found = warned(document)
    said = [
        fault
        for fault in found
        if fault.path == path and all(word in fault.message for word in words)
    ]
    assert len(said) == 1, found


@pytest.mark.parametrize(
    "document",
    [
        cell(),
        gpu(8, count=2),
        gpu(4.4),
        quota(5, 0.5),
        quota(6, 4),
        bursts(8),
        bursts(9.1, threads=0) | {"nodes": {"E": {"tier": "edge"}}},
        on_one({"background": 0.3}, {"a": stage(7)}),
        by_priority(9),
        objective({"robot": 1, "edge": 1}, caps={"utilisation": 1}),
        objective({"robot": 0.01}),
        objective(weights={"latency": 10, "violations": 0, "robot": 0, "edge": 0, "switching": 0}),
        disturbed({**LINK, "loss": 0.1}, {**LINK, "rate_mbps": 5}, {"node": "E", "down": True}),
        servo(5),
        guarded(fallbacks=["SO", "LOC"], initial="SO"),
        guarded(),
        watched(15),
        watched(15, {"latency": "seen"}),
        cell(controller={"decide_cycles": 5, "min_dwell_cycles": 5}),
        cell(controller={"decide_cycles": 5, "min_dwell_cycles": 0}),
        prioritised("priority"),
        # It shares the accelerator with nobody, or the other one has the same priority.
        on_one(
            {"cores": 4, "accelerators": {"gpu": 1}},
            {"big": stage(2), "rt": stage(1, priority=10, accelerator="gpu")},
        ),
        on_one({}, {"a": stage(2, priority=3), "b": stage(1, priority=3)}),
        # It orders jobs on one of its nodes.
        cell(
            nodes={"R": {"tier": "robot", "scheduler": "priority"}, "E": {"tier": "edge"}},
            tasks={**cell()["tasks"], "act": {**cell()["tasks"]["act"], "priority": 1}},
        ),
        side_by_side((5, 5), (5, 5)),
        side_by_side((6, 5), (6, 5), scheduler="fair"),
        side_by_side((6, 5), (6, 5), cores=10),
        side_by_side((6, 3), (6, 3), (6, 3)),
        linked(rate_mbps=1e6),
        disturbed({**LINK, "rate_mbps": 1e5}),
        cell(deadline_ms=30, live={"max_age_ms": 32}),
    ],
)
def test_what_is_near_it_is_not(document: Mapping[str, Any]) -> None:
    assert warned(document) == []


def test_what_no_other_placement_helps_against_is_not_said_of_fallbacks() -> None:
    """A stage that stays on E needs it wherever the others go."""
    tasks = {**cell()["tasks"], "map": {"on": {"E": {"exec_ms": 1}}}}
    assert warned(cell(tasks=tasks, controller={"guard_cycles": 5, "fallbacks": ["SO"]})) == []


@pytest.mark.parametrize("own_ms", [7.5, 9.1])
def test_beside_bursts_a_queue_grows_where_it_is_said(own_ms: float) -> None:
    """What bursts leave is what the simulator leaves."""
    document = bursts(own_ms)
    run = dwell.simulate(from_document({**document, "window_cycles": 1000}), seed=1, windows=20)
    latency_ms = run.cycles["latency_ns"].drop_nulls().to_numpy() / 1e6
    assert bool(latency_ms[-1000:].min() > 1000) is bool(warned(document))


def test_below_a_full_priority_nothing_is_done() -> None:
    document = {**by_priority(10), "window_cycles": 100}
    run = dwell.simulate(from_document(document), seed=1, windows=5)
    assert (run.cycles["outcome"] == "in_flight").all()


@pytest.mark.parametrize(
    ("plant", "gain", "damping"),
    [("integrator", 4.0, 0.0), ("double-integrator", 9.0, 4.0), ("double-integrator", 2.0, 6.0)],
)
@pytest.mark.parametrize(("share", "grows"), [(0.9, False), (1.1, True)])
def test_a_loop_is_stable_up_to_its_longest_delay(
    plant: str, gain: float, damping: float, share: float, grows: bool
) -> None:
    """As the reference loop has it, with commands far closer together than the delay is long."""
    servo = Servo(plant, gain, MovingTarget(1.0, 10.0), damping)  # type: ignore[arg-type]
    delay_ns = round(share * longest_delay_s(servo) * 1e9)
    release_ns = np.arange(60_000, dtype=np.int64) * 1_000_000
    actuated = actuations(release_ns, np.full(60_000, delay_ns - 500_000))
    early, late = (
        track(servo, actuated, begin_s * 10**9, (begin_s + 10) * 10**9).rms_mm
        for begin_s in (10, 50)
    )
    assert (late > 2 * early or math.isinf(late)) is grows


def test_a_loop_with_rare_commands_has_half_their_interval_as_delay() -> None:
    """12 and 32 ms of latency: without the interval of 600 ms the loop would be stable."""
    rare = servo(6, delay_ms=0)
    assert not warned(rare)
    rare["tasks"] = {**rare["tasks"], "cam": {"every": 6, **rare["tasks"]["cam"]}}
    loops = [one for one in warned(rare) if one.path == "servo.gain"]
    delays = [re.search(r"under (\w+) .* is ([\d.]+) ms", one.message) for one in loops]
    assert [one.groups() for one in delays if one] == [("LOC", "332"), ("SO", "312")]


@pytest.mark.parametrize("name", CELLS)
def test_the_examples_have_no_warning(name: str) -> None:
    assert not list(warnings_of(dwell.load(EXAMPLES / f"{name}.yaml")))


@pytest.mark.parametrize(
    ("at_s", "for_s", "warmup", "words"),
    [
        (1000, math.inf, 0, "begins at 1000 s, and the run counts from 0 to 10 s"),
        (10, math.inf, 0, "begins at 10 s"),
        (0, 3, 3, "is over before the warm-up is, and the run counts from 3 to 10 s"),
        (9.9, math.inf, 3, ""),
        (0, 3.1, 3, ""),
        (0, math.inf, 9, ""),
    ],
)
def test_a_scenario_that_a_run_does_not_reach_is_said(
    at_s: float, for_s: float, warmup: int, words: str
) -> None:
    item = {"node": "R", "at_s": at_s, "stress_threads": 1}
    item |= {} if math.isinf(for_s) else {"for_s": for_s}
    problem = from_document({**disturbed(item), "warmup_windows": warmup})
    found = [str(fault) for fault in unplayed(problem, "s", 10)]
    assert [words in text for text in found] == [True] * bool(words)
    assert not list(unplayed(problem, "baseline", 10))


def test_one_disturbance_that_falls_into_a_run_is_enough() -> None:
    items = ({"node": "R", "at_s": at_s, "stress_threads": 1} for at_s in (5, 1000))
    assert not list(itertools.chain(unplayed(from_document(disturbed(*items)), "s", 10)))


def replayed(folder: Path, instants: Sequence[float], **trace: Any) -> list[str]:
    """Return the warnings of a cell with a period of 10 ms that replays a trace by time."""
    rows = "".join(f"{i // 4},{instant!r},1\n" for i, instant in enumerate(instants))
    (folder / "t.csv").write_text(f"g,t,ms\n{rows}")
    file = str(folder / "t.csv")
    delay = {"file": file, "column": "ms", "by": "time", "time": "t", "wrap": True, **trace}
    document = {**linked(delay_ms={"trace": delay}), "period_ms": 10}
    document["tasks"]["see"]["on"] = {"R": {"exec_ms": 2}, "E": {"exec_ms": 3}}
    return [str(fault) for fault in warnings_of(from_document(document))]


@pytest.mark.parametrize(
    ("instants", "words"),
    [
        # Nanoseconds.
        ([1.7e18 + i * 1e7 for i in range(10)], "its rows last 9e+04 s, more than 1e+06 periods"),
        # The last instant stands for none.
        ([0.0, 10.0, 20.0, float(2**63 - 1)], "one row lasts 9.223e+15 s, the median row 0.01 s"),
        ([0.0, 10.0, 20_000.0], "one row lasts 19.99 s, the median row 0.01 s"),
        ([0.0, 1e-3, 1.0, 2.0, 3.0, 3e3 + 1], "one row lasts 2.998 s, the median row 0.001 s"),
    ],
)
def test_instants_of_a_trace_that_cannot_be_meant_are_said(
    tmp_path: Path, instants: list[float], words: str
) -> None:
    (message,) = replayed(tmp_path, instants)
    assert f"t.csv: {words}" in message


@pytest.mark.parametrize(
    ("instants", "group"),
    [
        ([0.0, 10.0, 20.0, 10_000.0], None),
        ([10.0 * i for i in range(1000)], None),
        ([0.0], None),
        ([5.0, 5.0, 5.0], None),
        # Each of two recordings, a year apart, is short.
        ([0.0, 10.0, 20.0, 30.0, 3.2e10, 3.2e10 + 10, 3.2e10 + 20], "g"),
    ],
)
def test_instants_of_a_trace_that_may_be_meant_are_not(
    tmp_path: Path, instants: list[float], group: str | None
) -> None:
    assert replayed(tmp_path, instants, **({"group": group} if group else {})) == []


def crowded(rng: Random) -> dict[str, Any]:
    """Return a random cell whose stages, on one node, take 60 to 95 % of its cores."""
    cores = rng.choice([2, 4, 6, 8])
    node: dict[str, Any] = {"tier": "edge", "cores": cores}
    node["scheduler"] = rng.choice(["fifo", "priority"])
    if rng.random() < 0.3:
        node["background"] = rng.uniform(0, cores / 4)
    if rng.random() < 0.3:
        node["bursts"] = {"every_ms": 40, "for_ms": 10, "threads": rng.randint(1, 8)}
    if rng.random() < 0.2:
        node["quota"] = {"cpu": rng.uniform(0.8, 1) * cores, "period_ms": 5}
    names = [f"t{i}" for i in range(rng.randint(2, 4))]
    shares = [rng.uniform(0.2, 1) for _ in names]
    share = rng.uniform(0.6, 0.95) * cores / sum(shares)
    tasks: dict[str, Any] = {"cam": {"on": {"R": {"exec_ms": 0}}}}
    flows = []
    for i, name in enumerate(names):
        threads = rng.randint(1, cores)
        execution = {
            "exec_ms": 10 * share * shares[i] / threads,
            "threads": threads,
            "workers": rng.choice([1, 1, 2, 3]),
        }
        tasks[name] = {"priority": rng.randint(0, 2), "on": {"E": execution}}
        flows.append({"from": rng.choice(["cam", *names[:i]]), "to": name})
    return {
        "dwell": 1,
        "period_ms": 10,
        "window_cycles": 1000,
        "nodes": {"R": {"tier": "robot"}, "E": node},
        "links": [{"from": "R", "to": "E", "delay_ms": 1, "loss": rng.choice([0, 0, 0.15])}],
        "tasks": tasks,
        "flows": flows,
        "candidates": {"SO": {}},
    }


@pytest.mark.parametrize("begin", range(0, 100, 50))
def test_jobs_that_do_not_fit_side_by_side_really_fall_behind(begin: int) -> None:
    """Of the cycles of a run at least the share that the warning implies is unfinished."""
    falling = 0
    for seed in range(begin, begin + 50):
        problem = from_document(crowded(Random(seed)))
        messages = [fault.message for fault in warnings_of(problem) if "side" in fault.message]
        if not messages:
            continue
        (needed,) = re.findall(r"at least ([\d.]+) ms", messages[0])
        late = 1 - 10 / float(needed)
        cycles = dwell.simulate(problem, seed=1, windows=2).cycles
        unfinished = int((cycles["outcome"] == "in_flight").sum())
        assert unfinished >= 0.95 * late * cycles.height - 2, (seed, needed, unfinished)
        falling += late > 0.02
    assert falling >= 3
