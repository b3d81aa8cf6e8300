"""The clairvoyant's sequence against every sequence there is, and against Algorithm 1's."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.errors import MetricError, PolicyError
from dwell.model import Caps, Objective, Placement, QoS, Targets, Weights
from dwell.policies import DTP
from dwell.study.clairvoyant import clairvoyant, priced

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def allowed(choice: Sequence[int], decides: Sequence[bool], initial: int, min_dwell: int) -> bool:
    """Whether a sequence keeps the dwell: enough decisions were blocked before each migration."""
    if choice[0] != initial:
        return False
    entered = 0
    for k in range(1, len(choice)):
        if choice[k] == choice[k - 1]:
            continue
        if not decides[k - 1] or sum(decides[entered : k - 1]) < min_dwell:
            return False
        entered = k
    return True


@cache
def all_sequences(candidates: int, decides: tuple[bool, ...], initial: int, min_dwell: int) -> Ints:
    windows = len(decides)
    every = itertools.product(range(candidates), repeat=windows)
    return np.array([s for s in every if allowed(s, decides, initial, min_dwell)])


def totals(sequences: Ints, costs: Floats, switching: Floats, counts: Floats) -> Floats:
    """Total of every sequence, added up as slowly as it reads."""
    result = np.zeros(len(sequences))
    for k in range(costs.shape[0]):
        result += counts[k] * costs[k, sequences[:, k]]
        if k:
            result += counts[k] * switching[sequences[:, k - 1], sequences[:, k]]
    return result


def changes(choice: Ints) -> list[int]:
    """Windows in which a migration takes effect."""
    return [int(k) for k in np.flatnonzero(np.diff(choice)) + 1]


# Few values, so that there are ties; and any values.
J = st.one_of(
    st.integers(0, 3).map(float),
    st.floats(0, 100, allow_subnormal=False),
)


@st.composite
def cases(
    draw: st.DrawFn,
) -> tuple[Floats, Floats, int, int, Floats, tuple[bool, ...]]:
    windows, candidates = draw(st.integers(1, 8)), draw(st.integers(1, 3))
    min_dwell = draw(st.integers(0, 3))
    row = st.lists(J, min_size=candidates, max_size=candidates)
    costs = np.array(draw(st.lists(row, min_size=windows, max_size=windows)))
    switching = np.array(draw(st.lists(row, min_size=candidates, max_size=candidates)))
    np.fill_diagonal(switching, 0.0)
    # Masks are rare, as in use; where they shrink to nothing, what is left is the plain case.
    counts = np.ones(windows)
    decides = (True,) * windows
    if draw(st.booleans()):
        some = st.lists(st.sampled_from([1.0, 0.0, 0.5]), min_size=windows, max_size=windows)
        counts = np.array(draw(some))
        decides = tuple(draw(st.lists(st.booleans(), min_size=windows, max_size=windows)))
    return costs, switching, draw(st.integers(0, candidates - 1)), min_dwell, counts, decides


@given(cases())
def test_no_sequence_of_all_is_cheaper(
    case: tuple[Floats, Floats, int, int, Floats, tuple[bool, ...]],
) -> None:
    costs, switching, initial, min_dwell, counts, decides = case
    found = clairvoyant(
        costs, switching, initial=initial, min_dwell=min_dwell, counts=counts, decides=decides
    )
    every = totals(
        all_sequences(costs.shape[1], decides, initial, min_dwell), costs, switching, counts
    )
    own = totals(found.choice[None], costs, switching, counts)[0]
    assert allowed(found.choice.tolist(), decides, initial, min_dwell)
    assert found.total == pytest.approx(own, rel=1e-12, abs=1e-12)
    assert found.total == pytest.approx(every.min(), rel=1e-9, abs=1e-9)


OBJECTIVE = Objective(
    weights=Weights(latency=1, violations=0, robot=0, edge=0, switching=0.5),
    targets=Targets(latency_ms=1.0),
    caps=Caps(latency_ms=1e6, utilisation=1.0),
    tiers={},
)
CANDIDATES = {
    "both-on-A": Placement({"one": "A", "two": "A"}),
    "apart": Placement({"one": "B", "two": "A"}),
    "both-on-B": Placement({"one": "B", "two": "B"}),
}
NAMES = tuple(CANDIDATES)
SWITCHING = np.array([[0, 0.25, 0.5], [0.25, 0, 0.25], [0.5, 0.25, 0]])


def sequence_of_dtp(
    shown: Sequence[Sequence[float]],
    decides: Sequence[bool],
    *,
    observed: Sequence[Sequence[float]] | None = None,
    min_dwell: int,
) -> list[int]:
    """Placements of Algorithm 1 in one window more than it is shown.

    L95 of a candidate, in milliseconds, is its J; `shown` holds estimates by window and candidate,
    `observed` what the incumbent is really like.
    """
    policy = DTP(
        candidates=CANDIDATES, objective=OBJECTIVE, min_dwell=min_dwell, min_improvement=0.0
    )
    choice = [0]
    for k, estimated in enumerate(shown):
        now = choice[-1]
        if decides[k]:
            real = estimated if observed is None else observed[k]
            seen = QoS(real[now], 0.0, {})
            estimates = {name: QoS(estimated[i], 0.0, {}) for i, name in enumerate(NAMES)}
            decision = policy.decide(observed=seen, estimates=estimates | {NAMES[now]: seen})
            choice.append(NAMES.index(decision.name))
        else:
            choice.append(now)
    return choice


@pytest.mark.parametrize("min_dwell", range(4))
@pytest.mark.parametrize("decides", [(True,) * 6, (True, False, True, True, True, True)])
def test_the_sequences_are_those_algorithm_1_can_produce(
    min_dwell: int, decides: tuple[bool, ...]
) -> None:
    # Whatever it shall choose after each window is shown to be far better than all else.
    wishes = itertools.product(range(3), repeat=5)
    produced = {
        tuple(
            sequence_of_dtp(
                [[0.0 if i == wanted else 9.0 for i in range(3)] for wanted in wish],
                decides,
                min_dwell=min_dwell,
            )
        )
        for wish in wishes
    }
    assert produced == set(map(tuple, all_sequences(3, decides, 0, min_dwell).tolist()))
    assert max(len(changes(np.array(s))) for s in produced) <= 6 // (min_dwell + 1)


@st.composite
def shown(draw: st.DrawFn) -> tuple[list[list[float]], list[list[float]]]:
    """Return what windows are really like, and what is estimated of them."""
    windows = draw(st.integers(1, 30))
    row = st.lists(st.integers(0, 20).map(lambda tenths: tenths / 10), min_size=3, max_size=3)
    rows = st.lists(row, min_size=windows, max_size=windows)
    return draw(rows), draw(rows)


@given(shown(), st.integers(0, 4))
def test_algorithm_1_is_never_cheaper_whatever_it_is_shown(
    windows: tuple[list[list[float]], list[list[float]]], min_dwell: int
) -> None:
    real, estimated = windows
    costs = np.array(real)
    decides = (True,) * len(real)
    own = sequence_of_dtp(estimated[:-1], decides, observed=real, min_dwell=min_dwell)
    found = clairvoyant(costs, SWITCHING, initial=0, min_dwell=min_dwell)
    ours = priced(np.array(own), costs, SWITCHING).sum()
    assert found.total <= ours * (1 + 1e-9)
    assert found.total <= costs[:, 0].sum() * (1 + 1e-9)


HUNDREDTHS = st.integers(0, 10_000).map(lambda units: units / 100)


@given(
    st.lists(HUNDREDTHS, min_size=1, max_size=4),
    HUNDREDTHS,
    st.integers(0, 5),
    st.integers(1, 60),
)
def test_constant_costs_take_one_migration_at_most(
    levels: list[float], price: float, min_dwell: int, windows: int
) -> None:
    candidates = len(levels)
    costs = np.tile(levels, (windows, 1))
    switching = price * (1 - np.eye(candidates))
    found = clairvoyant(costs, switching, initial=0, min_dwell=min_dwell)
    # As soon as the dwell is over, or never.
    assert changes(found.choice) in ([], [min_dwell + 1])
    gain = (levels[0] - min(levels)) * (windows - min_dwell - 1) - price
    if gain > 1e-6:
        assert levels[found.choice[-1]] == min(levels)
    if gain < -1e-6:
        assert changes(found.choice) == []


def alternating(windows: int, block: int) -> Floats:
    """Costs of two candidates that take turns: 0 for a block, 1 for a block."""
    turn = np.arange(windows) // block % 2
    return np.stack([turn, 1 - turn], axis=1).astype(float)


@pytest.mark.parametrize(
    ("block", "price", "min_dwell", "total"),
    [
        # There and back costs less than a block of the wrong one: follow every turn.
        (1, 0.25, 0, 19 * 0.25),
        (4, 1.5, 0, 4 * 1.5),
        (4, 1.5, 3, 4 * 1.5),
        # It costs more: stay, and move at the end alone, if that pays.
        (1, 0.75, 0, 9 + 0.75),
        (1, 1.0, 0, 10.0),
        (4, 2.5, 0, 8.0),
        # Blocks of 2, but every stay lasts for 3: for three blocks then, one of them the wrong one.
        (2, 0.0, 2, 6.0),
        # The dwell is longer than the run.
        (1, 0.0, 20, 10.0),
        (1, 0.0, 10**6, 10.0),
    ],
)
def test_costs_that_alternate(block: int, price: float, min_dwell: int, total: float) -> None:
    switching = np.array([[0.0, price], [price, 0.0]])
    found = clairvoyant(alternating(20, block), switching, initial=0, min_dwell=min_dwell)
    assert found.total == total


def test_a_tie_stays_and_then_goes_to_the_first() -> None:
    # Equals: nothing is gained by a move that costs nothing.
    same = clairvoyant(np.ones((9, 3)), np.zeros((3, 3)), initial=1)
    assert same.choice.tolist() == [1] * 9
    # 0.1 + 0.2 is not 0.3 in floating point, and still no reason to move, either way.
    costs = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [0.0, 0.3]])
    for initial in (0, 1):
        once = clairvoyant(costs, np.zeros((2, 2)), initial=initial, decides=[1, 0, 0, 0])
        assert once.choice.tolist() == [initial] * 4
    # Two that are equally good to go to.
    costs = np.array([[1.0, 5.0, 5.0], [5.0, 1.0, 1.0], [5.0, 1.0, 1.0]])
    assert clairvoyant(costs, SWITCHING * 0, initial=0).choice.tolist() == [0, 1, 1]


def test_one_candidate_and_one_window() -> None:
    alone = clairvoyant([[2.0], [3.0]], [[0.0]], initial=0, min_dwell=1)
    assert (alone.choice.tolist(), alone.total) == ([0, 0], 5.0)
    once = clairvoyant([[2.0, 1.0]], [[0, 1], [1, 0]], initial=0)
    assert (once.choice.tolist(), once.total) == ([0], 2.0)
    assert once.choice.dtype == np.int64


def test_windows_that_do_not_count_cost_nothing() -> None:
    costs = alternating(6, 3)
    counts = [0, 0, 0, 1, 1, 1]
    found = clairvoyant(costs, [[0, 9.0], [9.0, 0]], initial=0, counts=counts)
    # The move is free while nothing counts, and dear afterwards.
    assert found.total == 0.0
    assert changes(found.choice) == [2]


def test_long_runs_lose_no_digits() -> None:
    rng = np.random.default_rng(5)
    costs = 1e6 + rng.random((20_000, 2)) * 1e-3
    found = clairvoyant(costs, np.zeros((2, 2)), initial=int(costs[0].argmin()))
    assert found.choice.tolist() == costs.argmin(axis=1).tolist()


@pytest.mark.parametrize(
    ("costs", "switching", "more", "message"),
    [
        ([1.0, 2.0], [[0.0]], {}, r"costs has the shape \(2,\)"),
        (np.empty((0, 2)), np.zeros((2, 2)), {}, r"costs has the shape \(0, 2\)"),
        ([[1.0, np.nan]], np.zeros((2, 2)), {}, r"costs\[0, 1\] is nan; it must be finite"),
        ([[1.0, 2.0]], [[0.0]], {}, r"switching has the shape \(1, 1\); it must be \(2, 2\)"),
        ([[1.0, 2.0]], [[0, -1.0], [1, 0]], {}, r"switching\[0, 1\] is -1.0"),
        ([[1.0, 2.0]], [[0, np.inf], [1, 0]], {}, r"switching\[0, 1\] is inf"),
        ([[1.0, 2.0]], [[0, 1], [1, 2.0]], {}, r"switching\[1, 1\] is 2.0; it must be 0"),
        ([[1.0]], [[0.0]], {"counts": [1.0, 1.0]}, r"counts has the shape \(2,\)"),
        ([[1.0]], [[0.0]], {"counts": [-1.0]}, "counts must be finite and at least 0"),
        ([[1.0]], [[0.0]], {"decides": [True, True]}, r"decides has the shape \(2,\)"),
    ],
)
def test_what_cannot_be_priced_is_refused(
    costs: Floats, switching: Floats, more: dict[str, list[float]], message: str
) -> None:
    with pytest.raises(MetricError, match=message):
        clairvoyant(costs, switching, initial=0, **more)  # type: ignore[arg-type]


def test_parameters_out_of_range_are_refused() -> None:
    with pytest.raises(PolicyError, match="initial is 2; it must be from 0 to 1"):
        clairvoyant([[1.0, 2.0]], np.zeros((2, 2)), initial=2)
    with pytest.raises(PolicyError, match="min_dwell is -1; it must be"):
        clairvoyant([[1.0]], [[0.0]], initial=0, min_dwell=-1)
