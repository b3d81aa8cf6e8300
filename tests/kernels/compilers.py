"""The compilers that are here, and packages whose kernel they have built."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import pytest

import hatch_build

ROOT = Path(__file__).parents[2]
LIBRARY: Final[str] = hatch_build.FILE["NAME"]

#: By name: the command.
COMPILERS: Final[Mapping[str, list[str]]] = {
    "gcc": ["g++"],
    "clang": [*hatch_build.ZIG, "-mcpu=baseline"],
}
needs_gcc = pytest.mark.skipif(not shutil.which("g++"), reason="g++ is not installed")
needs_clang = pytest.mark.skipif(
    not find_spec("ziglang"), reason="ziglang is not installed (requirements/zig.txt)"
)
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


def copy_package(folder: Path, compiler: str, options: Sequence[str] = ()) -> Path:
    """Copy the package, with a kernel by a compiler; return the folder that it is imported from."""
    kept = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "src" / "dwell", folder / "dwell", ignore=kept)
    hatch_build.build(COMPILERS[compiler], folder / "dwell" / "kernels" / LIBRARY, options)
    return folder


def run_with(
    package: Path, *words: str | Path, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run Python with a copy of the package, from the repository's folder."""
    return subprocess.run(
        [sys.executable, *words],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(package), **variables},
    )
