"""The layout of the kernel's tables."""

from __future__ import annotations

import inspect
from typing import Any

from dwell.kernels.advance import advance
from dwell.kernels.layout import Tables


def test_arguments_of_the_kernel_are_the_fields_of_its_tables() -> None:
    function: Any = getattr(advance, "py_func", advance)
    assert tuple(inspect.signature(function).parameters) == Tables._fields
