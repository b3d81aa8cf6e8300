"""Errors: what their texts name, how they cross processes, and what they say is to be installed."""

from __future__ import annotations

import inspect
import pickle
import tomllib
from pathlib import Path

import pytest

from dwell import errors
from dwell.errors import (
    DwellError,
    ExitCode,
    Fault,
    KernelError,
    LiveError,
    PolicyError,
    ProblemError,
    TraceError,
    installing,
    lacking,
    line_and_code,
    missing_package,
)

ROOT = Path(__file__).parents[1]
KINDS = [
    kind for _, kind in inspect.getmembers(errors, inspect.isclass) if issubclass(kind, Exception)
]


def test_every_error_is_a_dwell_error_that_can_be_imported() -> None:
    assert all(issubclass(kind, DwellError) for kind in KINDS)
    assert {kind.__name__ for kind in KINDS} <= set(errors.__all__)


@pytest.mark.parametrize(
    ("source", "line", "text"),
    [
        (None, None, "nodes.R: no"),
        (None, 7, "line 7: nodes.R: no"),
        ("cell.yaml", None, "cell.yaml: nodes.R: no"),
        ("cell.yaml", 7, "cell.yaml:7: nodes.R: no"),
    ],
)
def test_a_fault_is_written_as_compilers_write_it(
    source: str | None, line: int | None, text: str
) -> None:
    faults = [Fault("nodes.R", "no", line), Fault("", "all of it")]
    assert str(ProblemError(faults, source)).splitlines()[0] == text


@pytest.mark.parametrize("kind", [ProblemError, TraceError])
def test_faults_cross_the_borders_of_processes(kind: type[ProblemError]) -> None:
    error = kind([Fault("a", "b", 3)], "cell.yaml")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert (again.faults, again.source, str(again)) == (error.faults, "cell.yaml", str(error))


def test_a_flaw_of_the_kernel_crosses_them_too() -> None:
    error = KernelError("it is missing", "make env")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.remedy) == ("it is missing; make env", "make env")


def test_what_is_missing_is_named_with_an_extra_that_brings_it() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for module, (package, extra) in errors.OPTIONAL.items():
        told = missing_package(ModuleNotFoundError(name=f"{module}.part"))
        line = f"{package} is not installed; pip install '{project['name']}[{extra}]'"
        assert str(told) == line
        brought = " ".join(project["optional-dependencies"][extra]).replace("_", "-")
        assert module.replace("_", "-") in brought
    told = missing_package(ModuleNotFoundError(name="cv2"))
    assert str(told) == "cv2 is not installed; pip install opencv-python-headless"
    assert missing_package(ModuleNotFoundError(name="stages")) is None


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (PolicyError("unknown"), "error: unknown", ExitCode.WRONG),
        (LiveError("a port is taken"), "error: a port is taken", ExitCode.FAILED),
        (ProblemError("no", "cell.yaml"), "cell.yaml: no", ExitCode.WRONG),
        (OSError(2, "no such file", "x.yaml"), "error: x.yaml: no such file", ExitCode.FAILED),
        (OSError("broken"), "error: broken", ExitCode.FAILED),
    ],
)
def test_a_command_prints_a_line_and_ends_with_a_code(
    error: DwellError | OSError, line: str, code: ExitCode
) -> None:
    assert line_and_code(error) == (line, code)


def test_a_module_of_a_user_that_is_missing_has_no_line() -> None:
    assert line_and_code(ModuleNotFoundError(name="stages")) is None
    known = line_and_code(ModuleNotFoundError(name="zenoh"))
    assert known is not None
    assert known[1] == ExitCode.FAILED


def test_missing_packages_are_named_with_the_command_that_installs_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dwell.errors.OPTIONAL", {"no_such": ("A", "x"), "nor_this": ("B", "y")})
    assert lacking("x") == f"A is not installed; {installing('x')}"
    assert lacking("x", "y") == f"A and B are not installed; {installing('y')}"
    assert lacking("z") == ""
