"""A run does not depend on the seed of Python's hashes, which orders sets."""

from __future__ import annotations

import os
import subprocess
import sys

PRINTS = """
from random import Random
import dwell
from tests.cells.generated import random_problem
problem = random_problem(Random(13), schedulers=("fair", "fifo", "priority", "turns"), orders=True)
run = dwell.simulate(problem, scenario="disturbed", policy="dtp+corrected", seed=13, windows=20)
print(run.decisions.write_csv())
"""


def test_estimates_do_not_depend_on_the_order_of_sets() -> None:
    printed = {
        subprocess.run(
            [sys.executable, "-c", PRINTS],
            env={**os.environ, "PYTHONHASHSEED": seed},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for seed in ("0", "1")
    }
    assert len(printed) == 1
