"""The cost J of a placement and the caps it must respect (paper, eq. 5 to 8).

J weighs the four metrics of a window, each relative to its design target, and the share of tasks
that moved::

    J = a_L * L95 / L_target + a_V * V_D + a_r * U_r / U_r_target + a_e * U_e / U_e_target
        [+ a_c * U_c / U_c_target] [+ a_a * age / age_target] [+ a_p * price / price_target]
        + a_S * S

U_r and U_e are maxima over the tier's nodes, because a mean hides a single saturated robot. They
include accelerators if the objective counts them. The bracketed terms exist only if the objective
weighs cloud nodes separately (otherwise cloud nodes count as edge nodes), the mean age of the
newest command, or the price of transmitted bytes. L95 is of the data age of a chain if the
objective names one.

All arithmetic is in `price`, which takes floats and arrays: one window and an array of thousands
give the same bits.

Estimates have standard errors (`QoS.error`). A difference of two estimates is significant if it
exceeds their `margin`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from dwell.errors import MetricError, PlacementError
from dwell.model.objective import MISSES_SHARE, Objective
from dwell.model.placement import Placement
from dwell.model.qos import NO_ERROR, QoS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["cost", "hamming"]

Metric = TypeVar("Metric", float, "NDArray[np.float64]")

#: Utilisation from which a resource counts as full: further load no longer raises it.
SATURATED = 0.995
#: Number of standard errors in the `margin` of two estimates.
ERRORS = 1.0
#: Number of standard errors of a difference by which the best of K estimates with `QoS.paired` must
#: be better, by K from 1: sqrt(2 ln K), the largest error to expect of K.
SELECTED = (
    0.0,
    1.1774100225154747,
    1.4823038073675112,
    1.6651092223153954,
    1.7941225779941015,
    1.8930184728248454,
    1.9727697022487511,
    2.039333980337618,
)
#: A gain must exceed a threshold by more than this, or rounding could cause a move.
GAIN_TOLERANCE = 1e-9


class TierNodes(NamedTuple):
    """Nodes and accelerators of U_r, U_e and U_c; an empty tier has utilisation 0."""

    robot: tuple[str, ...]
    edge: tuple[str, ...]
    cloud: tuple[str, ...]


class TierUtilisation(NamedTuple):
    """U_r, U_e and U_c; U_c is 0 where cloud nodes count as edge nodes."""

    robot: float
    edge: float
    cloud: float


def hamming(current: Placement, previous: Placement) -> float:
    """Share of tasks whose set of nodes changes between two placements (paper, eq. 6).

    Parameters
    ----------
    current, previous : Placement
        Over the same tasks.

    Returns
    -------
    float
        In [0, 1]; one task of four moved is 0.25.

    Raises
    ------
    PlacementError
        If the two cover different tasks.
    """
    if current.keys() != previous.keys():
        here, there = (", ".join(sorted(tasks)) for tasks in (current, previous))
        raise PlacementError(
            f"cannot compare placements of different tasks: {here} against {there}; "
            "place every task of the pipeline in both"
        )
    return len(current.moved(previous)) / len(current)


def tier_nodes(objective: Objective) -> TierNodes:
    """Return nodes, then accelerators, of each utilisation term of J, in the objective's order.

    Cloud nodes are in `edge` unless ``weights.cloud`` is given.
    """
    apart = objective.weights.cloud is not None
    counted = {"robot": "robot", "edge": "edge", "cloud": "cloud" if apart else "edge"}
    tiers: dict[str, list[str]] = {"robot": [], "edge": [], "cloud": []}
    for name, tier in (*objective.tiers.items(), *objective.accelerators.items()):
        tiers[counted[tier]].append(name)
    return TierNodes(tuple(tiers["robot"]), tuple(tiers["edge"]), tuple(tiers["cloud"]))


def tier_utilisation(utilisation: Mapping[str, float], objective: Objective) -> TierUtilisation:
    """Return U_r, U_e and U_c of a window: maxima over each tier's nodes and accelerators.

    Parameters
    ----------
    utilisation : mapping of str to float
        Busy share by resource, for every node of ``objective.tiers``. Accelerators of
        ``objective.accelerators`` may be missing; other resources are ignored.

    Raises
    ------
    MetricError
        If a node of ``objective.tiers`` is missing.
    """
    for node in objective.tiers:
        if node not in utilisation:
            known = ", ".join(utilisation) or "none"
            raise MetricError(
                f"utilisation of {node} is missing (nodes given: {known}); "
                "J needs it for every node of objective.tiers"
            )
    robot, edge, cloud = (
        max((utilisation[name] for name in names if name in utilisation), default=0.0)
        for names in tier_nodes(objective)
    )
    return TierUtilisation(robot, edge, cloud)


def price(
    l95_ms: Metric,
    violation_rate: Metric,
    robot: Metric,
    edge: Metric,
    cloud: Metric | float,
    switching: Metric | float,
    objective: Objective,
    age_ms: Metric | float = 0.0,
    price_per_hour: Metric | float = 0.0,
) -> Metric:
    """Return J of metrics given as floats or arrays, elementwise (paper, eq. 5 and 7).

    Floats and arrays use the same operations in the same order, so the bits are equal.

    Parameters
    ----------
    l95_ms : float, or array of shape (windows,)
        Milliseconds.
    violation_rate : float or array
        V_D, in [0, 1].
    robot, edge, cloud : float or array
        U_r, U_e, U_c; `cloud` is ignored unless ``objective.weights.cloud`` is given.
    switching : float or array
        S, the share of tasks moved.
    age_ms : float or array
        Mean age, milliseconds; ignored unless ``objective.weights.age`` is above 0.
    price_per_hour : float or array
        Price of transmitted bytes; ignored unless ``objective.weights.price`` is above 0.

    Returns
    -------
    float or array
        J, without unit.
    """
    weights, targets = objective.weights, objective.targets
    J = (
        weights.latency * (l95_ms / targets.latency_ms)
        + weights.violations * violation_rate
        + weights.robot * (robot / targets.robot)
        + weights.edge * (edge / targets.edge)
    )
    if weights.cloud is not None and targets.cloud is not None:
        J = J + weights.cloud * (cloud / targets.cloud)
    if weights.age and targets.age_ms is not None:
        J = J + weights.age * (age_ms / targets.age_ms)
    if weights.price and targets.price_per_hour is not None:
        J = J + weights.price * (price_per_hour / targets.price_per_hour)
    return J + weights.switching * switching


def cost(qos: QoS, current: Placement, previous: Placement, objective: Objective) -> float:
    """Return J of a window under `current`, after the placement `previous` (paper, eq. 7).

    Parameters
    ----------
    qos : QoS
        Observed or estimated metrics of the window.
    current, previous : Placement
        Over the same tasks; equal if no task moved.

    Returns
    -------
    float
        J, finite and at least 0, without unit.

    Raises
    ------
    MetricError
        If the utilisation of a node of ``objective.tiers``, or a weighed age or price, is missing,
        or J is not finite.
    PlacementError
        If the placements cover different tasks.
    """
    robot, edge, cloud = tier_utilisation(qos.utilisation, objective)
    switching = hamming(current, previous)
    metrics = (qos.l95_ms, qos.violation_rate, robot, edge, cloud, switching)
    J = float(price(*metrics, objective, *weighed(qos, objective)))
    if not math.isfinite(J):
        raise MetricError(f"J is {J!r} for {qos}; a metric is too large for its weight and target")
    return J


def weighed(qos: QoS, objective: Objective) -> tuple[float, float]:
    """Return the mean age (ms) and the price per hour of a QoS as J needs them.

    A metric is 0 if J has no term of it. Raises MetricError if J has, and the metric is missing.
    """
    age_ms = qos.age_ms if objective.weighs_age else 0.0
    per_hour = qos.price_per_hour if objective.weighs_price else 0.0
    if age_ms is None:
        raise MetricError("age_ms is missing; J needs it where weights.age is above 0")
    if per_hour is None:
        raise MetricError("price_per_hour is missing; J needs it where weights.price is above 0")
    return age_ms, per_hour


def cost_error(
    error: tuple[float, float] | None, objective: Objective, age_error_ms: float = 0.0
) -> float:
    """Return the standard error of an estimate's J from the errors of its metrics (see `QoS`).

    The terms are added, not combined in quadrature: L95, V_D and the age come from the same cycles
    and err in the same direction. The sum is the largest error that any correlation gives. The
    price of bytes counts as exact: messages are sent at a fixed rate.
    """
    if error is None:
        return 0.0
    l95_ms, violation_rate = error
    weights, targets = objective.weights, objective.targets
    known = weights.latency * (l95_ms / targets.latency_ms) + weights.violations * violation_rate
    if weights.age and targets.age_ms is not None:
        known += weights.age * (age_error_ms / targets.age_ms)
    return known


def margin_errors(qos: QoS, candidates: int) -> tuple[float, float, float]:
    """Return the errors of L95 (ms), V_D and age (ms) of an estimate for `margin`.

    Estimates with paired errors have these, `SELECTED` times; the incumbent's are 0. Ages have no
    paired errors.
    """
    if qos.paired is None:
        return *(qos.error or NO_ERROR), qos.age_error_ms
    l95_ms, violation_rate = qos.paired
    errors = SELECTED[min(candidates, len(SELECTED)) - 1]
    return errors * l95_ms, errors * violation_rate, errors * qos.age_error_ms


def margin(one: float, other: float) -> float:
    """Return the least difference of two estimates that exceeds their error.

    The margin is `ERRORS` standard errors of the difference of two independent estimates. It is
    larger than necessary for estimates from the same samples.

    Parameters
    ----------
    one, other : float
        Standard error of each.
    """
    return ERRORS * math.sqrt(one * one + other * other)


def exceeds(gain: float, threshold: float) -> bool:
    """Return whether a gain exceeds a threshold by more than `GAIN_TOLERANCE`."""
    return gain > threshold + GAIN_TOLERANCE


def busiest(qos: QoS) -> float:
    """Return the utilisation of the busiest resource for comparison with caps; 0 without resources.

    A saturated resource counts as full: an observed 0.997 equals an estimated 1.
    """
    used = qos.utilisation
    largest = max(used.values()) if used else 0.0
    return largest if largest < SATURATED else max(largest, 1.0)


def excess(qos: QoS, objective: Objective) -> float:
    """Return the largest relative excess over the caps (constraints of eq. 8).

    Returns
    -------
    float
        Maximum of ``value / cap - 1`` over the uncut L95 (a lost cycle exceeds every cap), the
        utilisation of every resource in `qos` (see `busiest`), and its share of stretches with too
        many misses, if known and capped. Above 0 if and only if a cap is
        exceeded.
    """
    caps = objective.caps
    # Without a cap, even an infinite latency does not exceed it.
    latency = qos.uncut_l95_ms / caps.latency_ms if caps.latency_ms < math.inf else 0.0
    # Faster than max(); this runs for every candidate in every window.
    load = busiest(qos) / caps.utilisation
    if caps.misses is not None and qos.misses is not None:
        load = max(load, qos.misses / MISSES_SHARE)
    return (load if load > latency else latency) - 1.0
