"""Timeline: the changes of nodes and links in a realisation of a scenario.

The changes come from the simulator with the seed of the run. So episodes, ramps and simultaneous
disturbances have the same meaning on a testbed. Bursts are left out, as they belong to nodes and
links instead of the scenario.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from dwell.errors import LiveError
from dwell.live.local.conditions import Conditions
from dwell.model import Link, LinkDisturbance, Problem, Scenario
from dwell.model.instants import NEVER_NS, require_length
from dwell.model.scenario import RAMP_STEPS, Disturbance

if TYPE_CHECKING:
    from dwell.sim import LinkSegment

NS_PER_S = 1e9


@dataclass(frozen=True, slots=True)
class NodeState:
    """State of a node: number of foreign threads, and whether it is down."""

    threads: int
    down: bool = False


@dataclass(frozen=True, slots=True)
class Change:
    """Change of a node or a link (``R1->E``) to a new complete state.

    `at_ns` counts from the first release.
    """

    at_ns: int
    place: str
    state: NodeState | Conditions

    @property
    def at_s(self) -> float:
        """Time of the change in seconds."""
        return self.at_ns / 1e9


@dataclass(frozen=True, slots=True)
class Timeline:
    """Changes of the nodes and links that a scenario disturbs, sorted by time.

    `items` is the scenario, with one disturbance per sampled episode.
    """

    items: Scenario = ()
    changes: tuple[Change, ...] = ()


def timeline_of(
    problem: Problem, scenario: str, *, seed: int, seconds: float, outages: bool = False
) -> Timeline:
    """Return the changes of a realisation of a scenario; a simulation with this seed has the same.

    Parameters
    ----------
    seed : int
        At least 0.
    seconds : float
        Length of the run.
    outages : bool
        Whether the testbed can emulate nodes and links that are down.

    Raises
    ------
    ProblemError
        If the scenario is unknown or too long, or a link would lose all messages.
    LiveError
        If the testbed cannot emulate the scenario; lists all reasons.
    """
    require_playable_scenario(problem, scenario, outages=outages)
    written = problem.scenario(scenario)
    if not written:
        return Timeline()
    from dwell.sim import Drawing

    window_s = problem.window_ms / 1e3
    windows = math.floor(seconds / window_s) + 1
    period_ms = problem.pipeline.period_ms
    require_length(windows, problem.window_cycles, period_ms, f"seconds = {seconds:g}")
    problem = _without_bursts(problem)
    drawing = Drawing(problem, scenario, seed=seed, windows=windows)
    items, (nodes, segments) = drawing.episodes(), drawing.changes
    changes = [Change(one.at_ns, one.node, NodeState(one.threads, one.down)) for one in nodes]
    # The first segment of a link is undisturbed, unless a disturbance begins at 0.
    at_once = {item.place for item in items if first_ns(item) == 0}
    changes += [
        Change(one.at_ns, one.link, _conditions(problem.fabric.links[one.link], one, written))
        for one in segments
        if one.at_ns > 0 or one.link in at_once
    ]
    return Timeline(items, tuple(sorted(changes, key=lambda change: change.at_ns)))


def first_ns(item: Disturbance) -> int:
    """Return the time of the first change of a disturbance, since the first release."""
    return round(item.at_s * NS_PER_S) + step_ns(item)


def last_ns(item: Disturbance) -> int:
    """Return the time of the last change of a disturbance; `NEVER_NS` if it does not end."""
    if math.isinf(item.for_s):
        return NEVER_NS
    end_ns = round(min(round(item.at_s * NS_PER_S) + item.for_s * NS_PER_S, NEVER_NS))
    return end_ns - step_ns(item)


def step_ns(item: Disturbance) -> int:
    """Return the length of a step of a disturbance's ramp; 0 without a ramp."""
    step: int = round(round(item.ramp_s * NS_PER_S) / RAMP_STEPS)
    return step


def require_playable_scenario(problem: Problem, scenario: str, *, outages: bool) -> None:
    """Raise a LiveError with all reasons if a testbed cannot emulate a scenario.

    Raises a ProblemError if the scenario is unknown.
    """
    down = [item.place for item in problem.scenario(scenario) if item.down]
    if down and not outages:
        faults = "; ".join(f"{place} cannot be taken down here" for place in down)
        instead = "a link with a loss of 0.99 can be played, and `dwell testbed run` plays outages"
        raise LiveError(f"scenario {scenario!r} cannot be played: {faults}; {instead}")


def _without_bursts(problem: Problem) -> Problem:
    fabric = problem.fabric
    nodes = {name: replace(node, bursts=None) for name, node in fabric.nodes.items()}
    links = {name: replace(link, bursts=None) for name, link in fabric.links.items()}
    return replace(problem, fabric=replace(fabric, nodes=nodes, links=links))


def usual_conditions(link: Link) -> Conditions:
    """Return the conditions of a link without disturbances."""
    return Conditions(delay_ms=link.delay_ms, rate_mbps=link.rate_mbps, loss=link.loss)


def _conditions(link: Link, segment: LinkSegment, scenario: Scenario) -> Conditions:
    """Return the conditions of a link in a segment of its realisation."""
    delays, shares, layer = [], [], 0
    for item in scenario:
        if not isinstance(item, LinkDisturbance) or item.link != link.name:
            continue
        if item.add_delay_ms is None:
            continue
        # The layers are the binary digits of the disturbance's strength.
        level = sum(1 << (one - layer) for one in segment.layers if 0 <= one - layer < item.layers)
        delays.append(item.add_delay_ms)
        shares.append(level / ((1 << item.layers) - 1))
        layer += item.layers
    return Conditions(
        delay_ms=link.delay_ms,
        add_delays_ms=tuple(delays),
        shares=tuple(shares),
        rate_mbps=segment.rate_mbps,
        loss=segment.loss,
        down=segment.down,
    )
