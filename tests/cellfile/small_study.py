"""The least study file, and what is wrong with others."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import pytest

from dwell.cellfile.study_file import DeclaredStudy, read_study
from dwell.errors import ProblemError

LEAST = """\
dwell-study: 1
cell: cell.yaml
policies: [LOC]
"""


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
