"""How much longer stages take where a probe's piece of work does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dwell.model.document import to_document
from dwell.record import Run
from dwell_lab.testbed.measured import DisturbedPlaces, Measured, Visit
from dwell_lab.testbed.sensitivity import LEAST_POINTS, TOGETHER, sensitivities, usual_of
from tests.cells.small import make_problem

CELL = to_document(replace(make_problem(), warmup_windows=0))
SEE, FIND = ("see", "R1"), ("find", "E")
JOBS = 20


def measured(
    name: str,
    speed: float,
    slow: dict[tuple[str, str], float],
    *,
    windows: int = 200,
    spread: float = 0.1,
    for_windows: int = 1,
    blur: float = 0.0,
    stressed: tuple[str, ...] = (),
) -> Measured:
    """A run whose CPUs change every so many windows; stages follow by their exponents.

    Probes see it blurred, and one window in twenty as if the CPU were four times as slow.
    """
    draw = np.random.default_rng(len(name))
    changes = {
        node: np.exp(np.repeat(draw.normal(0, spread, windows), for_windows)[:windows])
        for node in ("R1", "E")
    }
    off = np.exp(draw.normal(0, blur, windows)) * np.where(draw.random(windows) < 0.05, 4, 1)
    seen = {node: of * off if blur else of for node, of in changes.items()}
    rows = [
        {"window": i, "work_ms": {"0": 0.1 * speed * seen["R1"][i], "1": 0.2 * seen["E"][i]}}
        for i in range(windows)
    ]
    visits = {}
    for site, exponent in slow.items():
        jobs = np.repeat(np.arange(windows), JOBS)
        noise = draw.gamma(50, 1 / 50, len(jobs))
        usual_ms = 5.0 * (speed**exponent if site[1] == "R1" else 1.0)
        stage_ms = usual_ms * changes[site[1]][jobs] ** exponent * noise
        none_ms = np.zeros(len(jobs))
        visits[site] = Visit(stage_ms, none_ms, np.arange(len(jobs)), jobs)
    meta = {
        "problem": CELL,
        "testbed": {"nodes": {"R1": {"cpus": [0]}, "E": {"cpus": [1]}}},
        "pressure": {"windows": rows},
    }
    return Measured(
        name=name,
        run=Run(meta, {}),
        disturbed=DisturbedPlaces(frozenset(stressed), frozenset(), frozenset(stressed)),
        placement="",
        windows=windows,
        visits=visits,
        rates={},
        starts={},
        spent_ms={},
        used={},
        work_ms={"R1": 0.1 * speed, "E": 0.2},
    )


def test_exponents_are_found() -> None:
    slow = {SEE: 0.5, FIND: 1.5}
    found = sensitivities([measured("a", 1.0, slow), measured("bb", 1.2, slow)])
    assert found[SEE] == pytest.approx(0.5, abs=0.1)
    assert found[FIND] == pytest.approx(1.5, abs=0.1)


def test_noise_of_the_probes_does_not_flatten_them() -> None:
    """A line through all windows finds 0.1 here."""
    slow = {SEE: 1.0, FIND: 1.5}
    runs = [measured("a" * n, 1.0, slow, windows=60, for_windows=10, blur=0.03) for n in (1, 2, 3)]
    found = sensitivities(runs)
    assert found[SEE] == pytest.approx(1.0, abs=0.15)
    assert found[FIND] == pytest.approx(1.5, abs=0.15)


def test_what_shows_nothing_says_nothing() -> None:
    few = (LEAST_POINTS - 1) * TOGETHER
    assert sensitivities([measured("a", 1.0, {SEE: 1.0}, windows=few, spread=1.0)]) == {}
    assert sensitivities([measured("a", 1.0, {SEE: 1.0}, spread=0.001)]) == {}
    busy = measured("a", 1.0, {SEE: 1.0, FIND: 1.0}, stressed=("E",))
    assert sensitivities([busy]).keys() == {SEE}


def test_a_stage_never_takes_less_on_a_slower_cpu() -> None:
    assert sensitivities([measured("a", 1.0, {SEE: -1.0})])[SEE] == 0.0


def test_the_usual_speed_is_that_of_all_runs() -> None:
    usual = usual_of([measured("a", 1.0, {SEE: 1.0}), measured("bb", 1.2, {SEE: 1.0})])
    assert usual.work_ms == pytest.approx({"R1": 0.11, "E": 0.2})
    assert usual.factor({"R1": 0.22}, *SEE) == pytest.approx(2.0, rel=0.1)
