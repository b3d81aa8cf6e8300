"""Simulated sizes of a fleet, and the file that keeps them until a capacity study ends."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.model.fleet import Fleet
from dwell.record.fleet_run import fleet_document
from dwell.sim.versions import versions


class Sizes(NamedTuple):
    """Range of sizes to simulate together with one seed; both ends included."""

    first: int
    last: int
    seed: int


class PlayedSize(NamedTuple):
    """Result of one size with one seed.

    Parameters
    ----------
    rate : float
        V_D of the worst cell. Each half of the cycles selects the worst cell, and the other half
        gives its V_D; `rate` is the mean of both. The largest of several noisy rates would be
        biased upwards.
    half : float
        Half the difference between both values: the error of `rate` from its cycles.
    used : mapping of str to float
        Utilisation of the shared resources.
    """

    rate: float
    half: float
    used: Mapping[str, float]

    @classmethod
    def of(cls, missed: Iterable[NDArray[np.bool_]], used: Mapping[str, float]) -> PlayedSize:
        """Return the result for the missed counted cycles of each cell."""
        halves = np.array([[part.mean() for part in np.array_split(one, 2)] for one in missed])
        first, last = halves.argmax(axis=0)
        late, early = float(halves[first, 1]), float(halves[last, 0])
        return cls((late + early) / 2, (late - early) / 2, used)


class KeptSizes:
    """Results of simulated sizes in a file, one line of JSON per call of a player.

    Parameters
    ----------
    file : Path
        A line that a crash has truncated is ignored.

    Attributes
    ----------
    count : int
        Number of results in the file.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.count = file, 0
        self._known: dict[tuple[str, Sizes], list[PlayedSize]] = {}
        lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
        for line in lines:
            with suppress(ValueError, KeyError, TypeError):
                row = json.loads(line)
                played = [PlayedSize(*one) for one in row["played"]]
                self._known[row["study"], Sizes(*row["sizes"])] = played
                self.count += len(played)

    def __repr__(self) -> str:
        return f"<KeptSizes: {self.count} in {self.file}>"

    def known(self, study: str, sizes: Sizes) -> list[PlayedSize] | None:
        """Return the results of sizes in a study; None if they are not in the file."""
        return self._known.get((study, sizes))

    def keep(self, study: str, sizes: Sizes, played: Sequence[PlayedSize]) -> None:
        """Append the results of sizes to the file."""
        self.count += len(played)
        row = {"study": study, "sizes": sizes, "played": played}
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with self.file.open("a", encoding="utf-8") as file:
            file.write(f"\n{json.dumps(row)}")

    def remove(self) -> None:
        """Remove the file, and its folder if empty."""
        self.file.unlink(missing_ok=True)
        with suppress(OSError):
            self.file.parent.rmdir()


def study_of(fleet: Fleet, duration_ns: int, twins: Mapping[str, int]) -> str:
    """Return a digest of all inputs that determine the results of a size, except the seed."""
    source = [fleet_document(fleet), duration_ns, dict(twins), versions()]
    return hashlib.sha256(json.dumps(source, sort_keys=True).encode()).hexdigest()
