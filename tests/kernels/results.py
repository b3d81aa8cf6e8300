"""Prints a digest of what the kernel computes: the same by every compiler.

``python -m tests.kernels.results``
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from dwell.kernels import library, servo_loop


def servo_loops() -> Iterator[bytes]:
    """Yield the holds and integrals of random loops."""
    rng = np.random.default_rng(7)
    for case in range(200):
        n = int(rng.integers(0, 300))
        released = np.arange(n) * 0.03
        actuated = np.sort(released + rng.exponential(0.04, n))
        plant = (True, 30.0, 8.0) if case % 2 else (False, rng.uniform(1, 60), 0.0)
        states, integrals = np.zeros((n + 1, servo_loop.N_STATE)), np.empty(2)
        stretch = np.minimum(released, actuated), actuated, 0.5, 0.03 * n
        status = servo_loop.follow(*stretch, *plant, 40.0, rng.uniform(1, 9), states, integrals)
        yield bytes([status])
        yield states.tobytes()
        yield integrals.tobytes()


if __name__ == "__main__":
    print(library.compiler())
    print(hashlib.sha256(b"".join(servo_loops())).hexdigest())
