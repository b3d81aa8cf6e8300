"""The version is the same for whoever asks."""

from __future__ import annotations

import tomllib
from pathlib import Path

import dwell
from dwell.version import __version__


def test_the_version_is_that_of_the_distribution() -> None:
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    assert dwell.__version__ == __version__ == tomllib.loads(text)["project"]["version"]
