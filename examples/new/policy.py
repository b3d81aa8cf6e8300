"""A policy of your own: `dwell run cell.yaml --policy policy:Patient` plays it."""

from __future__ import annotations

from collections.abc import Mapping

from dwell.model import Problem, QoS


class Patient:
    """Move to the candidate that should miss the fewest deadlines, once it has stayed the best."""

    # Change: what makes it move, and how long it waits. It may have an estimator, too:
    # `--policy policy:Patient+corrected`.
    def __init__(self, initial: str = "LOC", patience: int = 3) -> None:
        self.incumbent = initial
        self.patience = patience  # decisions at which another candidate must be the best
        self.better: list[str] = []

    @classmethod
    def from_problem(cls, problem: Problem) -> Patient:
        """Make it for a cell: what the cell file says is in `problem`."""
        return cls(problem.initial)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Choose the placement for the next window, by name.

        `observed` is what the last window showed, `estimates` what it would have shown under each
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
        """Take note that the guard, or an operator, has moved the cell."""
        self.incumbent, self.better = name, []
