"""Keys of a cell file with a value at fault: where it is said to be, and in what words."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from dwell.cellfile import load
from dwell.errors import ProblemError
from tests.cellfile.faulty import DOCUMENT, faults_of_document, one_fault

TARGET = {"amplitude_mm": 50, "period_s": 2}

# Where, what, and the words that must be in the message: the value, the bound, the remedy.
VALUES: list[tuple[tuple[str | int, ...], object, str, tuple[str, ...]]] = [
    (("dwell",), 2, "dwell", ("2", "newer", "1", "upgrade")),
    (("dwell",), 0, "dwell", ("0", "`dwell: 1`")),
    (("dwell",), "1", "dwell", ("'1'", "`dwell: 1`")),
    (("dwell",), True, "dwell", ("true", "`dwell: 1`")),
    (("name",), 5, "name", ("5", "text", "quotes")),
    (("period_ms",), 0, "period_ms", ("0 is not allowed", "from 0.001 to 1e9")),
    (("period_ms",), "40", "period_ms", ("'40'", "from 0.001 to 1e9", "write 40 without quotes")),
    (("period_ms",), "1_000", "period_ms", ("'1_000'", "write 1000 without quotes")),
    (("period_ms",), True, "period_ms", ("true", "a number")),
    (("period_ms",), math.nan, "period_ms", ("NaN", "a number")),
    (("period_ms",), math.inf, "period_ms", ("infinity", "to 1e9")),
    (("period_ms",), 10**400, "period_ms", ("401 digits", "to 1e9")),
    (("period_ms",), None, "period_ms", ("nothing is given",)),
    (("period_ms",), [40], "period_ms", ("a list", "a number")),
    (("deadline_ms",), 2561, "deadline_ms", ("2561", "at most 64 period_ms = 2560")),
    (("deadline_ms",), -1, "deadline_ms", ("-1", "from 1e-6 to 1e9")),
    (("window_cycles",), 0, "window_cycles", ("0", "a whole number from 1 to 1000000")),
    (("window_cycles",), 1.5, "window_cycles", ("1.5", "a whole number")),
    (("warmup_windows",), -1, "warmup_windows", ("-1", "from 0 to 1000000")),
    (("release_jitter_ms",), -3, "release_jitter_ms", ("-3", "from 0 to 1e9")),
    (("nodes",), [], "nodes", ("a list", "a mapping")),
    (("nodes", "R1"), None, "nodes.R1", ("nothing is given",)),
    (("nodes", "R1"), 5, "nodes.R1", ("5", "a mapping of tier, cores")),
    (("nodes", "R1", "tier"), "robott", "nodes.R1.tier", ("robott", "edge, cloud", "'robot'?")),
    (("nodes", "R1", "tier"), False, "nodes.R1.tier", ("false", "robot, edge, cloud")),
    (("nodes", "R1", "cores"), 0, "nodes.R1.cores", ("0", "from 1 to 4096")),
    (("nodes", "R1", "cores"), math.nan, "nodes.R1.cores", ("NaN", "from 1 to 4096")),
    (("nodes", "R1", "core"), 4, "nodes.R1.core", ("unknown key 'core'", "'cores'?")),
    (("nodes", "R1", "zzz"), 4, "nodes.R1.zzz", ("unknown key 'zzz'", "tier, cores, scheduler")),
    (("nodes", "R1", "scheduler"), "rr", "nodes.R1.scheduler", ("'rr'", "fair, fifo, priority")),
    (("nodes", "R1", "accelerators"), {"gpu": 0}, "nodes.R1.accelerators.gpu", ("0", "from 1")),
    (("nodes", "R1", "accelerators"), {"a/b": 1}, "nodes.R1.accelerators.a/b", ("not a name",)),
    (("objective", "accelerators"), "yes", "objective.accelerators", ("'yes'", "true")),
    (("nodes", "R1", "quota"), {"cpu": 0, "period_ms": 4}, "nodes.R1.quota.cpu", ("0", "0.001")),
    (
        ("nodes", "R1", "quota"),
        {"cpu": 1, "period_ms": 4000},
        "nodes.R1.quota.period_ms",
        ("4000", "from 1 to 1000"),
    ),
    (
        ("nodes", "R1", "quota"),
        {"cpu": 1, "period_ms": 4, "tick_ms": 1e-4},
        "nodes.R1.quota.tick_ms",
        ("0.0001", "0.001"),
    ),
    (
        ("nodes", "R1"),
        {"tier": "robot", "cores": 4, "quota": {"cpu": 1, "period_ms": 4, "tick_ms": 4}},
        "nodes.R1.quota.tick_ms",
        ("several cores",),
    ),
    (
        ("nodes", "R1"),
        {"tier": "robot", "background_hz": 50, "quota": {"cpu": 1, "period_ms": 4}},
        "nodes.R1.background_hz",
        ("50", "without a `quota` with `tick_ms`"),
    ),
    (("nodes", "R1", "background_hz"), 1e6, "nodes.R1.background_hz", ("from 0 to 100000",)),
    (
        ("nodes", "R1", "bursts"),
        {"every_ms": 0, "for_ms": 1},
        "nodes.R1.bursts.every_ms",
        ("0.0", "mean", "from 0.01"),
    ),
    (
        ("nodes", "R1", "bursts"),
        {"every_ms": 1, "for_ms": 1, "add_delay_ms": 1},
        "nodes.R1.bursts.add_delay_ms",
        ("unknown key", "threads"),
    ),
    (("nodes", "bad/name"), {"tier": "edge"}, "nodes.bad/name", ("'bad/name'", "letters")),
    (("nodes", ""), {"tier": "edge"}, "nodes.''", ("''", "letters")),
    (("links",), None, "links", ("nothing is given",)),
    (("links",), {}, "links", ("a mapping", "a list", "[]")),
    (("links", 0), None, "links[0]", ("nothing is given",)),
    (("links", 0, "from"), "R9", "links[0].from", ("unknown node 'R9'", "R1")),
    (("links", 0, "from"), 9, "links[0].from", ("9", "text", "quotes")),
    (("links", 0, "to"), "R1", "links[0].to", ("'R1'", "another node than `from`")),
    (("links", 0, "delay_ms"), -0.5, "links[0].delay_ms", ("-0.5", "from 0 to 1e9")),
    (
        ("links", 0, "delay_ms", "lognormal", "mean"),
        0,
        "links[0].delay_ms.lognormal.mean",
        ("0", "above 0"),
    ),
    (("links", 0, "rate_mbps"), 0, "links[0].rate_mbps", ("0", "at least 0.0001")),
    (("links", 0, "rate_mbps"), math.inf, "links[0].rate_mbps", ("infinity", "leave the key out")),
    (("links", 0, "rate_mbps"), 10**400, "links[0].rate_mbps", ("digits", "leave the key out")),
    (("links", 0, "loss"), 1, "links[0].loss", ("1", "at least 0 and below 1")),
    (("links", 0, "on_loss"), "retry", "links[0].on_loss", ("'retry'", "`drop`", "retransmit_ms")),
    (
        ("links", 0, "on_loss"),
        {"retransmit_ms": 0},
        "links[0].on_loss.retransmit_ms",
        ("0", "from 0.001"),
    ),
    (("links", 0, "in_order"), "yes", "links[0].in_order", ("'yes'", "true or false")),
    (("tasks",), "all", "tasks", ("'all'", "a mapping")),
    (("tasks", "sensing", "on"), {}, "tasks.sensing.on", ("at least one node",)),
    (("tasks", "sensing", "on"), [], "tasks.sensing.on", ("a list", "a mapping")),
    (("tasks", "sensing", "on", "R1"), 3, "tasks.sensing.on.R1", ("3", "exec_ms")),
    (
        ("tasks", "perception", "on", "R3"),
        {"exec_ms": 3},
        "tasks.perception.on.R3",
        ("unknown node 'R3'", "R1"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        "slow",
        "tasks.sensing.on.R1.exec_ms",
        ("'slow'", "a number from 0 to 1e9", "lognormal"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        "lognormal",
        "tasks.sensing.on.R1.exec_ms",
        ("'lognormal'", "with its values"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {},
        "tasks.sensing.on.R1.exec_ms",
        ("exactly one process", "none"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {"constant": 1, "exponential": {"mean": 1}},
        "tasks.sensing.on.R1.exec_ms",
        ("exactly one process", "2 of them"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {"lognorm": {"mean": 1, "cv": 1}},
        "tasks.sensing.on.R1.exec_ms.lognorm",
        ("unknown key", "'lognormal'?"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {"lognormal": {"mean": 1}},
        "tasks.sensing.on.R1.exec_ms.lognormal.cv",
        ("missing", "standard deviation"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {"lognormal": 4},
        "tasks.sensing.on.R1.exec_ms.lognormal",
        ("4", "a mapping of mean, cv"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {"uniform": {"low": 5, "high": 4}},
        "tasks.sensing.on.R1.exec_ms.uniform.high",
        ("4.0", "at least low = 5"),
    ),
    (
        ("tasks", "sensing", "on", "R1", "exec_ms"),
        {"gamma": {"mean": 5, "cv": 0}},
        "tasks.sensing.on.R1.exec_ms.gamma.cv",
        ("0", "from 1e-6 to 100"),
    ),
    (("scales", "scene", "ar1", "rho"), 1, "scales.scene.ar1.rho", ("1", "below 1")),
    (("scales", "scene", "ar1", "cv"), -1, "scales.scene.ar1.cv", ("-1", "from 0 to 100")),
    (
        ("scales", "scene"),
        {"ar1": {"mean": 1, "cv": 3, "rho": -0.9}},
        "scales.scene.ar1.rho",
        ("-0.9", "cv 3"),
    ),
    (("tasks", "perception", "scale"), "scen", "tasks.perception.scale", ("'scen'", "'scene'?")),
    (("tasks", "perception", "input"), "last", "tasks.perception.input", ("'last'", "`latest`")),
    (("tasks", "perception", "input"), {"queue": 0}, "tasks.perception.input.queue", ("0", "1")),
    (("tasks", "perception", "input"), 3, "tasks.perception.input", ("3", "{queue: 8}")),
    (("tasks", "perception", "priority"), 2000, "tasks.perception.priority", ("2000", "1000")),
    (("tasks", "perception", "workers"), 0, "tasks.perception.workers", ("0", "from 1")),
    (("tasks", "perception", "state_bytes"), -1, "tasks.perception.state_bytes", ("-1", "from 0")),
    (("tasks", "perception", "start_ms"), -1, "tasks.perception.start_ms", ("-1", "from 0 to 1e9")),
    (("tasks", "perception", "offset_ms"), 3, "tasks.perception.offset_ms", ("3", "remove it")),
    (
        ("tasks", "perception", "on", "E", "accelerator"),
        "gpu",
        "tasks.perception.on.E.accelerator",
        ("'gpu'", "accelerator of E"),
    ),
    (
        ("tasks", "perception", "on", "E", "threads"),
        0.5,
        "tasks.perception.on.E.threads",
        ("0.5", "a whole number from 1"),
    ),
    (("flows", 0, "bytes"), -1, "flows[0].bytes", ("-1", "a whole number from 0 to 1e12")),
    (("flows", 0, "bytes"), 0.5, "flows[0].bytes", ("0.5", "a whole number")),
    (("flows", 0, "from"), "sensin", "flows[0].from", ("'sensin'", "'sensing'?")),
    (("flows", 0, "payload_bytes"), 1, "flows[0].payload_bytes", ("unknown key", "bytes")),
    (("flows", 1), DOCUMENT["flows"][0], "flows[1]", ("sensing -> perception", "flows[0]")),
    (("flows", 1, "to"), "sensing", "flows", ("sensing -> perception -> sensing", "remove one")),
    (("candidates", "LOC"), [], "candidates.LOC", ("a list", "a mapping")),
    (("candidates", "LOC", "planning"), 2, "candidates.LOC.planning", ("2", "text")),
    (("candidates", "LOC", "plan"), "R2", "candidates.LOC.plan", ("'plan'", "'planning'?")),
    (("candidates", "LOC", "planning"), "R3", "candidates.LOC.planning", ("'R3'", "R1, E, R2")),
    (
        ("candidates", "LOC", "planning"),
        "R1",
        "candidates.LOC.planning",
        ("cannot run on 'R1'", "R2, E"),
    ),
    (("candidates", "LOC", "sensing"), "E", "candidates.LOC.sensing", ("anchored to R1", "E")),
    (("candidates", "dtp"), DOCUMENT["candidates"]["LOC"], "candidates.dtp", ("a policy's",)),
    (("candidates", "LOC"), {"planning": "R2"}, "candidates.LOC", ("'perception'", "R1 or E")),
    (("scenarios", "baseline"), [{"node": "E", "down": True}], "scenarios.baseline", ("empty",)),
    (("scenarios", "x"), None, "scenarios.x", ("nothing is given",)),
    (("scenarios", "x"), [{"at_s": 3}], "scenarios.x[0]", ("`node` or `link`", "neither")),
    (("scenarios", "x"), [{"node": "E", "link": "R1->E"}], "scenarios.x[0]", ("both",)),
    (("scenarios", "x"), [{"node": "E9"}], "scenarios.x[0].node", ("unknown node 'E9'", "E")),
    (("scenarios", "x"), [{"link": "E"}], "scenarios.x[0].link", ("'E'", "`R1->E`")),
    (("scenarios", "x"), [{"link": "E->R9"}], "scenarios.x[0].link", ("'E->R9'", "E->R")),
    (("scenarios", "x"), [{"node": "E", "loss": 0.1}], "scenarios.x[0].loss", ("links", "remove")),
    (
        ("scenarios", "x"),
        [{"link": "R1->E", "stress_threads": 1}],
        "scenarios.x[0].stress_threads",
        ("nodes", "remove"),
    ),
    (("scenarios", "x"), [{"node": "E", "at_s": -1}], "scenarios.x[0].at_s", ("-1", "at least 0")),
    (("scenarios", "x"), [{"node": "E", "for_s": 0}], "scenarios.x[0].for_s", ("0", "above 0")),
    (
        ("scenarios", "x"),
        [{"node": "E", "stress_threads": -4}],
        "scenarios.x[0].stress_threads",
        ("-4", "from 0 to 1000000"),
    ),
    (
        ("scenarios", "x"),
        [{"link": "R1->E", "loss": 1.01}],
        "scenarios.x[0].loss",
        ("1.01", "from 0 to 1"),
    ),
    (("scenarios", "x"), [{"node": "E", "ramp_s": -1}], "scenarios.x[0].ramp_s", ("-1", "from 0")),
    (
        ("scenarios", "x"),
        [{"node": "E", "for_s": 8, "ramp_s": 5}],
        "scenarios.x[0].ramp_s",
        ("5", "at most half of for_s = 8"),
    ),
    (
        ("scenarios", "x"),
        [{"node": "E", "episodes": {"every_s": 1, "for_s": 1}}],
        "scenarios.x[0].episodes.name",
        ("missing",),
    ),
    (
        ("scenarios", "x"),
        [{"node": "E", "episodes": {"name": "a", "every_s": 0, "for_s": 1}}],
        "scenarios.x[0].episodes.every_s",
        ("0", "a process whose mean is", "from 1e-5 to 1e9"),
    ),
    (
        ("scenarios", "x"),
        [{"link": "R1->E", "both_ways": True, "episodes": {"name": "", "every_s": 1, "for_s": 1}}],
        "scenarios.x[0].episodes.name",
        ("'' is not a name",),
    ),
    (
        ("scenarios", "x"),
        [
            {"node": "E", "episodes": {"name": "a", "every_s": 1, "for_s": 1}},
            {"node": "R1", "episodes": {"name": "a", "every_s": 1, "for_s": 2}},
        ],
        "scenarios.x[1].episodes",
        ("'a' is declared otherwise at scenarios.x[0]", "another name"),
    ),
    (
        ("scenarios", "x"),
        [{"link": "R1->E", "add_delay_ms": 1, "ramp_s": 1}] * 13,
        "scenarios.x[12].add_delay_ms",
        ("one too many on R1->E", "65", "63"),
    ),
    (("objective", "weights", "edge"), -1, "objective.weights.edge", ("-1", "from 0 to 1e9")),
    (
        ("objective", "weights"),
        dict.fromkeys(("latency", "violations", "robot", "edge", "switching"), 0),
        "objective.weights",
        ("all weights are 0", "above 0"),
    ),
    (("objective", "weights", "cloud"), 1, "objective.targets.cloud", ("missing", "weights.cloud")),
    (("objective", "targets", "edge"), 0, "objective.targets.edge", ("0", "from 1e-9")),
    (("objective", "caps", "latency_ms"), 0, "objective.caps.latency_ms", ("0", "above 0")),
    (("objective", "tiers"), {"R7": "robot"}, "objective.tiers.R7", ("unknown node 'R7'", "R1")),
    (("objective", "tiers"), {"R1": "rover"}, "objective.tiers.R1", ("'rover'", "robot, edge")),
    (("controller", "on"), "F", "controller.on", ("unknown node 'F'", "R1, E, R2")),
    (("controller", "policy"), "dpt", "controller.policy", ("unknown policy 'dpt'", "'dtp'?")),
    (("controller", "initial"), "LOK", "controller.initial", ("'LOK'", "'LOC'?")),
    (("controller", "fallbacks"), ["LOC", "HY"], "controller.fallbacks[1]", ("'HY'", "'HYB'?")),
    (("controller", "fallbacks"), "LOC", "controller.fallbacks", ("'LOC'", "a list")),
    (("controller", "estimator"), "oracle", "controller.estimator", ("'oracle'", "profile")),
    (("controller", "estimator"), "shadows", "controller.estimator", ("'shadows'", "'shadow'?")),
    (("controller", "escape"), "no", "controller.escape", ("'no'", "true or false")),
    (("controller", "shadow_fraction"), -1, "controller.shadow_fraction", ("-1", "from 0 to 1")),
    (
        ("controller", "shadow_fraction"),
        "automatic",
        "controller.shadow_fraction",
        ("'automatic' is not allowed; it must be auto or a number from 0 to 1",),
    ),
    (("controller", "shadow_fraction"), "0.1", "controller.shadow_fraction", ("without quotes",)),
    (("controller", "shadow_fraction"), True, "controller.shadow_fraction", ("true", "auto or")),
    (("controller", "shadow_fraction"), ["auto"], "controller.shadow_fraction", ("a list", "auto")),
    (("controller", "half_life_windows"), 0, "controller.half_life_windows", ("0", "above 0")),
    (("controller", "migration"), "hot", "controller.migration", ("'hot'", "warm, cold")),
    (("controller", "probe_cycles"), 0, "controller.probe_cycles", ("0", "from 1 to 1000000")),
    (("controller", "guard_cycles"), 1, "controller.guard_cycles", ("1", "from 2 to 1000000")),
    (("controller", "min_dwell"), -1, "controller.min_dwell", ("-1", "from 0 to 1000000")),
    (("controller", "min_dwell"), 0.5, "controller.min_dwell", ("0.5", "a whole number")),
    (("controller", "min_dwell_cycles"), 9.5, "controller.min_dwell_cycles", ("9.5", "whole")),
    (("controller", "decide_cycles"), 0, "controller.decide_cycles", ("0", "from 1 to 1000000")),
    (("controller", "decide_cycles"), 2.5, "controller.decide_cycles", ("2.5", "whole number")),
    (
        ("controller", "decide_cycles"),
        51,
        "controller.decide_cycles",
        ("51 is not allowed", "at most window_cycles = 50", "raise window_cycles"),
    ),
    (("controller", "min_improvement"), -0.1, "controller.min_improvement", ("-0.1", "from 0")),
    (("controller", "order_delay_ms"), 1e10, "controller.order_delay_ms", ("10000000000", "1e9")),
    (("controller", "order_lead_cycles"), 0.5, "controller.order_lead_cycles", ("0.5", "whole")),
    (("controller", "close_grace_ms"), math.nan, "controller.close_grace_ms", ("NaN", "from 0")),
    (("servo",), [], "servo", ("a list", "a mapping of plant, gain, target, damping")),
    (("servo",), {"gain": 1, "target": TARGET}, "servo.plant", ("missing",)),
    (("servo",), {"plant": "integrator", "gain": 1}, "servo.target", ("missing",)),
    (("servo", "plant"), "integrater", "servo.plant", ("integrater", "'integrator'?")),
    (("servo", "gain"), 0, "servo.gain", ("0", "above 0 and at most 1000000")),
    (("servo", "damping"), -1, "servo.damping", ("-1", "from 0 to 1000000")),
    (("servo", "damping"), 0, "servo.damping", ("0", "above 0 with a double-integrator")),
    (("servo", "plant"), "integrator", "servo.damping", ("8", "left out with an integrator")),
    (("servo", "target", "amplitude_mm"), 0, "servo.target.amplitude_mm", ("0", "from 1e-6")),
    (("servo", "target", "period_s"), 0.079, "servo.target.period_s", ("0.079", "at least 0.08")),
    (("servo", "target", "phase"), 1, "servo.target.phase", ("phase",)),
    (("task",), {}, "task", ("unknown key 'task'", "'tasks'?")),
]


@pytest.mark.parametrize(
    ("steps", "value", "path", "words"), VALUES, ids=[f"{row[2]}-{row[3][0]}" for row in VALUES]
)
def test_a_value_at_fault(
    steps: tuple[str | int, ...], value: object, path: str, words: tuple[str, ...]
) -> None:
    fault = one_fault(value, *steps)
    assert fault.path == path
    for word in words:
        assert word in fault.message


FIVE = """\
dwell: 1
period_ms: 40
deadline_ms: 5000
nodes:
  R: {tier: robot, cores: 0}
  E: {tier: edge}
links:
  - {from: R, to: F, both_ways: true, delay_ms: {lognormal: {mean: -1, cv: 0.3}}}
tasks:
  a: {on: {R: {exec_ms: 1}}, input: newest}
  b:
    on:
      R: {exec_ms: 5}
      E: {exec_ms: 2, thread: 4}
flows:
  - {from: a, to: c}
candidates:
  LOC: {b: R}
  SO: {a: E, b: E}
"""

EXPECTED = {
    (3, "deadline_ms"): "at most 64 period_ms = 2560",
    (5, "nodes.R.cores"): "from 1 to 4096",
    (8, "links[0].to"): "unknown node 'F'",
    (8, "links[0].delay_ms.lognormal.mean"): "-1 is not allowed",
    (10, "tasks.a.input"): "`latest`",
    (14, "tasks.b.on.E.thread"): "did you mean 'threads'?",
    (16, "flows[0].to"): "unknown task 'c'",
    (19, "candidates.SO.a"): "anchored to R",
}


def test_structure_and_meaning_are_reported_in_one_pass(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(FIVE)
    with pytest.raises(ProblemError) as caught:
        load(path)
    error = caught.value
    found = {(fault.line, fault.path): fault.message for fault in error.faults}
    assert set(found) == set(EXPECTED)
    for where, words in EXPECTED.items():
        assert words in found[where]
    lines = str(error).splitlines()
    assert len(lines) == len(EXPECTED)
    assert lines[0].startswith(f"{path}:3: deadline_ms: 5000")
    assert [fault.line for fault in error.faults] == sorted(line for line, _ in EXPECTED)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "folder"),
        (lambda path: path.write_bytes(b""), "the file is empty"),
        (lambda path: path.write_bytes(b"# nothing\n\n"), "the file is empty"),
        (lambda path: path.write_bytes(b"~"), "this is nothing"),
        (lambda path: path.write_bytes(b"- 1"), "this is a list"),
        (lambda path: path.write_bytes(b"dwell"), "this is 'dwell'"),
        (lambda path: path.write_bytes(b"dwell: 1\nname: \xff"), "0xff"),
        (lambda path: path.write_bytes(b"x" * 4_000_001), "4000000 bytes"),
    ],
)
def test_a_file_that_is_no_cell(make: Callable[[Path], object], words: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    make(path)
    with pytest.raises(ProblemError) as caught:
        load(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))


def test_an_impossible_path_is_no_cell() -> None:
    with pytest.raises(ProblemError, match="cannot be read"):
        load("a\0b")


def test_faults_stay_on_one_line_and_can_be_printed() -> None:
    document = {**DOCUMENT, "a\nb\ud800": 1}
    (fault,) = faults_of_document(document)
    assert "\n" not in str(fault)
    assert str(fault).encode()
