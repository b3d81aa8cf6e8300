"""The cache of compiled kernels: stale machine code must never run."""

from __future__ import annotations

import pytest

from dwell.kernels import cache_name, compiled
from dwell.kernels.advance import advance


@pytest.mark.skipif(not compiled.COMPILED, reason="kernels are not compiled (NUMBA_DISABLE_JIT)")
def test_the_cache_of_a_kernel_carries_the_fingerprint() -> None:
    stamp = advance._cache._cache_file._source_stamp  # type: ignore[attr-defined]
    assert stamp[1] == cache_name.fingerprint()
