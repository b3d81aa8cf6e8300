"""Keys of a study: seeds, and values of one kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cellfile.small_study import LEAST, read


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
