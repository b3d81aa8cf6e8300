from __future__ import annotations

import json
import math

from dwell.policies import by_name, parameters_of
from tests.cells.paper import problem


class Mine:
    def __init__(self, gain: float, name: str = "x", helper: object = None, lost: int = 1) -> None:
        self.gain, self.name, self.helper = gain, name, helper


def test_arguments_that_are_kept_under_their_names_are_recorded() -> None:
    assert parameters_of(Mine(math.inf)) == {"gain": "inf", "name": "x", "helper": None}
    # What JSON does not have is left out, and so is what the object does not keep.
    assert parameters_of(Mine(0.5, helper=object())) == {"gain": 0.5, "name": "x"}


def test_an_objective_is_as_in_a_cell_file() -> None:
    kept = parameters_of(by_name("dtp", problem()))
    assert kept["min_dwell"] == problem().controller.min_dwell
    assert json.loads(json.dumps(kept)) == kept
