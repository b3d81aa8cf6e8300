"""The same numbers on every processor: those that runs depend on, where libm and NumPy differ."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hatch_build
from tests.kernels.compilers import ROOT

KERNELS = hatch_build.KERNELS
SOURCES = (ROOT / "tests" / "kernels" / "digests.cpp", KERNELS / "draw.cpp")
#: Compiles for another processor, and runs what was compiled.
CROSS, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"

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
    control: str, variable: str, value: str
) -> None:
    here, older = digests(), digests(**{variable: value})
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
