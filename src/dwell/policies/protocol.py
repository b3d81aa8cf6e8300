"""Interfaces of policies: the methods users write, and the base class the controller uses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

from dwell.model.objective import Objective
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS


@runtime_checkable
class MinimalPolicy(Protocol):
    """The smallest policy: an object with the method `decide`.

    A policy may also have

    * ``start(problem)``, called before every run, which resets it; without ``start``, every run
      begins with a new copy;
    * ``initial``, the name of the candidate at the start, if it differs from the problem's;
    * ``adopt(name)``, called if the cell is on a candidate that the policy did not choose, such as
      after a move by the guard.
    """

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Decision | str:
        """Choose the placement for the next window.

        Parameters
        ----------
        observed : QoS
            Metrics of the last window, under the incumbent.
        estimates : mapping of str to QoS
            Estimated metrics of the same window, by candidate, with their standard errors if
            known (`QoS.error`). The incumbent's entry is a prediction if the estimator learns, and
            equals `observed` otherwise.

        Returns
        -------
        Decision, or str
            A decision, or only the name of a candidate.
        """
        ...


@runtime_checkable
class Policy(MinimalPolicy, Protocol):
    """A policy that can be restarted; it depends on no clock, simulator or socket."""

    def start(self, problem: Problem) -> None:
        """Reset the state before a run of `problem`."""
        ...


class Proposer(ABC):
    """Base of the policies that the controller calls.

    A policy proposes a decision, and its state changes only when the decision is committed.
    """

    #: The candidate at the start; the problem's if None.
    initial: str | None = None
    #: The objective for J; the problem's if None.
    objective: Objective | None = None
    #: Whether a guard may move the cell.
    guarded: bool = True
    #: The estimator if neither the cell nor the caller names one.
    usual_estimator: ClassVar[str] = "corrected"
    #: Whether the policy moves to any candidate that is cheap enough, which lets the ledger of a
    #: fleet replace its choice.
    by_price: ClassVar[bool] = False

    @property
    def given(self) -> object:
        """The object that the user passed as the policy."""
        return self

    @abstractmethod
    def start(self, problem: Problem) -> None:
        """Reset the state before a run of `problem`."""

    @abstractmethod
    def propose(
        self, *, observed: QoS, estimates: Mapping[str, QoS], tentative: bool = False
    ) -> tuple[Decision | str, Any]:
        """Return the decision on a window, and the state for `commit`.

        A `tentative` proposal leaves the policy unchanged, because it may be discarded.
        """

    @abstractmethod
    def commit(self, after: Any) -> None:
        """Change to the state that `propose` returned."""

    @abstractmethod
    def adopt(self, name: str) -> None:
        """Make a candidate the incumbent that the policy did not choose."""
