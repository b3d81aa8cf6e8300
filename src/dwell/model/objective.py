"""The objective: weights, design targets and hard caps of the cost J (paper, eq. 5, 7 and 8)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import LARGEST, MAX_COUNT, Bound, require
from dwell.model.chain import Chain
from dwell.model.declaration import declared, key
from dwell.model.frozen import FrozenDict

Tier: TypeAlias = Literal["robot", "edge", "cloud"]
TIERS: tuple[Tier, ...] = ("robot", "edge", "cloud")
#: Aim for a cell: a share of missed deadlines under 5 % (from the paper).
AIM = 0.05
#: The bounds keep J finite for any metrics.
#: Longest stretch of a cap on misses: the longest simulation of a candidate has 20 of them.
LONGEST_STRETCH = 4_000
#: Largest share of stretches with too many misses.
MISSES_SHARE = 0.01
WEIGHT, TARGET, CAP = Bound(0, LARGEST), Bound(1e-9, LARGEST), Bound(0, above=True)


@declared("weights")
class Weights:
    """Weights of the terms of the cost J; at least one above 0."""

    latency: float = key("Weight of L95 / target.", WEIGHT, default=1.0)
    violations: float = key("Weight of the violation rate.", WEIGHT, default=3.0)
    robot: float = key("Weight of robot utilisation / target.", WEIGHT, default=0.5)
    edge: float = key("Weight of edge utilisation / target.", WEIGHT, default=0.3)
    switching: float = key("Weight of the share of moved tasks.", WEIGHT, default=0.5)
    cloud: float | None = key(
        "Weight of cloud utilisation / target.",
        WEIGHT,
        default=None,
        usual="cloud nodes count as edge nodes",
    )
    age: float = key(
        "Weight of the mean age / target, of the chain `objective.latency`, else of cycles.",
        WEIGHT,
        default=0.0,
        is_rare=True,
    )
    price: float = key(
        "Weight of the price of transmitted bytes / target.", WEIGHT, default=0.0, is_rare=True
    )

    def __post_init__(self) -> None:
        values = (self.latency, self.violations, self.robot, self.edge, self.switching, self.cloud)
        if not any((*values, self.age, self.price)):
            raise ProblemError(
                [Fault("weights", "all weights are 0; at least one must be above 0")]
            )


@declared("targets")
class Targets:
    """Design targets that normalise latency and utilisation (paper, eq. 5)."""

    latency_ms: float = key(
        "Of L95, ms.",
        TARGET,
        usual="the deadline; `max_age_ms` of the chain `objective.latency`, if it has one",
    )
    robot: float = key("Of robot utilisation.", TARGET, default=0.7)
    edge: float = key("Of edge utilisation.", TARGET, default=0.7)
    cloud: float | None = key(
        "Of cloud utilisation; required with `weights.cloud`.", TARGET, default=None
    )
    age_ms: float | None = key(
        "Of the mean age, ms; required with `weights.age`.", TARGET, default=None
    )
    price_per_hour: float | None = key(
        "Of the price of transmitted bytes, money per hour; required with `weights.price`.",
        TARGET,
        default=None,
    )


def latency_target_ms(deadline_ms: float, chain: Chain | None) -> float:
    """Return the target of latency where a cell gives none: of its chain, else the deadline."""
    return chain.max_age_ms if chain is not None and chain.is_bounded else deadline_ms


@declared("misses")
class MissCap:
    """Cap on misses: more than m in at most 1 % of the stretches of k cycles."""

    m: int = key("Misses that a stretch may have.", Bound(0, MAX_COUNT, whole=True))
    k: int = key("Consecutive cycles of a stretch.", Bound(1, LONGEST_STRETCH, whole=True))

    def __post_init__(self) -> None:
        require(self.m < self.k, "misses.m", self.m, f"below k = {self.k}")

    @property
    def least_cycles(self) -> int:
        """Least number of simulated cycles for the share of stretches."""
        return 20 * self.k


@declared("caps")
class Caps:
    """Hard caps; a candidate above one is not eligible."""

    latency_ms: float = key("On L95, ms.", CAP, default=math.inf, usual="none")
    utilisation: float = key(
        "On the utilisation of every node and accelerator, as 0.98.",
        CAP,
        default=math.inf,
        usual="none",
    )
    misses: MissCap | None = key(
        "On misses: more than m in at most 1 % of the stretches of k cycles.",
        default=None,
        usual="none",
    )


@declared()
class Objective:
    """The parameters of J: weights, targets, caps, and the tiers of nodes."""

    weights: Weights = key("Weights of the terms of J.", digested="decision", tier="first")
    targets: Targets = key("Design targets.", digested="decision", tier="first")
    caps: Caps = key("Hard caps.", default_factory=Caps, digested="decision", tier="first")
    tiers: Mapping[str, Tier] = key(
        "Nodes whose utilisation counts, and as which tier.",
        default_factory=FrozenDict,
        usual="all, as their own tier",
        digested="decision",
    )
    accelerators: Mapping[str, Tier] = key(
        "Tier of each accelerator that counts in J, by resource (``E.gpu``): all accelerators of "
        "the nodes in `tiers`, or none, as in the paper. J leaves out accelerators without "
        "measured utilisation.",
        default_factory=FrozenDict,
    )
    latency: str | None = key(
        "Chain whose data age counts as latency in J, caps and targets.",
        default=None,
        usual="the latency of cycles",
        digested="decision",
    )

    def __post_init__(self) -> None:
        faults = []
        if self.weights.cloud is not None and self.targets.cloud is None:
            faults.append(Fault("targets.cloud", "missing; weights.cloud weighs cloud nodes apart"))
        if self.weighs_age and self.targets.age_ms is None:
            faults.append(Fault("targets.age_ms", "missing; weights.age weighs the mean age"))
        if self.weighs_price and self.targets.price_per_hour is None:
            faults.append(
                Fault("targets.price_per_hour", "missing; weights.price weighs transmitted bytes")
            )
        if faults:
            raise ProblemError(faults)

    @property
    def beyond_cycles(self) -> str:
        """Path of the first key that needs more than latencies and V_D of windows; else empty."""
        given = {
            "latency": self.latency is not None,
            "weights.age": self.weighs_age,
            "caps.misses": self.caps.misses is not None,
        }
        return next((name for name, there in given.items() if there), "")

    def require_searchable(self) -> None:
        """Refuse keys that the search of placements does not support.

        Raises
        ------
        ProblemError
            If it has one.
        """
        if name := self.beyond_cycles:
            message = "the search of placements does not support it; remove it, or list candidates"
            raise ProblemError([Fault(f"objective.{name}", message)])

    def require_judgeable(self, other: Objective) -> None:
        """Refuse another objective whose runs have no J by this one.

        Raises
        ------
        ProblemError
            If its latency is that of another chain, or its runs lack the mean age.
        """
        judges = "as in the cell, whose objective judges the runs of all policies"
        path, bound = "objective.latency", f"{self.latency or 'absent'}, {judges}"
        require(other.latency == self.latency, path, other.latency, bound)
        measured = other.weighs_age or not self.weighs_age
        require(measured, "objective.weights.age", other.weights.age, f"above 0, {judges}")

    @property
    def weighs_age(self) -> bool:
        """Whether J has a term of the mean age."""
        return self.weights.age > 0

    @property
    def weighs_price(self) -> bool:
        """Whether J has a term of the price of transmitted bytes."""
        return self.weights.price > 0
