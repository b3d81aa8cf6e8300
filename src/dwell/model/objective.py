"""The objective: weights, design targets and hard caps of the cost J (paper, eq. 5, 7 and 8)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal, TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import LARGEST, Bound
from dwell.model.declaration import declared, key
from dwell.model.frozen import FrozenDict

Tier: TypeAlias = Literal["robot", "edge", "cloud"]
TIERS: tuple[Tier, ...] = ("robot", "edge", "cloud")
#: Aim for a cell: a share of missed deadlines under 5 % (from the paper).
AIM = 0.05


#: The bounds keep J finite for any metrics.
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

    def __post_init__(self) -> None:
        values = (self.latency, self.violations, self.robot, self.edge, self.switching, self.cloud)
        if not any(values):
            raise ProblemError(
                [Fault("weights", "all weights are 0; at least one must be above 0")]
            )


@declared("targets")
class Targets:
    """Design targets that normalise latency and utilisation (paper, eq. 5)."""

    latency_ms: float = key("Of L95, ms.", TARGET, usual="the deadline")
    robot: float = key("Of robot utilisation.", TARGET, default=0.7)
    edge: float = key("Of edge utilisation.", TARGET, default=0.7)
    cloud: float | None = key(
        "Of cloud utilisation; needed where `weights` has `cloud`.", TARGET, default=None
    )


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

    def __post_init__(self) -> None:
        if self.weights.cloud is not None and self.targets.cloud is None:
            raise ProblemError(
                [Fault("targets.cloud", "missing; weights.cloud weighs cloud nodes apart")]
            )
