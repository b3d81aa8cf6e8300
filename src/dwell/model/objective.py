"""The objective: weights, design targets and hard caps of the cost J (paper, eq. 5, 7 and 8)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import CAP, TARGET, WEIGHT, require
from dwell.model.frozen import FrozenDict

Tier: TypeAlias = Literal["robot", "edge", "cloud"]
TIERS: tuple[Tier, ...] = ("robot", "edge", "cloud")


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the terms of J: from 0 to 1e9, not all 0.

    `cloud` is None where cloud nodes count as edge nodes (the default).
    """

    latency: float = 1.0
    violations: float = 3.0
    robot: float = 0.5
    edge: float = 0.3
    switching: float = 0.5
    cloud: float | None = None

    def __post_init__(self) -> None:
        weights = {
            "latency": self.latency,
            "violations": self.violations,
            "robot": self.robot,
            "edge": self.edge,
            "switching": self.switching,
        }
        if self.cloud is not None:
            weights["cloud"] = self.cloud
        for name, value in weights.items():
            WEIGHT.check(f"weights.{name}", value)
        if not any(weights.values()):
            raise ProblemError(
                [Fault("weights", "all weights are 0; at least one must be above 0")]
            )


@dataclass(frozen=True, slots=True)
class Targets:
    """Design targets that normalise latency and utilisation (paper, eq. 5): from 1e-9 to 1e9."""

    latency_ms: float
    robot: float = 0.7
    edge: float = 0.7
    cloud: float | None = None

    def __post_init__(self) -> None:
        for name in ("latency_ms", "robot", "edge", "cloud"):
            value = getattr(self, name)
            if value is not None:
                TARGET.check(f"targets.{name}", value)


@dataclass(frozen=True, slots=True)
class Caps:
    """Hard caps on L95 (ms) and on the utilisation of every resource; infinite for none."""

    latency_ms: float = math.inf
    utilisation: float = math.inf

    def __post_init__(self) -> None:
        CAP.check("caps.latency_ms", self.latency_ms)
        CAP.check("caps.utilisation", self.utilisation)


@dataclass(frozen=True, slots=True)
class Objective:
    """Everything that J and its constraints need besides the metrics.

    Parameters
    ----------
    weights, targets, caps
        See the classes.
    tiers : mapping of str to {"robot", "edge", "cloud"}
        Tier of every node whose utilisation counts.
    accelerators : mapping of str to {"robot", "edge", "cloud"}
        Tier of every kind of accelerators that counts in J beside the nodes, by the name of the
        resource (``E.gpu``): those of all nodes of `tiers`, or none, as in the paper. J does
        without those that a QoS does not have.
    """

    weights: Weights
    targets: Targets
    caps: Caps = field(default_factory=Caps)
    tiers: Mapping[str, Tier] = field(default_factory=FrozenDict)
    accelerators: Mapping[str, Tier] = field(default_factory=FrozenDict)

    def __post_init__(self) -> None:
        for key in ("tiers", "accelerators"):
            of = getattr(self, key)
            for name, tier in of.items():
                require(tier in TIERS, f"{key}.{name}", tier, f"one of {', '.join(TIERS)}")
            object.__setattr__(self, key, FrozenDict(of))
        if self.weights.cloud is not None and self.targets.cloud is None:
            raise ProblemError(
                [Fault("targets.cloud", "missing; weights.cloud weighs cloud nodes apart")]
            )
