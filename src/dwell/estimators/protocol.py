"""Protocols of estimators: with and without learning."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol, runtime_checkable

from dwell.estimators.evidence import Evidence
from dwell.model.problem import Problem
from dwell.model.qos import QoS
from dwell.model.shadow_plan import ShadowFraction

if TYPE_CHECKING:
    from dwell.estimators.presents import Present


class Support(NamedTuple):
    """Support of an estimate: number and age of the samples behind it.

    Parameters
    ----------
    samples : float
        Number of samples, or their weight.
    age_windows : float
        Windows since the newest.
    """

    samples: float
    age_windows: float


@runtime_checkable
class Estimator(Protocol):
    """Predicts the QoS of every candidate from what a window showed under the incumbent.

    Its class may have an attribute ``states_errors``, true if its estimates have standard errors
    (`QoS.error`). N_min is then 0 where a cell gives none, else 3.
    """

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Estimate every candidate's metrics for the window just seen.

        Parameters
        ----------
        observed : QoS
            Metrics of the window.
        incumbent : str
            The candidate it ran under; its entry is an estimate like the others, which policies
            are shown if the estimator is a `Learner`: else `observed` takes its place.
        own : mapping of str to float
            Share of each node's cores that the cell's own work took in the window; the rest of
            the observed utilisation is foreign load.

        Returns
        -------
        mapping of str to QoS
            One entry for each candidate; with standard errors where they are known.

        Raises
        ------
        MetricError
            If a node's utilisation is missing.
        """
        ...


@runtime_checkable
class Learner(Protocol):
    """An estimator that learns from what happened to jobs and messages.

    It may have an attribute ``shadow_fraction``, the share of the cycles that it wants sent through
    each alternative as well (one number, or one for each active candidate), and a method
    ``support()`` that gives a `Support` for each candidate. It is started before a run. Policies
    compare its prediction of the incumbent with those of the others, so that an error that all of
    them share decides nothing.
    """

    def start(self, problem: Problem) -> None:
        """Forget everything that was learnt."""
        ...

    def learn(self, evidence: Evidence) -> None:
        """Take in a window; called before `estimate` for the same window."""
        ...

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """As `Estimator.estimate`."""
        ...


class CellEstimator(ABC):
    """An estimator as the controller works with it: all that others need not have has a default.

    Attributes
    ----------
    learns, supports : bool
        Whether it is shown what happened to jobs, and says what stands behind its estimates.
    states_errors : bool
        Whether its estimates have standard errors (`QoS.error`).
    shadow_fraction : float, or mapping of str to float
        Share of the cycles that it wants sent through each alternative, by the active candidate.
    revision : int
        Counts what is new of `present`.
    """

    learns: bool = False
    supports: bool = False
    states_errors: ClassVar[bool] = False
    shadow_fraction: ShadowFraction = 0.0
    revision: int = 0

    def __init_subclass__(cls) -> None:
        """Use the `learn` and the `support` of a subclass, also of a user's."""
        cls.learns = issubclass(cls, Learner)
        cls.supports = cls.support is not CellEstimator.support

    @property
    def given(self) -> object:
        """The object that was given as the estimator."""
        return self

    @property
    def present(self) -> Present | None:
        """What it knows to be otherwise than declared; None where it says nothing of it."""
        return None

    @abstractmethod
    def start(self, problem: Problem) -> None:
        """Forget every window."""

    def look(self, evidence: Evidence) -> None:
        """Take in what happened to the jobs of a window, where it learns."""
        if isinstance(self, Learner):
            self.learn(evidence)

    @abstractmethod
    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """As `Estimator.estimate`."""

    def deviations(self, name: str) -> tuple[float, float] | None:
        """Return standard deviations of one window under a candidate: of L95 (ms), and of V_D.

        None where they are not known, so that no window can be compared with the estimate.
        """
        return None

    def support(self) -> Mapping[str, Support]:
        """Say what stands behind the estimates, where it supports them."""
        return {}

    def share(self, nodes: Collection[str], cells: int, *, known: bool = True) -> None:
        """Take note of nodes whose other jobs are those of a fleet's cells.

        Parameters
        ----------
        known : bool
            Whether their load is accounted for; if not, it counts as foreign.
        """
        return
