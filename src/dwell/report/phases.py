"""Phases: the stretches of a run in which the same disturbances were on."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

__all__ = ["CALM", "Disturbed", "Phase", "disturbed", "phases"]

CALM = "baseline"
#: Who is disturbed, as it is called: by what the disturbance acts on.
NETWORK = "network impairment"
#: Decimals of seconds: what began and ended together did so within a tenth.
DIGITS = 1

Item: TypeAlias = Mapping[str, Any]


class Disturbed(NamedTuple):
    """Something that was done to a node or to links for a while.

    Parameters
    ----------
    begin_s, end_s : float
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
    begin_s, end_s : float
    """

    name: str
    begin_s: float
    end_s: float


def disturbed(scenario: Iterable[Item], tiers: Mapping[str, str]) -> list[Disturbed]:
    """Return what a scenario did, links that were disturbed together as one.

    Parameters
    ----------
    scenario : iterable of mapping
        As in a cell file. Those that come in episodes are left out: when they came was drawn.
    tiers : mapping of str to str
        Of the nodes.
    """
    found: dict[tuple[float, float, str, str], tuple[float, float, list[str]]] = {}
    for item in scenario:
        if item.get("episodes") is not None:
            continue
        begin_s = float(item.get("at_s", 0.0))
        length_s = item.get("for_s")
        end_s = begin_s + (math.inf if length_s is None else float(length_s))
        link = item.get("link")
        what = _on_node(item) if link is None else _on_link(item)
        kind = _stress(item, tiers) if link is None else NETWORK
        who = str(item["node"]) if link is None else "–".join(sorted(str(link).split("->")))
        together = round(begin_s, DIGITS), round(end_s, DIGITS), kind, what
        *_, mine = found.setdefault(together, (begin_s, end_s, []))
        if who not in mine:
            mine.append(who)
    return [
        Disturbed(begin_s, end_s, f"{', '.join(who)}: {what}", kind)
        for (_, _, kind, what), (begin_s, end_s, who) in sorted(found.items())
    ]


def _stress(item: Item, tiers: Mapping[str, str]) -> str:
    return f"{tiers.get(str(item['node']), 'node')} {'outage' if item.get('down') else 'stress'}"


def _on_node(item: Item) -> str:
    if item.get("down"):
        return "down"
    threads = int(item.get("stress_threads", 0))
    return f"{threads} busy thread{'' if threads == 1 else 's'}"


def _on_link(item: Item) -> str:
    if item.get("down"):
        return "down"
    parts = []
    if item.get("add_delay_ms") is not None:
        mean_ms = _mean(item["add_delay_ms"])
        parts.append("more delay" if mean_ms is None else f"+{mean_ms:g} ms")
    if item.get("loss"):
        parts.append(f"loss {100 * float(item['loss']):g} %")
    rate = item.get("rate_mbps")
    if rate is not None and math.isfinite(float(rate)):
        parts.append(f"{float(rate):g} Mbit/s")
    return ", ".join(parts) or "disturbed"


def _mean(process: object) -> float | None:
    """Return the mean that a process says it has."""
    if isinstance(process, int | float):
        return float(process)
    if isinstance(process, Mapping):
        for values in process.values():
            if isinstance(values, Mapping) and isinstance(values.get("mean"), int | float):
                return float(values["mean"])
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
