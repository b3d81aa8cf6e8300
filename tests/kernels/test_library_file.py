"""The file of the compiled kernel: the digest of its sources, its header."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

from dwell.kernels.library_file import FLAGS, MACHINES, NAME, is_of, read_header, source_digest

KERNELS = Path(str(files("dwell.kernels")))


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    for name in ("a.cpp", "b.h", FLAGS):
        (tmp_path / name).write_text(f"// {name}\n", encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("name", ["a.cpp", "b.h", "c.cpp", FLAGS])
def test_the_digest_is_of_every_source_and_the_flags(name: str, sources: Path) -> None:
    before = source_digest(sources)
    (sources / name).write_text("// another\n", encoding="utf-8")
    assert source_digest(sources) != before


def test_the_digest_is_of_names_too(sources: Path) -> None:
    before = source_digest(sources)
    (sources / "b.h").rename(sources / "c.h")
    assert source_digest(sources) != before


@pytest.mark.parametrize("name", ["a.py", NAME, "a.cpp.orig", ".a.cpp.swp"])
def test_the_digest_is_of_nothing_else(name: str, sources: Path) -> None:
    before = source_digest(sources)
    (sources / name).write_text("// another\n", encoding="utf-8")
    assert source_digest(sources) == before


def test_the_header_tells_the_processor_and_the_length() -> None:
    content = (KERNELS / NAME).read_bytes()
    header = read_header(content)
    assert header is not None
    assert header.machine in MACHINES.values()
    assert header.n_bytes == len(content)


@pytest.mark.parametrize("content", [b"", b"\x7fELF", b"#!/bin/sh\n" * 100])
def test_what_is_no_library_has_no_header(content: bytes) -> None:
    assert read_header(content) is None


def test_a_library_is_of_texts_that_it_has_to_their_end() -> None:
    content = (KERNELS / NAME).read_bytes()
    digest = source_digest(KERNELS)
    assert is_of(content, digest)
    assert is_of(content, digest[1:])
    assert not is_of(content, digest[:-1])
    assert not is_of(content, digest, "another compiler")
    assert not is_of(content[:-1], digest)
