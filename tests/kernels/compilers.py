"""The compilers that the kernel's C++ is tested with: those that are here."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import pytest

import hatch_build

#: By name: its command.
COMPILERS: Final[Mapping[str, list[str]]] = {
    "gcc": ["g++"],
    "clang": [*hatch_build.ZIG, "-mcpu=baseline"],
}
#: What each needs to be here, and the reason for a skip.
needs_gcc = pytest.mark.skipif(not shutil.which("g++"), reason="g++ is not installed")
needs_clang = pytest.mark.skipif(not find_spec("ziglang"), reason="ziglang is not installed")

with_every_compiler = pytest.mark.parametrize(
    "compiler",
    [pytest.param("gcc", marks=needs_gcc), pytest.param("clang", marks=needs_clang)],
)


def compile_one(compiler: str, source: Path, library: Path) -> Path:
    """Compile one source as the kernel's are, warnings being errors; return the library."""
    flags = (hatch_build.KERNELS / "compile_flags.txt").read_text(encoding="utf-8").split()
    flags += ["-Werror", f"-I{hatch_build.KERNELS}"]
    errors = hatch_build.compile_library(COMPILERS[compiler], [source], flags, library)
    assert not errors, errors
    return library
