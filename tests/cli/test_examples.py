"""Where the example cells are found."""

from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell.cli.examples import find_examples
from dwell.errors import ProblemError
from tests.cli.small_cell import ROOT


def test_examples_are_found_or_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_examples(None) == ROOT / "examples"
    assert find_examples(tmp_path) == tmp_path
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dwell, "__file__", str(tmp_path / "a" / "b" / "c" / "__init__.py"))
    with pytest.raises(ProblemError, match="--examples"):
        find_examples(None)
