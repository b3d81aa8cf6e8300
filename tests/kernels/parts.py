"""Parts of the kernel that Python does not call, compiled for the tests of each."""

from __future__ import annotations

import ctypes
import shutil
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.kernels.compilers import compile_one

SOURCE = Path(__file__).with_suffix(".cpp")


@cache
def parts() -> ctypes.CDLL:
    """Return the library of ``parts.cpp``; tests are skipped where nothing can compile it."""
    name = "gcc" if shutil.which("g++") else "clang" if find_spec("ziglang") else ""
    if not name:
        pytest.skip("no C++20 compiler was found")
    with TemporaryDirectory() as folder:
        # A library that is open needs its file no more.
        loaded = ctypes.CDLL(str(compile_one(name, SOURCE, Path(folder, "parts.so"))))
    loaded.part_attempt_uniform.restype = ctypes.c_double
    for name in ("events", "running", "later", "whole_ns", "ceil_ns", "last_ns", "key"):
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
