"""Sobol indices of functions whose indices are known, and against SciPy's estimator."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from dwell.errors import SimulationError
from dwell.study.sensitivity import Parameter, sobol_design, sobol_indices, sobol_pairs

Floats = NDArray[np.float64]

CUBE = [Parameter(name, -math.pi, math.pi) for name in "abc"]
N = 1024


def ishigami(points: Floats) -> Floats:
    """With a = 7 and b = 0.1 (Ishigami & Homma 1990, DOI 10.1109/ISUMA.1990.151285)."""
    x, y, z = points.T
    values: Floats = np.sin(x) + 7 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x)
    return values


def test_a_design_has_its_shape_and_bounds() -> None:
    parameters = [Parameter("a", 2.0, 4.0), Parameter("b", 0.01, 100.0, log=True)]
    design = sobol_design(parameters, 64, seed=1)
    assert design.shape == (64 * 4, 2)
    assert sobol_design(parameters, 64, second_order=True, seed=1).shape == (64 * 6, 2)
    base = design[::4]
    # A Sobol sequence has as many points in the upper half as in the lower, of every parameter.
    assert (base[:, 0] < 3).sum() == 32
    assert (base[:, 1] < 1).sum() == 32
    assert (design >= [2.0, 0.01]).all()
    assert (design <= [4.0, 100.0]).all()
    # Each mixed point takes one parameter from the last of its group, the others from the first.
    assert (design[1::4, 0] == design[3::4, 0]).all()
    assert (design[1::4, 1] == design[::4, 1]).all()


def test_a_design_follows_its_seed() -> None:
    first = sobol_design(CUBE, 8, seed=1)
    assert (first == sobol_design(CUBE, 8, seed=1)).all()
    assert not (first == sobol_design(CUBE, 8, seed=2)).any()


def test_ishigami_has_its_indices() -> None:
    design = sobol_design(CUBE, N, seed=1)
    found = sobol_indices(CUBE, {"y": ishigami(design)}, N)
    assert found["parameter"].to_list() == ["a", "b", "c"]
    first, total = (0.3139, 0.4424, 0.0), (0.5576, 0.4424, 0.2437)
    assert found["S1"].to_list() == pytest.approx(first, abs=0.03)
    assert found["ST"].to_list() == pytest.approx(total, abs=0.03)
    for name, known in (("S1", first), ("ST", total)):
        assert (found[f"{name}_low"] <= np.array(known)).all()
        assert (found[f"{name}_high"] >= np.array(known)).all()
        assert (found[f"{name}_high"] - found[f"{name}_low"] < 0.25).all()
    assert not found["insensitive"].any()
    assert set(found["n"]) == {N}
    assert set(found["seeds"]) == {1}
    assert set(found["evaluations"]) == {N * 5}
    assert found.equals(sobol_indices(CUBE, {"y": ishigami(design)}, N))


def test_ishigami_has_its_pairs() -> None:
    design = sobol_design(CUBE, N, second_order=True, seed=1)
    outputs = {"y": ishigami(design)}
    found = sobol_pairs(CUBE, outputs, N)
    assert found.select("first", "second").rows() == [("a", "b"), ("a", "c"), ("b", "c")]
    assert found["S2"].to_list() == pytest.approx([0.0, 0.2437, 0.0], abs=0.05)
    assert set(found["evaluations"]) == {N * 8}
    # The other indices can be had of the same runs.
    both = sobol_indices(CUBE, outputs, N)
    assert both["ST"].to_list() == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.05)


def test_a_sum_has_the_shares_of_its_variances() -> None:
    parameters = [Parameter("a", 0.0, 1.0), Parameter("b", 5.0, 7.0), Parameter("idle", 1.0, 2.0)]
    design = sobol_design(parameters, 256, seed=3)
    found = sobol_indices(parameters, {"y": 1000 + design @ [4.0, 1.0, 0.0]}, 256)
    # Variances 16 / 12 and 4 / 12.
    assert found["S1"].to_list() == pytest.approx([0.8, 0.2, 0.0], abs=0.02)
    assert found["ST"].to_list() == pytest.approx([0.8, 0.2, 0.0], abs=0.02)
    idle = found.row(2, named=True)
    assert (idle["ST"], idle["ST_low"], idle["ST_high"]) == (0.0, 0.0, 0.0)


def test_the_estimator_is_saltellis() -> None:
    """SciPy has the estimator of Saltelli et al. 2010 too; it was written by others."""
    design = sobol_design(CUBE, 64, seed=5)
    values = ishigami(design)
    groups = values.reshape(64, 5).T
    oracle = stats.sobol_indices(
        func={"f_A": groups[:1], "f_B": groups[4:], "f_AB": groups[1:4, None, :]}, n=64
    )
    found = sobol_indices(CUBE, {"y": values}, 64)
    assert found["S1"].to_list() == pytest.approx(np.ravel(oracle.first_order), abs=0.02)
    assert found["ST"].to_list() == pytest.approx(np.ravel(oracle.total_order))


def test_common_seeds_are_averaged_first() -> None:
    design = sobol_design(CUBE, 64, seed=1)
    noise = np.random.default_rng(1).normal(size=len(design))
    seeds = np.stack([ishigami(design) + noise, ishigami(design) - noise])
    found = sobol_indices(CUBE, {"y": seeds}, 64)
    alone = sobol_indices(CUBE, {"y": ishigami(design)}, 64)
    assert found["S1"].to_list() == pytest.approx(alone["S1"].to_list())
    assert set(found["seeds"]) == {2}
    assert set(found["evaluations"]) == {2 * 64 * 5}


def test_an_output_that_never_changes_is_insensitive() -> None:
    design = sobol_design(CUBE, 8, seed=1)
    # 0.3 or 0.1 + 0.2: different to a computer, and the same.
    rounded = np.where(design[:, 0] > 0, 0.3, 0.1 + 0.2)
    outputs = {"none": np.zeros(40), "rounded": rounded, "some": design[:, 0]}
    found = sobol_indices(CUBE, outputs, 8)
    assert found["output"].to_list() == ["none"] * 3 + ["rounded"] * 3 + ["some"] * 3
    assert found["insensitive"].to_list() == [True] * 6 + [False] * 3
    indices = found.drop("output", "parameter", "n", "seeds", "evaluations", "insensitive")
    assert indices[:6].null_count().sum_horizontal().item() == indices[:6].width * 6
    assert indices[6:].null_count().sum_horizontal().item() == 0


def test_too_few_points_to_part_a_variance_are_no_insensitivity() -> None:
    values = np.zeros(2 * 5)
    values[1] = 1.0
    found = sobol_indices(CUBE, {"y": values}, 2)
    assert found["S1"].null_count() == 3
    assert not found["insensitive"].any()


def test_what_is_no_range_is_refused() -> None:
    with pytest.raises(SimulationError, match=r"low is 2\.0; it must be below high, 1\.0"):
        Parameter("a", 2.0, 1.0)
    with pytest.raises(SimulationError, match="must be finite"):
        Parameter("a", 0.0, math.inf)
    with pytest.raises(SimulationError, match=r"below high, -2\.0\nparameter a: .* above 0"):
        Parameter("a", -1.0, -2.0, log=True)


@pytest.mark.parametrize("n", [0, 1, 12])
def test_n_is_a_power_of_two(n: int) -> None:
    with pytest.raises(SimulationError, match=f"n is {n}; it must be a power of two"):
        sobol_design(CUBE, n, seed=1)


def test_parameters_have_names_of_their_own() -> None:
    with pytest.raises(SimulationError, match="holds a twice"):
        sobol_design([CUBE[0], CUBE[0]], 8, seed=1)
    with pytest.raises(SimulationError, match="parameters is empty"):
        sobol_indices([], {}, 8)


def test_outputs_fit_the_design() -> None:
    with pytest.raises(SimulationError, match=r"output y has shape \(7,\).*\(40,\)"):
        sobol_indices(CUBE, {"y": np.zeros(7)}, 8)
    with pytest.raises(SimulationError, match=r"output y has shape \(0, 40\)"):
        sobol_indices(CUBE, {"y": np.zeros((0, 40))}, 8)
    lost = np.zeros((2, 40))
    lost[1, 3] = math.inf
    with pytest.raises(SimulationError, match="output y is inf at point 3 under seed 1"):
        sobol_indices(CUBE, {"y": lost}, 8)
    with pytest.raises(SimulationError, match="without second_order"):
        sobol_pairs(CUBE, {"y": np.arange(40.0)}, 8)
    with pytest.raises(SimulationError, match="seed is 0"):
        sobol_indices(CUBE, {"y": np.arange(40.0)}, 8, seed=0)


def test_without_salib_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SALib", "SALib.analyze", "SALib.sample"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SimulationError, match="pip install salib"):
        sobol_design(CUBE, 8, seed=1)
