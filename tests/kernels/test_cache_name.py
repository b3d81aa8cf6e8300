"""What compiled kernels are called on disk."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from dwell.kernels import cache_name


class Source:
    """A file of a package, as importlib.resources shows it."""

    def __init__(self, name: str, text: bytes) -> None:
        self.name, self.text = name, text

    def read_bytes(self) -> bytes:
        """Return its content."""
        return self.text


class Package:
    """A folder of such files."""

    def __init__(self, *sources: Source) -> None:
        self.sources = sources

    def iterdir(self) -> Iterator[Source]:
        """List them in an order of no meaning."""
        return iter(self.sources[::-1])


def test_the_fingerprint_changes_with_every_source(monkeypatch: pytest.MonkeyPatch) -> None:
    def of(*sources: Source) -> str:
        monkeypatch.setattr(cache_name, "files", lambda _package: Package(*sources))
        return cache_name.fingerprint()

    one, two = Source("advance.py", b"A"), Source("nodes.py", b"B")
    base = of(one, two)
    assert base == of(two, one)
    assert base == of(one, two, Source("advance.nbi", b"machine code"))
    assert base != of(one, Source("nodes.py", b"C"))
    assert base != of(one)
    assert base != of(one, two, Source("new.py", b""))
