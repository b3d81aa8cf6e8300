"""What a policy has to be, and what the controller makes of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

from dwell.model.objective import Objective
from dwell.model.problem import Problem
from dwell.model.qos import Decision, QoS


@runtime_checkable
class MinimalPolicy(Protocol):
    """The least a policy has to be: something that decides.

    A policy may also have

    * ``start(problem)``, called before every run, which makes it forget the run before; without
      it every run begins with a fresh copy;
    * ``initial``, the name of the candidate it starts on, where that is not the problem's;
    * ``adopt(name)``, called when somebody else (the guard) has moved the cell to a candidate.
    """

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Decision | str:
        """Choose the placement for the next window.

        Parameters
        ----------
        observed : QoS
            Metrics of the last window, under the incumbent.
        estimates : mapping of str to QoS
            Estimated metrics of the same window, by candidate, with their standard errors where
            they are known (`QoS.error`); the incumbent's are a prediction, as the others', where
            the estimator learns, and `observed` where it does not.

        Returns
        -------
        Decision, or str
            A candidate's name is enough.
        """
        ...


@runtime_checkable
class Policy(MinimalPolicy, Protocol):
    """Observation and estimates in, decision out; it knows no clock, simulator or socket."""

    def start(self, problem: Problem) -> None:
        """Forget everything: a run of `problem` begins."""
        ...


class Proposer(ABC):
    """A policy as the controller works with it: it proposes, and changes by what is carried out.

    Attributes
    ----------
    initial : str or None
        Candidate that it starts on; the problem's where None.
    objective : Objective or None
        What it prices by; the problem's where None.
    guarded : bool
        Whether a guard may move the cell.
    usual_estimator : str
        Estimator where neither the cell nor the caller names one.
    by_price : bool
        Whether it moves to any candidate that is cheap enough, so that in a fleet another one may
        be taken in the place of its own.
    """

    initial: str | None = None
    objective: Objective | None = None
    guarded: bool = True
    usual_estimator: ClassVar[str] = "corrected"
    by_price: ClassVar[bool] = False

    @property
    def given(self) -> object:
        """The object that was given as the policy."""
        return self

    @abstractmethod
    def start(self, problem: Problem) -> None:
        """Forget everything: a run of `problem` begins."""

    @abstractmethod
    def propose(
        self, *, observed: QoS, estimates: Mapping[str, QoS], tentative: bool = False
    ) -> tuple[Decision | str, Any]:
        """Return the decision on a window, and what `commit` takes where it counts.

        Parameters
        ----------
        tentative : bool
            Whether it may not count: the policy is as before then.
        """

    @abstractmethod
    def commit(self, after: Any) -> None:
        """Be as after a decision that was proposed."""

    @abstractmethod
    def adopt(self, name: str) -> None:
        """Take note that somebody else has moved the cell to a candidate."""
