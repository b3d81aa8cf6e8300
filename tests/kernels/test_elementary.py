"""The kernel's elementary functions: how exact they are, and the same bits by every compiler."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.kernels.compilers import compile_one, needs_clang, needs_gcc, with_every_compiler

Floats: TypeAlias = NDArray[np.float64]

SOURCE = Path(__file__).with_name("elementary.cpp")
QUARTER = np.pi / 2
#: Angles up to this are exact to within 1 ulp.
FAR = 1e8


def some_angles() -> dict[str, Floats]:
    rng = np.random.default_rng(1)
    multiples = rng.integers(0, int(FAR / QUARTER), 100_000) * QUARTER
    return {
        "one turn": rng.uniform(-2 * np.pi, 2 * np.pi, 400_000),
        "those of a run": rng.uniform(0, 1e5, 400_000),
        "far ones": rng.uniform(-FAR, FAR, 400_000),
        "small ones": 10.0 ** rng.uniform(-300, 0, 100_000),
        "where one is next to nothing": np.concatenate(
            [np.arange(100_000) * QUARTER, multiples, np.nextafter(multiples, 0.0)]
        ),
    }


def sines_and_cosines(library: Path, angles: Floats) -> tuple[Floats, Floats]:
    function = ctypes.CDLL(str(library)).sines_and_cosines
    doubles = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    function.argtypes = [doubles, ctypes.c_int64, doubles, doubles]
    function.restype = None
    sines, cosines = np.empty_like(angles), np.empty_like(angles)
    function(angles, len(angles), sines, cosines)
    return sines, cosines


def some_exponents() -> Floats:
    rng = np.random.default_rng(2)
    return np.concatenate(
        [
            rng.uniform(-1, 1, 400_000),
            rng.uniform(-40, 60, 400_000),
            rng.uniform(-700, 700, 400_000),
            10.0 ** rng.uniform(-300, 0, 100_000),
            [0.0, -0.0, 700.0, -700.0],
        ]
    )


def some_positive_numbers() -> Floats:
    rng = np.random.default_rng(3)
    return np.concatenate(
        [
            1 - rng.random(400_000),
            1 + np.arange(-1_000, 1_000) * 2.0**-52,
            rng.uniform(0.5, 2, 400_000),
            10.0 ** rng.uniform(-300, 300, 400_000),
            [2.0**-1022, 1.7e308],
        ]
    )


def applied(library: Path, name: str, x: Floats) -> Floats:
    function = getattr(ctypes.CDLL(str(library)), name)
    doubles = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    function.argtypes, function.restype = [doubles, ctypes.c_int64, doubles], None
    out = np.empty_like(x)
    function(x, len(x), out)
    return out


needs_longer_floats = pytest.mark.skipif(
    np.finfo(np.longdouble).nmant < 63, reason="no longer float to compare with"
)


@needs_longer_floats
@with_every_compiler
def test_exponential_logarithm_and_cube_root_are_exact_to_one_ulp(
    compiler: str, tmp_path: Path
) -> None:
    library = compile_one(compiler, SOURCE, tmp_path / "elementary.so")
    for name, function, x, most in (
        ("exponentials", np.exp, some_exponents(), 0.52),
        ("logarithms", np.log, some_positive_numbers(), 1.0),
        ("cube_roots", np.cbrt, some_positive_numbers()[:-1], 0.67),
    ):
        exact = function(x.astype(np.longdouble))
        found = applied(library, name, x)
        ulp = np.spacing(np.abs(exact.astype(np.float64)))
        assert np.abs((found - exact) / ulp).max() < most, name
    assert applied(library, "exponentials", np.zeros(1)) == 1
    assert applied(library, "logarithms", np.ones(1)) == 0
    cubes = np.arange(10_000.0)
    assert np.array_equal(applied(library, "cube_roots", cubes**3), cubes)


@needs_longer_floats
@with_every_compiler
def test_sine_and_cosine_are_exact_to_one_ulp(compiler: str, tmp_path: Path) -> None:
    library = compile_one(compiler, SOURCE, tmp_path / "elementary.so")
    for kind, angles in some_angles().items():
        longer = angles.astype(np.longdouble)
        expected = np.sin(longer), np.cos(longer)
        for found, exact in zip(sines_and_cosines(library, angles), expected, strict=True):
            ulp = np.spacing(np.abs(exact.astype(np.float64)))
            assert np.abs((found - exact) / ulp).max() < 1.0, kind


@with_every_compiler
def test_sine_and_cosine_at_the_ends(compiler: str, tmp_path: Path) -> None:
    library = compile_one(compiler, SOURCE, tmp_path / "elementary.so")
    sines, cosines = sines_and_cosines(library, np.array([0.0, 5e-324, np.nan, np.inf]))
    assert sines[:2].tolist() == [0.0, 5e-324]
    assert cosines[:2].tolist() == [1.0, 1.0]
    assert np.isnan([*sines[2:], *cosines[2:]]).all()


@needs_gcc
@needs_clang
def test_the_bits_are_the_same_by_every_compiler(tmp_path: Path) -> None:
    angles = np.concatenate(list(some_angles().values()))
    by_gcc, by_clang = (
        compile_one(compiler, SOURCE, tmp_path / f"{compiler}.so") for compiler in ("gcc", "clang")
    )
    assert np.array_equal(sines_and_cosines(by_gcc, angles), sines_and_cosines(by_clang, angles))
    for name, x in (
        ("exponentials", some_exponents()),
        ("logarithms", some_positive_numbers()),
        ("cube_roots", some_positive_numbers()[:-1]),
    ):
        assert np.array_equal(applied(by_gcc, name, x), applied(by_clang, name, x))
