"""Global sensitivity: which parameters a result depends on, over all of their ranges together.

The variance of an output over the ranges of the parameters is parted among them (Sobol 2001, DOI
10.1016/S0378-4754(00)00270-6). The first-order index S1 of a parameter is the share that it makes
alone; its total index ST is the share that goes when it is known together with everything it acts
with. S1 of all sum up to at most 1; ST - S1 is interaction.

Design and estimators are those of Saltelli et al. 2010 (DOI 10.1016/j.cpc.2009.09.018) over a
scrambled Sobol sequence, by SALib. Every point of a design is simulated under the same seeds, and
the mean over them is the output: what differs between two points is then the parameters and not
luck. The intervals are about the sampling of parameters; they say nothing of other seeds.

An output must not contain what is varied. J is made of the weights, so that its sensitivity to a
weight is arithmetic, and tells nothing of the system: take V_D, L95, migrations or the distance to
a reference policy. What an output is made of cannot be seen from its numbers; nothing here checks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.study.intervals import CONFIDENCE, RESAMPLING_SEED, Floats

if TYPE_CHECKING:
    import polars as pl

__all__ = ["RESAMPLES", "Parameter", "sobol_design", "sobol_indices", "sobol_pairs"]

#: Of the bootstrap over the n base points. It estimates a standard deviation, which needs few.
RESAMPLES = 500
#: A range of outputs below this part of their size is rounding.
ROUNDING = 1e-12


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that is varied between two bounds, evenly, or evenly in its logarithm.

    Parameters
    ----------
    name : str
    low, high : float
        Bounds, finite; the upper one is not reached. Whole numbers are the caller's to round, from
        bounds half a step further out.
    log : bool
        Whether factors rather than differences are spread evenly; for bounds above 0.

    Raises
    ------
    SimulationError
        If the bounds are no range; it names all that is wrong.
    """

    name: str
    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        """Check the bounds."""
        faults = []
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            faults.append(f"bounds are {self.low} and {self.high}; they must be finite")
        elif not self.low < self.high:
            faults.append(f"low is {self.low}; it must be below high, {self.high}")
        if self.log and not self.low > 0:
            faults.append(f"low is {self.low}; with log it must be above 0")
        if faults:
            raise SimulationError("\n".join(f"parameter {self.name}: {item}" for item in faults))

    def at(self, share: Floats) -> Floats:
        """Return the values at shares of the range, in [0, 1]."""
        if self.log:
            values: Floats = self.low * (self.high / self.low) ** share
            return values
        return self.low + (self.high - self.low) * share


def sobol_design(
    parameters: Sequence[Parameter], n: int, *, second_order: bool = False, seed: int
) -> Floats:
    """Points at which a model must be evaluated.

    Parameters
    ----------
    parameters : sequence of Parameter
        k of them, with different names.
    n : int
        Base points, a power of two: the sequence is balanced at no other number.
    second_order : bool
        Whether interactions of pairs shall be estimated too (see `sobol_pairs`).
    seed : int
        Of the scrambling.

    Returns
    -------
    float64 array, shape (n · (k + 2), k)
        One row a point; n · (2 k + 2) rows with `second_order`. Their order means something.

    Raises
    ------
    SimulationError
        If there are no parameters, two have one name, `n` is no power of two, or SALib is missing.
    """
    problem = _problem(parameters)
    if n < 2 or n & (n - 1):
        raise SimulationError(f"n is {n}; it must be a power of two, at least 2")
    sample, _ = _salib()
    shares = sample(problem, n, calc_second_order=second_order, scramble=True, seed=seed)
    return np.column_stack(
        [item.at(column) for item, column in zip(parameters, shares.T, strict=True)]
    )


def sobol_indices(
    parameters: Sequence[Parameter],
    outputs: Mapping[str, Floats],
    n: int,
    *,
    seed: int = RESAMPLING_SEED,
) -> pl.DataFrame:
    """First-order and total indices of every output and parameter.

    Parameters
    ----------
    parameters : sequence of Parameter
        Of the design.
    outputs : mapping of str to float array, shape (points,) or (seeds, points)
        By name, finite, in the order of the design's rows; the mean over seeds is analysed.
    n : int
        Base points of the design.
    seed : int
        Of the bootstrap, at least 1.

    Returns
    -------
    DataFrame
        One row an output and parameter: ``output``, ``parameter``, ``S1`` and ``ST`` with the ends
        of their 95 % intervals (``S1_low``, ``S1_high``, ``ST_low``, ``ST_high``; the estimate and
        1.96 standard deviations of a bootstrap over base points, so that small indices may seem to
        be negative), ``n``, ``seeds``, ``evaluations`` (runs: points times seeds), and
        ``insensitive``: the output is the same at every point, but for rounding. Its indices are
        null then. They are null, too, where only the mixed points differ, and n is too small.

    Raises
    ------
    SimulationError
        If an output's shape does not fit the design, it is not finite, or SALib is missing.
    """
    rows: list[dict[str, object]] = []
    for output, item in _analyse(parameters, outputs, n, seed).items():
        for index, parameter in enumerate(parameters):
            row: dict[str, object] = {"output": output, "parameter": parameter.name}
            for name in ("S1", "ST"):
                row |= _limits(name, item, (index,))
            rows.append(row | item.budget(n))
    return _frame(rows, ("output", "parameter"), ("S1", "ST"))


def sobol_pairs(
    parameters: Sequence[Parameter],
    outputs: Mapping[str, Floats],
    n: int,
    *,
    seed: int = RESAMPLING_SEED,
) -> pl.DataFrame:
    """Second-order indices: the share that two parameters make only together.

    Parameters
    ----------
    parameters, outputs, n, seed
        As `sobol_indices` has them, of a design with `second_order`.

    Returns
    -------
    DataFrame
        One row an output and pair: ``output``, ``first``, ``second``, ``S2``, ``S2_low``,
        ``S2_high``, ``n``, ``seeds``, ``evaluations``, ``insensitive``.

    Raises
    ------
    SimulationError
        As `sobol_indices`, and if the design was without `second_order`.
    """
    names = [parameter.name for parameter in parameters]
    rows: list[dict[str, object]] = []
    for output, item in _analyse(parameters, outputs, n, seed).items():
        if item.points == n * (len(names) + 2):
            raise SimulationError(
                f"output {output} has {item.points} points, of a design without second_order; "
                "interactions of pairs need one with it"
            )
        for i, first in enumerate(names):
            for j, second in enumerate(names[i + 1 :], i + 1):
                row: dict[str, object] = {"output": output, "first": first, "second": second}
                rows.append(row | _limits("S2", item, (i, j)) | item.budget(n))
    return _frame(rows, ("output", "first", "second"), ("S2",))


@dataclass(frozen=True, slots=True)
class _Analysis:
    """What SALib found for one output; no indices where it is the same at every point."""

    seeds: int
    points: int
    insensitive: bool
    indices: Mapping[str, Floats] | None

    def budget(self, n: int) -> dict[str, object]:
        return {
            "n": n,
            "seeds": self.seeds,
            "evaluations": self.seeds * self.points,
            "insensitive": self.insensitive,
        }


def _analyse(
    parameters: Sequence[Parameter], outputs: Mapping[str, Floats], n: int, seed: int
) -> dict[str, _Analysis]:
    problem = _problem(parameters)
    if seed < 1:
        # SALib takes 0 for "no seed".
        raise SimulationError(f"seed is {seed}; it must be at least 1")
    _, analyze = _salib()
    found = {}
    for output, values in outputs.items():
        mean, seeds = _mean_over_seeds(output, values, n, len(parameters))
        step = len(mean) // n
        base = np.concatenate([mean[::step], mean[step - 1 :: step]])
        indices = None
        if not _constant(base):
            indices = analyze(
                problem,
                mean,
                calc_second_order=step > len(parameters) + 2,
                num_resamples=RESAMPLES,
                conf_level=CONFIDENCE,
                seed=seed,
            )
        found[output] = _Analysis(seeds, len(mean), _constant(mean), indices)
    return found


def _mean_over_seeds(output: str, values: Floats, n: int, count: int) -> tuple[Floats, int]:
    """Check an output's shape and values, and take its mean over seeds."""
    array = np.atleast_2d(np.asarray(values, np.float64))
    sizes = (n * (count + 2), n * (2 * count + 2))
    if array.ndim != 2 or not array.shape[0] or array.shape[1] not in sizes:
        raise SimulationError(
            f"output {output} has shape {np.shape(values)}; with n = {n} and {count} parameters it "
            f"must be ({sizes[0]},) or (seeds, {sizes[0]}), or {sizes[1]} points with second_order"
        )
    if not np.isfinite(array).all():
        seed, point = (int(where[0]) for where in np.nonzero(~np.isfinite(array)))
        raise SimulationError(
            f"output {output} is {array[seed, point]} at point {point} under seed {seed} (from 0); "
            "a variance needs finite numbers"
        )
    mean: Floats = array.mean(axis=0)
    return mean, array.shape[0]


def _constant(values: NDArray[np.float64]) -> bool:
    return bool(np.ptp(values) <= ROUNDING * np.abs(values).max())


def _limits(name: str, item: _Analysis, where: tuple[int, ...]) -> dict[str, object]:
    if item.indices is None:
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"))
    value = float(item.indices[name][where])
    half = float(item.indices[f"{name}_conf"][where])
    return {name: value, f"{name}_low": value - half, f"{name}_high": value + half}


def _frame(
    rows: list[dict[str, object]], texts: tuple[str, ...], indices: tuple[str, ...]
) -> pl.DataFrame:
    import polars as pl

    schema: dict[str, pl.DataType] = {name: pl.String() for name in texts}
    for name in indices:
        schema |= {column: pl.Float64() for column in (name, f"{name}_low", f"{name}_high")}
    schema |= {name: pl.Int64() for name in ("n", "seeds", "evaluations")}
    return pl.DataFrame(rows, schema=schema | {"insensitive": pl.Boolean()})


def _problem(parameters: Sequence[Parameter]) -> dict[str, object]:
    """Describe the unit cube to SALib; the bounds are ours to apply."""
    names = [parameter.name for parameter in parameters]
    if not names:
        raise SimulationError("parameters is empty; name at least one")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SimulationError(f"parameters holds {', '.join(twice)} twice; name each once")
    return {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}


def _salib() -> tuple[Callable[..., Floats], Callable[..., Mapping[str, Floats]]]:
    """Return SALib's sampler and estimator; no extra brings it."""
    try:
        from SALib.analyze import sobol as analysis
        from SALib.sample import sobol as sampling
    except ImportError as error:
        raise SimulationError(
            "Sobol indices need SALib, which is not installed; pip install salib"
        ) from error
    return sampling.sample, analysis.analyze
