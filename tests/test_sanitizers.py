"""The kernel's tests with a kernel that AddressSanitizer and UBSan watch."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from tests.kernels.compilers import copy_package, needs_gcc, run_with

#: Without the optimiser, which would fold what is undefined, and takes a minute here.
OPTIONS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-O0", "-g")
#: The kernel's tests, but for those that compile for themselves.
WATCHED = ("tests/kernels", "--ignore=tests/kernels/test_elementary.py")


@needs_gcc
def test_the_kernel_reads_and_writes_what_it_may_and_nothing_is_undefined(tmp_path: Path) -> None:
    package = copy_package(tmp_path, "gcc", OPTIONS)
    runtime = subprocess.run(
        ["g++", "-print-file-name=libasan.so"], check=True, capture_output=True, text=True
    )
    variables = {
        "LD_PRELOAD": os.path.realpath(runtime.stdout.strip()),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python's own
    }
    results = run_with(package, "-m", "tests.kernels.results", **variables)
    assert results.returncode == 0, results.stderr
    assert OPTIONS[0] in results.stdout
    # What a sanitizer reports is not for pytest to keep.
    pytest = ("-m", "pytest", "-p", "no:cacheprovider", "--capture=sys")
    tests = run_with(package, *pytest, *WATCHED, **variables)
    assert tests.returncode == 0, tests.stdout + tests.stderr
