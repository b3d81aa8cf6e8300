"""The paper's questions give the means that were written down: one, at the scale of a look.

All of them take minutes: `make paper ARGS="--scale quick"`, then `python -m tests.regression paper
FOLDER` writes `paper-quick.csv` again, for `git diff` to show.
"""

from __future__ import annotations

from pathlib import Path

import polars as pl
from polars.testing import assert_frame_equal

from reproduction.__main__ import main
from tests.regression.paper import FULL, KEYS, METRICS, QUICK, means, read


def test_the_means_of_a_question_are_those_that_were_written_down(tmp_path: Path) -> None:
    words = ["--scale", "quick", "--only", "table", "--processes", "1"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    found = means([tmp_path / "out" / "runs" / "table"])
    known = read(QUICK).filter(pl.col("study") == "table").fill_null("")
    assert known.height == 45
    assert_frame_equal(found, known, check_dtypes=False, rel_tol=1e-7)


def test_what_was_written_down_is_whole() -> None:
    quick, full = read(QUICK), read(FULL)
    for frame in (quick, full):
        assert frame.columns == [*KEYS, "seeds", *METRICS]
        assert not frame.select(KEYS).is_duplicated().any()
    # A full study goes beyond a look; what takes hours may not have been asked yet.
    assert set(quick["study"]) >= set(full["study"])
    assert full.height > 2 * quick.height
