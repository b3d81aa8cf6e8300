"""What a run says of the software that made it."""

from __future__ import annotations

import re

from dwell import simulate
from dwell.kernels import library
from dwell.sim.versions import kernel_digest, versions
from tests.cells.small import make_problem


def test_a_run_names_the_kernel_and_its_compiler() -> None:
    run = simulate(make_problem(), policy="LOC", seed=1, windows=1)
    assert run.meta["versions"] == versions()
    assert versions()["kernel"].split(" ", 1) == [kernel_digest(), library.compiler()]
    assert re.fullmatch("[0-9a-f]{16}", kernel_digest())
