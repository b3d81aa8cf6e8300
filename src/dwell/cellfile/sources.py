"""Digest of Python sources: whether the same code made two results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from importlib.resources import files
from importlib.resources.abc import Traversable


def digest_of(names: Iterable[str], package: str = "dwell") -> str:
    """Return 16 hexadecimal digits that change with any of the named Python files.

    Parameters
    ----------
    names : iterable of str
        Files and folders of the package, as ``sim`` or ``cost.py``.

    Raises
    ------
    FileNotFoundError
        If one of them is not there.
    """
    digest = hashlib.sha256()
    for name in names:
        sources = list(_sources(files(package).joinpath(name), name))
        if not sources:
            raise FileNotFoundError(f"{package} has no sources {name}")
        for path, text in sources:
            digest.update(path.encode())
            digest.update(text)
    return digest.hexdigest()[:16]


def _sources(entry: Traversable, path: str) -> Iterator[tuple[str, bytes]]:
    """Yield every Python file below an entry, in the order of their paths."""
    if entry.is_dir():
        for inner in sorted(entry.iterdir(), key=lambda one: one.name):
            yield from _sources(inner, f"{path}/{inner.name}")
    elif path.endswith(".py"):
        yield path, entry.read_bytes()
