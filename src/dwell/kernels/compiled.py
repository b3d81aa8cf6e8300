"""How kernels are compiled: ahead of nothing, cached on disk, no fast-math, no parallelism.

Without Numba they are the same code as plain Python. That is for what draws a scenario's changes
where a cell runs live, some numbers in a run; the simulator asks for Numba itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

# Numba's own types know neither the flags below nor its configuration.
njit: Any
config: Any
try:
    from numba import config, njit
except ModuleNotFoundError:
    config = None

#: Whether kernels are compiled; NUMBA_DISABLE_JIT=1 runs the same code as plain Python.
COMPILED: bool = config is not None and not config.DISABLE_JIT

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T", bound=np.generic)


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile an entry point that Python calls; its machine code is cached on disk.

    Numba throws cached code away when the file of the entry point changes, but not when one that
    it inlines from does. It also writes the index before the code: a process that dies in between,
    or one that reads then, would take the old code for the new. So the sources of all kernels and
    the processor are part of the files' names, and no version ever finds another's code. Where no
    folder can hold the cache, every process compiles for itself.
    """
    if not COMPILED:
        return function
    from dwell.kernels.cache_name import cache_suffix, fingerprint

    options: dict[str, Any] = {"error_model": "numpy", "_nrt": False}
    try:
        compiled = njit(cache=True, **options)(function)
    except RuntimeError:
        return cast(Callable[P, R], njit(**options)(function))
    cache, stamp = compiled._cache, fingerprint()
    name = f"{cache._impl.filename_base}.{cache_suffix()}"
    file = cache._cache_file
    cache._cache_file = type(file)(cache.cache_path, name, (file._source_stamp, stamp))
    return cast(Callable[P, R], compiled)


def phase(function: Callable[P, R]) -> Callable[P, R]:
    """Compile one phase of a kernel into its caller (inlined by LLVM)."""
    if not COMPILED:
        return function
    compiled = njit(
        error_model="numpy",
        forceinline=True,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        _nrt=False,
    )(function)
    return cast(Callable[P, R], compiled)


def fixed_columns(table: NDArray[T], columns: int) -> NDArray[T]:
    """View a table as one whose number of columns the compiler knows.

    An element's address is then computed with constants instead of a length that must be loaded.
    """
    return table


def index(row: int) -> int:
    """Promise that a row number is not negative.

    Compiled code must otherwise look at the sign of every index, because a negative one counts
    from the end; the kernels have none.
    """
    return row


if COMPILED:
    from numba import types
    from numba.extending import intrinsic
    from numba.np.arrayobj import make_array, populate_array

    @intrinsic
    def _unsigned(_context: Any, row: Any) -> Any:
        def lower(_context: Any, _builder: Any, _signature: Any, arguments: Any) -> Any:
            return arguments[0]

        return types.uint64(types.int64), lower

    @intrinsic(prefer_literal=True)
    def _fixed_view(_context: Any, table: Any, columns: Any) -> Any:
        """The same array with its number of columns, and its strides, as constants."""

        def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            array_type = signature.args[0]
            make = cast(Any, make_array)(array_type)
            old, new = make(context, builder, value=arguments[0]), make(context, builder)
            itemsize = context.get_abi_sizeof(context.get_data_type(array_type.dtype))
            word, width = types.intp, columns.literal_value
            rows = builder.extract_value(old.shape, 0)
            cast(Any, populate_array)(
                new,
                data=old.data,
                shape=[rows, context.get_constant(word, width)],
                strides=[
                    context.get_constant(word, width * itemsize),
                    context.get_constant(word, itemsize),
                ],
                itemsize=context.get_constant(word, itemsize),
                meminfo=None,
            )
            return new._getvalue()

        return table(table, columns), lower

    fixed_columns = _fixed_view  # type: ignore[assignment]
    index = _unsigned  # type: ignore[assignment]
