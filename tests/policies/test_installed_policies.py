"""Policies that other packages add by an entry point."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dwell import load
from dwell.cli.commands import app
from dwell.errors import PolicyError
from dwell.policies import by_name
from dwell.policies.registry import REGISTRY, names
from dwell.study import compare
from tests.policies.cell import problem

CELL = Path(__file__).parents[2] / "examples/canonical.yaml"
STAY = """
from dwell.policies import Static


class Stay(Static):
    @classmethod
    def from_problem(cls, problem):
        return cls(
            candidates=problem.candidates, initial=problem.initial, objective=problem.objective
        )
"""


@pytest.fixture
def distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder on ``sys.path`` with a distribution that adds three policies."""
    metadata = tmp_path / "stayers-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: stayers\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[dwell.policies]\nstay = stayers_policy:Stay\nlost = stayers_absent:Lost\n"
        "dtp = stayers_policy:Stay\n"
    )
    (tmp_path / "stayers_policy.py").write_text(STAY)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.usefixtures("distribution")
def test_an_installed_policy_is_known_and_made_by_its_name() -> None:
    assert names() == (*REGISTRY, "lost", "stay")
    assert type(by_name("stay", problem())).__name__ == "Stay"


@pytest.mark.usefixtures("distribution")
def test_no_package_takes_the_name_of_a_policy_of_ours() -> None:
    assert type(by_name("dtp", problem())).__name__ == "DTP"


@pytest.mark.usefixtures("distribution")
def test_a_broken_entry_point_names_its_package_only_when_it_is_asked_for() -> None:
    by_name("stay", problem())
    with pytest.raises(PolicyError, match=r"'lost' of the package stayers \(stayers_absent:Lost\)"):
        by_name("lost", problem())


@pytest.mark.usefixtures("distribution")
def test_an_installed_policy_runs_by_the_command_line(tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--policy", "stay", "--windows", "8", "--out", str(out)]
    made = CliRunner().invoke(app, ["run", str(CELL), *options])
    assert made.exit_code == 0, made.output
    reported = CliRunner().invoke(app, ["report", str(out)])
    assert reported.exit_code == 0, reported.output


@pytest.mark.usefixtures("distribution")
def test_an_installed_policy_is_compared() -> None:
    comparison = compare(
        load(CELL),
        scenarios=["baseline"],
        policies=["stay", "dtp"],
        seeds=[1],
        windows=8,
        processes=1,
    )
    assert comparison.policies == ("stay", "dtp")


def test_the_registry_loads_without_the_classes() -> None:
    code = (
        "import sys, dwell.policies.registry; "
        "sys.exit(any(m in sys.modules for m in "
        "('dwell.policies.dtp', 'numba', 'polars', 'scipy', 'numpy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
