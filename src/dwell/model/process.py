"""Random processes of durations, which a cell file may have in place of a number.

Each process is a frozen description with a stationary marginal distribution. ``marginal`` draws
independent values of it; drawing a *path* (with an ``ar1`` process's memory, or a trace replayed
in order) is the simulator's business.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Context, Decimal
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

from dwell.errors import Fault, TraceError
from dwell.model.bounds import LARGEST, VALUE, Bound, counted, require
from dwell.model.declaration import declared, key
from dwell.model.frozen import shortened

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dwell.model.number_arrays import Floats


# One nanosecond, in milliseconds.
NS = 1e-6

# Logarithms and exponentials of parameters: libm's last bit depends on the processor.
EXACT = Context(prec=40)

MEAN, CV = Bound(0, LARGEST, above=True), Bound(0, 100)
SPREAD = "Coefficient of variation: standard deviation / mean."


@runtime_checkable
class Process(Protocol):
    """A stationary random process with non-negative values (milliseconds, or a bare factor)."""

    @property
    def expectation(self) -> float:
        """Mean of the marginal distribution."""
        ...

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values of the marginal distribution."""
        ...


@declared()
class Constant:
    """Always the same value."""

    value: float = key("Always this value.", VALUE, named="constant")

    @property
    def expectation(self) -> float:
        """The value."""
        return self.value

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Return `size` copies; draws nothing from `rng`."""
        import numpy as np

        return np.full(size, self.value)


@declared("uniform")
class Uniform:
    """Uniform on [low, high]."""

    low: float = key("Smallest value.", VALUE)
    high: float = key("Largest value, at least `low`.", VALUE)

    def __post_init__(self) -> None:
        require(self.high >= self.low, "uniform.high", self.high, f"at least low = {self.low:g}")

    @property
    def expectation(self) -> float:
        """Midpoint of the interval."""
        return (self.low + self.high) / 2

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values."""
        return rng.uniform(self.low, self.high, size)


@declared("normal")
class Normal:
    """Gaussian, clipped from below at `min` (the clipped mass sits on `min`)."""

    mean: float = key("Mean before clipping.", Bound(-LARGEST, LARGEST))
    std: float = key("Standard deviation before clipping.", VALUE)
    min: float = key("What smaller values are raised to.", VALUE, default=0.0)

    @property
    def expectation(self) -> float:
        """Mean after clipping."""
        if self.std == 0:
            return max(self.mean, self.min)
        z, least = (self.min - self.mean) / self.std, max(self.mean, self.min)
        if abs(z) > 9:
            return least
        density = float(EXACT.exp(Decimal(-0.5 * z * z))) / math.sqrt(2 * math.pi)
        # Phi(z) - 1/2 = phi(z) (z + z^3 / 3 + z^5 / (3 5) + ...): 150 terms are enough up to 9.
        series = 0.0
        for odd in range(301, 0, -2):
            series = (z * z * series + 1) / odd
        below = 0.5 + density * z * series
        return max(self.min * below + self.mean * (1 - below) + self.std * density, least)

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values."""
        import numpy as np

        values = rng.standard_normal(size)
        values *= self.std
        values += self.mean
        return np.maximum(values, self.min, out=values)


class _ByMean:
    """A process that is declared by its mean."""

    __slots__ = ()
    mean: float

    @property
    def expectation(self) -> float:
        """The mean."""
        return self.mean


class _ByLogarithm(_ByMean):
    """A process whose values have a normal logarithm."""

    __slots__ = ()
    cv: float

    @property
    def log_parameters(self) -> tuple[float, float]:
        """Mean and standard deviation of the logarithm."""
        return _log_parameters(self.mean, self.cv)


@declared("lognormal")
class LogNormal(_ByLogarithm):
    """Lognormal with the mean and coefficient of variation of the value itself, not of its log."""

    mean: float = key("Mean.", MEAN)
    cv: float = key(SPREAD, CV)

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values."""
        import numpy as np

        mu, sigma = self.log_parameters
        values = rng.standard_normal(size)
        values *= sigma
        values += mu
        return np.exp(values, out=values)


@declared("gamma")
class Gamma(_ByMean):
    """Gamma with the given mean and coefficient of variation."""

    mean: float = key("Mean.", MEAN)
    cv: float = key(SPREAD, Bound(1e-6, 100))

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values."""
        shape = 1 / (self.cv * self.cv)
        return rng.gamma(shape, self.mean / shape, size)


@declared("exponential")
class Exponential(_ByMean):
    """Exponential with the given mean."""

    mean: float = key("Mean.", MEAN)

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values."""
        return rng.exponential(self.mean, size)


@declared("ar1")
class AR1(_ByLogarithm):
    """Positive first-order autoregression: lognormal marginal, lag-1 correlation `rho`.

    The logarithm is a Gaussian AR(1) process. Its correlation r gives the *value* (not the
    logarithm) exactly the declared mean, coefficient of variation and correlation: for a
    lognormal pair, corr = (exp(r s^2) - 1) / (exp(s^2) - 1), so
    r = log(1 + rho cv^2) / s^2 with s^2 = log(1 + cv^2).
    """

    mean: float = key("Mean.", MEAN)
    cv: float = key(SPREAD, CV)
    rho: float = key(
        "Correlation of a cycle's value with the previous value.",
        Bound(-1, 1, above=True, below=True),
    )

    def __post_init__(self) -> None:
        # As r > -1, where r is the correlation of the logarithm.
        reachable = 1 + self.rho * (1 + self.cv * self.cv) > 0
        require(
            reachable, "ar1.rho", self.rho, f"reachable by a positive process of cv {self.cv:g}"
        )

    @property
    def log_correlation(self) -> float:
        """Lag-1 correlation of the logarithm."""
        return _log_correlation(self.cv, self.rho)

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` independent values (without the memory)."""
        return LogNormal(self.mean, self.cv).marginal(rng, size)


@lru_cache(maxsize=4096)
def _log_parameters(mean: float, cv: float) -> tuple[float, float]:
    variance = _log1p(cv * cv)
    return float(EXACT.ln(Decimal(mean))) - variance / 2, math.sqrt(variance)


@lru_cache(maxsize=4096)
def _log_correlation(cv: float, rho: float) -> float:
    if cv < 1e-8:  # the limit; below it, cv^2 leaves the floating-point numbers
        return rho
    square = cv * cv
    return max(_log1p(rho * square) / _log1p(square), -1.0)


def _log1p(x: float) -> float:
    """Return log(1 + x), correctly rounded."""
    return float(EXACT.ln(EXACT.add(1, Decimal(x)))) if abs(x) > 1e-16 else x


def _one_group() -> NDArray[np.int64]:
    """Return the first rows of the groups of a file that is not grouped."""
    import numpy as np

    return np.zeros(1, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class TraceTable:
    """Columns of one file of measurements; every process that names the file shares its rows.

    Tables with equal contents and equal replay are equal.

    Parameters
    ----------
    file : str
        As written in the cell file; also the name in messages.
    columns : mapping of str to array of float64, shape (rows,)
        The columns that some process of the cell uses.
    by : {"row", "time"}
        Whether a cycle takes the next row, or the latest row sent at or before its release.
    starts : array of int64
        First row of every group, ascending, from 0; one group where the file is not grouped.
    time_ms : array of float64, shape (rows,), optional
        Instant of each row since its group's first, ascending; needed by ``by: time``.
    wrap : bool
        Whether replay continues with the first row after the last.
    group : str or tuple of str, optional
        Columns whose values make a group.
    on_negative, time
        As written in the cell file.
    dropped : int
        Rows left out by ``on_negative: drop``, or clipped by ``clip``.
    """

    file: str
    columns: dict[str, Floats]
    by: Literal["row", "time"] = "row"
    starts: NDArray[np.int64] = field(default_factory=_one_group)
    time_ms: Floats | None = None
    wrap: bool = False
    group: str | tuple[str, ...] | None = None
    on_negative: Literal["error", "drop", "clip"] = "error"
    time: str | None = None
    dropped: int = 0

    def __post_init__(self) -> None:
        lengths = {len(column) for column in self.columns.values()}
        if self.time_ms is not None:
            lengths.add(len(self.time_ms))
        if len(lengths) != 1 or 0 in lengths:
            raise TraceError([Fault(self.file, "needs columns of one length, at least one row")])
        if self.by == "time" and self.time_ms is None:
            raise TraceError([Fault(self.file, "has no instants; `by: time` needs a time column")])

    def __repr__(self) -> str:
        columns = shortened(self.columns)
        return f"<TraceTable {self.file!r}: {counted(self.rows, 'row')} of {columns}; by {self.by}>"

    def __eq__(self, other: object) -> bool:
        import numpy as np

        if self is other:
            return True
        if not isinstance(other, TraceTable) or self._declared != other._declared:
            return False
        return all(map(np.array_equal, self._arrays, other._arrays))

    def __hash__(self) -> int:
        return hash(self._declared)

    @property
    def _arrays(self) -> list[NDArray[Any]]:
        time_ms = () if self.time_ms is None else (self.time_ms,)
        return [self.starts, *time_ms, *(self.columns[name] for name in sorted(self.columns))]

    @property
    def _declared(self) -> tuple[object, ...]:
        replayed = (self.file, self.by, self.group, self.time, self.on_negative, self.wrap)
        return (*replayed, self.rows, self.time_ms is None, frozenset(self.columns))

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))

    @property
    def stream(self) -> str:
        """Name of the streams that rows of it are drawn from: the file as written.

        Only the last part of an absolute path counts: a run does not depend on the folder of its
        files.
        """
        return self.file.rpartition("/")[2] if self.file.startswith("/") else self.file

    def replay(
        self, rng: np.random.Generator, release_ms: Floats, *, wraps: bool = False
    ) -> NDArray[np.int64]:
        """Rows that cycles released at `release_ms` take, from a random start.

        Without ``wrap`` the start is drawn from those after which enough rows (or enough time)
        remain in the same group; with `wraps` as if it had ``wrap``.

        Raises
        ------
        TraceError
            If no group is long enough and the trace does not wrap.
        """
        import numpy as np

        ends, time_ms = np.append(self.starts[1:], self.rows), self.time_ms
        wraps = wraps or self.wrap
        if self.by == "row" or time_ms is None:
            return self._replay_rows(rng, len(release_ms), ends, wraps)
        elapsed_ms = release_ms - release_ms[0]
        spans = time_ms[ends - 1]
        if wraps:
            counts = ends - self.starts
            lengths = _lasting_ms(spans, counts)
            total = float(lengths.sum())
            if total == 0:  # every row has the same instant: their order is all there is
                return self._replay_rows(rng, len(elapsed_ms), np.array([self.rows]), True)
            begin = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))
            instants = np.repeat(begin, counts) + time_ms
            phase = (rng.uniform(0, total) + elapsed_ms) % total
            return np.asarray(np.searchsorted(instants, phase, side="right") - 1, np.int64)
        needs = float(elapsed_ms[-1])
        # Releases are whole nanoseconds: a trace that ends within one of them is long enough.
        long_enough = spans + NS >= needs
        if not long_enough.any():
            raise self._too_short(f"{spans.max() / 1e3:.6g} s", f"{needs / 1e3:.6g} s")
        slack = np.maximum(spans - needs, 0)
        before = np.cumsum(slack)
        if before[-1] > 0:
            pick = rng.uniform(0, before[-1])
            last = int(np.flatnonzero(slack)[-1])
            group = min(int(np.searchsorted(before, pick, side="right")), last)
            offset = min(max(pick - float(before[group] - slack[group]), 0.0), float(slack[group]))
        else:
            group, offset = int(rng.choice(np.flatnonzero(long_enough))), 0.0
        rows = slice(int(self.starts[group]), int(ends[group]))
        inside = np.searchsorted(time_ms[rows], offset + elapsed_ms, side="right") - 1
        return np.asarray(inside + int(self.starts[group]), np.int64)

    def _replay_rows(
        self, rng: np.random.Generator, cycles: int, ends: NDArray[np.int64], wraps: bool
    ) -> NDArray[np.int64]:
        import numpy as np

        if wraps:
            # The complete file is one loop: every row is used, and groups keep their order.
            return (rng.integers(self.rows) + np.arange(cycles)) % self.rows
        slack = np.maximum(ends - self.starts - cycles + 1, 0)
        before = np.cumsum(slack)
        if before[-1] == 0:
            longest = int((ends - self.starts).max())
            raise self._too_short(counted(longest, "row"), counted(cycles, "cycle"))
        pick = int(rng.integers(before[-1]))
        group = int(np.searchsorted(before, pick, side="right"))
        first = int(self.starts[group]) + pick - int(before[group] - slack[group])
        return np.arange(first, first + cycles)

    def loop_cycles(self, period_ms: float) -> float:
        """Return the number of cycles after which a replay that wraps is back at its start."""
        import numpy as np

        if self.by == "row" or self.time_ms is None:
            return float(self.rows)
        ends = np.append(self.starts[1:], self.rows)
        total_ms = float(_lasting_ms(self.time_ms[ends - 1], ends - self.starts).sum())
        return total_ms / period_ms if total_ms else float(self.rows)

    def _too_short(self, has: str, needs: str) -> TraceError:
        where = "longest group" if len(self.starts) > 1 else "trace"
        return TraceError(
            [
                Fault(
                    self.file,
                    f"the {where} has {has} but the run needs {needs}, and wrap is false; "
                    "ask for fewer windows, or set `wrap: true` to go on from its beginning",
                )
            ]
        )


def _lasting_ms(spans: Floats, counts: NDArray[np.int64]) -> Floats:
    """Return how long groups last: one mean row spacing more than to the last row.

    The spacing is the group's own, or the table's where the group has one row.

    Parameters
    ----------
    spans, counts : array, shape (groups,)
        Instant of each group's last row since its first, milliseconds, and its number of rows.
    """
    import numpy as np

    gaps = counts - 1
    usual = spans.sum() / max(int(gaps.sum()), 1)
    return spans + np.where(gaps > 0, spans / np.maximum(gaps, 1), usual)


@dataclass(frozen=True, slots=True)
class Trace:
    """A recorded column, replayed in order."""

    table: TraceTable
    column: str

    @property
    def values(self) -> Floats:
        """The column, one value per row, milliseconds."""
        return self.table.columns[self.column]

    @property
    def expectation(self) -> float:
        """Mean of the recorded values."""
        return float(self.values.mean())

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Draw `size` recorded values independently."""
        return self.values[rng.integers(self.table.rows, size=size)]


@dataclass(frozen=True, slots=True)
class UnreadTrace:
    """A trace that is named, and whose data were not read: a record or a live node has none.

    Parameters
    ----------
    declaration : mapping of str to object
        As a cell file has it, with the digest of the data.
    """

    declaration: Mapping[str, object]

    @property
    def expectation(self) -> float:
        """Not known.

        Raises
        ------
        TraceError
            Always.
        """
        raise self._unread()

    def marginal(self, rng: np.random.Generator, size: int) -> Floats:
        """Not known.

        Raises
        ------
        TraceError
            Always.
        """
        raise self._unread()

    def _unread(self) -> TraceError:
        message = "a run's record names this trace and has no data of it; load the cell's file"
        return TraceError([Fault(str(self.declaration["file"]), message)])


def require_mean(bound: Bound, path: str, process: Process) -> None:
    """Require the mean of a process to be within a bound; a trace without data passes.

    Raises
    ------
    ProblemError
        If it is outside.
    """
    if not isinstance(process, UnreadTrace):
        mean = process.expectation
        require(bound.holds(mean), path, mean, f"a process whose mean is {bound}")


#: The cell file's words for the processes that are drawn by their parameters, the fields' names.
DRAWN: Mapping[str, type[Process]] = {
    "uniform": Uniform,
    "normal": Normal,
    "lognormal": LogNormal,
    "gamma": Gamma,
    "exponential": Exponential,
    "ar1": AR1,
}
