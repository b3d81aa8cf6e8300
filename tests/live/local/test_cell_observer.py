"""What looks on while a cell runs is a class of the cell's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.local.cell_observer import load_observer
from tests.cells.small import make_problem

CODE = """
class Looking:
    def __init__(self, folder, begin_ns):
        if begin_ns < 0:
            raise ValueError("before the beginning")
        self.seen = (str(folder), begin_ns)
    def look(self, now_ns):
        return {"error_mm": 1.0}
    def told(self, origin_ns):
        return {"origin_ns": origin_ns}
    def close(self):
        pass
"""


def test_it_is_made_beside_the_cell_with_its_folder_and_its_time(tmp_path: Path) -> None:
    (tmp_path / "looking_on.py").write_text(CODE, encoding="utf-8")
    problem = replace(make_problem(), folder=str(tmp_path))
    made = load_observer("looking_on:Looking", problem, tmp_path / "work", 7)
    assert made.seen == (str(tmp_path / "work"), 7)  # type: ignore[attr-defined]
    assert made.look(8) == {"error_mm": 1.0}
    with pytest.raises(LiveError, match="observer looking_on:Looking: ValueError: before the"):
        load_observer("looking_on:Looking", problem, tmp_path, -1)
    with pytest.raises(LiveError, match="observer looking_on:Absent: AttributeError"):
        load_observer("looking_on:Absent", problem, tmp_path, 1)
    with pytest.raises(LiveError, match="observer absent:Looking: no module 'absent'"):
        load_observer("absent:Looking", problem, tmp_path, 1)
