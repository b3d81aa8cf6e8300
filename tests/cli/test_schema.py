"""`dwell schema`: the schema, printed or written for an editor."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from dwell.cli.schema import SCHEMA_FILE
from tests.cli.small_cell import ROOT, assert_refused, call

CELLS = [
    path
    for path in sorted((ROOT / "examples").rglob("*.yaml"))
    if re.search("^dwell: ", path.read_text(encoding="utf-8"), re.MULTILINE)
]


@pytest.fixture
def printed() -> str:
    return call("schema").stdout


@pytest.mark.parametrize("cell", CELLS, ids=lambda path: str(path.relative_to(ROOT)))
def test_examples_name_their_schema(cell: Path, printed: str) -> None:
    first = cell.read_text(encoding="utf-8").partition("\n")[0]
    place = first.removeprefix("# yaml-language-server: $schema=")
    # Made by `dwell schema --write examples/cell.schema.json`.
    assert (cell.parent / place).read_text(encoding="utf-8") == printed


def test_a_schema_is_written_and_replaces_an_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert json.loads(printed)["title"] == "Dwell cell"
    assert f"$schema={SCHEMA_FILE}" in call("schema", "--write").stdout
    Path("other.json").write_text('{"title": "Dwell cell", "old": true}', encoding="utf-8")
    for name in (SCHEMA_FILE, "other.json"):
        assert call("schema", "--write", name).exit_code == 0
        assert Path(name).read_text(encoding="utf-8") == printed
    assert {path.name for path in tmp_path.iterdir()} == {SCHEMA_FILE, "other.json"}


def test_no_other_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / SCHEMA_FILE
    for text in ("mine", '{"title": "mine"}', "[1]", "dwell: 1\n"):
        path.write_text(text, encoding="utf-8")
        refused = call("schema", "--write", path)
        assert_refused(refused, "exists and is no schema")
        assert refused.stderr.count("\n") == 1
        assert path.read_text(encoding="utf-8") == text
    assert_refused(call("schema", "--write", tmp_path), "is a folder")
    assert_refused(call("schema", "--write", tmp_path / "a" / "b"), "is not a folder")
    assert_refused(call("schema", tmp_path / "other.json"), "add --write")
    assert not (tmp_path / "other.json").exists()
