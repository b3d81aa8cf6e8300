from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest
import yaml

import dwell
from dwell.model import Problem
from dwell.testbed.chaos.fault_timeline import planned
from dwell.testbed.chaos.faults import faults_of
from dwell.testbed.chaos.light_cell import document


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    file: Path = tmp_path_factory.mktemp("cell") / "cell.yaml"
    file.write_text(yaml.safe_dump(document("SO")))
    return dwell.load(file)


def test_a_seed_makes_the_same_timeline_again(problem: Problem) -> None:
    faults = list(faults_of(problem))
    first = list(islice(planned(3, faults), 60))
    assert first == list(islice(planned(3, faults), 60))
    assert first != list(islice(planned(4, faults), 60))


def test_every_kind_has_its_turn_in_every_round(problem: Problem) -> None:
    faults = list(faults_of(problem))
    kinds = {fault.kind or fault.how for fault in faults}
    first = list(islice(planned(1, faults), len(kinds)))
    assert {one.fault.kind or one.fault.how for one in first} == kinds
    assert kinds == {
        *("kill", "kill node", "freeze", "freeze node", "cut", "cut one way", "relay"),
        *("jump", "drift", "starve", "fill", "hog"),
    }


def test_every_fault_has_its_turn(problem: Problem) -> None:
    faults = list(faults_of(problem))
    kinds = {fault.kind or fault.how for fault in faults}
    rounds = max(sum((f.kind or f.how) == kind for f in faults) for kind in kinds)
    everything = {one.fault.name for one in islice(planned(1, faults), rounds * len(kinds))}
    assert everything == {fault.name for fault in faults}
