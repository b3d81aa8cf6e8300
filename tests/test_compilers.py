"""What the kernel computes does not depend on the compiler."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.kernels.compilers import ROOT, needs_gcc

#: What `make env` and the kernel's tests need of a checkout.
CHECKOUT = (
    *("Makefile", "README.md", "LICENSE", "pyproject.toml", "hatch_build.py"),
    *("requirements", "src", "lab", "examples", "tests"),
)


@pytest.fixture
def without(tmp_path: Path) -> dict[str, str]:
    """Return the environment of somebody on whose PATH no C++ compiler is."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for place in os.get_exec_path():
        for command in Path(place).glob("*"):
            if "++" not in command.name and not (folder / command.name).exists():
                (folder / command.name).symlink_to(command)
    left_out = ("CXX", "PYTHONPATH", "VIRTUAL_ENV", "MAKEFLAGS", "MAKELEVEL")
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    return {**kept, "PATH": str(folder)}


@needs_gcc
def test_make_env_has_clang_build_the_same_kernel_where_there_is_no_compiler(
    without: dict[str, str], tmp_path: Path
) -> None:
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    unwanted = shutil.ignore_patterns("*.so", "__pycache__")
    for name in CHECKOUT:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, checkout / name, ignore=unwanted)
        else:
            shutil.copy(ROOT / name, checkout)

    def run(*words: str, folder: Path = checkout) -> str:
        done = subprocess.run(
            words, cwd=folder, env=without, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run("make", "env", f"PYTHON={os.path.realpath(sys.executable)}")
    python, results = ".venv/bin/python", ("-m", "tests.kernels.results")
    by_clang, *found = run(python, *results).splitlines()
    by_gcc, *known = run(sys.executable, *results, folder=ROOT).splitlines()
    assert "clang" in by_clang
    assert "clang" not in by_gcc
    assert found == known != []
    # Every test that asks for it.
    words = ("-p", "no:cacheprovider", "-k", "clang or ziglang")
    files = [*ROOT.glob("tests/kernels/test_*.py"), ROOT / "tests" / "test_hatch_build.py"]
    asking = [file for file in files if "compiler" in file.read_text(encoding="utf-8")]
    run(python, "-m", "pytest", *words, *(str(file.relative_to(ROOT)) for file in asking))
