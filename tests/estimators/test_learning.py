"""What the estimators that send shadow jobs hold of every part, and for how long."""

from __future__ import annotations

import math
from typing import TypeAlias

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.estimators import Corrected, Evidence, Shadow
from dwell.estimators.learning import WIDENING
from dwell.estimators.pool import LARGEST
from dwell.model import QoS
from tests.cells.deterministic import MOVES, cell
from tests.estimators.windows import GONE, Row, local_row, off_row, seen_window, window

SEEN = QoS(1.0, 0.0, {"R": 0.0, "E": 0.0})
NO_WORK = {"R": 0.0, "E": 0.0}
#: OFF as declared, milliseconds.
QUIET_MS = 14.0

Kind: TypeAlias = type[Shadow] | type[Corrected]

both = pytest.mark.parametrize("kind", [Shadow, Corrected])


def estimate(estimator: Shadow | Corrected) -> dict[str, QoS]:
    return estimator.estimate(observed=SEEN, incumbent="LOC", own=NO_WORK)


def see(estimator: Shadow | Corrected, evidence: Evidence) -> dict[str, QoS]:
    """Close a window."""
    estimator.learn(evidence)
    return estimate(estimator)


# ------------------------------------------------------------------------------------- support


@both
def test_the_support_is_that_of_the_weakest_part(kind: Kind) -> None:
    estimator = kind(cell())
    assert estimator.support() == dict.fromkeys(MOVES, (0, 0))
    see(estimator, seen_window(extra_ms=7.0, lost=4))
    # Of `plan` and `control` on E nothing has been seen; of OFF six shadows arrived.
    assert estimator.support() == {
        "LOC": (10, 0),
        "OFF": (6, 0),
        "FAR": (0, 1),
        "SINK": (0, 1),
        "TWIN": (10, 0),
    }
    see(estimator, seen_window())
    assert estimator.support()["LOC"] == (20, 0)
    assert estimator.support()["OFF"].age_windows == 1
    assert estimator.support()["FAR"] == (0, 2)


@both
def test_the_samples_of_a_run_are_in_its_decisions(kind: Kind) -> None:
    problem = cell(scenario=())
    decisions = dwell.simulate(
        problem, policy="LOC", estimator=kind(problem), seed=1, windows=4
    ).decisions
    # Of 50 cycles of a window all go through LOC, and about every tenth through OFF.
    assert decisions["est_samples_LOC"].to_list()[:2] == [50, 100]
    assert decisions["est_samples_OFF"].to_list() == sorted(decisions["est_samples_OFF"])
    assert set(decisions["est_age_windows_LOC"]) == {0}
    assert decisions["est_samples_SINK"].to_list() == [0] * 4
    assert decisions["est_age_windows_SINK"].to_list() == [1, 2, 3, 4]


@both
def test_a_window_of_two_placements_counts_for_both(kind: Kind) -> None:
    starts = [40.0 * i for i in range(20)]
    estimator = kind(cell())
    see(
        estimator,
        window(
            [local_row(at) for at in starts],
            close_ms=800.0,
            release_ms=starts,
            placement=[0] * 8 + [2] * 12,
        ),
    )
    assert estimator.support()["LOC"].samples == 8
    assert estimator.support()["FAR"].samples == 12


@both
def test_twins_share_what_is_seen_of_either(kind: Kind) -> None:
    estimator = kind(cell())
    see(estimator, seen_window())
    assert estimator.support()["TWIN"] == estimator.support()["LOC"] == (10, 0)
    # A shadow through a twin runs nothing, and counts nothing twice.
    estimator.start(cell())
    starts = [40.0 * i for i in range(20)]
    see(
        estimator,
        window(
            [local_row(at) for at in starts],
            close_ms=800.0,
            release_ms=starts,
            shadows=[GONE] * 20,
            through=[4] * 20,
        ),
    )
    assert estimator.support()["TWIN"] == (20, 0)
    assert estimate(estimator)["TWIN"] == estimate(estimator)["LOC"]


# -------------------------------------------------------------------------------------- memory


@both
def test_a_value_is_held_for_the_memory(kind: Kind) -> None:
    estimator = kind(cell(), half_life_windows=2.0)
    held = []
    for _ in range(20):
        see(estimator, seen_window(extra_ms=7.0))
        held.append(estimator.support()["OFF"].samples)
    most = int(kind.MEMORY * 2.0)
    assert held == [10 * min(k, most) for k in range(1, 21)]


@both
def test_no_more_than_so_many_values_are_held(kind: Kind) -> None:
    estimator = kind(cell(), half_life_windows=1e6)
    for _ in range(LARGEST // 10 + 5):
        see(estimator, seen_window(extra_ms=7.0))
    assert estimator.support()["OFF"].samples == LARGEST


@both
def test_a_tiny_half_life_knows_the_last_windows_only(kind: Kind) -> None:
    estimator = kind(cell(), half_life_windows=1e-9)
    for extra_ms in (16.0, 6.0, 9.0):
        assert see(estimator, seen_window(extra_ms=extra_ms))["OFF"].l95_ms == pytest.approx(
            QUIET_MS + extra_ms
        )


@both
def test_another_regime_does_away_with_the_one_before(kind: Kind) -> None:
    estimator = kind(cell(), half_life_windows=50.0)
    # Of the window that shows it to be as declared again nothing is held.
    for number, (extra_ms, windows) in enumerate([(16.0, 3), (6.0, 3), (0.0, 2)]):
        for _ in range(3):
            assert see(estimator, seen_window(extra_ms=extra_ms))["OFF"].l95_ms == pytest.approx(
                QUIET_MS + extra_ms
            )
        assert estimator.regimes == number + 1
        assert estimator.support()["OFF"].samples == 10 * windows
    assert estimate(estimator)["OFF"].error == (0.0, 0.0)


@both
def test_what_is_not_measured_is_known_less_and_less_and_forgotten_in_the_end(kind: Kind) -> None:
    estimator = kind(cell(), half_life_windows=0.2)
    see(estimator, seen_window(extra_ms=7.0))
    last = round(kind.UNSEEN * 0.2)
    errors = [estimate(estimator)["OFF"].error]
    for age in range(1, last):
        shown = see(estimator, seen_window())
        assert estimator.support()["OFF"].age_windows == age
        assert shown["OFF"].l95_ms == pytest.approx(QUIET_MS + 7.0)
        assert shown["LOC"].error == (0.0, 0.0)
        errors.append(shown["OFF"].error)
    known = [error[0] for error in errors if error is not None]
    assert len(known) == last
    assert known[1:] == pytest.approx(
        [(QUIET_MS + 7.0) * WIDENING * math.sqrt(age) for age in range(1, last)]
    )
    # Then it is as declared.
    for _ in range(3):
        shown = see(estimator, seen_window())
        assert shown["OFF"].l95_ms == QUIET_MS
        assert shown["OFF"].error == (0.0, 0.0)


# -------------------------------------------------------------------------------------- losses


@both
def test_messages_that_are_lost_are_a_share(kind: Kind) -> None:
    problem = cell()
    estimator = kind(problem)
    for _ in range(3):
        see(estimator, seen_window(extra_ms=0.0, lost=4))
    shown = estimate(estimator)["OFF"]
    assert shown.violation_rate == pytest.approx(0.4, abs=0.05)
    assert (shown.l95_ms, shown.uncut_l95_ms) == (problem.censor_ms, math.inf)
    assert shown.error is not None


@both
def test_what_is_under_way_says_nothing_yet(kind: Kind) -> None:
    """The last two shadows of a window have not arrived when it closes, as they may."""
    estimator = kind(cell())
    starts = [40.0 * i for i in range(10)]
    sent: list[Row] = [off_row(at) for at in starts]
    sent[-1] = sent[-2] = GONE
    see(
        estimator,
        window([local_row(at) for at in starts], close_ms=380.0, release_ms=starts, shadows=sent),
    )
    assert estimate(estimator)["OFF"].error == (0.0, 0.0)
    assert estimator.support()["OFF"].samples == 8


# -------------------------------------------------------------------------------- how it is made


@both
@pytest.mark.parametrize("half_life", [0.0, -1.0, math.nan, math.inf, True])
def test_a_half_life_is_a_number_above_0(half_life: float, kind: Kind) -> None:
    with pytest.raises(ProblemError, match=r"half_life_windows: .* is not allowed; it must be"):
        kind(cell(), half_life_windows=half_life)


@both
def test_what_it_is_made_with_goes_before_the_cell_file(kind: Kind) -> None:
    problem = cell(shadow_fraction=0.1, half_life_windows=2.0)
    assert kind(problem).shadow_fraction == 0.1
    assert kind(problem, 0.3).shadow_fraction == 0.3
    assert kind(problem).memory == 2.0 * kind.MEMORY
    assert kind(problem, half_life_windows=5.0).unseen == 5.0 * kind.UNSEEN
    assert repr(kind(problem, 0.3)) == f"{kind.__name__}(shadow_fraction=0.3, regimes=0)"
