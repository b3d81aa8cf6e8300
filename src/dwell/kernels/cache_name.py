"""What the machine code of the kernels is called on disk: by their sources and the processor."""

from __future__ import annotations

import hashlib
from importlib.resources import files
from typing import Any, cast

from numba.core import registry


def fingerprint() -> str:
    """Return a hash of the sources of all kernels."""
    digest = hashlib.sha256()
    for source in sorted(files(__package__).iterdir(), key=lambda entry: entry.name):
        if source.name.endswith(".py"):
            digest.update(source.name.encode())
            digest.update(source.read_bytes())
    return digest.hexdigest()


def cache_suffix() -> str:
    """Return ``STAMP.HOST``: 16 digits of the kernels' sources and 8 of the processor."""
    target = cast(Any, registry.cpu_target).target_context
    host = hashlib.sha256(repr(target.codegen().magic_tuple()).encode())
    return f"{fingerprint()[:16]}.{host.hexdigest()[:8]}"
