"""Player: with whose software it plays, and what it tries beforehand."""

from __future__ import annotations

import pytest

import dwell.sim
from dwell.errors import SimulationError
from dwell.study import Contender, Study, run_study
from dwell.study.player import Player
from tests.study.test_study import make_study


def test_a_worker_with_other_software_refuses() -> None:
    study = make_study()
    player = Player(study, software={**Player(study).software, "numpy": "1.0"})
    with pytest.raises(SimulationError, match=r"numpy \d.*, not numpy 1\.0"):
        player(study.items()[0])


def test_an_unknown_policy_is_found_before_the_work_begins() -> None:
    seen: list[int] = []
    study: Study = make_study(contenders=(Contender("LOC", "LOC"), Contender("dpt", "dpt")))
    with pytest.raises(dwell.errors.PolicyError, match="did you mean 'dtp'"):
        run_study(study, processes=1, progress=lambda done, _: seen.append(done))
    assert seen == []
