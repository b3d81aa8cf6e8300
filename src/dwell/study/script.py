"""Script: a policy that follows a list of placements and ignores all metrics."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.errors import PolicyError
from dwell.model import Problem, QoS
from dwell.model.bounds import counted
from dwell.model.number_arrays import Ints, Mask
from dwell.model.window_close import window_close_ns

if TYPE_CHECKING:
    from dwell.sim import Realisation


class Script:
    """Follows a list of candidates, one for each stretch between decisions.

    A longer run stays on the last candidate. While its node is down, the controller makes no
    decisions. The script finds these times in the realisation and so stays in step with the
    stretches. A move that is due during an outage is made at the next decision if the list still
    has it there.

    Parameters
    ----------
    names : sequence of str
        Candidate of every stretch, the run's initial candidate first.
    problem : Problem
        With warm migrations: stretches shift by the time that their orders take.
    realisation : Realisation
        The run's realisation.
    decide_cycles : int, optional
        Cycles between decisions; a window's where None.

    Raises
    ------
    PolicyError
        If `names` is empty or holds what is no candidate.
    """

    def __init__(
        self,
        names: Sequence[str],
        problem: Problem,
        realisation: Realisation,
        decide_cycles: int | None = None,
    ) -> None:
        self.names = tuple(names)
        known = ", ".join(problem.candidates)
        if not self.names:
            raise PolicyError(f"names is empty; give a candidate for each window ({known})")
        for window, name in enumerate(self.names):
            if name not in problem.candidates:
                raise PolicyError(
                    f"names[{window}] is {name!r}, which is no candidate (candidates here: {known})"
                )
        self.initial = self.names[0]
        every = problem.window_cycles if decide_cycles is None else decide_cycles
        self._closes = _seen_closes(self, problem, realisation, every)
        self._asked = 0

    def __repr__(self) -> str:
        moves = sum(here != there for here, there in itertools.pairwise(self.names))
        return f"Script({counted(len(self.names), 'placement')}, {counted(moves, 'migration')})"

    def placement(self, stretch: int) -> str:
        """Name of the candidate for a stretch."""
        return self.names[min(stretch, len(self.names) - 1)]

    def start(self, problem: Problem) -> None:
        """Begin again with the first stretch."""
        self._asked = 0

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Return the candidate for the stretch that follows."""
        close = self._closes[self._asked]
        self._asked += 1
        return self.placement(close + 1)


def is_up(problem: Problem, realisation: Realisation, at_ns: Ints) -> Mask:
    """Return whether the controller's node is up at instants.

    Parameters
    ----------
    at_ns : int64 array, shape (n,)

    Returns
    -------
    bool array, shape (n,)
    """
    change_ns, down = _outages(problem, realisation)
    up: Mask = ~down[np.searchsorted(change_ns, at_ns, side="right")]
    return up


def _outages(problem: Problem, realisation: Realisation) -> tuple[Ints, Mask]:
    """Return the changes of the controller's node, and whether it is down before and after each.

    Returns
    -------
    int64 array, shape (changes,)
        Nanoseconds, ascending.
    bool array, shape (changes + 1,)
    """
    from dwell.sim import NodeChanges

    changes = NodeChanges.of(realisation.node_changes)
    mine = [i for i, node in enumerate(changes.nodes) if node == problem.controller_node]
    at_ns, _, _, down = changes.table[np.isin(changes.table[:, 1], mine)].T
    return at_ns, np.append(False, down.astype(bool))


def _seen_closes(
    script: Script, problem: Problem, realisation: Realisation, every: int
) -> Sequence[int]:
    """Return the stretches at whose close the controller decides.

    When a stretch closes depends on the migrations before it: after each, the next stretch begins
    with the first cycle that the order reaches.
    """
    change_ns, down = _outages(problem, realisation)
    if not down.any():
        return range(realisation.cycles // every)
    settings, release_ns = problem.controller, realisation.release_ns
    delay_ns = round(settings.order_delay_ms * 1e6)
    seen = []
    placement, stretch, boundary = script.initial, 0, every
    while boundary <= realisation.cycles:
        close_ns = int(window_close_ns(problem, release_ns[boundary - 1], release_ns[boundary]))
        if not down[np.searchsorted(change_ns, close_ns, side="right")]:
            seen.append(stretch)
            if script.placement(stretch + 1) != placement:
                placement = script.placement(stretch + 1)
                reached = int(np.searchsorted(release_ns[:-1], close_ns + delay_ns))
                boundary = max(boundary + settings.order_lead_cycles, reached)
        stretch += 1
        boundary += every
    return seen
