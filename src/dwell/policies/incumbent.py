"""Base classes of Dwell's policies: candidates, the incumbent, J and a decision rule."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, TypeVar

from dwell.errors import MetricError, PolicyError
from dwell.model.bounds import Bound
from dwell.model.frozen import FrozenDict
from dwell.model.objective import Objective
from dwell.model.placement import Placement
from dwell.model.qos import Decision, QoS, Reason
from dwell.model.semantics import nearest_of
from dwell.policies.pricing import Pricing, check_metrics
from dwell.policies.protocol import Proposer

if TYPE_CHECKING:
    from dwell.model.problem import Problem

Number = TypeVar("Number", int, float)

NOT_PRICED: FrozenDict[str, float] = FrozenDict()


def check_candidates(candidates: Mapping[str, Placement]) -> FrozenDict[str, Placement]:
    """Return the candidates as an immutable mapping, in their order.

    Raises PolicyError if the mapping is empty or two candidates place different tasks, and
    PlacementError if a value is not a placement.
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


def check_name(field: str, name: str | None, candidates: Mapping[str, object]) -> str:
    """Return `name`, or the first candidate's name if it is None.

    Raises PolicyError if no candidate has that name.
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


class Standing(NamedTuple):
    """The state of a policy, as one immutable value."""

    #: The incumbent (pi_{k-1} when window k is decided).
    name: str
    #: The incumbent before the last decision (pi_{k-2}).
    previous: str
    #: Decisions since the last move (n_d).
    dwell: int
    #: The rule's own state from earlier windows; immutable, or None.
    memory: Any


class CandidatePolicy(Proposer):
    """Base of Dwell's policies: the candidates, the incumbent, and J of each candidate.

    A subclass implements the rule, `_decide`, without changing any state. The order of the
    candidates breaks ties. `initial` is the candidate at the start, the first if None. Without an
    `objective`, J is not computed. Raises PolicyError if `initial` is no candidate, or candidates
    place different tasks.
    """

    #: Further arguments that `from_problem` passes, with their keys in ``problem.controller``.
    SETTINGS: ClassVar[Mapping[str, str]] = {}

    initial: str

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
        self._standing = self._first()

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
        return self._standing.name

    def start(self, problem: Problem) -> None:
        """Reset the policy to the initial candidate and n_d = 0, without memory of windows."""
        self._standing = self._first()

    def adopt(self, name: str) -> None:
        """Make `name` the incumbent with n_d = 0, although this policy did not choose it.

        Raises PolicyError if no candidate has that name.
        """
        name = check_name("the adopted placement", name, self.candidates)
        self._standing = Standing(name, self._standing.name, 0, self._adopted())

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS] | None = None) -> Decision:
        """Decide the placement for the next window.

        `observed` has the metrics under the incumbent, and `estimates` the metrics of each
        candidate, optional if the rule does not read them. Raises MetricError, with the policy
        unchanged, if a metric or a candidate's estimate is missing.
        """
        decision, after = self.propose(observed=observed, estimates=estimates)
        self.commit(after)
        return decision

    def propose(
        self,
        *,
        observed: QoS,
        estimates: Mapping[str, QoS] | None = None,
        tentative: bool = False,
    ) -> tuple[Decision, Standing]:
        """Return the decision on a window, and the policy's state after it."""
        check_metrics(observed, "observed")
        decision, memory = self._decide(observed, estimates)
        return decision, Standing(decision.name, self._standing.name, decision.dwell, memory)

    def commit(self, after: Standing) -> None:
        """Set the state that `propose` returned."""
        self._standing = after

    @abstractmethod
    def _decide(
        self, observed: QoS, estimates: Mapping[str, QoS] | None
    ) -> tuple[Decision, object]:
        """Return the decision on a window, and the rule's memory after it (see `decide`)."""

    def _blank(self) -> object:
        """Return the memory before the first window."""
        return None

    def _adopted(self) -> object:
        """Return the memory after `adopt`."""
        return self._blank()

    def _first(self) -> Standing:
        return Standing(self.initial, self.initial, 0, self._blank())

    def _stay(
        self,
        reason: Reason,
        costs: Mapping[str, float] = NOT_PRICED,
        delta_j: float = math.nan,
    ) -> Decision:
        """Decide for the incumbent; n_d grows."""
        name, dwell = self._standing.name, self._standing.dwell + 1
        return Decision(self.candidates[name], name, False, reason, costs, dwell, delta_j)

    def _move(
        self,
        name: str,
        reason: Reason,
        costs: Mapping[str, float] = NOT_PRICED,
        delta_j: float = math.nan,
    ) -> Decision:
        """Decide for another candidate; n_d restarts."""
        return Decision(self.candidates[name], name, True, reason, costs, 0, delta_j)

    def _known(self, estimates: Mapping[str, QoS] | None) -> Mapping[str, QoS]:
        """Return the estimates; raise MetricError if they are None."""
        if estimates is None:
            raise MetricError(
                f"estimates is None; give one for each of {', '.join(self.candidates)}"
            )
        return estimates

    def _costs(self, estimates: Mapping[str, QoS] | None) -> FrozenDict[str, float]:
        """Return J of every candidate against the incumbent; empty without objective or estimates.

        Raises MetricError if a metric, or the estimate of a candidate, is missing.
        """
        if self._pricing is None or estimates is None:
            return NOT_PRICED
        return self._pricing.estimated(estimates, self._standing.name)


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
