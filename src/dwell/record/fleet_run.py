"""FleetRun: the runs of the cells of a fleet that were played together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from dwell.model.fleet import Fleet
from dwell.record.run import Run

if TYPE_CHECKING:
    import polars as pl


class FleetRun:
    """What became of a fleet.

    Parameters
    ----------
    fleet : Fleet
        As it was played.
    cells : mapping of str to Run
        By the cells' names.
    seed : int
    guard : bool
        Whether guards acted.
    """

    def __init__(self, fleet: Fleet, cells: Mapping[str, Run], *, seed: int, guard: bool) -> None:
        self.fleet, self.cells = fleet, dict(cells)
        self.seed, self.guard = seed, guard

    def __repr__(self) -> str:
        return f"<FleetRun of {self.fleet.name}: {len(self.cells)} cells, seed {self.seed}>"

    @property
    def windows(self) -> pl.DataFrame:
        """Windows of all cells, with a column `cell`; what a cell does not have is null."""
        return self._all("windows")

    @property
    def decisions(self) -> pl.DataFrame:
        """Decisions of all cells, with a column `cell`; what a cell does not have is null."""
        return self._all("decisions")

    def _all(self, table: str) -> pl.DataFrame:
        import polars as pl

        frames = [
            getattr(run, table).select(pl.lit(name).alias("cell"), pl.all())
            for name, run in self.cells.items()
        ]
        return pl.concat(frames, how="diagonal_relaxed")
