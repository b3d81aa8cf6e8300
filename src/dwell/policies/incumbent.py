"""The candidates of a policy, which of them is active, and for how long."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Self, TypeVar

from dwell.errors import PolicyError
from dwell.model.bounds import Bound
from dwell.model.frozen import FrozenDict
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.qos import Decision, QoS, Reason
from dwell.model.semantics import nearest_of
from dwell.policies.pricing import Pricing

if TYPE_CHECKING:
    from dwell.model.problem import Problem

Number = TypeVar("Number", int, float)

NOT_PRICED: FrozenDict[str, float] = FrozenDict()


def check_candidates(candidates: Mapping[str, Placement]) -> FrozenDict[str, Placement]:
    """Return the candidates unchangeable, in their order.

    Raises
    ------
    PolicyError
        If there is none, or two of them place different tasks.
    PlacementError
        If one is not a placement.
    """
    if not candidates:
        raise PolicyError("candidates is empty; give at least one placement, as {'LOC': ...}")
    placements = {
        name: moves if isinstance(moves, Placement) else Placement(moves)
        for name, moves in candidates.items()
    }
    first, reference = next(iter(placements.items()))
    for name, placement in placements.items():
        if placement.keys() != reference.keys():
            raise PolicyError(
                f"candidates.{name} places {', '.join(placement)} but candidates.{first} places "
                f"{', '.join(reference)}; every candidate must place the same tasks"
            )
    return FrozenDict(placements)


def check_name(field: str, name: str | None, candidates: Mapping[str, Placement]) -> str:
    """Return `name`, or the first candidate's where it is None.

    Raises
    ------
    PolicyError
        If no candidate has that name.
    """
    if name is None:
        return next(iter(candidates))
    if name not in candidates:
        raise PolicyError(
            f"{field} is {name!r}, which is no candidate; "
            f"{nearest_of(str(name), candidates, 'candidates')}"
        )
    return name


def check_parameter(field: str, value: Number, bound: Bound) -> Number:
    """Return `value` if it is within the bound, else raise PolicyError."""
    if not bound.holds(value):
        raise PolicyError(f"{field} is {value!r}; it must be {bound}")
    return value


class Incumbent:
    """The active candidate, the candidate before the last decision, and the windows since a move.

    Parameters
    ----------
    name : str
        The candidate to begin with.

    Attributes
    ----------
    name : str
        The active candidate (pi_{k-1} when window k is decided).
    previous : str
        The one active before the last decision (pi_{k-2}).
    dwell : int
        Windows since the last migration (n_d).
    """

    __slots__ = ("candidates", "dwell", "name", "previous")

    def __init__(self, candidates: Mapping[str, Placement], name: str) -> None:
        self.candidates = candidates
        self.begin(name)

    def begin(self, name: str) -> None:
        """Start anew with a candidate that nothing preceded."""
        self.name = self.previous = name
        self.dwell = 0

    def adopt(self, name: str) -> None:
        """Take over a candidate that somebody else moved the cell to.

        Raises
        ------
        PolicyError
            If no candidate has that name.
        """
        name = check_name("the adopted placement", name, self.candidates)
        self.previous, self.name, self.dwell = self.name, name, 0

    def stay(
        self,
        reason: Reason,
        costs: Mapping[str, float] = NOT_PRICED,
        delta_j: float = math.nan,
    ) -> Decision:
        """Decide for the incumbent; n_d grows."""
        name = self.previous = self.name
        self.dwell += 1
        return Decision(self.candidates[name], name, False, reason, costs, self.dwell, delta_j)

    def move(
        self,
        name: str,
        reason: Reason,
        costs: Mapping[str, float] = NOT_PRICED,
        delta_j: float = math.nan,
    ) -> Decision:
        """Decide for another candidate; n_d restarts."""
        self.previous, self.name, self.dwell = self.name, name, 0
        return Decision(self.candidates[name], name, True, reason, costs, 0, delta_j)


class CandidatePolicy:
    """Base of our policies: the candidates, the active one among them, and their J.

    Parameters
    ----------
    candidates : mapping of str to Placement
        Over the same tasks; the order breaks ties.
    initial : str, optional
        The candidate it starts on; the first where None.
    objective : Objective, optional
        Weights, targets, caps and tiers of J; where None, nothing is priced.

    Raises
    ------
    PolicyError
        If `initial` is no candidate, or candidates place different tasks.
    """

    #: Arguments beside these that `from_problem` gives, with their names in ``problem.controller``.
    SETTINGS: ClassVar[Mapping[str, str]] = {}

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective | None = None,
    ) -> None:
        self.candidates = check_candidates(candidates)
        self.initial = check_name("initial", initial, self.candidates)
        self.objective = objective
        self._pricing = None if objective is None else Pricing(self.candidates, objective)
        self._incumbent = Incumbent(self.candidates, self.initial)

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the policy with the parameters of ``problem.controller``."""
        settings = {name: getattr(problem.controller, key) for name, key in cls.SETTINGS.items()}
        return cls(
            candidates=problem.candidates,
            initial=problem.initial,
            objective=problem.objective,
            **settings,
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}(initial={self.initial!r})"

    @property
    def incumbent(self) -> str:
        """Name of the active candidate."""
        return self._incumbent.name

    def start(self, problem: Problem) -> None:
        """Begin again on the initial candidate, n_d = 0."""
        self._incumbent.begin(self.initial)

    def adopt(self, name: str) -> None:
        """Take over `name` as the incumbent with n_d = 0: somebody else moved the cell there."""
        self._incumbent.adopt(name)

    def _costs(self, estimates: Mapping[str, QoS] | None) -> FrozenDict[str, float]:
        """J of every candidate against the incumbent, where it is priced and estimated.

        Raises
        ------
        MetricError
            If a metric, or the estimate of a candidate, is missing.
        """
        if self._pricing is None or estimates is None:
            return NOT_PRICED
        return self._pricing.estimated(estimates, self._incumbent.name)


class PricingPolicy(CandidatePolicy):
    """A policy that needs J."""

    objective: Objective
    _pricing: Pricing

    def __init__(
        self,
        *,
        candidates: Mapping[str, Placement],
        initial: str | None = None,
        objective: Objective,
    ) -> None:
        super().__init__(candidates=candidates, initial=initial)
        self.objective = objective
        self._pricing = Pricing(self.candidates, objective)
