"""Learning: estimators that hold of every part what windows have shown of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Message, Part
from dwell.estimators.online import Online
from dwell.estimators.pool import Pool
from dwell.estimators.prices import SEED
from dwell.estimators.protocol import Support
from dwell.estimators.slow_processes import unseen_error
from dwell.model.controller_settings import HALF_LIFE_WINDOWS
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]

#: Deviation of the logarithm of a price one window after a part was measured that is not as
#: declared.
WIDENING = 0.03


class Learning(Online):
    """Base of the estimators that hold a pool of every part.

    Parameters
    ----------
    shadow_fraction : float, optional
        Share of the cycles sent through each alternative; the cell file's where None.
    half_life_windows : float, optional
        The cell file's where None.
    seed : int
        Seed of what is played.

    Raises
    ------
    ProblemError
        If `half_life_windows` is out of its range.
    """

    #: Half-lives after which a measured value gives way to newer ones, and after which a part that
    #: was not measured any more is as declared again.
    MEMORY: ClassVar[float]
    UNSEEN: ClassVar[float]

    def __init__(
        self,
        problem: Problem,
        shadow_fraction: float | None = None,
        half_life_windows: float | None = None,
        seed: int = SEED,
    ) -> None:
        settings = problem.controller
        given = problem.shadow_fraction if shadow_fraction is None else shadow_fraction
        self.shadow_fraction = given
        half_life = settings.half_life_windows if half_life_windows is None else half_life_windows
        HALF_LIFE_WINDOWS.check("half_life_windows", half_life)
        #: In decisions.
        decisions = half_life * problem.decisions_per_window
        self.memory, self.unseen = self.MEMORY * decisions, self.UNSEEN * decisions
        self.seed = seed
        self.start(problem)

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the estimator with the settings of ``problem.controller``."""
        return cls(problem)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(shadow_fraction={self.shadow_fraction:g}, "
            f"regimes={self.regimes})"
        )

    def start(self, problem: Problem) -> None:
        """Forget everything but the profile."""
        super().start(problem)
        #: Decisions that have been learnt from.
        self._window = 0
        self._pools = {
            part: Pool(reference, isinstance(part, Message))
            for part, reference in self._playing.declared.references.items()
        }

    def _take_in(self, demands: Mapping[Part, Floats], evidence: Evidence) -> None:
        self._window += 1
        changed: list[Part] = []
        cycles = len(evidence.release_ns)
        # How often any part is compared with its reference in a window of the cell.
        tests = len(self._pools) * max(self.problem.window_cycles / cycles, 1.0)
        for part, values in demands.items():
            pool = self._pools[part]
            if pool.learn(values, self._window, self.memory, cycles, tests):
                changed.append(part)
            self._has_grown |= not pool.is_declared
        for pool in self._pools.values():
            if pool.touched and self._window - pool.touched >= max(self.unseen, 1.0):
                pool.reset()
                self._has_changed = True
        self._regimes += len(changed)
        if changed:
            self._has_changed = True
            self._correct(changed, frozenset(demands))

    def _correct(self, changed: Sequence[Part], measured: frozenset[Part]) -> None:
        """Correct what nobody measured by what has changed."""

    def _otherwise(self) -> dict[Part, Floats]:
        return {part: pool.held for part, pool in self._pools.items() if not pool.is_declared}

    def support(self) -> dict[str, Support]:
        """Support of each candidate's estimate: that of its weakest part."""
        self._take_in_pending()
        return {
            name: Support(
                min(self._pools[part].measured for part in parts),
                self._windows_since(min(self._pools[part].last for part in parts)),
            )
            for name, parts in self._parts.items()
        }

    def deviation(self) -> dict[str, float]:
        """Deviation of the logarithm of each candidate's price, by the age of what is known."""
        self._take_in_pending()
        return {
            name: max(self._widening(self._pools[part]) for part in parts)
            for name, parts in self._parts.items()
        }

    def _widening(self, pool: Pool) -> float:
        if pool.is_declared:
            return 0.0
        return WIDENING * math.sqrt(max(self._windows_since(pool.last), 0))

    def _windows_since(self, decision: int) -> float:
        """Return the age of what was learnt at a decision, in windows."""
        return (self._window - decision) / self.problem.decisions_per_window

    def _known_error(self, name: str, rate: float) -> tuple[float, float]:
        pools = [self._pools[part] for part in self._parts[name]]
        measured = [pool for pool in pools if not pool.is_declared]
        if not measured:
            return 0.0, 0.0
        l95_ms = math.hypot(*(pool.error_ms for pool in measured))
        widened = max(map(self._widening, measured)) * self._playing.played(name).l95_ms
        count = max(min(pool.measured for pool in measured), 1)
        return math.hypot(l95_ms, widened), unseen_error(rate, count)
