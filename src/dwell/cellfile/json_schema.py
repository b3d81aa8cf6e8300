"""JSON Schema of the cell file, for editors."""

from __future__ import annotations

from typing import Any

DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: Names the schema, by the version of the format.
NAME = "urn:dwell:cell"


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the cell file.

    It covers structure: keys, types, units and the bounds of single values. Only
    `dwell.cellfile.load` checks names, links and the DAG.

    Returns
    -------
    dict
        Ready for `json.dumps`.
    """
    from dwell.cellfile.cell_form import CELL

    definitions: dict[str, Any] = {}
    cell = CELL.shape.definition(definitions)
    head = {"$schema": DIALECT, "$id": f"{NAME}:{CELL.version}", "title": "Dwell cell"}
    return {**head, **cell, "$defs": dict(sorted(definitions.items()))}
