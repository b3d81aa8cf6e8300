"""The command as a process: exit codes, streams, signals, and what it imports."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import dwell
from tests.cli.small_cell import CANONICAL, ROOT, environment, interrupt_at_first_sign

CELL = ROOT / "examples" / "live" / "cell.yaml"

# Not pydantic: Typer itself may read arguments with it.
HEAVY = ("polars", "numpy", "matplotlib", "rich", "yaml", "zenoh")


def call(*arguments: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "dwell", *map(str, arguments)],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def running(*arguments: str) -> str:
    """Return code that runs a command and goes on."""
    call = f"    main({list(arguments)!r})"
    return f"from dwell.cli import main\ntry:\n{call}\nexcept SystemExit:\n    pass"


@pytest.mark.parametrize(
    "code",
    ["import dwell, dwell.cli, dwell.errors", running("--help"), running("run", "--help")],
)
def test_nothing_heavy_is_imported_before_it_is_needed(code: str) -> None:
    script = f"{code}\nimport sys\nprint([name for name in {HEAVY} if name in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", script],
        env=environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("words", "who", "refused"),
    [
        (("agent", "--node", "R9", "--cell", CELL), "agent@R9", "no node 'R9'"),
        (("controller", "--cell", "none.yaml"), "controller", "none.yaml"),
        (("dash", "none.yaml"), "dash", "none.yaml"),
    ],
)
def test_an_error_that_ends_a_command_is_json_where_its_log_is(
    words: tuple[str | Path, ...], who: str, refused: str, tmp_path: Path
) -> None:
    result = call(*words, "--log-format", "json", folder=tmp_path)
    assert result.returncode != 0
    last = json.loads(result.stderr.splitlines()[-1])
    assert last["process"] == who
    assert refused in last["message"]


def test_results_go_to_stdout(tmp_path: Path) -> None:
    result = call("--version", folder=tmp_path)
    assert (result.returncode, result.stdout) == (0, f"dwell {dwell.__version__}\n")
    result = call("check", CANONICAL, folder=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith("canonical: no faults\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "missing.yaml"), "missing.yaml"),
        (("check", "."), "."),
        (("run", CANONICAL, "--policy", "nope"), "unknown policy"),
        (("report", "missing"), "missing"),
        (("run",), "CELL"),
        (("nope",), "nope"),
    ],
)
def test_a_mistake_is_told_without_a_traceback(
    tmp_path: Path, arguments: tuple[str | Path, ...], words: str
) -> None:
    result = call(*arguments, folder=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    assert words in result.stderr
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    arguments = ["run", str(CANONICAL), "--windows", "200000", "--out", "here"]
    code, stdout, shown = interrupt_at_first_sign(arguments, tmp_path)
    assert (code, stdout) == (130, "")
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_run_leaves_the_one_before(tmp_path: Path) -> None:
    before = ("run", CANONICAL, "--policy", "LOC", "--windows", "6", "--out", "here")
    assert call(*before, folder=tmp_path).returncode == 0
    arguments = ["run", str(CANONICAL), "--windows", "200000", "--out", "here", "--force"]
    code, _, _ = interrupt_at_first_sign(arguments, tmp_path)
    assert code == 130
    assert [path.name for path in tmp_path.iterdir()] == ["here"]
    assert dwell.open_run(tmp_path / "here").windows.height == 6


@pytest.mark.parametrize("processes", ["1", "2"])
def test_an_interrupted_demo_leaves_nothing(tmp_path: Path, processes: str) -> None:
    arguments = ["demo", "--seeds", "5000", "--processes", processes, "--out", "out"]
    code, stdout, shown = interrupt_at_first_sign(arguments, tmp_path)
    assert (code, stdout) == (130, "")
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []
