"""A process through which others ask how a cell is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from dwell.cellfile import from_document
from dwell.errors import LiveError
from dwell.live.local.loopback import on_this_machine
from dwell.model.document import to_document
from dwell_lab.testbed.watcher import Watcher
from tests.cells.light import document


def written(folder: Path) -> Path:
    problem = on_this_machine(replace(from_document(document()), folder=str(folder)))
    cell = folder / "cell.yaml"
    cell.write_text(yaml.safe_dump(to_document(problem)), encoding="utf-8")
    return cell


def test_where_nobody_answers_it_says_so_and_can_be_asked_again(tmp_path: Path) -> None:
    with Watcher(written(tmp_path)) as watcher:
        for _ in range(2):
            with pytest.raises(LiveError, match="no controller of cell 'light' answers"):
                watcher.status(0.2)
    with pytest.raises(LiveError, match="does not run"):
        watcher.status(0.2)


def test_a_cell_that_cannot_be_read_is_told_when_it_starts(tmp_path: Path) -> None:
    watcher = Watcher(tmp_path / "none.yaml")
    with pytest.raises(LiveError, match=r"watcher of .*none\.yaml: .*no such file"):
        watcher.start()


def test_its_command_may_have_words_before_it(tmp_path: Path) -> None:
    words = ["env", "DWELL_WATCHED=1"]
    with (
        Watcher(written(tmp_path), words) as watcher,
        pytest.raises(LiveError, match="no controller"),
    ):
        watcher.status(0.2)
