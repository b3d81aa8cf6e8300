"""QoS, the metrics of a window, and Decision, the result of a policy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, get_args

from dwell.errors import MetricError
from dwell.model.frozen import FrozenDict
from dwell.model.placement import Placement

#: The last three are reasons of moves that an operator or another controller ordered.
Reason: TypeAlias = Literal[
    "dwell", "hold", "migrate", "capped", "infeasible", "guard", "pinned", "drained", "ordered"
]
#: Every reason of a decision.
REASONS: tuple[Reason, ...] = get_args(Reason)
INFINITY = math.inf
#: Standard errors of L95 and V_D if a QoS has none.
NO_ERROR = (0.0, 0.0)
#: Mean age and its standard error if a QoS has none.
NO_AGE: tuple[float | None, float] = (None, 0.0)


@dataclass(frozen=True, slots=True)
class QoS:
    """Metrics of one window under one placement, observed or estimated.

    Parameters
    ----------
    l95_ms : float
        95th percentile of end-to-end latency, milliseconds; finite, at least 0.
    violation_rate : float
        Share of the window's cycles that missed the deadline, in [0, 1].
    utilisation : mapping of str to float
        Busy share of each resource: a node's cores, by its name, or a kind of its accelerators,
        as ``E.gpu``; finite, at least 0. A missing resource has an unknown utilisation.
    cut_from_ms : float, optional
        The true L95 if it is above the bound `l95_ms`, which replaces it in J; infinite for a lost
        cycle. Caps apply to this value.
    error : tuple of float, optional
        Standard errors of `l95_ms` (milliseconds) and of `violation_rate`; finite, at least 0.
        None if unknown, which counts as 0.
    age_ms : float, optional
        Mean over time of the age of the newest command, milliseconds; finite, at least 0. Needed if
        J weighs ages.
    age_error_ms : float, optional
        Standard error of `age_ms`; finite, at least 0.
    misses : float, optional
        Share of the stretches of k cycles with more than m misses, in [0, 1] (``caps.misses``);
        None if unknown, which respects the cap.
    paired : tuple of float, optional
        In a cell whose candidates come from a search: standard errors of the differences of
        `l95_ms` and `violation_rate` from the incumbent's estimates on the same samples.
    price_per_hour : float, optional
        Price of the bytes that links transmit, money per hour; finite, at least 0. Needed if J
        weighs it.

    Raises
    ------
    MetricError
        If a value is missing, NaN, out of its range, or infinite (`cut_from_ms` may be).
    """

    l95_ms: float
    violation_rate: float
    utilisation: Mapping[str, float]
    cut_from_ms: float | None = None
    error: tuple[float, float] | None = None
    age_ms: float | None = None
    age_error_ms: float = 0.0
    misses: float | None = None
    paired: tuple[float, float] | None = None
    price_per_hour: float | None = None

    def __post_init__(self) -> None:
        l95_ms, cut_from_ms = self.l95_ms, self.cut_from_ms
        # Comparisons with NaN are false, so each test is written to pass only for a good value.
        if not 0 <= l95_ms < INFINITY:
            raise MetricError(f"l95_ms is {l95_ms!r}; it must be finite and at least 0")
        if not 0 <= self.violation_rate <= 1:
            raise MetricError(f"violation_rate is {self.violation_rate!r}; it must lie in [0, 1]")
        for node, value in self.utilisation.items():
            if not 0 <= value < INFINITY:
                raise MetricError(
                    f"utilisation of {node} is {value!r}; it must be finite and at least 0"
                )
        if cut_from_ms is not None:
            if not cut_from_ms >= l95_ms:
                raise MetricError(
                    f"cut_from_ms is {cut_from_ms!r}; it must be at least l95_ms, {l95_ms!r}"
                )
            if cut_from_ms == l95_ms:
                object.__setattr__(self, "cut_from_ms", None)
        for errors in (one for one in (self.error, self.paired) if one is not None):
            for metric, value in zip(("l95_ms", "violation_rate"), errors, strict=True):
                if not 0 <= value < INFINITY:
                    raise MetricError(
                        f"error of {metric} is {value!r}; it must be finite and at least 0"
                    )
        further = {
            "age_ms": self.age_ms,
            "age_error_ms": self.age_error_ms,
            "price_per_hour": self.price_per_hour,
        }
        for name, least in further.items():
            if least is not None and not 0 <= least < INFINITY:
                raise MetricError(f"{name} is {least!r}; it must be finite and at least 0")
        if self.misses is not None and not 0 <= self.misses <= 1:
            raise MetricError(f"misses is {self.misses!r}; it must lie in [0, 1]")
        if type(self.utilisation) is not FrozenDict:
            object.__setattr__(self, "utilisation", FrozenDict(self.utilisation))

    @property
    def age(self) -> tuple[float, float] | None:
        """The mean age and its standard error, milliseconds, if known."""
        return None if self.age_ms is None else (self.age_ms, self.age_error_ms)

    @property
    def uncut_l95_ms(self) -> float:
        """L95 for comparison with caps, milliseconds; infinite for a lost cycle."""
        return self.l95_ms if self.cut_from_ms is None else self.cut_from_ms


(
    _set_l95_ms,
    _set_violation_rate,
    _set_utilisation,
    _set_cut_from_ms,
    _set_error,
    _set_age_ms,
    _set_age_error_ms,
    _set_misses,
    _set_paired,
    _set_price_per_hour,
) = (getattr(QoS, name).__set__ for name in QoS.__match_args__)


def unchecked_qos(
    l95_ms: float,
    violation_rate: float,
    utilisation: Mapping[str, float],
    cut_from_ms: float | None,
    error: tuple[float, float] | None = None,
    age: tuple[float, float] | None = None,
    misses: float | None = None,
    paired: tuple[float, float] | None = None,
    price_per_hour: float | None = None,
) -> QoS:
    """Make a QoS without checks, in a third of the time.

    The caller guarantees valid metrics and an immutable `utilisation`; `cut_from_ms` must be None
    if it equals `l95_ms`. `age` is `age_ms` and `age_error_ms`.
    """
    qos: QoS = object.__new__(QoS)
    _set_l95_ms(qos, l95_ms)
    _set_violation_rate(qos, violation_rate)
    _set_utilisation(qos, utilisation)
    _set_cut_from_ms(qos, cut_from_ms)
    _set_error(qos, error)
    age_ms, age_error_ms = age or NO_AGE
    _set_age_ms(qos, age_ms)
    _set_age_error_ms(qos, age_error_ms)
    _set_misses(qos, misses)
    _set_paired(qos, paired)
    _set_price_per_hour(qos, price_per_hour)
    return qos


@dataclass(frozen=True, slots=True)
class Decision:
    """The placement for the next window, and the reason.

    Parameters
    ----------
    placement : Placement
        For the cycles of the next window.
    name : str
        Its candidate name.
    migrated : bool
        Whether it differs from the incumbent.
    reason : {"dwell", "hold", "migrate", "capped", "infeasible", "guard"}
        The rule that determined it.
    costs : mapping of str to float
        Estimated J of every candidate against the incumbent; empty if the policy computes none.
    dwell : int
        Windows since the last migration, after this decision (n_d).
    delta_j : float
        J of the incumbent, with the switching term of its own last decision, minus J of the best
        candidate; NaN if not computed.
    """

    placement: Placement
    name: str
    migrated: bool
    reason: Reason
    costs: Mapping[str, float] = field(default_factory=FrozenDict)
    dwell: int = 0
    delta_j: float = math.nan
