"""The same numbers on every processor: those that runs depend on, where libm and NumPy differ."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hatch_build
from tests.kernels.compilers import ROOT

KERNELS = hatch_build.KERNELS
SOURCES = (ROOT / "tests" / "kernels" / "digests.cpp", KERNELS / "draw.cpp")
#: Compiles for another processor, and runs what was compiled.
CROSS, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"

#: Packages that draw, estimate and decide.
DECIDING = ("control", "cost.py", "estimators", "kernels", "model", "policies", "sim")
#: Functions whose last bit depends on the processor; `math.hypot` is CPython's own.
OF_LIBM = {
    *("acos", "arccos", "arcsin", "arctan", "arctan2", "asin", "atan", "atan2", "cbrt", "cos"),
    *("cosh", "erf", "erfc", "exp", "exp2", "expm1", "float_power", "gamma", "lgamma", "log"),
    *("log10", "log1p", "log2", "logaddexp", "pow", "power", "sin", "sinh", "tan", "tanh"),
}
#: Their uses that reach no draw of the simulator, no estimate and no decision: the digits of a
#: message, draws of a live cell's links, a warning, and the windows of `check_policy`.
HARMLESS = {
    ("model/bounds.py", "math.log10"),
    ("model/process.py", "np.exp"),
    ("estimators/cell_warnings.py", "math.atan2"),
    ("policies/check.py", "math.exp"),
}

#: Hides from glibc what newer processors have.
WITHOUT_FMA = "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-AVX512F,-FMA,-FMA4,-FMA_Usable"
#: Numbers that depend on the processor, and show that hiding works.
CONTROLS = ("libm", "numpy")


def digests(**variables: str) -> dict[str, str]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.same_numbers"],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **variables},
    )
    return dict(line.split() for line in done.stdout.splitlines())


@pytest.fixture(scope="module")
def here() -> dict[str, str]:
    return digests()


def numpy_features() -> str:
    """Return what NumPy uses of this processor beyond what all have."""
    config = np.show_config(mode="dicts")
    assert config is not None
    return " ".join(config["SIMD Extensions"]["found"])


@pytest.mark.parametrize(
    ("control", "variable", "value"),
    [
        ("libm", "GLIBC_TUNABLES", WITHOUT_FMA),
        ("numpy", "NPY_DISABLE_CPU_FEATURES", numpy_features()),
    ],
)
def test_numbers_that_runs_depend_on_are_the_same_on_an_older_processor(
    here: dict[str, str], control: str, variable: str, value: str
) -> None:
    older = digests(**{variable: value})
    if here[control] == older[control]:
        pytest.skip(f"{variable} changes nothing on this processor")
    for name in here.keys() - set(CONTROLS):
        assert here[name] == older[name], name


@pytest.mark.skipif(
    not all(map(shutil.which, ("g++", CROSS, EMULATOR))),
    reason=f"g++, {CROSS} or {EMULATOR} is not installed",
)
def test_functions_and_draws_of_the_kernel_are_the_same_on_x86_64_and_aarch64(
    tmp_path: Path,
) -> None:
    flags = (KERNELS / "compile_flags.txt").read_text(encoding="utf-8").split()

    def printed(compiler: str, *emulator: str) -> str:
        program = tmp_path / compiler
        options = [*flags, "-Werror", "-static", f"-I{KERNELS}", *map(str, SOURCES)]
        subprocess.run([compiler, *options, "-o", str(program)], check=True)
        done = subprocess.run([*emulator, program], check=True, capture_output=True, text=True)
        return done.stdout

    here, there = printed("g++"), printed(CROSS, EMULATOR)
    assert len(here.splitlines()) == 10
    assert here == there


def libm_in(tree: ast.AST) -> Iterator[str]:
    """Yield what a source takes from libm or BLAS: functions, powers of variables, products."""
    for node in ast.walk(tree):
        match node:
            # A generator's `gamma` is a distribution.
            case ast.Attribute(value=ast.Name(id="math" | "np"), attr=name) if name in OF_LIBM:
                yield ast.unparse(node)
            case ast.Attribute(value=ast.Name(id="np"), attr="dot" | "einsum" | "hypot" | "linalg"):
                yield ast.unparse(node)
            case ast.BinOp(op=ast.Pow(), left=base) if not isinstance(base, ast.Constant):
                yield ast.unparse(node)
            case ast.BinOp(op=ast.MatMult()):
                yield ast.unparse(node)


def test_nothing_that_decides_takes_from_libm() -> None:
    """`x**2` is libm's `pow`, which differs from `x * x` in one of a thousand numbers."""
    sources = ROOT / "src" / "dwell"
    files = [sources / name for name in DECIDING]
    found = {
        (str(path.relative_to(sources)), name)
        for file in files
        for path in (file.rglob("*.py") if file.is_dir() else [file])
        for name in libm_in(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert found == HARMLESS
