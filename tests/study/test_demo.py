"""The demo, made small."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dwell.errors import TraceError
from dwell.model import Problem, Trace, TraceTable
from dwell.study import canonical_demo, real_demo, tenants_demo
from dwell.study.demo import longest_run
from tests.cells.small import make_problem

ROOT = Path(__file__).parents[2]
TRACES = ROOT.parent / "shared" / "data"


def with_trace(rows: int, *, wrap: bool = False) -> Problem:
    """Return the small cell with a trace of so many rows in the place of its scale."""
    problem = make_problem()
    table = TraceTable(file="scene.csv", columns={"scale": np.ones(rows)}, wrap=wrap)
    pipeline = replace(problem.pipeline, scales={"scene": Trace(table, "scale")})
    return replace(problem, pipeline=pipeline)


@pytest.mark.parametrize(("rows", "windows"), [(1000, 40), (400, 40), (399, 39), (35, 3)])
def test_a_short_trace_shortens_the_run(rows: int, windows: int) -> None:
    assert longest_run(with_trace(rows), 40) == windows


def test_a_trace_that_wraps_does_not() -> None:
    assert longest_run(with_trace(35, wrap=True), 40) == 40


def test_a_trace_shorter_than_the_warm_up_is_an_error() -> None:
    with pytest.raises(TraceError, match="needs 30 cycles"):
        longest_run(with_trace(29), 40)


def test_the_canonical_demo() -> None:
    seen: list[tuple[int, int]] = []
    found = canonical_demo(
        ROOT / "examples",
        seeds=1,
        windows=7,
        processes=1,
        progress=lambda done, total: seen.append((done, total)),
    )
    paper = {"baseline", "robot-cpu-stress", "edge-cpu-stress", "network-impairment"}
    assert paper < set(found.scenarios)
    plain = ("LOC", "SO", "HYB", "atp", "DTP as printed", "dtp, no caps", "latency-first")
    assert found.policies == (*plain, "DTP", "cusum+corrected")
    assert seen[-1] == (found.runs.height, found.runs.height)


def test_the_tenants_of_the_edge_are_varied_and_nothing_else() -> None:
    found = tenants_demo(ROOT / "examples", seeds=1, windows=7, processes=1)
    shares = []
    for point in found.study.points:
        bursts = point.problem.fabric.nodes["E"].bursts
        assert bursts is not None
        shares.append(bursts.share)
    assert shares == pytest.approx([0.0, 0.03, 0.0625, 0.1], abs=1e-6)
    assert found.runs.height == 4 * 2 * 4
    canonical = canonical_demo(ROOT / "examples", seeds=1, windows=7, processes=1)
    own = found.runs.filter(found.runs[found.parameters[0]] == 3000.0)
    for scenario, policy, rate in own.select("scenario", "policy", "violation_rate").rows():
        assert canonical.values(scenario, policy, "violation_rate") == [rate]


@pytest.mark.skipif(not TRACES.is_dir(), reason="the measurements are not at ../shared/data")
def test_the_demo_on_measurements() -> None:
    seen: list[tuple[int, int]] = []
    found = real_demo(
        ROOT / "examples",
        TRACES,
        seeds=1,
        windows=7,
        processes=1,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert [one.problem.name for one in found] == ["real", "real-5g"]
    total = sum(one.runs.height for one in found)
    assert seen[-1] == (total, total)
    assert len({total for _, total in seen}) == 1
