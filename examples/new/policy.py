"""A policy of your own: `dwell run cell.yaml --policy policy:Patient` simulates it."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model import Problem, QoS


class Patient:
    """Move to the candidate with the fewest expected misses, if it is the best several times."""

    # Change: the condition of a move, and how long it waits. `--policy policy:Patient+profile`
    # selects another estimator than the cell's.
    def __init__(self, initial: str = "LOC", patience: int = 3) -> None:
        self.incumbent = initial
        self.patience = patience  # decisions at which another candidate must be the best
        self.better: list[str] = []

    @classmethod
    def from_problem(cls, problem: Problem) -> Patient:
        """Make it for a cell; `problem` has the values of the cell file."""
        return cls(problem.initial)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Choose the placement for the next window, by name.

        `observed` has the metrics of the last window, `estimates` the expected metrics of each
        candidate: l95_ms, violation_rate, utilisation (by node).
        """
        best = min(estimates, key=lambda name: estimates[name].violation_rate)
        if estimates[best].violation_rate < observed.violation_rate:
            self.better.append(best)
        else:
            self.better.clear()
        if self.better[-self.patience :] == [best] * self.patience:
            self.incumbent, self.better = best, []
        return self.incumbent

    def adopt(self, name: str) -> None:
        """Continue from another placement: the guard or an operator has moved the cell."""
        self.incumbent, self.better = name, []
