"""What tests of calibration share: a known cell, its runs, and what is found from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.model import Gamma, Problem
from lab.tests.testbed.calibrated import Calibrated, calibrate
from tests.cells.known_cost import (
    ADDED_MS,
    BACKGROUND,
    BESIDE,
    CELL,
    INTERFERENCE,
    MESSAGING_MS,
    STAGE_MS,
    observed,
)


@pytest.fixture(scope="session")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cell = tmp_path_factory.mktemp("cell") / "known.yaml"
    cell.write_text(CELL)
    return cell


@pytest.fixture(scope="session")
def truth(nominal: Path) -> Problem:
    """The cell that is there, which nobody knows."""
    problem = dwell.load(nominal)
    tasks = {
        task.name: replace(
            task,
            on={
                node: replace(
                    of,
                    exec_ms=Gamma(STAGE_MS[task.name, node] + MESSAGING_MS[task.name, node], 0.12),
                )
                for node, of in task.on.items()
            },
        )
        for task in problem.pipeline.tasks.values()
    }
    fabric = replace(
        problem.fabric,
        nodes={
            node: replace(
                of,
                background=BACKGROUND[node],
                background_beside=BESIDE[node],
                interference=INTERFERENCE if node == "E" else 1.0,
            )
            for node, of in problem.fabric.nodes.items()
        },
        links={
            name: replace(link, delay_ms=replace(link.delay_ms, mean=0.7 + ADDED_MS))  # type: ignore[type-var]
            for name, link in problem.fabric.links.items()
        },
    )
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks), fabric=fabric)


@pytest.fixture(scope="session")
def folders(truth: Problem, nominal: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    at = tmp_path_factory.mktemp("runs")
    plan = (("LOC", "baseline"), ("OFF", "baseline"), ("OFF", "stress"), ("OFF", "far"))
    return [
        observed(truth, nominal, placement, scenario).save(at / f"{placement}-{scenario}")
        for placement, scenario in plan
    ]


@pytest.fixture(scope="session")
def calibrated(
    nominal: Path, folders: list[Path], tmp_path_factory: pytest.TempPathFactory
) -> Calibrated:
    out = tmp_path_factory.mktemp("out") / "measured.yaml"
    return calibrate(nominal, folders, out, say=lambda line: None)
