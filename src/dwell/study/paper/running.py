"""How much the paper's chapters simulate, and what runs their studies."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from dwell.errors import SimulationError
from dwell.study.engine import Progress, StudyResult, run_study
from dwell.study.study import Study

__all__ = ["HELD_OUT", "Runner", "Scale", "Show"]

#: Shows the progress of one study, by its name.
Show: TypeAlias = Callable[[str], "AbstractContextManager[Progress | None]"]

#: Seeds that parameters are tuned on begin after this one; no comparison uses them.
HELD_OUT = 1000

#: With fewer points along an axis of a map, all axes are coarse.
COARSE = 5

# With fewer windows a dynamic scenario would end before its disturbances do.
DYNAMIC_WINDOWS = 300


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is simulated: the same chapters, in full or for a look.

    Parameters
    ----------
    name : str
    seeds : int
        Seeds of a comparison: 1 to this.
    windows : int
        Length of a run in a steady scenario, the warm-up included.
    dynamic_windows : int
        The same in a dynamic one; a timetable takes 300 windows.
    grid : int
        Points along each axis of a map.
    grid_seeds : int
        Seeds of a grid, a map or a sweep, whose points share what one comparison has alone.
    sobol_n : int
        Base points of a Sobol design, a power of two.
    sobol_seeds : int
        Seeds of every point of it.
    sobol_windows : int
        Length of its runs, those with a timetable excepted.
    tuning_seeds : int
        Seeds that parameters are tuned on; see `held_out`.

    Raises
    ------
    SimulationError
        If one of them is too small; it names all that is wrong.
    """

    name: str
    seeds: int
    windows: int
    dynamic_windows: int
    grid: int
    grid_seeds: int
    sobol_n: int
    sobol_seeds: int
    sobol_windows: int
    tuning_seeds: int

    def __post_init__(self) -> None:
        """Check the numbers."""
        least = {
            **dict.fromkeys(("seeds", "grid_seeds", "sobol_seeds", "tuning_seeds"), 1),
            **dict.fromkeys(("windows", "dynamic_windows", "sobol_windows"), 2),
            **dict.fromkeys(("grid", "sobol_n"), 2),
        }
        faults = [
            f"{name} is {getattr(self, name)}; it must be at least {bound}"
            for name, bound in least.items()
            if getattr(self, name) < bound
        ]
        if faults:
            raise SimulationError("\n".join(faults))

    @classmethod
    def full(cls) -> Scale:
        """What the paper's numbers are made with."""
        return cls(
            name="full",
            seeds=20,
            windows=150,
            dynamic_windows=DYNAMIC_WINDOWS,
            grid=9,
            grid_seeds=12,
            sobol_n=32,
            sobol_seeds=3,
            sobol_windows=60,
            tuning_seeds=10,
        )

    @classmethod
    def quick(cls) -> Scale:
        """A look, in about a minute: every chapter runs, and hardly anything can be shown."""
        return cls(
            name="quick",
            seeds=3,
            windows=20,
            dynamic_windows=60,
            grid=3,
            grid_seeds=2,
            sobol_n=2,
            sobol_seeds=2,
            sobol_windows=15,
            tuning_seeds=2,
        )

    @classmethod
    def tiny(cls) -> Scale:
        """The least that every chapter works with; its numbers mean nothing."""
        return cls(
            name="tiny",
            seeds=2,
            windows=12,
            dynamic_windows=16,
            grid=2,
            grid_seeds=2,
            sobol_n=2,
            sobol_seeds=2,
            sobol_windows=12,
            tuning_seeds=2,
        )

    @property
    def coarse(self) -> bool:
        """Whether an axis has a few of its values only."""
        return self.grid < COARSE

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """Seeds of a comparison."""
        return tuple(range(1, self.seeds + 1))

    @property
    def some_seeds(self) -> tuple[int, ...]:
        """Seeds of a grid: the first of those of a comparison."""
        return tuple(range(1, self.grid_seeds + 1))

    @property
    def held_out(self) -> tuple[int, ...]:
        """Seeds that parameters are tuned on, and nothing else is done on."""
        return tuple(range(HELD_OUT + 1, HELD_OUT + 1 + self.tuning_seeds))


def _unseen(study: str) -> AbstractContextManager[Progress | None]:
    return nullcontext()


@dataclass(frozen=True, slots=True)
class Runner:
    """Runs studies, each in a folder of its name: what is finished there is not done again.

    Parameters
    ----------
    folder : Path
        Where the studies' folders go.
    processes : int, optional
    dask : str, optional
        See `dwell.study.run_study`.
    show : callable
        Opened for each study with its name; what it gives is told the progress.
    """

    folder: Path
    processes: int | None = None
    dask: str | None = None
    show: Show = _unseen

    def run(self, study: Study) -> StudyResult:
        """Run a study, or what is left to do of it.

        Raises
        ------
        DwellError
            See `dwell.study.run_study`.
        """
        with self.show(study.name) as progress:
            return run_study(
                study,
                folder=self.folder / study.name,
                processes=self.processes,
                dask=self.dask,
                progress=progress,
            )
