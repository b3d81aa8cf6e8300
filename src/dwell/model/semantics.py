"""Checks of a cell as a whole: names that resolve, an acyclic DAG, links that exist.

The checks work on parts: if the structure of a file is broken in one place, all other places are
still checked, and all faults are reported at once.
"""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter

from dwell.errors import Fault
from dwell.model import table_columns
from dwell.model.bounds import CLASS_PATH, shown
from dwell.model.chain import Chain, chain_faults
from dwell.model.controller_settings import REPLICATE, ControllerSettings
from dwell.model.every_placement import EveryPlacement, search_faults
from dwell.model.fabric import Link, Node, accelerator_tiers, resources_of
from dwell.model.live import LiveSettings
from dwell.model.objective import Tier
from dwell.model.pipeline import Flow, Task
from dwell.model.replicated import Replicated, replica_faults
from dwell.model.scenario import (
    MAX_LAYERS,
    RAMP_LAYERS,
    Disturbance,
    LinkDisturbance,
    NodeDisturbance,
)
from dwell.model.task_rates import rate_faults

# Names become columns, file names and keys of messages.
NAME = re.compile(r"\w[\w.+:-]*(?: [\w.+:-]+)*")
NAME_SIGN = re.compile(r"[\w.+:\- ]")
LONGEST_NAME = 64
#: Kinds that each cell needs.
NEEDED = frozenset({"node", "task", "candidate"})
_ONE_NODE = "a task at a ROS 2 topic runs on one node: keep one of them"
# How far shares may sum up beyond 1 by rounding.
SHARE_TOLERANCE = 1e-9


class UnreadNames(dict[str, None]):
    """Names of an unreadable section; every name counts as declared."""

    def __contains__(self, name: object) -> bool:
        return True

    def __missing__(self, name: str) -> None:
        """Return None: the content is unknown."""


@dataclass(slots=True)
class CellParts:
    """Parts of a cell, with the path each has in its file.

    A value of None is a part with a known name and unreadable content, whose fault is reported
    elsewhere. References to it resolve, and no other check applies.

    """

    nodes: Mapping[str, Node | None] = field(default_factory=dict)
    links: Sequence[tuple[str, Link]] = ()
    links_complete: bool = True
    tasks: Mapping[str, Task | None] = field(default_factory=dict)
    flows: Sequence[tuple[str, Flow]] = ()
    scales: Collection[str] = ()
    chains: Mapping[str, Chain] = field(default_factory=dict)
    candidates: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    replicated: Mapping[str, Replicated] = field(default_factory=dict)
    broken_candidates: Iterable[str] = ()
    every_placement: EveryPlacement | None = None
    scenarios: Mapping[str, Sequence[tuple[str, Disturbance]]] = field(default_factory=dict)
    controller: ControllerSettings | None = None
    tiers: Mapping[str, Tier] = field(default_factory=dict)
    accelerators: Mapping[str, Tier] = field(default_factory=dict)
    latency: str | None = None
    live: LiveSettings | None = None

    @property
    def candidate_names(self) -> list[str]:
        """Names of all candidates, with or without replicas, readable or not."""
        return [*self.candidates, *self.replicated, *self.broken_candidates]


def closest(word: str, known: Iterable[str], likeness: float = 0.6) -> str:
    """Return the known name that is most like a word; empty where none is like it enough.

    Parameters
    ----------
    likeness : float
        Least ratio of `difflib.SequenceMatcher`, from 0 to 1.
    """
    return next(iter(difflib.get_close_matches(word, list(known), n=1, cutoff=likeness)), "")


def nearest(word: str, known: Iterable[str]) -> str:
    """Return a remedy for an unknown name: the nearest known one, or the list of them."""
    names = list(known)
    match = closest(word, names)
    if match:
        return f"did you mean {match!r}?"
    return f"known: {', '.join(names)}" if names else "none is declared"


def nearest_of(word: str, known: Iterable[str], what: str) -> str:
    """Return a remedy for an unknown name that lists each known name once."""
    names = list(known)
    hint = nearest(word, names)
    return f"{hint} ({what} here: {', '.join(names)})" if hint.startswith("did") else hint


def find_faults(parts: CellParts) -> list[Fault]:
    """Return every fault in the meaning of a cell's parts, in the order of the file."""
    return [
        *_names(parts),
        *_nodes(parts),
        *_links(parts),
        *_tasks(parts),
        *_flows(parts),
        *_chains(parts),
        *_candidates(parts),
        *_scenarios(parts),
        *_objective(parts),
        *_controller(parts),
        *_live(parts),
        *_topics(parts),
    ]


def find_unregistered(
    parts: CellParts,
    name: str,
    policies: Sequence[str],
    estimators: Sequence[str],
    shadowing: Collection[str],
) -> Iterator[Fault]:
    """Yield the faults of names that only a cell file uses instead of classes.

    `name` is the name of the cell, `policies` and `estimators` are the known names, and `shadowing`
    are the estimators that send shadow jobs.
    """
    if message := bad_name(name):
        yield Fault("name", message)
    for candidate in (*parts.candidates, *parts.replicated):
        if candidate in policies:
            message = f"the name {candidate!r} is a policy's; choose another for the placement"
            yield Fault(f"candidates.{candidate}", message)
    settings = parts.controller
    if settings is not None:
        names = parts.candidate_names
        if settings.policy not in names and not CLASS_PATH.holds(settings.policy):
            known = [*policies, *names]
            yield from _unknown("controller.policy", "policy", settings.policy, known)
        yield from _base_faults(parts, settings.replicate.base, policies)
        estimator = settings.estimator
        if estimator is not None and not CLASS_PATH.holds(estimator):
            yield from _unknown("controller.estimator", "estimator", estimator, estimators)
        # The usual estimator sends shadow jobs.
        sends = estimator is None or estimator in shadowing
        given = settings.shadow_fraction if sends else None
        plain = len(names) - len(parts.replicated)
        if isinstance(given, float | int) and (message := too_many_shadows(given, plain)):
            yield Fault("controller.shadow_fraction", message)
    yield from _columns(parts)


def _base_faults(parts: CellParts, base: str, policies: Sequence[str]) -> Iterator[Fault]:
    """Yield the faults of the base policy of `replicate`."""
    path = "controller.replicate.base"
    if base in (REPLICATE, *parts.replicated):
        what = "needs a base itself" if base == REPLICATE else "has replicas"
        yield Fault(path, f"{base} {what}; name another policy, as dtp, or a plain candidate")
    elif not CLASS_PATH.holds(base):
        plain = [name for name in parts.candidate_names if name not in parts.replicated]
        yield from _unknown(path, "policy", base, [*policies, *plain])


def _unknown(path: str, what: str, word: str, known: Collection[str]) -> Iterator[Fault]:
    # A missing section is reported only once.
    if word not in known and (known or what not in NEEDED):
        # A name in decomposed Unicode looks like the declared name.
        twin = unicodedata.normalize("NFC", word) in known and bad_name(word)
        yield Fault(path, twin or f"unknown {what} {word!r}; {nearest(word, known)}")


def _names(parts: CellParts) -> Iterator[Fault]:
    sections: dict[str, Iterable[str]] = {
        "nodes": parts.nodes,
        "tasks": parts.tasks,
        "scales": parts.scales,
        "chains": parts.chains,
        "candidates": [*parts.candidates, *parts.replicated],
        "scenarios": parts.scenarios,
    }
    for section, names in sections.items():
        for name in names:
            if message := bad_name(name):
                yield Fault(f"{section}.{name or repr(name)}", message)


def bad_name(name: str) -> str:
    """Return the fault of a name; empty if it has none."""
    if NAME.fullmatch(name) is not None and len(name) <= LONGEST_NAME:
        return ""
    rule = (
        "use letters, digits, _ - . + : and single spaces, "
        f"a letter, a digit or _ first, at most {LONGEST_NAME} characters"
    )
    sign = next((sign for sign in name if not NAME_SIGN.fullmatch(sign)), None)
    if sign is None:
        return f"{name!r} is not a name; {rule}"
    called = unicodedata.name(sign, "a character without a name")
    composed = unicodedata.normalize("NFC", name)
    if NAME.fullmatch(composed) is not None:
        rule = "write the letter and its accent as one character (Unicode's form NFC)"
    return f"{name!r} is not a name, for it holds U+{ord(sign):04X} ({called}); {rule}"


def _nodes(parts: CellParts) -> Iterator[Fault]:
    if not parts.nodes:
        yield Fault("nodes", "none is declared; a cell needs at least one node")


def _links(parts: CellParts) -> Iterator[Fault]:
    seen: dict[str, str] = {}
    for path, link in parts.links:
        yield from _unknown(f"{path}.from", "node", link.source, parts.nodes)
        yield from _unknown(f"{path}.to", "node", link.target, parts.nodes)
        if link.name in seen:
            yield Fault(
                path,
                f"link {link.name} is declared again (first at {seen[link.name]}); "
                "keep one, or drop `both_ways` from the other",
            )
        seen.setdefault(link.name, path)


def _tasks(parts: CellParts) -> Iterator[Fault]:
    if not parts.tasks:
        yield Fault("tasks", "none is declared; a pipeline needs at least one task")
    targets = {flow.target for _, flow in parts.flows if not flow.sampled}
    for name, task in parts.tasks.items():
        if task is None:
            continue
        path = f"tasks.{name}"
        if task.scale is not None:
            yield from _unknown(f"{path}.scale", "scale", task.scale, parts.scales)
        if task.offset_ms and name in targets:
            yield Fault(
                f"{path}.offset_ms",
                f"{task.offset_ms:g} on a task that waits for inputs; only a task without waited "
                "inputs has an offset: remove it",
            )
        for node_name, execution in task.on.items():
            yield from _unknown(f"{path}.on.{node_name}", "node", node_name, parts.nodes)
            node = parts.nodes.get(node_name)
            kind = execution.accelerator
            if node is not None and kind is not None:
                yield from _unknown(
                    f"{path}.on.{node_name}.accelerator",
                    f"accelerator of {node_name}",
                    kind,
                    node.accelerators,
                )


def _flows(parts: CellParts) -> Iterator[Fault]:
    seen: dict[tuple[str, str], str] = {}
    for path, flow in parts.flows:
        yield from _unknown(f"{path}.from", "task", flow.source, parts.tasks)
        yield from _unknown(f"{path}.to", "task", flow.target, parts.tasks)
        pair = (flow.source, flow.target)
        if pair in seen:
            again = f"flow {flow.source} -> {flow.target} is declared again"
            yield Fault(path, f"{again} (first at {seen[pair]}); keep one")
        seen.setdefault(pair, path)
    flows = [flow for _, flow in parts.flows]
    loop = _cycle(flows)
    if not loop:
        yield from _rates(parts, flows)
        return
    walk = " -> ".join((*loop, loop[0]))
    links = {*zip(loop, (*loop[1:], loop[0]), strict=True)}
    if any(flow.sampled and (flow.source, flow.target) in links for flow in flows):
        message = f"the loop {walk} has a sampled flow; loops are not supported, remove this flow"
    else:
        message = f"the cycle {walk} never starts; remove one of these flows"
    yield Fault("flows", message)


def _rates(parts: CellParts, flows: Sequence[Flow]) -> Iterator[Fault]:
    """Yield the faults of the rates of tasks, if all tasks and flows are known."""
    tasks = {name: task for name, task in parts.tasks.items() if task is not None}
    ends = {name for flow in flows for name in (flow.source, flow.target)}
    if len(tasks) == len(parts.tasks) and ends <= tasks.keys():
        yield from rate_faults(tasks, flows)


def _chains(parts: CellParts) -> Iterator[Fault]:
    for name, chain in parts.chains.items():
        yield from _unknown(f"chains.{name}.from", "task", chain.source, parts.tasks)
        yield from _unknown(f"chains.{name}.to", "task", chain.target, parts.tasks)
    yield from chain_faults(parts.chains, parts.tasks, [flow for _, flow in parts.flows])


def _cycle(flows: Sequence[Flow]) -> list[str]:
    """Return the tasks of one directed cycle from the first of its flows on, or an empty list."""
    graph: TopologicalSorter[str] = TopologicalSorter()
    for flow in flows:
        graph.add(flow.target, flow.source)
    try:
        graph.prepare()
    except CycleError as error:
        loop: list[str] = error.args[1][:-1]
        first = loop.index(next(flow.source for flow in flows if flow.source in loop))
        return [*loop[first:], *loop[:first]]
    return []


def _candidates(parts: CellParts) -> Iterator[Fault]:
    settings, every = parts.controller, parts.every_placement
    fallbacks = settings.fallbacks if settings is not None else ()
    yield from search_faults(every, parts.candidate_names, fallbacks)
    is_searched = every is not None and not every.is_found
    if not (is_searched or parts.candidate_names):
        yield Fault("candidates", "none is declared; name at least one placement, as `LOC: {}`")
    for name, moves in parts.candidates.items():
        path = f"candidates.{name}"
        faults = list(_placed(parts, path, moves))
        yield from faults
        if not faults:
            yield from _connected(parts, path, moves)
    yield from replica_faults(
        parts.replicated,
        {
            name: {task: node for task in parts.tasks if (node := _node_of(parts, moves, task))}
            for name, moves in parts.candidates.items()
        },
        parts.broken_candidates,
        parts.tasks,
        [flow for _, flow in parts.flows],
        _unknown,
    )


def _placed(parts: CellParts, path: str, moves: Mapping[str, str]) -> Iterator[Fault]:
    for task_name, node in moves.items():
        here = f"{path}.{task_name}"
        if task_name not in parts.tasks:
            if task_name == "replicas":
                yield Fault(here, f"{node} is no list; name two candidates, as [LOC, SO]")
            else:
                yield from _unknown(here, "task", task_name, parts.tasks)
            continue
        task = parts.tasks[task_name]
        if task is None or node in task.on:
            continue
        feasible = ", ".join(task.on)
        if node not in parts.nodes:
            yield from _unknown(here, "node", node, parts.nodes)
        elif not all(name in parts.nodes for name in task.on):
            continue  # The task names an unknown node, possibly a misspelling of this node.
        elif task.anchored:
            yield Fault(here, f"{task_name} is anchored to {feasible}; it cannot move to {node}")
        else:
            yield Fault(here, f"{task_name} cannot run on {node!r}; feasible: {feasible}")
    for task_name, task in parts.tasks.items():
        if task is not None and not task.anchored and task_name not in moves:
            where = " or ".join(task.on)
            yield Fault(path, f"relocatable task {task_name!r} is not placed; put it on {where}")


def _connected(parts: CellParts, path: str, moves: Mapping[str, str]) -> Iterator[Fault]:
    if not parts.links_complete:
        return
    links = {link.name for _, link in parts.links}
    missing: dict[str, list[str]] = {}
    for _, flow in parts.flows:
        source = _node_of(parts, moves, flow.source)
        target = _node_of(parts, moves, flow.target)
        if source is None or target is None or source == target:
            continue
        if f"{source}->{target}" not in links:
            flows = missing.setdefault(f"{source}->{target}", [])
            flows.append(f"{flow.source} -> {flow.target}")
    for name, flows in missing.items():
        remedy = "declare it under `links`, or drop the candidate"
        yield Fault(path, f"needs the link {name} for {', '.join(flows)}; {remedy}")


def _node_of(parts: CellParts, moves: Mapping[str, str], task_name: str) -> str | None:
    if task_name in moves:
        return moves[task_name]
    task = parts.tasks.get(task_name)
    return next(iter(task.on)) if task is not None else None


def _scenarios(parts: CellParts) -> Iterator[Fault]:
    links = [link.name for _, link in parts.links]
    for name, items in parts.scenarios.items():
        if name == "baseline" and items:
            yield Fault(
                "scenarios.baseline",
                "must stay empty: it is the cell undisturbed; give the scenario another name",
            )
        for path, item in items:
            if isinstance(item, NodeDisturbance):
                yield from _unknown(f"{path}.node", "node", item.node, parts.nodes)
            elif parts.links_complete:
                yield from _unknown(f"{path}.link", "link", item.link, links)
        yield from episode_faults(items)
        yield from _layers(parts, items)


def episode_faults(items: Sequence[tuple[str, Disturbance]]) -> Iterator[Fault]:
    """Yield where disturbances whose episodes share a name cannot begin and end together.

    Parameters
    ----------
    items : sequence of (path, Disturbance)
    """
    first: dict[str, tuple[str, Disturbance]] = {}
    for path, item in items:
        if item.episodes is None:
            continue
        name = item.episodes.name
        if bad_name(name):
            yield Fault(f"{path}.episodes.name", bad_name(name))
        where, other = first.setdefault(name, (path, item))
        if (item.at_s, item.episodes) != (other.at_s, other.episodes):
            yield Fault(
                f"{path}.episodes",
                f"{name!r} is declared otherwise at {where}; what shares a name comes and goes "
                "together: make `at_s` and `episodes` equal, or give these another name",
            )


def _layers(parts: CellParts, items: Sequence[tuple[str, Disturbance]]) -> Iterator[Fault]:
    """Extra delays of a link are bits of a number."""
    bursts = {link.name for _, link in parts.links if link.bursts is not None}
    taken: dict[str, int] = {}
    for path, item in items:
        if isinstance(item, LinkDisturbance) and item.layers:
            before = taken.get(item.link, int(item.link in bursts))
            taken[item.link] = before + item.layers
            if before <= MAX_LAYERS < taken[item.link]:
                yield Fault(
                    f"{path}.add_delay_ms",
                    f"one too many on {item.link}: its extra delays count {taken[item.link]} and "
                    f"may count {MAX_LAYERS} (1 each, {RAMP_LAYERS} with a `ramp_s`, 1 for its "
                    "`bursts`)",
                )


def _objective(parts: CellParts) -> Iterator[Fault]:
    if parts.latency is not None:
        yield from _unknown("objective.latency", "chain", parts.latency, parts.chains)
    for name in parts.tiers:
        yield from _unknown(f"objective.tiers.{name}", "node", name, parts.nodes)
    counted = accelerator_tiers(parts.nodes, parts.tiers)
    if parts.accelerators and parts.accelerators != counted:
        names = ", ".join(f"{name}: {tier}" for name, tier in counted.items()) or "nothing"
        yield Fault(
            "objective.accelerators",
            f"{shown(dict(parts.accelerators))} is not allowed; it must be empty, or name the "
            f"accelerators of all nodes in tiers, {names}",
        )


def _controller(parts: CellParts) -> Iterator[Fault]:
    settings = parts.controller
    if settings is None:
        return
    names = parts.candidate_names
    if settings.on is not None:
        yield from _unknown("controller.on", "node", settings.on, parts.nodes)
    if settings.initial is not None:
        yield from _unknown("controller.initial", "candidate", settings.initial, names)
    for index, name in enumerate(settings.fallbacks):
        yield from _unknown(f"controller.fallbacks[{index}]", "candidate", name, names)
        if name in parts.replicated:
            yield Fault(
                f"controller.fallbacks[{index}]",
                f"{name} has replicas; name a plain candidate, such as one of its members",
            )
    if settings.migration == "cold" and parts.links_complete:
        yield from _state_transfers(parts)


def _live(parts: CellParts) -> Iterator[Fault]:
    live = parts.live
    if live is None:
        return
    for name, host in live.hosts.items():
        yield from _unknown(f"live.hosts.{name}", "node", name, parts.nodes)
        for other in host.seen_from:
            yield from _unknown(f"live.hosts.{name}.seen_from.{other}", "node", other, parts.nodes)
    if live.relay is not None:
        yield from _unknown("live.relay", "node", live.relay, parts.nodes)
    for task in live.actuators:
        path = f"live.actuators.{task}"
        known = list(_unknown(path, "task", task, parts.tasks))
        yield from known
        if not known and any(flow.source == task for _, flow in parts.flows):
            yield Fault(path, f"{task} is no sink: other tasks take what it sends; leave it out")


def _topics(parts: CellParts) -> Iterator[Fault]:
    """Faults of the ROS 2 topics at the ends of a cell."""
    targets = {flow.target for _, flow in parts.flows}
    sources = {name: task for name, task in parts.tasks.items() if task is not None and task.ros2}
    seen: dict[tuple[str, int | None], str] = {}
    for name, task in sources.items():
        path, topic = f"tasks.{name}.ros2", task.ros2
        if name in targets:
            yield Fault(path, f"{name} has inputs; only a source reads a topic: remove it")
        if not task.anchored:
            yield Fault(path, f"{name} can run on {' and '.join(task.on)}; {_ONE_NODE}")
        if topic is not None:
            read = topic.resolved, topic.domain
            if read in seen:
                yield Fault(f"{path}.topic", f"{topic.resolved} is read by {seen[read]}, too")
            seen.setdefault(read, name)
    for name, actuator in parts.live.actuators.items() if parts.live is not None else ():
        sink = parts.tasks.get(name)
        if sink is None or parts.live is None or isinstance(actuator, str):
            continue
        path, commands = f"live.actuators.{name}.ros2", actuator.ros2
        if not sink.anchored:
            where = " and ".join(sink.on)
            yield Fault(path, f"{name} can run on {where}, and each would publish; {_ONE_NODE}")
        if parts.live.silence == "zero" and not commands.stops:
            what = f"missing, with live.silence zero: {commands.type} has no message that stops"
            yield Fault(f"{path}.zero", f"{what} a robot; give its fields, or set silence: hold")
        if commands.stamp_from is not None and commands.stamp_from not in sources:
            yield from _unknown(
                f"{path}.stamp_from", "task with `ros2`", commands.stamp_from, sources
            )


def _columns(parts: CellParts) -> Iterator[Fault]:
    """Yield bad names of accelerators, and names that give two columns the same name."""
    for name, node in parts.nodes.items():
        for kind in node.accelerators if node is not None else ():
            if message := bad_name(kind):
                yield Fault(f"nodes.{name}.accelerators.{kind or repr(kind)}", message)
    resources, chains = resources_of(parts.nodes), list(parts.chains)
    candidates = [*parts.candidates, *parts.replicated]
    yield from table_columns.clash_faults(resources, candidates, chains)


def too_many_shadows(fraction: float, candidates: int) -> str:
    """Return the fault of a share of the cycles for each alternative; empty where it has none.

    A cycle is sent through one alternative at most.
    """
    alternatives = max(candidates - 1, 1)
    if fraction * alternatives <= 1 + SHARE_TOLERANCE:
        return ""
    return (
        f"{fraction:g} of the cycles through each of {alternatives} alternatives is more than all "
        f"cycles; at most {1 / alternatives:.4g}"
    )


def _state_transfers(parts: CellParts) -> Iterator[Fault]:
    """A cold migration carries the state of a task over a direct link."""
    links = {f"{link.source}->{link.target}" for _, link in parts.links}
    for name, task in parts.tasks.items():
        if task is None or task.state_bytes == 0:
            continue
        hosts = dict.fromkeys(
            placement[name] for placement in parts.candidates.values() if name in placement
        )
        missing = [
            f"{source}->{target}"
            for source in hosts
            for target in hosts
            if source != target and f"{source}->{target}" not in links
        ]
        if missing:
            yield Fault(
                f"tasks.{name}.state_bytes",
                f"its state cannot be sent without the link {', '.join(missing)}; "
                "declare it, or use migration: warm",
            )
