"""WatchedCell: a live cell on the page, from the messages that its observer receives."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dwell.dash.observer import ObservedCycle, ObservedWindow, Observer
from dwell.dash.paged_cell import MOST_WITH_JOBS, Plain, TimedCycle, cell_document, jobs_document
from dwell.dash.strip import Strip, binned_means
from dwell.model.number_arrays import Floats
from dwell.record.json_documents import json_ready

#: Largest number of cycles on the time line; the observer keeps fewer.
MOST_CYCLES = 40_000
#: Entries of the controller's status that the page shows unchanged.
SHOWN = (
    *("health", "headline", "mode", "fallback", "moving_to", "proving", "pinned", "drained"),
    *("migrations", "guard_moves", "unproven", "bound_ms", "silences", "release_ratio"),
    *("stages", "flows"),
)


class WatchedCell:
    """A live cell on the page (see `PagedCell`); its time line counts seconds."""

    live = True

    def __init__(self, observer: Observer) -> None:
        self.observer, self.problem = observer, observer.problem
        self._taking = threading.Lock()
        self._codes = {name: code for code, name in enumerate(self.problem.candidates)}
        self._strip, self._cycles_upto = self._strip_of(()), 0
        self._windows: list[ObservedWindow] = []
        self._windows_upto = -1
        # Ends of the windows and columns of their values, for the line charts.
        self._lines: tuple[Floats, dict[str, Floats]] = (np.zeros(0), {})
        self._told = (0, 0, 0)

    def _take(self) -> Strip:
        """Take the new cycles and windows from the observer; return the cycles."""
        observer = self.observer
        with self._taking:
            news = observer.cycles.since(self._cycles_upto)
            if news.items:
                self._cycles_upto = news.upto
                self._strip = self._strip.followed_by(self._strip_of(news.items), MOST_CYCLES)
            if observer.windows.upto != self._windows_upto:
                kept = observer.windows.since(0)
                self._windows, self._windows_upto = kept.items, kept.upto
                self._lines = self._lines_of(kept.items)
            return self._strip

    def _strip_of(self, cycles: Sequence[ObservedCycle]) -> Strip:
        latency_ns = [np.nan if one.latency_ns is None else one.latency_ns for one in cycles]
        return Strip(
            at=np.array([one.release_ns for one in cycles], np.int64) / 1e9,
            latency_ms=np.array(latency_ns, np.float64) / 1e6,
            missed=np.array([one.missed for one in cycles], bool),
            placement=np.array([self._codes[one.placement] for one in cycles], np.int32),
            number=np.array([one.number for one in cycles], np.int64),
            due=np.array([one.outcome != "idle" for one in cycles], bool),
        )

    def _lines_of(self, windows: Sequence[ObservedWindow]) -> tuple[Floats, dict[str, Floats]]:
        said = [window.said for window in windows]
        resources = self.problem.fabric.resources
        columns: dict[str, list[float | None]] = {
            **{f"j {name}": [one["estimates"].get(name) for one in said] for name in self._codes},
            **{f"u {name}": [one["utilisation"].get(name) for one in said] for name in resources},
            "cost": [one["cost"] for one in said],
        }
        closes = np.array([window.at_s for window in windows], np.float64)
        return closes, {name: np.array(values, np.float64) for name, values in columns.items()}

    def described(self) -> Plain:
        """See `PagedCell`."""
        now, strip = self.observer.now(), self._take()
        keyring = self.observer.security.keyring
        return {
            **cell_document(self.problem),
            "source": "",
            "live": True,
            "growing": True,
            "unit": "s",
            "begin": float(strip.at[0]) if len(strip.at) else now.at_s,
            "end": now.at_s,
            "about": {"kind": "live", "mode": self.problem.live.mode},
            "certificate": None if keyring is None else keyring.own.common_name,
            "has_jobs": True,
            "notes": [],
        }

    def view(self, begin: float, end: float, bins: int) -> Plain:
        """See `PagedCell`."""
        strip, (closes, columns) = self._take(), self._lines
        events = [
            {"at": event.at_s, "kind": event.kind, "text": event.text}
            for event in self.observer.events.since(0).items
            if begin <= event.at_s < end
        ]
        return {
            "begin": begin,
            "end": end,
            **strip.view(begin, end, bins),
            "windows": binned_means(closes, columns, begin, end, bins // 2),
            "events": events,
            "more_events": 0,
        }

    def state(self, at: float) -> Plain:
        """See `PagedCell`; always the current state."""
        now = self.observer.now()
        status, window = now.status, now.status.get("window") or {}
        ages_ms = [sink["applied_age_ms"] for sink in (status.get("sinks") or {}).values()]
        state = {
            "at": now.at_s,
            "cycle": self._strip.number[-1].item() if len(self._strip.number) else None,
            "placement": now.placement or None,
            "answer_age_ms": None if now.answer_age_s is None else round(now.answer_age_s * 1e3),
            # Largest age of the last applied command over the sinks.
            "age_ms": None if not ages_ms or None in ages_ms else max(ages_ms),
            "cycles": dict(now.cycles),
            "missed": now.missed,
            **{name: status.get(name) for name in SHOWN},
            "processes": _processes(status),
            **(self._window_state(window) if window else {}),
        }
        return dict(json_ready(state))

    def _window_state(self, window: Mapping[str, Any]) -> Plain:
        seen = {name: window[name] for name in ("l95_ms", "violation_rate", "cost")}
        seen["age_ms"] = window.get("mean_age_ms")
        last, period_s = window["last_cycle"], self.problem.pipeline.period_ms / 1e3
        recent = self._windows[-3:]
        before = [one for one in recent if one.said["last_cycle"] < last][-1:]
        end_s = next((one.at_s for one in recent if one.said["last_cycle"] == last), 0.0)
        return {
            "window": {
                "number": window["number"],
                "begin": end_s - window["cycles"] * period_s,
                "end": end_s,
                "placement": window["placement"],
                "seen": seen,
            },
            "predicted": _estimate(before[0].said, window["placement"]) if before else None,
            "used": window["utilisation"],
            "decision": {
                "incumbent": window["placement"],
                "placement": window.get("decided"),
                "reason": window["reason"],
            },
            "candidates": {name: _estimate(window, name) for name in window["estimates"]},
        }

    def jobs(self, begin: float, end: float) -> Plain:
        """See `PagedCell`."""
        heard = self.observer.cycles.since(0).items
        mine = [one for one in heard if begin <= one.release_ns / 1e9 < end][-MOST_WITH_JOBS:]
        cycles = [
            TimedCycle(
                *(one.number, one.release_ns),
                None if one.latency_ns is None else one.latency_ns / 1e6,
                one.missed,
            )
            for one in mine
        ]
        return jobs_document(cycles, (job for one in mine for job in one.jobs))

    def refreshed(self) -> bool:
        """See `PagedCell`; it takes the cycles before they leave the observer's feed."""
        self._take()
        observer = self.observer
        told = observer.cycles.upto, observer.windows.upto, observer.events.upto
        self._told, before = told, self._told
        return told != before


def _estimate(window: Mapping[str, Any], name: str) -> Plain:
    """Return the estimates of a candidate at the end of a window."""
    return {"cost": window["estimates"].get(name), **window.get("predicted", {}).get(name, {})}


def _processes(status: Mapping[str, Any]) -> list[Plain]:
    """Return the processes: received at least once, never received, and not of this cell."""
    known = [{"who": who, **told} for who, told in (status.get("processes") or {}).items()]
    silent = [{"who": who, "heard": False} for who in status.get("silent") or ()]
    strangers = [
        {"who": who, "heard": False, "note": why}
        for who, why in (status.get("strangers") or {}).items()
    ]
    return [*known, *silent, *strangers]
