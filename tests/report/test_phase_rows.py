"""What every phase of a live run has shown."""

from __future__ import annotations

from dwell.report.phase_rows import phase_rows
from dwell.report.run_header import RunHeader
from tests.report.live_runs import PLAYED, TRACKING, live_run


def test_a_phase_has_its_moves_shares_losses_and_error() -> None:
    run = live_run(scenario="demo", seed=1, played=PLAYED, tracking=TRACKING)
    calm, stress, after = phase_rows(run, RunHeader.of(run))
    assert (calm.migrations, calm.guard_moves) == (0, 0)
    assert (stress.migrations, stress.guard_moves) == (1, 1)
    assert stress.shares == {"SO": 10 / 11, "LOC": 1 / 11}
    assert calm.rms_mm == 3.0
    assert stress.rms_px == 8.0
    assert (calm.lost, after.lost) == (0, 1)
