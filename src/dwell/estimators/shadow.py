"""Shadow: online emulation, which also sends some cycles through each alternative.

A shadow shares with its cycle the jobs that run on the same nodes and has its own jobs and messages
for the rest. It stops before the sinks, because their commands would reach the actuator. Values
measured by shadows and by active cycles are kept for `MEMORY` half-lives. If they differ from the
declared values, the candidate is simulated with them (see `dwell.estimators.learning`). Parts that
no cycle and no shadow used keep their declared values.
"""

from __future__ import annotations

from typing import ClassVar

from dwell.estimators.learning import Learning


class Shadow(Learning):
    """Estimates the QoS of candidates from values that shadow jobs and active jobs measured.

    Parameters
    ----------
    shadow_fraction : float, optional
        Share of cycles sent through each alternative [default: the cell file's].
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

    MEMORY: ClassVar[float] = 2.0
    UNSEEN: ClassVar[float] = 10.0
