"""Parts of the kernel that Python does not call, compiled for the tests of each."""

from __future__ import annotations

import ctypes
import hashlib
import runpy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).parents[2]
SOURCE = Path(__file__).with_suffix(".cpp")


@cache
def parts() -> ctypes.CDLL:
    """Return the library of ``parts.cpp``; tests are skipped where nothing can compile it."""
    hook = runpy.run_path(str(ROOT / "hatch_build.py"))
    kernels: Path = hook["KERNELS"]
    compiler = hook["find_compiler"]()
    if not compiler:
        pytest.skip("no C++20 compiler was found")
    flags = [*(kernels / "compile_flags.txt").read_text().split(), f"-I{kernels}"]
    sources = [SOURCE, *sorted(kernels.glob("*.h"))]
    digest = hashlib.sha256(b"".join(one.read_bytes() for one in sources)).hexdigest()
    library = ROOT / "build" / "tests" / f"parts-{digest[:16]}.so"
    if not library.is_file():
        library.parent.mkdir(parents=True, exist_ok=True)
        errors = hook["compile_library"](compiler, [SOURCE], flags, library)
        assert not errors, errors
    loaded = ctypes.CDLL(str(library))
    loaded.part_attempt_uniform.restype = ctypes.c_double
    for name in ("events", "running", "later", "whole_ns", "last_ns", "key"):
        getattr(loaded, f"part_{name}").restype = ctypes.c_int64
    return loaded


def attempt_uniform(key: int, cycle: int, attempt: int) -> float:
    """Return the uniform number of one attempt to send one message."""
    words = ctypes.c_uint64(key), ctypes.c_int64(cycle), ctypes.c_int64(attempt)
    return float(parts().part_attempt_uniform(*words))


def whole(name: str, *numbers: int) -> int:
    """Call a part of whole numbers."""
    return int(getattr(parts(), f"part_{name}")(*map(ctypes.c_int64, numbers)))


def at(array: NDArray[Any]) -> ctypes.c_void_p:
    """Return the address of an array."""
    return ctypes.c_void_p(array.ctypes.data)


def ints(values: list[int]) -> NDArray[np.int64]:
    """Return an array of whole numbers."""
    return np.array(values, np.int64)
