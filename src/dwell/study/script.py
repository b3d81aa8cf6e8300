"""Script: a policy that follows a list of placements, window by window, whatever it is shown."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.errors import PolicyError
from dwell.model import Problem, QoS
from dwell.model.bounds import counted
from dwell.model.window_close import window_close_ns

if TYPE_CHECKING:
    from dwell.sim import Realisation


class Script:
    """Follows a list of candidates, one for each window; a longer run stays on the last.

    The controller asks nobody at the close of a window that it does not see, because its node is
    down. The script works out from the realisation which closes those are, so that its answers
    stay in step with the windows; a move that is due at such a close is made at the next one that
    is seen, if it still is due there.

    Parameters
    ----------
    names : sequence of str
        Candidate of every window, the initial one of the run for window 0.
    problem : Problem
        With warm migrations: it is by these that windows shift where orders take time.
    realisation : Realisation
        The one that will be played.

    Raises
    ------
    PolicyError
        If `names` is empty or holds what is no candidate.
    """

    def __init__(self, names: Sequence[str], problem: Problem, realisation: Realisation) -> None:
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
        self._closes = _seen_closes(self, problem, realisation)
        self._asked = 0

    def __repr__(self) -> str:
        moves = sum(here != there for here, there in itertools.pairwise(self.names))
        return f"Script({counted(len(self.names), 'window')}, {counted(moves, 'migration')})"

    def placement(self, window: int) -> str:
        """Name of the candidate for a window."""
        return self.names[min(window, len(self.names) - 1)]

    def start(self, problem: Problem) -> None:
        """Begin again with window 0."""
        self._asked = 0

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Return the candidate for the window that follows the one just closed."""
        close = self._closes[self._asked]
        self._asked += 1
        return self.placement(close + 1)


def _seen_closes(script: Script, problem: Problem, realisation: Realisation) -> Sequence[int]:
    """Return the windows at whose close the script is asked.

    When a window closes depends on the migrations before it: after each, the next window begins
    with the first cycle that the order reaches.
    """
    from dwell.sim import NodeChanges

    changes = NodeChanges.of(realisation.node_changes)
    mine = [i for i, node in enumerate(changes.nodes) if node == problem.controller_node]
    at_ns, _, _, down = changes.table[np.isin(changes.table[:, 1], mine)].T
    if not down.any():
        return range(realisation.windows)
    settings, release_ns = problem.controller, realisation.release_ns
    delay_ns = round(settings.order_delay_ms * 1e6)
    seen = []
    placement, window, boundary = script.initial, 0, problem.window_cycles
    while boundary <= realisation.cycles:
        close_ns = int(window_close_ns(problem, release_ns[boundary - 1], release_ns[boundary]))
        change = np.searchsorted(at_ns, close_ns, side="right") - 1
        if change < 0 or not down[change]:
            seen.append(window)
            if script.placement(window + 1) != placement:
                placement = script.placement(window + 1)
                reached = int(np.searchsorted(release_ns[:-1], close_ns + delay_ns))
                boundary = max(boundary + settings.order_lead_cycles, reached)
        window += 1
        boundary += problem.window_cycles
    return seen
