"""JSON Schema of the cell file, for editors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic_core.core_schema import NullableSchema


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the cell file.

    It covers structure: keys, types, units and the bounds of single values. What a cell means as a
    whole (names, links, the DAG) is checked by `dwell.cellfile.load` alone.

    Returns
    -------
    dict
        Ready for `json.dumps`.
    """
    from pydantic.json_schema import GenerateJsonSchema

    from dwell.cellfile.entries import CellEntry

    class Generator(GenerateJsonSchema):
        """Optional parts are left out of a file, never null."""

        def nullable_schema(self, schema: NullableSchema) -> dict[str, Any]:
            return self.generate_inner(schema["schema"])

    result = CellEntry.model_json_schema(by_alias=True, schema_generator=Generator)
    head = {"$schema": GenerateJsonSchema.schema_dialect, "title": "Dwell cell"}
    return {**head, **{key: value for key, value in _pruned(result).items() if key != "title"}}


def _pruned(value: Any) -> Any:
    """Leave out what says nothing to a reader: made-up titles, and defaults of null."""
    if isinstance(value, list):
        return [_pruned(item) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: _pruned(item)
        for key, item in value.items()
        # A property may have these names; what describes it is then a mapping.
        if not (key == "title" and isinstance(item, str)) and (key, item) != ("default", None)
    }
