"""How kernels are compiled: ahead of nothing, cached on disk, no fast-math, no parallelism."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

__all__ = ["kernel", "phase"]

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile an entry point that Python calls; its machine code is cached on disk."""
    return cast(Callable[P, R], numba.njit(cache=True, error_model="numpy", _nrt=False)(function))


def phase(function: Callable[P, R]) -> Callable[P, R]:
    """Compile one phase of a kernel into its caller (inlined by LLVM)."""
    compiled = numba.njit(
        error_model="numpy",
        forceinline=True,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        _nrt=False,
    )(function)
    return cast(Callable[P, R], compiled)
