"""Paths of random processes, one value per cycle, sampled on demand."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from ctypes import byref, c_int64, c_void_p
from typing import Final

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.rows import FLOATS_IN, INTS_OUT, structs
from dwell.model import AR1, Constant, LogNormal, Normal, Process, Uniform
from dwell.model.number_arrays import Floats, Ints

#: Cycles per block; the NumPy samples of a block fit in the second-level cache.
BLOCK: Final = 65536

CONSTANT, UNIFORM, NORMAL, LOGNORMAL = range(4)


def path_of(process: Process, rng: np.random.Generator, *, independent: bool = False) -> Path:
    """Return the path of a process on a random stream, from the current state of the stream.

    Parameters
    ----------
    process : Process
        Any process except a trace (see `ReplayedPath`).
    rng : Generator
        With an SFC64 bit generator; with others, values of an AR(1) process are independent.
    independent : bool
        Whether to sample an AR(1) process without its correlation.
    """
    if isinstance(process, AR1) and independent:
        process = LogNormal(process.mean, process.cv)
    row = _row(process)
    if row is not None and isinstance(rng.bit_generator, np.random.SFC64):
        return DrawnPath(row, rng.bit_generator)
    return SampledPath(process, rng)


def independent(process: Process) -> bool:
    """Whether a process has no memory; its values are then exchangeable between cycles."""
    return not isinstance(process, AR1)


class Path(ABC):
    """Values of one process, in order; each call continues after the previous call."""

    @abstractmethod
    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""

    def fill_ns(self, out: Ints, factors: Floats | None = None) -> None:
        """Fill an array with the next values, converted from ms to integer ns.

        Both arrays have the shape (n,). Values are multiplied by `factors` before they are rounded.
        """
        ms = self.values(len(out))
        _round_ns()(ms, len(out), _pointer(factors), out)


class SampledPath(Path):
    """Independent values of a process, sampled by its method `marginal`."""

    def __init__(self, process: Process, rng: np.random.Generator) -> None:
        self.process, self.rng = process, rng

    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""
        return np.ascontiguousarray(self.process.marginal(self.rng, count), np.float64)


class ReplayedPath(Path):
    """Known values, of a trace or of a complete path, selected by rows."""

    def __init__(self, known: Floats, rows: Ints) -> None:
        self.known, self.rows, self.taken = known, rows, 0

    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""
        rows = self.rows[self.taken : self.taken + count]
        self.taken += count
        return self.known[rows]


class DrawnPath(Path):
    """A path that compiled code samples, with the same random numbers as NumPy."""

    def __init__(self, row: Mapping[str, float], bits: np.random.SFC64) -> None:
        self._row = structs()["DrawnPath"](**row)
        self._row.stream[:] = bits.state["state"]["state"].tolist()

    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""
        out = np.empty(count)
        _draw()(byref(self._row), count, out)
        return out

    def fill_ns(self, out: Ints, factors: Floats | None = None) -> None:
        """Fill an array with the next values, converted from ms to integer ns (see `Path`)."""
        _draw_ns()(byref(self._row), len(out), _pointer(factors), out)


def _row(process: Process) -> dict[str, float] | None:
    """Return the parameters of a process for compiled code; None if only NumPy can sample it."""
    match process:
        case Constant():
            return {"kind": CONSTANT, "location": process.value}
        case Uniform():
            return {"kind": UNIFORM, "location": process.low, "spread": process.high - process.low}
        case Normal(mean, std, least):
            return {"kind": NORMAL, "location": mean, "spread": std, "least": least}
        case LogNormal():
            return _logarithm(process)
        case AR1():
            r = process.log_correlation
            memory = {"correlation": r, "gain": math.sqrt(1 - r * r), "last": math.nan}
            return _logarithm(process) | memory
        case _:
            return None


def _logarithm(process: LogNormal | AR1) -> dict[str, float]:
    mu, sigma = process.log_parameters
    # Values below e^-600 ms round to 0 ns; the kernel's exponential needs arguments from -700 on.
    return {"kind": LOGNORMAL, "location": max(mu, -600.0), "spread": sigma}


def _pointer(factors: Floats | None) -> object:
    return None if factors is None else factors.ctypes


_draw = foreign("dwell_draw", None, c_void_p, c_int64, FLOATS_IN)
_draw_ns = foreign("dwell_draw_ns", None, c_void_p, c_int64, c_void_p, INTS_OUT)
_round_ns = foreign("dwell_round_ns", None, FLOATS_IN, c_int64, c_void_p, INTS_OUT)
