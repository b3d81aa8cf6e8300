"""Timeline: which fault befalls a cell next, when and for how long, by a seed."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dwell.testbed.chaos.faults import Fault

#: How long faults last, seconds: shorter and longer than a session's lease.
LASTS_S = 0.5, 2.4
#: And how long the cell is left alone before the next one.
RESTS_S = 0.0, 1.5


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """A fault of a timeline.

    Parameters
    ----------
    number : int
        From 1.
    phase : float
        Of the period at which it begins.
    lasts_s, rests_s : float
        How long it lasts, and how long nothing happens before it.
    """

    number: int
    fault: Fault
    phase: float
    lasts_s: float
    rests_s: float


def planned(seed: int, faults: Sequence[Fault]) -> Iterator[PlannedFault]:
    """Yield the faults of a seed, without end.

    Each kind comes once a round, in a random order, and its faults in a random order, too: none
    comes again before all of its kind have been there.
    """
    kinds: dict[str, list[Fault]] = {}
    for fault in faults:
        kinds.setdefault(fault.kind or fault.how, []).append(fault)
    draw = random.Random(f"chaos {seed}")  # noqa: S311 - no secret
    waiting: dict[str, list[Fault]] = {kind: [] for kind in kinds}
    number = 0
    while kinds:
        for kind in draw.sample(sorted(kinds), len(kinds)):
            if not waiting[kind]:
                waiting[kind] = draw.sample(kinds[kind], len(kinds[kind]))
            number += 1
            yield PlannedFault(
                number,
                waiting[kind].pop(),
                draw.random(),
                draw.uniform(*LASTS_S),
                draw.uniform(*RESTS_S),
            )
