"""Printed lines about the state of a running live cell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import typer

from dwell.model.disturbed import Disturbed
from dwell.study.metric import METRICS

#: Age of the controller's last answer above which the controller is silent.
SILENT_S = 1.5


@dataclass(frozen=True, slots=True)
class CellState:
    """State of a cell at `at_s`, the time since its begin.

    `status` is the controller's last answer, at `answered_s` (empty before the first). `observed`
    has the values of the cell's observer by names with units; the lines show ``error_mm``.
    """

    at_s: float
    status: Mapping[str, Any]
    answered_s: float
    observed: Mapping[str, float]
    active: Sequence[Disturbed]

    @property
    def error_mm(self) -> float:
        """Tracking error from the observer; NaN if unknown."""
        return self.observed.get("error_mm", math.nan)

    @property
    def window(self) -> Mapping[str, Any]:
        """Metrics of the last complete window."""
        window: Mapping[str, Any] = self.status.get("window") or {}
        return window

    @property
    def disturbances(self) -> str:
        """Text about the active disturbances."""
        return "; ".join(f"{item.kind} ({item.what})" for item in self.active)

    @property
    def silent_s(self) -> float:
        """Time since the controller's last answer; 0 up to `SILENT_S`."""
        silent_s = self.at_s - self.answered_s
        return silent_s if silent_s > SILENT_S else 0.0


@dataclass(slots=True)
class Lines:
    """Prints a line at each change of a cell's state."""

    last: tuple[object, ...] = ()

    def show(self, state: CellState) -> None:
        """Print a line if the state has changed."""
        status, window = state.status, state.window
        silent = state.silent_s > 0
        headline = "" if silent else status.get("headline") or ""
        moved = status.get("placement"), status.get("guard_moves")
        key = (*moved, silent, status.get("health"), state.disturbances)
        if key == self.last:
            return
        self.last = key
        by_guard = "  by the guard" if status.get("fallback") else ""
        typer.echo(
            f"{state.at_s:6.1f} s  {status.get('placement') or '-'}{by_guard}"
            f"{_metric(window, 'l95_ms')}{_metric(window, 'violation_rate')}"
            f"{_error(state)}"
            f"{'  the controller is silent' if silent else ''}"
            f"  {state.disturbances or 'nothing disturbs it'}"
            f"{f'  {headline}' if headline else ''}",
            err=True,
        )


def _error(state: CellState) -> str:
    return "" if math.isnan(state.error_mm) else f"  error {state.error_mm:.1f} mm"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _metric(window: Mapping[str, Any], column: str) -> str:
    metric, value = METRICS[column], _float(window.get(column))
    return f"  {metric.name} {'-' if math.isnan(value) else metric.text(value)}"
