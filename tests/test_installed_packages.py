"""Policies and estimators that other packages add by entry points."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dwell import load, open_run
from dwell.cellfile import schema
from dwell.cli.commands import app
from dwell.errors import PolicyError, ProblemError
from dwell.estimators import by_name as estimator_by_name
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.estimators.registry import names as estimator_names
from dwell.policies import by_name
from dwell.policies.registry import REGISTRY, names
from dwell.study import compare
from tests.cells.paper import problem

ROOT = Path(__file__).parents[1]
CELL = ROOT / "examples/canonical.yaml"
STAY = """
from dwell.estimators import Profile
from dwell.policies import Static


class Stay(Static):
    @classmethod
    def from_problem(cls, problem):
        return cls(
            candidates=problem.candidates, initial=problem.initial, objective=problem.objective
        )


class Guess(Profile):
    pass
"""


@pytest.fixture
def distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder on ``sys.path`` with a distribution that adds policies and estimators."""
    metadata = tmp_path / "stayers-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: stayers\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[dwell.policies]\nstay = stayers_policy:Stay\nlost = stayers_absent:Lost\n"
        "dtp = stayers_policy:Stay\n"
        "[dwell.estimators]\nguess = stayers_policy:Guess\ngone = stayers_absent:Gone\n"
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
def test_an_installed_estimator_is_known_and_made_by_its_name() -> None:
    assert estimator_names() == (*ESTIMATORS, "gone", "guess")
    assert type(estimator_by_name("guess", problem())).__name__ == "Guess"
    with pytest.raises(ProblemError, match="estimator 'gone' of the package stayers"):
        estimator_by_name("gone", problem())


def test_a_cell_file_names_an_installed_policy_and_estimator(
    distribution: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = CELL.read_text(encoding="utf-8")
    assert "  policy: dtp" in text
    assert "  estimator: profile" in text
    file = distribution / "cell.yaml"
    named = text.replace("policy: dtp", "policy: stay").replace(
        "estimator: profile", "estimator: guess"
    )
    file.write_text(named, encoding="utf-8")
    out = tmp_path / "run"
    made = CliRunner().invoke(app, ["run", str(file), "--windows", "8", "--out", str(out)])
    assert made.exit_code == 0, made.output
    # Without the package the cell is refused, and its run is still a run.
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one != str(distribution)])
    refused = CliRunner().invoke(app, ["check", str(file)])
    assert refused.exit_code == 2
    assert "unknown policy 'stay'" in refused.output
    run = open_run(out)
    assert (run.problem.controller.policy, run.problem.controller.estimator) == ("stay", "guess")


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


def test_the_registries_load_without_the_classes() -> None:
    code = (
        "import sys, dwell.policies.registry, dwell.estimators.registry; "
        "sys.exit(any(m in sys.modules for m in ('dwell.policies.dtp', "
        "'dwell.estimators.profile', 'polars', 'scipy', 'numpy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# ------------------------------------------------------------------- where names are told


@pytest.mark.parametrize(
    ("registry", "page"),
    [
        (REGISTRY, "concepts.md"),
        (ESTIMATORS, "reference/estimators.md"),
        (ESTIMATORS, "reference/cells.md"),
    ],
)
def test_the_pages_list_every_name_of_ours(registry: Mapping[str, object], page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    listed = re.findall(r"`([\w-]+)`", "\n".join(re.findall(r"^[-|*] .*", text, re.MULTILINE)))
    assert [name for name in registry if name not in listed] == []


def test_the_schema_offers_the_names_of_ours() -> None:
    controller = schema()["$defs"]["Controller"]["properties"]
    assert controller["policy"]["anyOf"][0]["enum"] == list(REGISTRY)
    assert controller["estimator"]["anyOf"][0]["enum"] == list(ESTIMATORS)
