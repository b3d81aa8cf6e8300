"""Settings of a cell's controller, and bounds that other modules share."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from dwell.model.bounds import MAX_COUNT, MIN_DWELL, MIN_IMPROVEMENT, TIME_MS, Bound
from dwell.model.declaration import declared, key

GUARD_CYCLES = Bound(2, MAX_COUNT, whole=True)
PROBE_CYCLES = Bound(1, MAX_COUNT, whole=True)
HALF_LIFE_WINDOWS = Bound(0, MAX_COUNT, above=True)
AUTO = "auto"
SHADOW_FRACTION = Bound(0, 1)
DECIDE_CYCLES = Bound(1, MAX_COUNT, whole=True)
MIN_DWELL_CYCLES = Bound(0, MAX_COUNT, whole=True)
#: N_min if the cell sets none and the estimator states no errors.
USUAL_DWELL = 3
#: The policy that adds a second copy of each cycle to the placement of its base.
REPLICATE = "replicate"


@declared("replicate")
class ReplicateSettings:
    """Settings of the policy `replicate`, which adds a second copy of each cycle where it pays."""

    base: str = key(
        "The policy that decides among the candidates without replicas; a candidate never moves.",
        default="dtp",
    )


@declared()
class ControllerSettings:
    """The controller: its node, policy and estimator, and the timing of its orders."""

    on: str | None = key(
        "Node of the controller.",
        default=None,
        usual="the first edge node, else the first node",
        tier="first",
    )
    policy: str = key(
        "A policy, `package.module:Class` of your own, or a candidate: the placement that never "
        "moves.",
        default="dtp",
        digested="decision",
        tier="first",
    )
    initial: str | None = key(
        "Candidate to start with.", default=None, usual="the first", tier="first"
    )
    decide_cycles: int | None = key(
        "Cycles between two decisions, at most W.",
        DECIDE_CYCLES,
        default=None,
        usual="W/4, rounded down, then up to a multiple of the slowest sink's interval",
        digested="decision",
    )
    min_dwell: int | None = key(
        "Windows that a placement stays at least (N_min).",
        MIN_DWELL,
        default=None,
        usual="0 with an estimator that states its errors, else 3",
        digested="decision",
    )
    min_dwell_cycles: int = key(
        "Cycles that a placement stays at least, if N_min windows are fewer.",
        MIN_DWELL_CYCLES,
        default=0,
        digested="decision",
    )
    min_improvement: float = key(
        "Improvement of J that a migration must promise (Delta_min).",
        MIN_IMPROVEMENT,
        default=0.05,
        digested="decision",
    )
    escape: bool = key(
        "Whether an incumbent over a cap may leave before the hysteresis is met.",
        default=False,
        digested="decision",
    )
    estimator: str | None = key(
        "How the QoS of candidates is estimated; also `package.module:Class` of your own.",
        default=None,
        usual="`corrected`; `profile` for a placement that never moves, `latency-first` and "
        "`atp-thresholds`",
        digested="decision",
    )
    replicate: ReplicateSettings = key(
        "Settings of the policy `replicate`.",
        default_factory=ReplicateSettings,
        usual="base: dtp",
        is_rare=True,
        digested="decision",
    )
    shadow_fraction: float | Literal["auto"] = key(
        "Share of cycles that are also sent through each alternative, if the estimator uses "
        "shadow jobs; `auto`: for each placement the largest share, up to 0.05, that hardly delays "
        "the cell's own cycles.",
        replace(SHADOW_FRACTION, word=AUTO),
        default=AUTO,
        digested="decision",
    )
    half_life_windows: float = key(
        "Half-life of estimators, windows: they keep measured values for 1 to 6 half-lives.",
        HALF_LIFE_WINDOWS,
        default=2.0,
        digested="decision",
    )
    migration: Literal["warm", "cold"] = key(
        "`warm`: a moved task is ready at once; `cold`: after its `start_ms` and the transfer of "
        "its `state_bytes`.",
        default="warm",
    )
    guard_cycles: int = key(
        "The guard moves the cell to a fallback after max(D, P) + (g - 1) P without a completion.",
        GUARD_CYCLES,
        default=3,
    )
    probe_cycles: int = key(
        "Cycles that must complete through a placement before the cell leaves the guard's fallback "
        "for it; also the length of the guard's rest after its own move.",
        PROBE_CYCLES,
        default=30,
    )
    fallbacks: tuple[str, ...] = key(
        "Candidates that the guard may move to, best first; none: no guard.", default=()
    )
    order_delay_ms: float = key(
        "Time that an order travels, ms.", TIME_MS, default=0.0, tier="measured"
    )
    order_lead_cycles: int = key(
        "Cycles between a window's close and the first one its order may stamp.",
        Bound(0, MAX_COUNT, whole=True),
        default=0,
        tier="measured",
    )
    close_grace_ms: float = key(
        "Time that a window stays open for stragglers after the release of the first cycle beyond "
        "it, ms. No window closes before the last deadline of its cycles.",
        TIME_MS,
        default=0.0,
        tier="measured",
    )

    @property
    def shadow_workers(self) -> bool:
        """Whether nodes keep workers for shadow jobs, for estimates or for the guard's probes."""
        return self.estimator != "profile" or bool(self.fallbacks)

    @property
    def failures_in_a_row(self) -> int:
        """Consecutive failures that count as a fault of a worker or candidate: g + 1."""
        return self.guard_cycles + 1
