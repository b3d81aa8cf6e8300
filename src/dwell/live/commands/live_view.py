"""Lines about a live cell while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import typer

from dwell.model.disturbed import Disturbed

#: Age from which an answer of the controller counts as silence.
SILENT_S = 1.5


@dataclass(frozen=True, slots=True)
class CellState:
    """State of a cell at an instant.

    Parameters
    ----------
    at_s : float
        Time since the cell began.
    status : mapping
        The controller's last answer; empty before the first.
    answered_s : float
        Time of that answer.
    observed : mapping of str to float
        Values of the cell's observer, by names with units; ``error_mm`` is shown.
    """

    at_s: float
    status: Mapping[str, Any]
    answered_s: float
    observed: Mapping[str, float]
    active: Sequence[Disturbed]

    @property
    def error_mm(self) -> float:
        """Tracking error of the last second; NaN where unknown."""
        return self.observed.get("error_mm", math.nan)

    @property
    def window(self) -> Mapping[str, Any]:
        """The last closed window."""
        window: Mapping[str, Any] = self.status.get("window") or {}
        return window

    @property
    def disturbances(self) -> str:
        """The disturbances that are on, in words."""
        return "; ".join(f"{item.kind} ({item.what})" for item in self.active)

    @property
    def silent_s(self) -> float:
        """How long the controller has not answered; 0 where that is not long."""
        silent_s = self.at_s - self.answered_s
        return silent_s if silent_s > SILENT_S else 0.0


@dataclass(slots=True)
class Lines:
    """A line whenever something has changed, for logs."""

    last: tuple[object, ...] = ()

    def show(self, state: CellState) -> None:
        """Print a line if there is news."""
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
            f"  L95 {_number(window.get('l95_ms'), 'ms')}"
            f"  V_D {_number(_hundred(window.get('violation_rate')), '%')}"
            f"{_error(state)}"
            f"{'  the controller is silent' if silent else ''}"
            f"  {state.disturbances or 'nothing disturbs it'}"
            f"{f'  {headline}' if headline else ''}",
            err=True,
        )


def _error(state: CellState) -> str:
    return "" if math.isnan(state.error_mm) else f"  error {_number(state.error_mm, 'mm')}"


def _float(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _hundred(value: object) -> float:
    return 100 * _float(value)


def _number(value: object, unit: str) -> str:
    known = _float(value)
    return "-" if math.isnan(known) else f"{known:.1f} {unit}"
