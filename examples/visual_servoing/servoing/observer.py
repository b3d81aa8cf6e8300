"""What looks on while the cell runs: how far the hand is from where it ought to be."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from .error_sampler import ErrorSampler
from .world import World

#: The arm comes from its home, and first has to get to the tag.
SETTLED_NS = 3_000_000_000


class TrackingObserver:
    """Samples the tracking error in the world that camera and arm share.

    Parameters
    ----------
    folder : Path
        Of the cell's processes.
    begin_ns : int
        From which instant the cell counts.
    """

    def __init__(self, folder: Path, begin_ns: int) -> None:
        self._world = World.open(folder / "world", time.monotonic_ns())
        self._sampler = ErrorSampler(self._world, begin_ns + SETTLED_NS)

    def look(self, now_ns: int) -> Mapping[str, float]:
        """Return the root mean squares of the last second."""
        self._sampler.sample(now_ns)
        error_mm, error_px = self._sampler.newest()
        return {"error_mm": error_mm, "error_px": error_px}

    def told(self, origin_ns: int) -> Mapping[str, object]:
        """Return the error through time, as a run keeps it."""
        return {"tracking": self._sampler.told(origin_ns)}

    def close(self) -> None:
        """Look no more."""
        self._world.close()
