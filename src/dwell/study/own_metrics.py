"""Metrics of a user's own: functions of a Run, named ``package.module:function``."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from numbers import Real
from typing import TYPE_CHECKING

from dwell.errors import SimulationError, describe_raised
from dwell.model.bounds import shown
from dwell.model.user_classes import user_function

if TYPE_CHECKING:
    from dwell.record import Run


def own_metric(path: str, folder: str | None, run: Run, who: str) -> float:
    """Return a metric of a run.

    Parameters
    ----------
    folder : str, optional
        Its modules are preferred to installed modules.
    who : str
        The metric and the run, for messages.

    Raises
    ------
    SimulationError
        If the function cannot be imported, raises, or returns no finite number.
    """
    function = _function(path, folder)
    try:
        value = function(run)
    except Exception as error:
        raise SimulationError(f"{who}: {describe_raised(error)}") from error
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise SimulationError(f"{who}: returned {shown(value)}; return a finite number")
    return float(value)


@cache
def _function(path: str, folder: str | None) -> Callable[..., object]:
    """Return a function, which a process imports once."""
    return user_function(path, folder, "metric", SimulationError)
