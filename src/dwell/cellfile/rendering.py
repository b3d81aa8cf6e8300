"""Values of a document in words, for messages."""

from __future__ import annotations

import math

from dwell.model.bounds import shown


def as_read(value: object) -> str:
    """Return a value as its author wrote it, or what it is where it is no single value."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "infinity" if value > 0 else "-infinity"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return shown(value)
