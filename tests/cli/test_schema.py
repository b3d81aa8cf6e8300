"""`dwell schema`: the schema, printed or written for an editor."""

from __future__ import annotations

import json
from pathlib import Path

from dwell.cli.schema import SCHEMA_FILE, schema_text
from tests.cli.small_cell import call, read_json


def test_schema_is_json() -> None:
    assert read_json(call("schema"))["title"] == "Dwell cell"


def test_an_older_schema_is_replaced_and_no_other_file(tmp_path: Path) -> None:
    path = tmp_path / SCHEMA_FILE
    first = call("schema", "--write", path)
    assert (first.exit_code, path.read_text(encoding="utf-8")) == (0, schema_text())
    assert f"$schema={SCHEMA_FILE}" in first.stdout
    path.write_text(json.dumps({"title": "Dwell cell", "old": True}), encoding="utf-8")
    assert call("schema", "--write", path).exit_code == 0
    assert path.read_text(encoding="utf-8") == schema_text()
    for text in ("mine", '{"title": "mine"}', "[1]"):
        path.write_text(text, encoding="utf-8")
        refused = call("schema", "--write", path)
        assert refused.exit_code == 2
        assert "is there already, and is no schema" in refused.stderr
        assert path.read_text(encoding="utf-8") == text
    assert "is a folder" in call("schema", "--write", tmp_path).stderr
    assert "there is no folder" in call("schema", "--write", tmp_path / "a" / "b").stderr
