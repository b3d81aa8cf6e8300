"""Versions of the software that a run's numbers come from."""

from __future__ import annotations

import platform

import numpy as np

from dwell.kernels import library
from dwell.version import __version__


def versions() -> dict[str, str]:
    """Return the versions by their names; the kernel's are its sources' digest and its compiler.

    Raises
    ------
    KernelError
        If the compiled kernel cannot be used.
    """
    return {
        "dwell": __version__,
        "numpy": np.__version__,
        "kernel": f"{kernel_digest()} {library.compiler()}",
        "python": platform.python_version(),
    }


def kernel_digest() -> str:
    """Return 16 hexadecimal digits of the kernel's sources: they give the same by any compiler."""
    return library.digest()[:16]
