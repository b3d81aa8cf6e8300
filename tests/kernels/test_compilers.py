"""What the kernel computes does not depend on the compiler."""

from __future__ import annotations

from pathlib import Path

from tests.kernels.compilers import copy_package, needs_clang, needs_gcc, run_with


@needs_gcc
@needs_clang
def test_gcc_and_clang_give_the_same_bytes(tmp_path: Path) -> None:
    compilers, digests = [], []
    for compiler in ("gcc", "clang"):
        package = copy_package(tmp_path / compiler, compiler)
        done = run_with(package, "-m", "tests.kernels.results")
        assert done.returncode == 0, done.stderr
        made_by, digest = done.stdout.splitlines()
        compilers.append(made_by)
        digests.append(digest)
    assert compilers[0] != compilers[1]
    assert digests[0] == digests[1]
