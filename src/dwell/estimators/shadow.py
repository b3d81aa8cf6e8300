"""Shadow: online emulation, the estimate from cycles also sent through each alternative.

A shadow shares with its cycle whatever runs on the same nodes, has jobs and messages of its own for
the rest, and stops before the sinks, whose commands would reach the actuator. What it shows of a
part, and what the cycles of a placement that was active showed, is held for `MEMORY` half-lives;
where it is not as declared, the candidate is played with it (see `dwell.estimators.learning`). Of
what no cycle and no shadow went through nothing is assumed.
"""

from __future__ import annotations

from typing import ClassVar

from dwell.estimators.learning import Learning


class Shadow(Learning):
    """Estimates QoS of candidates from what shadow jobs and active ones showed of their parts.

    Parameters
    ----------
    shadow_fraction : float, optional
        Share of the cycles sent through each alternative; the cell file's where None.
    half_life_windows : float, optional
        The cell file's where None.
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

    MEMORY: ClassVar[float] = 2.0
    UNSEEN: ClassVar[float] = 10.0
