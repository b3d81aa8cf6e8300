"""Corrected: the profile, corrected online by what active and shadow jobs reveal.

Every part of a cycle (a task on a node, a flow on a link) is as declared until windows show it to
be otherwise; then it has the values that were measured of it, by own jobs and by shadow jobs, and
those of the newest `MEMORY` half-lives at most (see `dwell.estimators.pool` and
`dwell.estimators.learning`).

What nobody measured
    A message that was not measured while another one on its link changed its regime gets the extra
    delay and the losses of that one; a job that was not, while another one on its node began to
    need more, needs so much more, too. A node of which nothing was measured is judged by its
    foreign load.

Age
    What is not as declared, and was not measured for a windows, is less and less known: the error
    of a price grows with the square root of a. In the end (after `UNSEEN` half-lives) what was
    measured of it is forgotten, and it is as declared.
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
        Share of the cycles sent through each alternative; the cell file's where None. 0 learns
        from the active placement alone.
    half_life_windows : float, optional
        The cell file's where None; see `MEMORY` and `UNSEEN`.
    seed : int
        Seed of what is played.

    Attributes
    ----------
    regimes : int
        Changes of regime seen since the start.

    Raises
    ------
    ProblemError
        If `half_life_windows` is out of its range.
    """

    #: Half-lives; going back to look can cost dearly.
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
    """The node or link that a part is on."""
    return part.link if isinstance(part, Message) else part.node
