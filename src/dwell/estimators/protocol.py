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
    from dwell.estimators.present import Present


class Support(NamedTuple):
    """Support of an estimate: number and age of the samples behind it.

    Parameters
    ----------
    samples : float
        Number of samples, or their weight.
    age_windows : float
        Windows since the newest sample.
    """

    samples: float
    age_windows: float


@runtime_checkable
class Estimator(Protocol):
    """Predicts the QoS of every candidate from a window under the incumbent.

    Its class may have an attribute ``states_errors``, true if its estimates have standard errors
    (`QoS.error`). If the cell sets no N_min, it is 0 with this attribute and 3 without.
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
            The candidate that was active. Policies receive its estimate if the estimator is a
            `Learner`, otherwise `observed`.
        own : mapping of str to float
            Share of each node's cores that the cell's own work used in the window; the rest of
            the observed utilisation is foreign load.

        Returns
        -------
        mapping of str to QoS
            One entry per candidate, with standard errors if they are known.

        Raises
        ------
        MetricError
            If a node's utilisation is missing.
        """
        ...


@runtime_checkable
class Learner(Protocol):
    """An estimator that learns from the timings of jobs and messages.

    It may have an attribute ``shadow_fraction``, the share of cycles to send through each
    alternative as well (one number, or one per active candidate), and a method ``support()`` that
    returns a `Support` per candidate. `start` is called before a run. Policies compare its
    prediction of the incumbent with its predictions of the others, because an error that all of
    them share then decides nothing.
    """

    def start(self, problem: Problem) -> None:
        """Forget everything that was learnt."""
        ...

    def learn(self, evidence: Evidence) -> None:
        """Learn from a window; called before `estimate` for the same window."""
        ...

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """As `Estimator.estimate`."""
        ...


class CellEstimator(ABC):
    """An estimator as the controller uses it, with defaults for all optional methods.

    Attributes
    ----------
    learns, supports : bool
        Whether it learns from the jobs of a window, and whether it has a method `support`.
    states_errors : bool
        Whether its estimates have standard errors (`QoS.error`).
    shadow_fraction : float, or mapping of str to float
        Share of cycles to send through each alternative, by active candidate.
    revision : int
        Number of updates of `present`.
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
        """Measured changes of the declared conditions, if the estimator measures any."""
        return None

    @abstractmethod
    def start(self, problem: Problem) -> None:
        """Forget every window."""

    def look(self, evidence: Evidence) -> None:
        """Learn from the jobs of a window, if the estimator learns."""
        if isinstance(self, Learner):
            self.learn(evidence)

    @abstractmethod
    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """As `Estimator.estimate`."""

    def deviations(self, name: str) -> tuple[float, float] | None:
        """Return standard deviations of L95 (ms) and V_D in one window under a candidate.

        None if unknown: windows are then not compared with the estimate.
        """
        return None

    def support(self) -> Mapping[str, Support]:
        """Return number and age of the samples behind each estimate; empty if unknown."""
        return {}

    def share(self, nodes: Collection[str], cells: int, *, known: bool = True) -> None:
        """Register nodes that the cells of a fleet share.

        Parameters
        ----------
        known : bool
            Whether the load of the other cells is accounted for; if not, it counts as foreign.
        """
        return
