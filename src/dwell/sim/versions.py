"""Versions of the software that computes a run."""

from __future__ import annotations

import platform

import numpy as np

from dwell.kernels import library
from dwell.version import __version__


def versions() -> dict[str, str]:
    """Return versions by name; the kernel's version has its compiler and a digest of its sources.

    Raises KernelError if the compiled kernel cannot be used.
    """
    return {
        "dwell": __version__,
        "numpy": np.__version__,
        "kernel": f"{kernel_digest()} {library.compiler()}",
        "python": platform.python_version(),
    }


def kernel_digest() -> str:
    """Return 16 hexadecimal digits of the digest of the kernel's sources."""
    return library.digest()[:16]
