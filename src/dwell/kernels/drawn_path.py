"""Paths of random processes, a value a cycle: drawn as far as they are asked for."""

from __future__ import annotations

import ctypes
import math
from abc import ABC, abstractmethod
from ctypes import c_double, c_int64, c_uint64, c_void_p
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.library import library
from dwell.model import AR1, Constant, LogNormal, Normal, Process, Uniform

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

#: Cycles at a time: what NumPy draws of a path stays in the second-level cache.
BLOCK: Final = 65536

CONSTANT, UNIFORM, NORMAL, LOGNORMAL = range(4)


def path_of(process: Process, rng: np.random.Generator, *, independent: bool = False) -> Path:
    """Return the path that a process takes on a random stream, from the stream's present state.

    Parameters
    ----------
    process : Process
        Not a trace, whose rows belong to cycles (see `ReplayedPath`).
    rng : Generator
        With bits of SFC64; with others, values of an AR(1) process are independent.
    independent : bool
        Whether values of an AR(1) process are drawn without its memory.
    """
    if isinstance(process, AR1) and independent:
        process = LogNormal(process.mean, process.cv)
    row = _row(process)
    if row is not None and isinstance(rng.bit_generator, np.random.SFC64):
        return DrawnPath(row, rng.bit_generator)
    return SampledPath(process, rng)


def independent(process: Process) -> bool:
    """Whether a process has no memory, so that any values of a path do for any cycles."""
    return not isinstance(process, AR1)


class Path(ABC):
    """Values of one process, in order; each call goes on where the one before ended."""

    @abstractmethod
    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""

    def fill_ns(self, out: Ints, factors: Floats | None = None) -> None:
        """Fill an array with the next values, milliseconds, in whole nanoseconds.

        Parameters
        ----------
        out : int64 array, shape (n,)
        factors : float64 array, shape (n,), optional
            What the values are multiplied by before they are rounded.
        """
        ms = self.values(len(out))
        _functions().dwell_round_ns(ms, len(out), _pointer(factors), out)


class SampledPath(Path):
    """Independent values of a process, by its own `marginal`."""

    def __init__(self, process: Process, rng: np.random.Generator) -> None:
        self.process, self.rng = process, rng

    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""
        return np.ascontiguousarray(self.process.marginal(self.rng, count), np.float64)


class ReplayedPath(Path):
    """Values of a trace in the order in which a run replays its rows."""

    def __init__(self, recorded: Floats, rows: Ints) -> None:
        self.recorded, self.rows, self.taken = recorded, rows, 0

    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""
        rows = self.rows[self.taken : self.taken + count]
        self.taken += count
        return self.recorded[rows]


class PickedPath(Path):
    """Some cycles of a path that is drawn for every cycle: all at once.

    Parameters
    ----------
    path : Path
    cycles : int
        Cycles of the whole path.
    picked : int64 array
        The cycles that are asked for.
    """

    def __init__(self, path: Path, cycles: int, picked: Ints) -> None:
        self.path, self.cycles, self.picked = path, cycles, picked

    def values(self, count: int) -> Floats:
        """Return the values of the cycles that are picked, which the caller may change."""
        if count != len(self.picked):
            raise ValueError(f"{count} values are not those of {len(self.picked)} cycles")
        return self.path.values(self.cycles)[self.picked]


class _DrawnPath(ctypes.Structure):
    """A path and how far it is drawn; ``draw.cpp`` has the same struct, and says what is what."""

    _fields_ = (
        ("stream", c_uint64 * 4),
        ("kind", c_int64),
        ("location", c_double),
        ("spread", c_double),
        ("least", c_double),
        ("correlation", c_double),
        ("gain", c_double),
        ("last", c_double),
    )


class DrawnPath(Path):
    """A path that compiled code draws: its numbers are those that NumPy draws from the stream."""

    def __init__(self, row: _DrawnPath, bits: np.random.SFC64) -> None:
        row.stream[:] = bits.state["state"]["state"].tolist()
        self._row = row

    def values(self, count: int) -> Floats:
        """Return the next values, which the caller may change."""
        out = np.empty(count)
        _functions().dwell_draw(self._row, count, out)
        return out

    def fill_ns(self, out: Ints, factors: Floats | None = None) -> None:
        """Fill an array with the next values, milliseconds, in whole nanoseconds (see `Path`)."""
        _functions().dwell_draw_ns(self._row, len(out), _pointer(factors), out)


def _row(process: Process) -> _DrawnPath | None:
    """Return what compiled code needs of a process; None where only NumPy draws it."""
    match process:
        case Constant():
            return _DrawnPath(kind=CONSTANT, location=process.value)
        case Uniform():
            return _DrawnPath(kind=UNIFORM, location=process.low, spread=process.high - process.low)
        case Normal():
            return _DrawnPath(
                kind=NORMAL, location=process.mean, spread=process.std, least=process.min
            )
        case LogNormal():
            return _logarithm(process)
        case AR1():
            row, r = _logarithm(process), process.log_correlation
            row.correlation, row.gain, row.last = r, math.sqrt(1 - r * r), math.nan
            return row
        case _:
            return None


def _logarithm(process: LogNormal | AR1) -> _DrawnPath:
    mu, sigma = LogNormal(process.mean, process.cv).log_parameters
    # All smaller ones are 0 ns, too, and an exponential of ours is exact from -700 on.
    return _DrawnPath(kind=LOGNORMAL, location=max(mu, -600.0), spread=sigma)


def _pointer(factors: Floats | None) -> object:
    return None if factors is None else factors.ctypes


@cache
def _functions() -> ctypes.CDLL:
    """Return the library; its functions refuse arrays of another type, or not in one piece."""
    kernel = library()
    path = ctypes.POINTER(_DrawnPath)
    ns = np.ctypeslib.ndpointer(np.int64, ndim=1, flags=("C_CONTIGUOUS", "WRITEABLE"))
    values = np.ctypeslib.ndpointer(np.float64, ndim=1, flags="C_CONTIGUOUS")
    kernel.dwell_draw.argtypes = [path, c_int64, values]
    kernel.dwell_draw_ns.argtypes = [path, c_int64, c_void_p, ns]
    kernel.dwell_round_ns.argtypes = [values, c_int64, c_void_p, ns]
    for function in (kernel.dwell_draw, kernel.dwell_draw_ns, kernel.dwell_round_ns):
        function.restype = None
    return kernel
