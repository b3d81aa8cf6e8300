"""Phases: the stretches of a run in which the same disturbances were on."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from dwell.model import (
    AR1,
    Constant,
    Disturbance,
    Exponential,
    Fabric,
    Gamma,
    LinkDisturbance,
    LogNormal,
    NodeDisturbance,
    Normal,
    Process,
)

__all__ = ["CALM", "Disturbed", "Phase", "disturbed", "phases"]

CALM = "baseline"
#: Who is disturbed, as it is called: by what the disturbance acts on.
NETWORK = "network impairment"
#: Decimals of seconds: what began and ended together did so within a tenth.
DIGITS = 1


class Disturbed(NamedTuple):
    """Something that was done to a node or to links for a while.

    Parameters
    ----------
    what : str
        As ``R1: 1 busy thread``.
    kind : str
        As ``robot stress``.
    """

    begin_s: float
    end_s: float
    what: str
    kind: str


class Phase(NamedTuple):
    """A stretch of time.

    Parameters
    ----------
    name : str
        ``baseline``, or the kinds of what was on.
    """

    name: str
    begin_s: float
    end_s: float


def disturbed(scenario: Iterable[Disturbance], fabric: Fabric) -> list[Disturbed]:
    """Return what a scenario did, links that were disturbed together as one.

    Parameters
    ----------
    scenario : iterable of Disturbance
        Those that come in episodes are left out: when they came was drawn.
    fabric : Fabric
        Whose nodes say their tiers.
    """
    found: dict[tuple[float, float, str, str], tuple[float, float, list[str]]] = {}
    for item in scenario:
        if item.episodes is not None:
            continue
        begin_s, end_s = item.at_s, item.end_s
        if isinstance(item, NodeDisturbance):
            who, what = item.node, _on_node(item)
            kind = f"{fabric.nodes[who].tier} {'outage' if item.down else 'stress'}"
        else:
            who, what = "–".join(sorted((item.source, item.target))), _on_link(item)
            kind = NETWORK
        together = round(begin_s, DIGITS), round(end_s, DIGITS), kind, what
        *_, mine = found.setdefault(together, (begin_s, end_s, []))
        if who not in mine:
            mine.append(who)
    return [
        Disturbed(begin_s, end_s, f"{', '.join(who)}: {what}", kind)
        for (_, _, kind, what), (begin_s, end_s, who) in sorted(found.items())
    ]


def _on_node(item: NodeDisturbance) -> str:
    if item.down:
        return "down"
    threads = item.stress_threads
    return f"{threads} busy thread{'' if threads == 1 else 's'}"


def _on_link(item: LinkDisturbance) -> str:
    if item.down:
        return "down"
    parts = []
    if item.add_delay_ms is not None:
        mean_ms = _declared_mean(item.add_delay_ms)
        parts.append("more delay" if mean_ms is None else f"+{mean_ms:g} ms")
    if item.loss:
        parts.append(f"loss {100 * item.loss:g} %")
    if item.rate_mbps < math.inf:
        parts.append(f"{item.rate_mbps:g} Mbit/s")
    return ", ".join(parts) or "disturbed"


def _declared_mean(process: Process) -> float | None:
    """Return the mean that a process is declared with; None where it is declared otherwise."""
    if isinstance(process, Constant):
        return process.value
    if isinstance(process, AR1 | Exponential | Gamma | LogNormal | Normal):
        return process.mean
    return None


def phases(events: Sequence[Disturbed], end_s: float) -> list[Phase]:
    """Return the phases of a run from its beginning on."""
    edges = {0.0, end_s}
    for event in events:
        edges.update(edge for edge in (event.begin_s, event.end_s) if 0 < edge < end_s)
    found: list[Phase] = []
    for begin_s, until_s in itertools.pairwise(sorted(edges)):
        kinds = [event.kind for event in events if event.begin_s <= begin_s < event.end_s]
        name = " and ".join(dict.fromkeys(kinds)) or CALM
        if found and found[-1].name == name:
            found[-1] = found[-1]._replace(end_s=until_s)
        else:
            found.append(Phase(name, begin_s, until_s))
    return found
