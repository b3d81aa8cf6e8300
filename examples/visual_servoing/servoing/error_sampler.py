"""ErrorSampler: how far the arm is from where it ought to be, looked at all the time.

The error at an instant follows from the world's records, also afterwards: nobody has to be awake at
that instant. Instants lie evenly in time, so that an arm without commands counts as long as it had
none.
"""

from __future__ import annotations

import math

from .world import World

SAMPLE_NS = 25_000_000
#: Samples of one stretch, for which a root mean square is kept.
SAMPLES = 10
#: The records reach back so far at least; a sampler that slept longer leaves a gap.
REACH_NS = 1_500_000_000


class ErrorSampler:
    """Takes samples of the error in a world.

    Parameters
    ----------
    world : World
    begin_ns : int
        First sample, on the machine's monotonic clock.
    """

    def __init__(self, world: World, begin_ns: int) -> None:
        self._world = world
        self._begin_ns = self._next_ns = begin_ns
        #: Errors in mm and px; NaN where nobody looked in time.
        self._samples: list[tuple[float, float]] = []

    def sample(self, now_ns: int) -> None:
        """Take the samples that are due."""
        while self._next_ns < now_ns:
            known = now_ns - self._next_ns < REACH_NS
            errors = self._world.errors(self._next_ns) if known else (math.nan, math.nan)
            self._samples.append(errors)
            self._next_ns += SAMPLE_NS

    def newest(self) -> tuple[float, float]:
        """Return the root mean squares of the last second, in mm and px; NaN where unknown."""
        last = self._samples[-(1_000_000_000 // SAMPLE_NS) :]
        return _rms([mm for mm, _ in last]), _rms([px for _, px in last])

    def told(self, origin_ns: int) -> dict[str, object]:
        """Return root mean squares of equal stretches as a run keeps them.

        Parameters
        ----------
        origin_ns : int
            First release of the run: where its time begins.
        """
        starts = range(0, len(self._samples), SAMPLES)
        stretches = [self._samples[start : start + SAMPLES] for start in starts]
        return {
            "begin_s": (self._begin_ns - origin_ns) / 1e9,
            "step_s": SAMPLES * SAMPLE_NS / 1e9,
            "rms_mm": [_written(_rms([mm for mm, _ in some])) for some in stretches],
            "rms_px": [_written(_rms([px for _, px in some])) for some in stretches],
        }


def _rms(values: list[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return math.sqrt(sum(value**2 for value in known) / len(known)) if known else math.nan


def _written(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
