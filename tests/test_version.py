"""The version is the same for whoever asks."""

from __future__ import annotations

import tomllib
from pathlib import Path

import dwell
from dwell.version import __version__

ROOT = Path(__file__).parents[1]


def test_the_version_is_that_of_both_distributions() -> None:
    assert dwell.__version__ == __version__
    projects = [
        tomllib.loads((ROOT / name).read_text(encoding="utf-8"))["project"]
        for name in ("pyproject.toml", "lab/pyproject.toml")
    ]
    assert [one["version"] for one in projects] == [__version__, __version__]
    (needed,) = projects[1]["dependencies"]
    assert needed.partition("==")[2] == __version__
