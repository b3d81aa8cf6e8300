"""What the kernel measures of a window is what `dwell.control.windows` makes of its cycles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.control.windows import missed_cycles, seen_l95_ms
from dwell.model import Caps
from dwell.model.instants import NEVER_NS
from dwell.model.window_close import window_close_ns
from tests.cells.deterministic import cell

#: What a cycle of the chain takes under LOC, ms.
LOC_MS = 17.0


@pytest.mark.parametrize(("deadline_ms", "missed"), [(LOC_MS, 0.0), (LOC_MS - 0.001, 1.0)])
def test_the_deadline_itself_is_in_time(deadline_ms: float, missed: float) -> None:
    problem = cell(deadline_ms=deadline_ms, estimator="profile")
    windows = dwell.simulate(problem, policy="LOC", seed=1, windows=2).windows
    assert windows["seen_violation_rate"].to_list() == [missed] * 2


@pytest.mark.parametrize("window_cycles", [20, 21, 50])
@pytest.mark.parametrize("scenario", ["network-impairment-mild", "edge-cpu-stress"])
def test_windows_are_measured_as_in_python(window_cycles: int, scenario: str) -> None:
    canonical = dwell.load("examples/canonical.yaml")
    objective = replace(canonical.objective, caps=Caps(latency_ms=40.0))
    controller = replace(canonical.controller, decide_cycles=window_cycles)
    problem = replace(
        canonical, objective=objective, window_cycles=window_cycles, controller=controller
    )
    run = dwell.simulate(problem, scenario=scenario, policy="SO", seed=1, windows=30)
    release_ns = run.cycles["release_ns"].to_numpy()
    latency_ns = run.cycles["latency_ns"].fill_null(NEVER_NS).to_numpy()
    deadline_ns = round(problem.pipeline.deadline_ms * 1e6)
    lost = run.decisions["excess_SO"].is_infinite().to_list()
    found = run.windows.select("first_cycle", "seen_violation_rate", "seen_l95_ms").rows()
    for (first, missed, l95_ms), is_lost in list(zip(found, lost, strict=True))[:-1]:
        beyond = first + window_cycles
        close_ns = window_close_ns(problem, release_ns[beyond - 1], release_ns[beyond])
        window = latency_ns[first:beyond], close_ns - release_ns[first:beyond]
        assert missed == missed_cycles(*window, deadline_ns) / window_cycles
        known_ms, uncut_ms = seen_l95_ms(*window, problem.censor_ms)
        assert (l95_ms, is_lost) == (known_ms, np.isinf(uncut_ms))
    assert len({missed for _, missed, _ in found}) > 1
