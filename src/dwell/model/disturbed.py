"""Descriptions of the disturbances of a scenario, with their times."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from dwell.model.fabric import Fabric
from dwell.model.process import AR1, Constant, Exponential, Gamma, LogNormal, Normal, Process
from dwell.model.scenario import Disturbance, LinkDisturbance, NodeDisturbance

#: Kind of all disturbances of links.
NETWORK = "network impairment"
#: Decimals of seconds: disturbances whose times agree to a tenth are shown together.
DIGITS = 1


class Disturbed(NamedTuple):
    """A disturbance of a node or of links, described in words.

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


def disturbed(scenario: Iterable[Disturbance], fabric: Fabric) -> list[Disturbed]:
    """Return the disturbances of a scenario, with equal simultaneous disturbances merged.

    Disturbances in episodes are left out, because their times are random.
    """
    found: dict[tuple[float, float, str, str], tuple[float, float, list[str]]] = {}
    for item in scenario:
        if item.episodes is not None:
            continue
        begin_s, end_s = item.at_s, item.end_s
        if isinstance(item, NodeDisturbance):
            who, what = item.node, on_node(item)
            kind = f"{fabric.nodes[who].tier} {'outage' if item.down else 'stress'}"
        else:
            who, what = "–".join(sorted((item.source, item.target))), on_link(item)
            kind = NETWORK
        together = round(begin_s, DIGITS), round(end_s, DIGITS), kind, what
        *_, mine = found.setdefault(together, (begin_s, end_s, []))
        if who not in mine:
            mine.append(who)
    return [
        Disturbed(begin_s, end_s, f"{', '.join(who)}: {what}", kind)
        for (_, _, kind, what), (begin_s, end_s, who) in sorted(found.items())
    ]


def on_node(item: NodeDisturbance) -> str:
    """Describe the disturbance of a node, as ``2 busy threads``."""
    if item.down:
        return "down"
    threads = item.stress_threads
    return f"{threads} busy thread{'' if threads == 1 else 's'}"


def on_link(item: LinkDisturbance) -> str:
    """Describe the disturbance of a link, as ``+25 ms, loss 2 %``."""
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
    """Return the declared mean of a process, or None for a process without a declared mean."""
    if isinstance(process, Constant):
        return process.value
    if isinstance(process, AR1 | Exponential | Gamma | LogNormal | Normal):
        return process.mean
    return None
