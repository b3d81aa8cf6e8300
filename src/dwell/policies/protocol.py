"""Protocols of policies: the least that one needs, and a full policy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

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
