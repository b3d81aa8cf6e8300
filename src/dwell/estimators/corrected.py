"""Corrected: the profile, corrected online by what active and shadow jobs reveal.

Every part of a cycle (a task on a node, a flow on a link) has its declared values until windows
show a change. It then has the values measured by the cell's jobs and by shadow jobs, at most from
the newest `MEMORY` half-lives (see `dwell.estimators.pool` and `dwell.estimators.learning`).

Unmeasured parts
    If a message on a link changes, unmeasured messages on the link get the same extra delay and
    losses. If a job on a node changes, unmeasured jobs on the node change by the same factor. A
    node without any measured job is judged by its foreign load.

Age
    The error of a price grows with the square root of the windows since the last measurement.
    After `UNSEEN` half-lives without one, the part has its declared values again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from dwell.estimators.learning import Learning
from dwell.estimators.measured import Message, Part


class Corrected(Learning):
    """Estimates QoS from the profile, corrected by what every window measured.

    Parameters
    ----------
    shadow_fraction : float, optional
        Share of cycles sent through each alternative [default: the cell file's]. With 0 the
        estimator learns from the active placement alone.
    half_life_windows : float, optional
        Unit of `MEMORY` and `UNSEEN` [default: the cell file's].
    seed : int
        Seed of the simulations.

    Attributes
    ----------
    regimes : int
        Number of changes detected since the start.

    Raises
    ------
    ProblemError
        If `half_life_windows` is out of its range.
    """

    #: Half-lives; long, because a return to a placement just to measure it can be expensive.
    MEMORY: ClassVar[float] = 6.0
    UNSEEN: ClassVar[float] = 60.0

    def _correct(self, changed: Sequence[Part], measured: frozenset[Part]) -> None:
        for place in dict.fromkeys(map(_place, changed)):
            here = [part for part in changed if _place(part) == place]
            surest = self._pools[max(here, key=lambda part: self._pools[part].measured)]
            for part, pool in self._pools.items():
                if part not in measured and _place(part) == place:
                    pool.follow(surest, self._window)


def _place(part: Part) -> str:
    """Return the node or link of a part."""
    return part.link if isinstance(part, Message) else part.node
