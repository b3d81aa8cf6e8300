"""The notebook of the examples runs in a real kernel, and is kept without what it printed."""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOK = EXAMPLES / "first-look.ipynb"


@pytest.fixture(scope="module")
def kept() -> Any:
    return nbformat.reads(NOTEBOOK.read_text(encoding="utf-8"), as_version=4)  # type: ignore[no-untyped-call]


def test_outputs_are_not_kept(kept: Any) -> None:
    code = [cell for cell in kept.cells if cell.cell_type == "code"]
    assert len(code) >= 5
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    nbformat.validate(kept)


def test_every_cell_runs_and_results_show_themselves(
    kept: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Nothing of a kernel's is left in the folders of whoever runs the tests.
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    before = set(os.listdir(EXAMPLES))
    played = NotebookClient(
        copy.deepcopy(kept), timeout=300, resources={"metadata": {"path": str(EXAMPLES)}}
    ).execute()
    shown = [
        output.data["text/html"]
        for cell in played.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if "text/html" in output.get("data", {})
    ]
    titles = ("Cell canonical", "DTP on canonical", "Placement policies compared on canonical")
    for title in titles:
        assert any(title in html and "<svg" in html for html in shown), title
    assert set(os.listdir(EXAMPLES)) == before
