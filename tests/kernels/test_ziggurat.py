"""Standard normals of the kernel: those of NumPy, from the same stream."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np

from tests.kernels.compilers import compile_one, with_every_compiler

SOURCE = Path(__file__).with_name("ziggurat.cpp")
#: From here on a normal is in the tail; the share of normals there.
TAIL, BEYOND = 3.6541528853610088, 2.58e-4


@with_every_compiler
def test_normals_are_those_of_numpy(compiler: str, tmp_path: Path) -> None:
    """Of 2^24, a height decides on some 240,000; 4,300 are in the tail, by other logarithms."""
    function = ctypes.CDLL(str(compile_one(compiler, SOURCE, tmp_path / "normals.so"))).normals
    words = np.ctypeslib.ndpointer(np.uint64, shape=(4,))
    doubles = np.ctypeslib.ndpointer(np.float64, ndim=1, flags="C_CONTIGUOUS")
    function.argtypes, function.restype = [words, ctypes.c_int64, doubles], None
    rng = np.random.Generator(np.random.SFC64(1))
    state = np.array(rng.bit_generator.state["state"]["state"])
    tails = 0
    # Pieces of every length: where one ends, the next goes on.
    for count in (0, 1, 2, 1000, *[2**20 - 1] * 16):
        found, expected = np.empty(count), rng.standard_normal(count)
        function(state, count, found)
        tail = np.abs(expected) > TAIL
        np.testing.assert_array_equal(found[~tail], expected[~tail])
        np.testing.assert_array_max_ulp(found[tail], expected[tail], maxulp=1)
        tails += int(np.count_nonzero(tail))
    assert state.tolist() == rng.bit_generator.state["state"]["state"].tolist()
    assert abs(tails / (16 * 2**20) / BEYOND - 1) < 0.1
