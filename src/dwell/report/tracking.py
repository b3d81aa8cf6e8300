"""Tracking error of a run's loop, where the run kept it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.errors import RunError


class Tracking(NamedTuple):
    """Root mean squares of the error of a loop, over short stretches of equal length.

    Parameters
    ----------
    begin_s : float
        From the first release of the run to the first stretch.
    mm, px : float64 array, shape (stretches,)
        NaN where the error is not known.
    """

    begin_s: float
    step_s: float
    mm: NDArray[np.float64]
    px: NDArray[np.float64]

    @classmethod
    def of(cls, meta: Mapping[str, Any]) -> Tracking | None:
        """Read it from what is said of a run; None where it kept none.

        Raises
        ------
        RunError
            If it cannot be read.
        """
        told = meta.get("tracking")
        if told is None:
            return None
        try:
            mm, px = (np.array(told[name], np.float64) for name in ("rms_mm", "rms_px"))
            found = cls(float(told["begin_s"]), float(told["step_s"]), mm, px)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"its tracking error cannot be read ({error!r})") from None
        if found.step_s <= 0 or found.mm.shape != found.px.shape or found.mm.ndim != 1:
            raise RunError("its tracking error cannot be read: its parts do not fit together")
        return found

    def rms(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """Return the root mean squares in mm and px between two instants; NaN where unknown."""
        middle_s = self.begin_s + (np.arange(len(self.mm)) + 0.5) * self.step_s
        inside = (begin_s <= middle_s) & (middle_s < end_s)
        return _rms(self.mm[inside]), _rms(self.px[inside])


def _rms(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan
