"""Symptoms: signs in the cycles of a live cell that it is not healthy.

Beats are not sufficient: they do not share the lane of the images, and a worker whose stage fails
still sends them. Symptoms count messages that arrived, commands that were applied, and deadlines.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dwell.live.roles.cycle_ledger import Ledger, LiveCycle
from dwell.live.roles.run_rows import LiveWindow
from dwell.live.wire.messages import ACTUATED, STALE, Completion
from dwell.model import Problem
from dwell.model.live import RECENT_WINDOWS

#: Time without shadows through a candidate, in windows, after which its failed shadows are ignored.
SILENT_WINDOWS = 2


@dataclass(slots=True)
class _Lead:
    """Cycles between two windows: the first one, their number, applied commands and silences."""

    first: LiveCycle | None = None
    count: int = 0
    applied: int = 0
    silences: int = 0


class Symptoms:
    """See the module; instants are on the controller's clock."""

    def __init__(self, problem: Problem, ledger: Ledger) -> None:
        self._ledger, self._size = ledger, problem.window_cycles
        # Cycles that may still complete within the guard's patience.
        self._open = problem.controller.guard_cycles + problem.pipeline.open_cycles - 1
        self._failures = problem.controller.failures_in_a_row
        self._deadline_ns = problem.pipeline.deadline_ns
        self._period_ns = problem.pipeline.period_ns
        self._begun_ns: int | None = None
        self._recent: deque[LiveWindow] = deque(maxlen=RECENT_WINDOWS)
        # Cycles before each of these windows, and before the next window.
        self._leads: deque[_Lead] = deque([_Lead()], maxlen=RECENT_WINDOWS + 1)
        # By sink: arrival of the last report of an applied command, and the last outcome.
        self._applied_ns: dict[str, int] = {}
        self._outcomes: dict[str, str] = {}
        self._silences = 0

    def begun(self, at_ns: int) -> None:
        """Record the first message about a cycle."""
        if self._begun_ns is None:
            self._begun_ns = at_ns

    def completed(self, completion: Completion, at_ns: int) -> None:
        """Record a sink's report of a command."""
        self._outcomes[completion.sink] = completion.outcome
        if completion.outcome == ACTUATED:
            self._applied_ns[completion.sink] = at_ns

    def silenced(self, silences: int) -> None:
        """Record reports of calls of `hold` or `zero`."""
        self._silences += silences

    def closed(self, window: LiveWindow) -> None:
        """Add a closed window."""
        self._recent.append(window)
        self._leads.append(_Lead())

    def led(self, cycles: Sequence[LiveCycle]) -> None:
        """Add cycles outside windows; they count with the next window."""
        lead = self._leads[-1]
        if lead.first is None and cycles:
            lead.first = cycles[0]
        lead.count += len(cycles)
        lead.applied += sum(map(self._is_applied, cycles))
        lead.silences += sum(cycle.silences for cycle in cycles)

    def set_back(self, back_ns: int) -> None:
        """Shift the times of arrival after the clock was set back."""
        if self._begun_ns is not None:
            self._begun_ns -= back_ns
        self._applied_ns = {sink: at_ns - back_ns for sink, at_ns in self._applied_ns.items()}

    def status(self, newest: Sequence[LiveCycle], now_ns: int) -> dict[str, Any]:
        """Return the symptoms as plain values; `newest` has the last cycle first.

        ``begun_ms``: time since the first message about a cycle, or None. ``silences``: number of
        calls of ``hold`` or ``zero`` before an applied command. ``release_ratio``: released cycles
        per period, over at most three windows; None before the first. ``recent``: V_D and
        `_commands` of the last windows, the number of their cycles whose data are over a chain's
        ``max_age_ms``, and the message that most of their lost cycles lack.
        ``sinks``: age of the last applied command, or None; outcome of the last command; if that is
        stale, the time between arrivals of its stamp and its completion here. ``failing``: by
        candidate whose last shadows have all failed, the number of these shadows
        (``failures_in_a_row``), and the message that the last of them lacks. Messages are source
        and target, as ``task@node``.
        """
        begun_ns = self._begun_ns
        return {
            "begun_ms": None if begun_ns is None else round((now_ns - begun_ns) / 1e6, 1),
            "silences": self._silences,
            "release_ratio": self._release_ratio(newest),
            "recent": {
                "violation_rates": [
                    window.violation_rate(self._deadline_ns) for window in self._recent
                ],
                **self._commands(),
                "over_age": sum(one.over_age for window in self._recent for one in window.cycles),
                "unreached": self._mostly_unreached(),
            },
            "sinks": {
                sink: self._sink(sink, newest, now_ns) for sink in sorted(self._ledger.sinks)
            },
            "failing": dict(self._failing(newest)),
        }

    def _release_ratio(self, newest: Sequence[LiveCycle]) -> float | None:
        """Cycles released per period, over the time of three windows."""
        if not newest:
            return None
        window_ns, last_ns = self._size * self._period_ns, newest[0].at_ns
        begin_ns = last_ns - RECENT_WINDOWS * window_ns
        before = (count for count, cycle in enumerate(newest) if cycle.at_ns <= begin_ns)
        count = next(before, len(newest) - 1)
        span_ns = last_ns - newest[count].at_ns
        return None if span_ns < window_ns else count * self._period_ns / span_ns

    def _is_applied(self, cycle: LiveCycle) -> bool:
        """Whether its command was applied, or was in time and overtaken by a later command.

        An idle cycle has no command.
        """
        if cycle.idle:
            return True
        in_time = cycle.overtaken and not cycle.missed(self._deadline_ns)
        return cycle.told or ((cycle.actuated or in_time) and self._ledger.complete(cycle))

    def _commands(self) -> dict[str, list[Any]]:
        """Return silences, applied commands and cycles of the last windows and of their leads.

        ``applied`` is the known number of applied commands per period; ``cycles`` has the numbers
        of the first and the last cycle.
        """
        found: dict[str, list[Any]] = {"silences": [], "applied": [], "cycles": []}
        for window, lead in zip(self._recent, self._leads, strict=False):
            cycles = window.cycles
            first = lead.first or cycles[0]
            span_ns = cycles[0].at_ns - first.at_ns + window.span_ns
            periods = max(span_ns / self._period_ns, lead.count + len(cycles))
            applied = lead.applied + sum(map(self._is_applied, cycles))
            found["silences"].append(lead.silences + sum(cycle.silences for cycle in cycles))
            found["applied"].append(applied / periods)
            found["cycles"].append((first.number, cycles[-1].number))
        return found

    def _sink(self, sink: str, newest: Sequence[LiveCycle], now_ns: int) -> dict[str, Any]:
        at_ns = self._applied_ns.get(sink)
        age_ms = None if at_ns is None else round((now_ns - at_ns) / 1e6, 1)
        stale = (
            round(cycle.interval_ns / 1e6, 1)
            for cycle in newest
            if cycle.interval_ns is not None
            and sink in cycle.reports
            and cycle.reports[sink].outcome == STALE
        )
        outcome = self._outcomes.get(sink)
        stale_ms = next(stale, None) if outcome == STALE else None
        return {"applied_age_ms": age_ms, "outcome": outcome, "stale_ms": stale_ms}

    def _mostly_unreached(self) -> tuple[str, str] | None:
        lost = (
            cycle
            for window in self._recent
            for cycle in window.cycles
            if cycle.missed(self._deadline_ns) and not (self._ledger.complete(cycle) or cycle.told)
        )
        unreached = (self._ledger.unreached(cycle, cycle.placement) for cycle in lost)
        counts = Counter(ways for ways in unreached if ways is not None)
        return max(counts, key=counts.__getitem__, default=None)

    def _failing(self, newest: Sequence[LiveCycle]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield candidates whose last shadows all failed, except within the guard's patience."""
        most = self._failures
        fails: dict[str, list[LiveCycle]] = {}
        succeeded = set()
        for place, cycle in enumerate(newest[self._open :]):
            if not cycle.shadow or cycle.shadow in succeeded:
                continue
            known = fails.get(cycle.shadow)
            if known is None and place >= SILENT_WINDOWS * self._size:
                continue
            ends = self._ledger.shadow_ends(cycle)
            if not ends:
                continue
            if ends <= {shadow.sink for shadow in cycle.shadows}:
                succeeded.add(cycle.shadow)
            elif known is None:
                fails[cycle.shadow] = [cycle]
            elif len(known) < most:
                known.append(cycle)
        for name, cycles in fails.items():
            if len(cycles) == most:
                yield name, {"shadows": most, "unreached": self._ledger.unreached(cycles[0], name)}
