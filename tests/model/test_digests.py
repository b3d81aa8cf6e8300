"""Every key of a cell file is part of one digest, which says who has to agree on it."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import yaml

from dwell.cellfile import from_document
from dwell.errors import ProblemError
from dwell.model import (
    Bursts,
    Caps,
    Chain,
    ControllerSettings,
    Execution,
    Flow,
    Link,
    LiveSettings,
    Node,
    Objective,
    Pipeline,
    Problem,
    Quota,
    Targets,
    Task,
    Weights,
)
from dwell.model.declaration import declared_fields
from dwell.model.document import digests, to_document
from dwell.model.live import Endpoint, Host
from dwell.model.ros_topics import RosActuator, RosCommands, RosTopic
from dwell.model.scenario import Episodes, LinkDisturbance, NodeDisturbance
from dwell.model.servo import MovingTarget, Servo

#: A value other than the usual one for every key.
CELL: dict[str, Any] = yaml.safe_load("""
dwell: 1
name: whole
period_ms: 100
deadline_ms: 90
phase_ms: 3
release_jitter_ms: 0.5
window_cycles: 40
warmup_windows: 2
scales: {load: {uniform: {low: 0.5, high: 1.5}}, other: {uniform: {low: 0.5, high: 1.5}}}
nodes:
  R:
    tier: robot
    accelerators: {gpu: 1}
    bursts: {every_ms: 900, for_ms: 5, threads: 1}
    quota: {cpu: 0.9, period_ms: 90, slack_ms: 4, tick_ms: 3}
    background: 0.1
    background_beside: 0.05
    background_hz: 50
    interference: 1.1
    price_per_hour: 2
  E: {tier: cloud, cores: 2, scheduler: fifo}
links:
  - from: R
    to: E
    delay_ms: 1
    rate_mbps: 100
    loss: 0.01
    on_loss: {retransmit_ms: 20}
    in_order: true
    price_per_gb: 0.5
    bursts: {every_ms: 800, for_ms: 4, add_delay_ms: 2}
  - {from: E, to: R, delay_ms: 1}
tasks:
  see: {"on": {R: {exec_ms: 1}}, offset_ms: 1, run: "stages:See"}
  think:
    "on":
      R: {exec_ms: 5, threads: 2, workers: 2, standby: 1}
      E: {exec_ms: 2}
    input: {queue: 2}
    priority: 1
    scale: load
    start_ms: 10
    state_bytes: 100
    warmup_jobs: 3
  listen:
    "on": {R: {exec_ms: 1}}
    every: 3
    ros2:
      topic: audio
      type: audio_msgs/msg/Audio
      qos: sensor_data
      depth: 3
      namespace: /robot
      domain: 7
      connect: tcp/localhost:7448
      mode: client
      messages: msgs
  look: {"on": {R: {exec_ms: 2, accelerator: gpu}}}
  act: {"on": {R: {exec_ms: 1}}}
flows:
  - {from: see, to: think, bytes: 100}
  - {from: see, to: look}
  - {from: listen, to: look, sampled: true}
  - {from: see, to: act, sampled: true}
  - {from: think, to: act}
  - {from: look, to: act}
chains: {see-act: {from: see, to: act, max_age_ms: 90}}
candidates: {LOC: {think: R}, FAR: {think: E}}
objective:
  weights:
    latency: 1.5
    violations: 2
    robot: 0.6
    edge: 0.4
    switching: 0.3
    cloud: 0.2
    age: 0.1
    price: 0.3
  targets: {latency_ms: 80, robot: 0.6, edge: 0.5, cloud: 0.4, age_ms: 70, price_per_hour: 2}
  caps: {latency_ms: 95, utilisation: 0.9, misses: {m: 2, k: 20}}
  latency: see-act
  tiers: {R: robot}
  accelerators: true
scenarios:
  bad:
    - {node: E, at_s: 1, for_s: 2, stress_threads: 1, ramp_s: 1}
    - {link: R->E, at_s: 1, for_s: 3, add_delay_ms: 2, loss: 0.1, rate_mbps: 50, ramp_s: 1}
    - {link: E->R, at_s: 1, for_s: 2, down: true, episodes: {name: e, every_s: 9, for_s: 1}}
    - {node: E, at_s: 5, for_s: 2, down: true}
controller:
  "on": E
  policy: atp
  initial: FAR
  decide_cycles: 30
  min_dwell: 2
  min_dwell_cycles: 7
  min_improvement: 0.1
  escape: true
  estimator: corrected
  shadow_fraction: 0.1
  half_life_windows: 3
  replicate: {base: latency-first}
  migration: cold
  guard_cycles: 4
  probe_cycles: 20
  fallbacks: [LOC]
  order_delay_ms: 1
  order_lead_cycles: 1
  close_grace_ms: 5
servo: {plant: double-integrator, gain: 2.0, target: {amplitude_mm: 30, period_s: 5}, damping: 0.5}
live:
  hosts: {E: {address: 10.0.0.2, port: 7000, seen_from: {R: {address: 10.0.0.3, port: 7100}}}}
  release: timer
  clock: system
  mode: advise
  relay: R
  max_age_ms: 150
  silence: zero
  checkpoint_cycles: 30
  degraded_at: 0.2
  actuators:
    act:
      ros2:
        topic: /act
        type: own_msgs/msg/Act
        zero: {speed: 0.0, joints: [0.0, 1.0]}
        require_subscriber: false
        stamp_from: listen
  observer: "stages:Observer"
""")

#: The keys of sections that the controller alone reads, and of which each node has its own.
DECISION = {
    "objective": {"weights", "targets", "caps", "tiers"},
    "controller": {
        *("policy", "estimator", "min_improvement", "min_dwell", "min_dwell_cycles"),
        *("decide_cycles", "shadow_fraction", "escape", "half_life_windows", "replicate"),
    },
    "live": {"mode", "observer"},
}
#: Other words for values that are words.
WORDS = (
    *("edge", "robot", "priority", "fifo", "R", "E", "see", "think", "look", "act", "R->E", "E->R"),
    *("other", "LOC", "FAR", "dtp", "analytic", "warm", "integrator", "estimated", "control"),
    *("hold", "frames", "latest", "stages:Other", "default", "peer", "tcp/localhost:7"),
)
#: Kinds whose keys are in a live cell's file.
KINDS = (
    *(Bursts, Caps, Chain, ControllerSettings, Endpoint, Episodes, Execution, Flow, Host),
    *(Link, LinkDisturbance, LiveSettings, MovingTarget, Node, NodeDisturbance, Objective),
    *(Pipeline, Problem, Quota, RosActuator, RosCommands, RosTopic, Servo, Targets, Task),
    Weights,
)
#: Keys that cannot be changed alone: ends of links and flows, kinds of accelerators, what excludes
#: a phase or goes with a damping, the only source of stamps.
FIXED = {"from", "to", "accelerator", "accelerators", "release", "plant", "stamp_from"}


def leaves(part: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every value of a document."""
    items = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in items:
        if isinstance(value, dict) or (value and isinstance(value, list)):
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key)


def others(value: object) -> tuple[object, ...]:
    """Return values that a key may have instead."""
    match value:
        case bool():
            return (not value,)
        case int():
            return value + 1, value - 1
        case float():
            return value * 0.99, 0.001
        case str():
            return (f"{value}x", *WORDS)
        case _:
            return ()


def changed(document: dict[str, Any], path: tuple[Any, ...]) -> Problem | None:
    """Return the cell with another value at a path; None if no other value is right."""
    made = copy.deepcopy(document)
    part: Any = made
    for key in path[:-1]:
        part = part[key]
    for value in others(part[path[-1]]):
        part[path[-1]] = value
        try:
            problem = from_document(made)
        except ProblemError:
            continue
        if to_document(problem) != document:
            return problem
    return None


def expected(path: tuple[Any, ...]) -> str:
    if path[0] == "tasks" and {"run", "ros2"} & {*path[2:]}:
        return "code"
    if path[1:2] and path[1] in DECISION.get(path[0], ()):
        return "decision"
    return {"hosts": "hosts", "actuators": "code"}.get(str([*path, ""][1]), "wiring")


def test_a_change_of_any_key_changes_the_one_digest_that_it_declares() -> None:
    problem = from_document(CELL)
    document, before = to_document(problem), digests(problem)
    seen: set[str] = set()
    for path in leaves(document):
        other = changed(document, path)
        if other is None:
            continue  # it cannot be changed alone; another of its name can
        after = digests(other)
        assert [part for part in before if before[part] != after[part]] == [expected(path)], path
        seen.update(map(str, path))
    declared = {one.named.partition(".")[0] for kind in KINDS for one in declared_fields(kind)}
    assert declared - seen <= FIXED


def under(estimator: str, *fallbacks: str) -> str:
    problem = from_document(CELL)
    controller = replace(problem.controller, estimator=estimator, fallbacks=fallbacks)
    return digests(replace(problem, controller=controller))["wiring"]


def test_an_estimator_that_needs_other_processes_is_wiring_too() -> None:
    assert under("corrected") != under("profile")
    assert under("corrected", "LOC") == under("profile", "LOC")


def test_a_task_s_code_is_its_own() -> None:
    document = to_document(from_document(CELL))
    before = digests(from_document(document))["code"]
    document["tasks"]["look"]["run"] = document["tasks"]["see"].pop("run")
    assert digests(from_document(document))["code"] != before
