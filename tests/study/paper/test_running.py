"""How much is simulated, and that nothing is simulated twice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from dwell.errors import RunError, SimulationError
from dwell.study import Contender, Point, Study
from dwell.study.engine import Progress
from dwell.study.paper import Runner, Scale
from tests.study.paper.small_cell import make_cell

SCALES = (Scale.full(), Scale.quick(), Scale.tiny())


def make_study(seeds: int = 3) -> Study:
    return Study(
        name="small",
        points=(Point({}, make_cell()),),
        scenarios=("baseline",),
        contenders=(Contender("LOC", "LOC"), Contender("dtp", "dtp")),
        seeds=tuple(range(1, seeds + 1)),
        windows=6,
    )


@pytest.mark.parametrize("scale", SCALES, ids=lambda scale: scale.name)
def test_held_out_seeds_are_no_others(scale: Scale) -> None:
    compared = {*scale.all_seeds, *scale.some_seeds, *range(1, scale.sobol_seeds + 1)}
    assert len(scale.held_out) == scale.tuning_seeds
    assert compared.isdisjoint(scale.held_out)


@pytest.mark.parametrize("scale", SCALES, ids=lambda scale: scale.name)
def test_a_sobol_design_takes_a_power_of_two(scale: Scale) -> None:
    assert scale.sobol_n & (scale.sobol_n - 1) == 0


def test_all_that_is_too_small_is_named() -> None:
    with pytest.raises(SimulationError) as caught:
        replace(Scale.full(), seeds=0, windows=1)
    lines = str(caught.value).splitlines()
    assert lines == ["seeds is 0; it must be at least 1", "windows is 1; it must be at least 2"]


def test_what_is_finished_is_not_done_again(tmp_path: Path) -> None:
    counted: list[tuple[str, int, int]] = []

    @contextmanager
    def show(study: str) -> Iterator[Progress]:
        yield lambda done, total: counted.append((study, done, total))

    runner = Runner(tmp_path, processes=1, show=show)
    first = runner.run(make_study())
    parts = sorted((tmp_path / "small" / "parts").iterdir())
    assert [done for _, done, _ in counted] == [0, 2, 4, 6]
    parts[1].unlink()
    kept = {part: part.stat().st_mtime_ns for part in parts if part.exists()}
    counted.clear()
    again = runner.run(make_study())
    assert counted == [("small", 4, 6), ("small", 6, 6)]
    assert {part: part.stat().st_mtime_ns for part in kept} == kept
    assert again.runs.equals(first.runs)
    assert again.latencies.equals(first.latencies)


def test_another_study_of_the_same_name_is_refused(tmp_path: Path) -> None:
    runner = Runner(tmp_path, processes=1)
    runner.run(make_study(seeds=1))
    with pytest.raises(RunError, match="holds another study"):
        runner.run(make_study(seeds=2))
