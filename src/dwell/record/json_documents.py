"""JSON documents: reading of files, and conversion of values for JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dwell.errors import RunError


def read_document(file: Path) -> dict[str, Any]:
    """Read a JSON object from a file; return an empty mapping for any other JSON value.

    Raises RunError if the file is unreadable or not JSON.
    """
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise RunError(f"{file}: cannot be read ({error})") from None
    return document if isinstance(document, dict) else {}


def json_ready(value: Any) -> Any:
    """Return a value for JSON; infinite numbers and NaN become None, paths become text."""
    if isinstance(value, Mapping):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
