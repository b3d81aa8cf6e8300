"""What the kernel computes does not depend on the compiler."""

from __future__ import annotations

from pathlib import Path

from tests.kernels.compilers import copy_package, needs_clang, needs_gcc, run_with


@needs_gcc
@needs_clang
def test_gcc_and_clang_give_the_same_bytes(tmp_path: Path) -> None:
    found = {}
    for compiler in ("gcc", "clang"):
        package = copy_package(tmp_path / compiler, compiler)
        done = run_with(package, "-m", "tests.kernels.results")
        assert done.returncode == 0, done.stderr
        made_by, *digests = done.stdout.splitlines()
        found[made_by] = digests
    by_gcc, by_clang = found.values()
    assert by_gcc
    assert by_gcc == by_clang
