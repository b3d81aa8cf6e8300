"""Events and disturbances of a recorded run on its time line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dwell.dash.paged_cell import Plain
from dwell.model import LinkDisturbance, Problem, Scenario
from dwell.model.disturbed import disturbed, on_link, on_node
from dwell.record import Run

#: Largest number of events in a view.
MOST_EVENTS = 300


def disturbances_met(run: Run, planned: Scenario) -> Scenario:
    """Return the disturbances of a run, with the sampled times of planned episodes."""
    if all(item.episodes is None for item in planned):
        return planned
    # Imported here: it loads the simulator, which samples the episodes.
    from dwell.study.drawn_disturbances import disturbances_of

    return disturbances_of(run)


class Band(NamedTuple):
    """Time during which a node or a link is disturbed; `begin` and `end` are places."""

    begin: float
    end: float
    where: str
    text: str


def bands_of(scenario: Scenario, place: Callable[[float], float], end_s: float) -> list[Band]:
    """Return the disturbances that begin before the end of a run, sorted by their begin.

    `place` converts seconds to places on the time line.
    """
    found = {
        Band(
            place(max(item.at_s, 0.0)),
            place(min(item.end_s, end_s)),
            item.place,
            on_link(item) if isinstance(item, LinkDisturbance) else on_node(item),
        )
        for item in scenario
        if item.episodes is None and item.at_s < end_s
    }
    return sorted(found)


def merged(bands: Iterable[Band]) -> list[tuple[float, float]]:
    """Return the periods with any disturbance; the bands must be sorted by their begin."""
    times: list[tuple[float, float]] = []
    for band in bands:
        if times and band.begin <= times[-1][1]:
            times[-1] = times[-1][0], max(times[-1][1], band.end)
        else:
            times.append((band.begin, band.end))
    return times


def disturbed_at(bands: Iterable[Band], at: float) -> dict[str, str]:
    """Return the texts of the disturbances at a place, by node or link."""
    texts: dict[str, list[str]] = {}
    for band in bands:
        if band.begin <= at < band.end:
            texts.setdefault(band.where, []).append(band.text)
    return {where: ", ".join(some) for where, some in texts.items()}


def disturbance_events(scenario: Scenario, problem: Problem, end_s: float) -> Iterator[Plain]:
    """Yield the begin and end of each disturbance until the end of the run, in seconds."""
    for item in disturbed(scenario, problem.fabric):
        for at_s, word in ((item.begin_s, "begins"), (item.end_s, "ends")):
            if 0 <= at_s <= end_s:
                text = f"{item.kind} {word}: {item.what}"
                yield {"at": at_s, "kind": "disturbance", "text": text}


class RecordedEvents:
    """Events of a run, sorted by their places."""

    def __init__(self, events: Iterable[Plain]) -> None:
        self._events: Sequence[Plain] = sorted(events, key=lambda event: event["at"])
        self._at = np.array([event["at"] for event in self._events])

    def view(self, begin: float, end: float) -> Plain:
        """Return the last `MOST_EVENTS` events between two places, and the number omitted."""
        low, high = np.searchsorted(self._at, (begin, end))
        events = self._events[low:high]
        return {
            "events": events[-MOST_EVENTS:],
            "more_events": max(len(events) - MOST_EVENTS, 0),
        }
