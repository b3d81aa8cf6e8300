"""A user's own classes in comparisons and studies: refused by name before anything is begun."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

from dwell.errors import PolicyError, ProblemError, SimulationError
from dwell.estimators import Profile
from dwell.model import QoS
from dwell.study import Contender, compare, load_study, run_study
from tests.cells.small import make_problem
from tests.cli.small_cell import SMALL, assert_refused, call, environment
from tests.study.test_study import make_study

PROBLEM = make_problem()

SCRIPT = """\
import dwell
from dwell.study import compare


class Nearest:
    def decide(self, *, observed, estimates):
        return min(estimates, key=lambda name: estimates[name].l95_ms)


if __name__ == "__main__":
    problem = dwell.load("small.yaml")
    policies = {"LOC": "LOC", "mine": Nearest()}
    compare(problem, policies=policies, seeds=[1, 2], windows=5, processes=PROCESSES)
"""
TOLD = "Nearest is defined in a notebook or script (__main__); put it into a module, or processes=1"


class Policy:
    """Holds something, and takes the first placement."""

    def __init__(self, held: object = None) -> None:
        self.held = held

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(iter(estimates))


class Typed(Policy):
    """Stands for a class that was typed into a notebook."""


class TypedEstimator(Profile):
    """Stands for an estimator that was typed into a notebook."""


def typed_function() -> None:
    """Stand for a function that was typed into a notebook."""


for one in (Typed, TypedEstimator, typed_function):
    one.__module__ = "__main__"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a cell, the current one."""
    (tmp_path / "small.yaml").write_text(SMALL, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("source", ["stdin", "script.py"])
def test_a_class_of_a_script_is_named_before_processes_begin(folder: Path, source: str) -> None:
    def run(processes: int) -> subprocess.CompletedProcess[str]:
        text = SCRIPT.replace("PROCESSES", str(processes))
        Path("script.py").write_text(text, encoding="utf-8")
        return subprocess.run(
            [sys.executable, "-" if source == "stdin" else source],
            input=text,
            env=environment(),
            capture_output=True,
            text=True,
            check=False,
        )

    refused = run(processes=2)
    assert refused.returncode == 1
    assert refused.stderr.splitlines()[-1] == f"dwell.errors.SimulationError: {TOLD}"
    assert "Process" not in refused.stderr
    assert run(processes=1).returncode == 0


def test_a_class_of_a_notebook_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR"):
        monkeypatch.setenv(name, str(folder / name))
    code = nbformat.v4.new_code_cell(SCRIPT.replace("PROCESSES", "2"))  # type: ignore[no-untyped-call]
    notebook = nbformat.v4.new_notebook(cells=[code])  # type: ignore[no-untyped-call]
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}})
    with pytest.raises(CellExecutionError) as caught:
        client.execute()
    assert (caught.value.ename, caught.value.evalue) == ("SimulationError", TOLD)


@pytest.mark.parametrize(
    ("contender", "told"),
    [
        (Contender("mine", Typed()), "Typed is defined in a notebook or script"),
        (Contender("mine", Policy(Typed())), "Typed is defined in a notebook or script"),
        (Contender("mine", Policy(typed_function)), "typed_function is defined in a notebook"),
        (Contender("mine", "dtp", TypedEstimator(PROBLEM)), "TypedEstimator is defined in a"),
        (Contender("mine", Policy(threading.Lock())), "mine cannot be sent to worker processes"),
        (Contender("mine", Policy(lambda: None)), "mine cannot be sent to worker processes"),
    ],
)
def test_what_worker_processes_cannot_import_is_refused(
    contender: Contender, told: str, tmp_path: Path
) -> None:
    contenders = (Contender("LOC", "LOC"), contender)
    with pytest.raises(SimulationError, match=told):
        compare(PROBLEM, policies=contenders, seeds=[1, 2], windows=4, processes=2)
    for folder in (None, tmp_path / "study"):
        with pytest.raises(SimulationError, match=told):
            run_study(make_study(contenders=contenders), folder=folder, processes=2)
    assert not os.listdir(tmp_path)


def test_what_stays_in_this_process_need_not_be_imported() -> None:
    estimator = TypedEstimator(PROBLEM)
    policies = (Contender("mine", Typed(typed_function)), Contender("also", "dtp", estimator))
    played = compare(PROBLEM, policies=policies, seeds=[1, 2], windows=4, processes=1)
    assert played.policies == ("mine", "also")
    # One item needs no other process.
    compare(PROBLEM, scenarios=["baseline"], policies=policies, seeds=[1], windows=4, processes=2)


@pytest.mark.parametrize(
    ("lines", "error", "told"),
    [
        (
            "policies: {mine: 'absent:Mine'}",
            PolicyError,
            "policy 'absent:Mine': no module",
        ),
        (
            "policies: {mine: {policy: dtp, estimator: 'own:Lost'}}",
            ProblemError,
            "estimator 'own:Lost': own has no class 'Lost'",
        ),
        (
            "policies: [dtp]\nparameters: {controller.estimator: [profile, 'absent:Mine']}",
            ProblemError,
            "estimator 'absent:Mine': no module",
        ),
        (
            "policies: {mine: 'own:Fails'}",
            KeyError,
            "Fails: decide at window 0 failed: KeyError: 'edge' (own.py:",
        ),
    ],
)
def test_a_class_that_cannot_be_used_is_found_before_the_folder_is_made(
    folder: Path, lines: str, error: type[Exception], told: str
) -> None:
    text = "class Fails:\n    def decide(self, **_):\n        raise KeyError('edge')\n"
    (folder / "own.py").write_text(text, encoding="utf-8")
    study = folder / "study.yaml"
    text = f"dwell-study: 1\nname: own\ncell: small.yaml\nwindows: 4\nseeds: 1\n{lines}\n"
    study.write_text(text, encoding="utf-8")
    before = sorted(os.listdir(folder))
    assert_refused(call("study", study, "--processes", "1"), f"error: {told}")
    for kept in (None, folder / "kept"):
        with pytest.raises(error):
            run_study(load_study(study), folder=kept, processes=1)
    assert sorted({*os.listdir(folder)} - {"__pycache__"}) == before


def test_an_unknown_policy_leaves_no_folder(tmp_path: Path) -> None:
    study = make_study(contenders=(Contender("dpt", "dpt"),))
    with pytest.raises(PolicyError, match="did you mean 'dtp'"):
        run_study(study, folder=tmp_path / "study", processes=1)
    assert not os.listdir(tmp_path)
