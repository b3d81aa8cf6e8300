"""Samples of QoS: what of a run counts, and figures by how often each unit does."""

from __future__ import annotations

import numpy as np
import pytest

from dwell import simulate
from dwell.errors import SimulationError
from dwell.study.summary import summarise
from dwell_lab.validation.qos_sample import QosSample, piece_of
from tests.cells.small import make_problem
from tests.report.live_runs import live_run

PROBLEM = make_problem()


def sample(policy: str, scenario: str, *, by_window: bool) -> QosSample:
    runs = [
        simulate(PROBLEM, scenario=scenario, policy=policy, seed=seed, windows=30)
        for seed in (1, 2, 3)
    ]
    return QosSample.of([piece_of(run, PROBLEM) for run in runs], PROBLEM, by_window=by_window)


def test_of_a_live_run_cycles_in_no_window_belong_to_the_one_before() -> None:
    piece = piece_of(live_run(), PROBLEM)
    assert piece.cycles["place"].value_counts(sort=True).rows()[0] == (1, 12)
    # The guard's move is not the policy's.
    assert (piece.cycles.height, piece.migrations) == (52, 1)


def test_excluded_windows_leave_with_their_cycles() -> None:
    run = simulate(PROBLEM, policy="LOC", seed=1, windows=8)
    piece = piece_of(run, PROBLEM, {3: "steal", 5: "steal"})
    assert piece.windows["window"].to_list() == [2, 4, 6, 7]
    assert piece.cycles["place"].to_list() == np.repeat(range(4), 10).tolist()
    with pytest.raises(SimulationError, match="every window after the warm-up is excluded"):
        piece_of(run, PROBLEM, range(8))


@pytest.mark.parametrize("by_window", [True, False])
def test_a_resample_of_every_unit_once_is_the_sample(by_window: bool) -> None:
    found = sample("dtp", "network-impairment", by_window=by_window)
    assert found.units == (3 * 28 if by_window else 3)
    once = np.ones((1, found.units))
    for name in ("l95_ms", *found.sums):
        assert found.resampled(name, once)[0] == pytest.approx(found.figure(name)), name


def test_figures_are_those_of_the_summary() -> None:
    run = simulate(PROBLEM, scenario="robot-cpu-stress", policy="dtp", seed=1, windows=30)
    found = QosSample.of([piece_of(run, PROBLEM)], PROBLEM, by_window=True)
    row = summarise(run, PROBLEM, {}).row
    columns = {"l95_ms": "p95_ms", "window_l95_ms": "l95_ms", "u_R1": "node_R1"}
    columns |= {name: name for name in ("violation_rate", "migrations", "share_LOC", "share_SO")}
    for name, column in columns.items():
        assert found.figure(name) == pytest.approx(row[column]), name
    shares = {name: row[f"share_{name}"] for name in PROBLEM.candidates}
    assert found.dominant == max(shares, key=lambda name: float(shares[name]))


def test_a_rate_asks_for_a_factor_of_the_latencies() -> None:
    found = sample("LOC", "baseline", by_window=True)
    assert found.rate_if(1.0) == pytest.approx(found.figure("violation_rate"))
    for rate in (0.1, 0.3, 0.7):
        assert found.rate_if(found.factor_for(rate)) == pytest.approx(rate, abs=2e-3)
    # For none to miss, or all of them, almost any factor would do.
    assert np.isnan([found.factor_for(0.0), found.factor_for(1.0)]).all()
    limits = np.array([0.0, found.l95_ms, np.inf])
    assert found.share_within(limits) == pytest.approx([0.0, 0.95, 1.0], abs=2e-3)
