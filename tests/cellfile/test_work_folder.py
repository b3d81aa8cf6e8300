from __future__ import annotations

import json
from pathlib import Path

import pytest

from dwell.cellfile.work_folder import FolderMark, open_work_folder
from dwell.errors import RunError, SimulationError

STUDY = FolderMark("study", "study.json", 1, ("parts",))


def test_the_same_work_goes_on_in_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with open_work_folder(folder, STUDY, {"seeds": [1, 2]}):
        (folder / "parts" / "one").write_text("done")
        (folder / "parts" / ".two.draft").write_text("half")
    with open_work_folder(folder, STUDY, {"seeds": [1, 2]}):
        assert sorted(one.name for one in (folder / "parts").iterdir()) == ["one"]
    assert json.loads((folder / "study.json").read_text())["seeds"] == [1, 2]


def test_notes_may_change_and_the_work_goes_on(tmp_path: Path) -> None:
    file = tmp_path / "out" / "study.json"
    for notes in ({"labels": {"a": "A"}}, {"labels": {"a": "B"}}, None):
        with open_work_folder(tmp_path / "out", STUDY, {"seeds": [1]}, notes):
            known = json.loads(file.read_text())
        assert known.get("labels") == (notes or {}).get("labels")
    with open_work_folder(tmp_path / "new", STUDY, {"seeds": [1]}):
        assert file.read_bytes() == (tmp_path / "new" / "study.json").read_bytes()


def test_other_work_is_told_what_differs_and_touches_nothing(tmp_path: Path) -> None:
    with open_work_folder(tmp_path / "out", STUDY, {"seeds": [1], "cell": {"period_ms": 40}}):
        pass
    before = (tmp_path / "out" / "study.json").read_bytes()
    with (
        pytest.raises(RunError, match=r"(?s)another study.*cell\.period_ms: 40 there, 50 now"),
        open_work_folder(tmp_path / "out", STUDY, {"seeds": [1], "cell": {"period_ms": 50}}),
    ):
        pass
    assert (tmp_path / "out" / "study.json").read_bytes() == before


def test_one_process_at_a_time(tmp_path: Path) -> None:
    with (
        open_work_folder(tmp_path / "out", STUDY, {}),
        pytest.raises(RunError, match="in use: another process works on this study"),
        open_work_folder(tmp_path / "out", STUDY, {}),
    ):
        pass


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(RunError, match="is no study"), open_work_folder(tmp_path, STUDY, {}):
        pass
    with (
        pytest.raises(RunError, match="is not a folder"),
        open_work_folder(tmp_path / "thesis.tex", STUDY, {}),
    ):
        pass
    assert [one.name for one in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_place_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(SimulationError, match="cannot be written"),
        open_work_folder(tmp_path / "file" / "out", STUDY, {}),
    ):
        pass


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_a_mark_that_says_nothing_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "study.json").write_text(text)
    with pytest.raises(RunError), open_work_folder(tmp_path, STUDY, {}):
        pass
    assert (tmp_path / "study.json").read_text() == text
