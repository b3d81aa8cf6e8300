from __future__ import annotations

import math

import pytest

from dwell.errors import MetricError
from dwell.model import FrozenDict, QoS
from dwell.model.qos import unchecked_qos


@pytest.mark.parametrize("l95_ms", [math.nan, math.inf, -0.1])
def test_l95_is_finite_and_not_negative(l95_ms: float) -> None:
    with pytest.raises(MetricError, match="l95_ms is"):
        QoS(l95_ms, 0.0, {})


@pytest.mark.parametrize("rate", [math.nan, -0.01, 1.01])
def test_a_violation_rate_is_a_share(rate: float) -> None:
    with pytest.raises(MetricError, match=r"violation_rate is .* \[0, 1\]"):
        QoS(1.0, rate, {})


@pytest.mark.parametrize("used", [math.nan, math.inf, -1.0])
def test_a_utilisation_names_its_node(used: float) -> None:
    with pytest.raises(MetricError, match="utilisation of E is"):
        QoS(1.0, 0.0, {"R1": 0.5, "E": used})


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.1])
def test_an_error_names_its_metric(value: float) -> None:
    for metric, error in {"l95_ms": (value, 0.0), "violation_rate": (0.0, value)}.items():
        with pytest.raises(MetricError, match=f"error of {metric} is .*; it must be finite"):
            QoS(1.0, 0.5, {}, error=error)


def test_it_may_be_over_1_and_cannot_be_changed() -> None:
    seen = QoS(1.0, 1.0, {"E": 1.2})
    with pytest.raises(TypeError):
        seen.utilisation["E"] = 0.0  # type: ignore[index]
    assert hash(seen) == hash(QoS(1.0, 1.0, {"E": 1.2}))


@pytest.mark.parametrize("cut_from_ms", [None, 7.0])
@pytest.mark.parametrize("error", [None, (1.0, 0.02)])
def test_one_that_is_not_checked_is_the_same(
    cut_from_ms: float | None, error: tuple[float, float] | None
) -> None:
    used = FrozenDict({"E": 0.5})
    same = QoS(5.0, 0.1, used, cut_from_ms, error)
    assert unchecked_qos(5.0, 0.1, used, cut_from_ms, error) == same
    assert unchecked_qos(5.0, 0.1, used, cut_from_ms).error is None
