"""What happened in a recorded run, beside its decisions, and the part of it that a view has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from dwell.dash.paged_cell import Plain
from dwell.model import Problem, Scenario
from dwell.model.disturbed import disturbed
from dwell.record import Run

#: Events of a view at most.
MOST_EVENTS = 300


def disturbances_met(run: Run, planned: Scenario) -> Scenario:
    """Return what a run met: what was planned, with its episodes as they were drawn."""
    if all(item.episodes is None for item in planned):
        return planned
    # Loads the simulator, which draws.
    from dwell.study.drawn_disturbances import disturbances_of

    return disturbances_of(run)


def disturbance_events(scenario: Scenario, problem: Problem, end_s: float) -> Iterator[Plain]:
    """Yield what a scenario did until its run ended; places are seconds."""
    for item in disturbed(scenario, problem.fabric):
        for at_s, word in ((item.begin_s, "begins"), (item.end_s, "ends")):
            if 0 <= at_s <= end_s:
                text = f"{item.kind} {word}: {item.what}"
                yield {"at": at_s, "kind": "disturbance", "text": text}


class RecordedEvents:
    """Events in the order of their places."""

    def __init__(self, events: Iterable[Plain]) -> None:
        self._events: Sequence[Plain] = sorted(events, key=lambda event: event["at"])
        self._at = np.array([event["at"] for event in self._events])

    def view(self, begin: float, end: float) -> Plain:
        """Return the last events between two places, and how many are before them."""
        low, high = np.searchsorted(self._at, (begin, end))
        events = self._events[low:high]
        return {
            "events": events[-MOST_EVENTS:],
            "more_events": max(len(events) - MOST_EVENTS, 0),
        }
