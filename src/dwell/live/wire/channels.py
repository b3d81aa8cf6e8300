"""Channels: the kinds of messages between the processes of a cell, in one table.

Type, keys, permitted senders, signature and second copy of a message follow from its channel.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from dwell.live.wire.keys import CONTROLLER, MAIN, SHADOW, Channel, Senders
from dwell.live.wire.messages import (
    Accepted,
    Answer,
    Ask,
    Beat,
    Beats,
    Carried,
    Completion,
    Header,
    Load,
    Order,
    Restored,
    Snapshot,
    Stamped,
    State,
)
from dwell.live.wire.wiring import Kind, roles
from dwell.model import Problem


def _from_stamper(problem: Problem) -> Senders:
    yield (), [problem.stamper_node]


def _from_controller(_: Problem) -> Senders:
    yield (), [CONTROLLER]


def _from_people(_: Problem) -> Senders:
    return ()


def _answers(_: Problem) -> Senders:
    yield ("*",), [CONTROLLER]


def _from_relay(problem: Problem) -> Senders:
    yield (), [problem.relay_node]


def _from_each_node(problem: Problem) -> Senders:
    for node in problem.fabric.nodes:
        yield (node,), [node]


def _from_each_process(problem: Problem) -> Senders:
    for role in roles(problem):
        yield (role.node, role.who), [CONTROLLER if role.kind == "controller" else role.node]


def _from_upstream(problem: Problem) -> Senders:
    pipeline = problem.pipeline
    for name, task in pipeline.tasks.items():
        flows = pipeline.inputs(name)
        before = {node for flow in flows for node in pipeline.tasks[flow.source].on}
        if not pipeline.waited(name):
            before.add(problem.stamper_node)
        for kind in (MAIN, SHADOW) if flows else (MAIN,):
            for node in task.on:
                yield (name, node, kind), before


def _from_sinks(problem: Problem) -> Senders:
    for name, task in problem.pipeline.tasks.items():
        if not problem.pipeline.outputs(name):
            yield (name,), task.on


def _from_workers(problem: Problem) -> Senders:
    for task in problem.pipeline.tasks.values():
        yield (), task.on


def _from_cameras(problem: Problem) -> Senders:
    """Yield the nodes of the first source, whose frames may start the cycles."""
    pipeline = problem.pipeline
    first = next(task for name, task in pipeline.tasks.items() if not pipeline.inputs(name))
    if problem.live.release == "frames":
        yield (), first.on


def _moving(problem: Problem) -> Iterable[tuple[str, str, str]]:
    """Yield task, node and other node of each move of a state."""
    for name, task in problem.pipeline.tasks.items():
        yield from ((name, to, node) for to in task.on for node in task.on if to != node)


def _old_nodes(problem: Problem) -> Senders:
    """Yield the nodes that may forward values to another node of a task that samples them."""
    sampling = {flow.target for flow in problem.pipeline.flows if flow.sampled}
    for task, to, node in _moving(problem):
        if task in sampling:
            yield (task, to, node), [node]


def _moved_to(problem: Problem) -> Senders:
    for task, node, _ in _moving(problem):
        yield (task, node), [CONTROLLER]


def _moved_from(problem: Problem) -> Senders:
    for task, to, node in _moving(problem):
        yield (task, to, node), [node]


def _movable(problem: Problem) -> Senders:
    for _, node, _ in _moving(problem):
        yield (), [node]


def _node(_: Problem, message: Completion | Load | Restored) -> str:
    return message.node


def _owner(problem: Problem, beat: Beat) -> str:
    return CONTROLLER if beat.who == f"controller@{problem.controller_node}" else beat.node


def _agent(_: Problem, beats: Beats) -> str:
    return beats.beats[0].node


def _stamper(problem: Problem, _: Accepted) -> str:
    return problem.stamper_node


def _controller(_: Problem, __: Order | Snapshot) -> str:
    return CONTROLLER


_WORKERS: tuple[Kind, ...] = "worker", "standby"
_BOTH: tuple[Kind, ...] = "stamper", "controller"

INPUT = Channel("in", Header, _from_upstream, (*_WORKERS, "shadow"), 3)
COMMAND = Channel("sink", Header, _from_sinks, ("sink",), 1)
DONE = Channel("done", Completion, _from_sinks, _BOTH, 1, _node, twice=True)
#: Ends of cycles and shadows before a sink.
ENDED = Channel("ended", Completion, _from_workers, _BOTH, 0, _node, twice=True)
BEAT = Channel("beat", Beat, _from_each_process, (), 2, _owner, twice=True)
#: Beats of all processes of a node, from its agent.
BEATS = Channel("beats", Beats, _from_each_node, (), 1, _agent)
#: Request of the stamper to the relay for the beats that it misses.
MISSED = Channel("missed", msgspec.Struct, _from_stamper, ("agent",))
STAMPED = Channel("stamped", Stamped, _from_stamper, ("controller", "visitor"))
#: Request for a cycle, because the source has a frame.
FRAME = Channel("frame", msgspec.Struct, _from_cameras, ("stamper",))
ORDER = Channel("order", Order, _from_controller, ("stamper",), 0, _controller)
ACCEPTED = Channel("accepted", Accepted, _from_stamper, ("controller",), 0, _stamper, twice=True)
LOAD = Channel("load", Load, _from_each_node, ("controller",), 1, _node, twice=True)
#: Request for a state, to both workers of its move.
SNAPSHOT = Channel("snapshot", Snapshot, _moved_to, _WORKERS, 2, _controller)
STATE = Channel("state", State, _moved_from, _WORKERS, 3)
#: Newest value of a sampled flow, from an old node of its target. Its workers subscribe to it.
VALUE = Channel("value", Header, _old_nodes, (), 3)
RESTORED = Channel("restored", Restored, _movable, ("controller",), 0, _node)
ASK = Channel("ask", Ask, _from_people, ("controller",))
LOOK = Channel("look", Ask, _from_people, ("controller",))
ANSWER = Channel("answer", Answer, _answers, ("visitor",), 1)
#: Batches of second copies: for the stamper, and, less frequent, for the controller.
CARRIED = Channel("carried", Carried, _from_relay, ("stamper",))
GATHERED = Channel("gathered", Carried, _from_relay, ("controller", "visitor"))

#: All channels, by their words.
CHANNELS: dict[str, Channel[Any]] = {
    channel.word: channel
    for channel in (
        *(INPUT, COMMAND, DONE, ENDED, BEAT, BEATS, MISSED, STAMPED, FRAME, ORDER, ACCEPTED, LOAD),
        *(SNAPSHOT, STATE, VALUE, RESTORED, ASK, LOOK, ANSWER, CARRIED, GATHERED),
    )
}
#: Channels on the detour.
RELAYED = frozenset(one for one in CHANNELS.values() if one.twice or one is BEATS)
