"""Keys of a study: seeds, and values of one kind."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import pytest

from dwell.cellfile.study_file import DeclaredStudy, read_study
from dwell.errors import ProblemError
from tests.cellfile.test_cell import EXAMPLE

LEAST = """\
dwell-study: 1
cell: cell.yaml
policies: [LOC]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a cell."""
    (tmp_path / "cell.yaml").write_text(EXAMPLE.read_text(encoding="utf-8"), encoding="utf-8")
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "study.yaml"
    path.write_text(textwrap.dedent(text), encoding="utf-8")
    return path


def read(folder: Path, text: str, **options: Any) -> DeclaredStudy:
    return read_study(write(folder, text), **options)


def faults(folder: Path, text: str, **options: Any) -> dict[str, str]:
    """Return the messages of a study file that is wrong, by their paths."""
    with pytest.raises(ProblemError) as caught:
        read(folder, text, **options)
    assert caught.value.source == str(folder / "study.yaml")
    return {fault.path: fault.message for fault in caught.value.faults}


@pytest.mark.parametrize(
    ("given", "seeds"),
    [
        ("3", (1, 2, 3)),
        ("[7, 5]", (7, 5)),
        ("{from: 0, count: 2}", (0, 1)),
        ("2e0", (1, 2)),
    ],
)
def test_seeds_are_a_number_a_list_or_a_stretch(
    folder: Path, given: str, seeds: tuple[int, ...]
) -> None:
    assert read(folder, f"{LEAST}seeds: {given}\n").seeds == seeds


@pytest.mark.parametrize(
    ("values", "kinds"),
    [("[1, 2]", [int, int]), ("[1, 2.5]", [float, float]), ("[1, {constant: 2}]", [str, str])],
)
def test_the_values_of_a_parameter_are_of_one_kind(
    folder: Path, values: str, kinds: list[type]
) -> None:
    text = f"{LEAST}parameters: {{'links[0].delay_ms': {values}}}\n"
    points = read(folder, text).points
    assert [type(point.values["links[0].delay_ms"]) for point in points] == kinds
