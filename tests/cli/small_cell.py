"""A small cell, and commands that are run on it."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from dwell.cli.commands import app

ROOT = Path(__file__).parents[2]
CANONICAL = ROOT / "examples" / "canonical.yaml"
REAL = ROOT.parent / "shared" / "data"

SMALL = """\
dwell: 1
name: small
period_ms: 20
window_cycles: 10
nodes:
  R: {tier: robot, cores: 1}
  E: {tier: edge, cores: 4}
links:
  - {from: R, to: E, both_ways: true, delay_ms: 1}
tasks:
  sense: {on: {R: {exec_ms: 1}}}
  plan: {on: {R: {exec_ms: 8}, E: {exec_ms: 2}}}
flows:
  - {from: sense, to: plan}
candidates:
  LOC: {plan: R}
  OFF: {plan: E}
scenarios:
  stress: [{node: R, stress_threads: 3}]
"""


def call(*arguments: str | Path) -> Result:
    """Run a command in this process."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def read_json(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def assert_refused(result: Result, *words: str, code: int = 2) -> None:
    """Assert that a command has printed nothing but an error, which says some words."""
    assert (result.exit_code, result.stdout) == (code, "")
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr


def environment() -> dict[str, str]:
    """Return this process's environment, in which this checkout's package is found."""
    return {"PYTHONPATH": str(ROOT / "src"), **os.environ}


def interrupt_at_first_sign(
    arguments: list[str], folder: Path, *, sign: str = "simulating"
) -> tuple[int, str, str]:
    """Start a command with stderr on a terminal, and press Ctrl-C once it shows a sign.

    Returns
    -------
    tuple
        Exit code, what stdout had, and what the terminal had.
    """
    main_end, its_end = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "dwell", *arguments],
        cwd=folder,
        env={**environment(), "TERM": "xterm"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=its_end,
        start_new_session=True,
    )
    os.close(its_end)
    shown = b""
    while sign.encode() not in shown:
        shown += os.read(main_end, 1024)
    # A terminal sends it to the whole group: worker processes as well.
    os.killpg(process.pid, signal.SIGINT)
    while True:
        try:
            data = os.read(main_end, 65536)
        except OSError:  # its end is closed
            break
        if not data:
            break
        shown += data
    stdout, _ = process.communicate(timeout=300)
    os.close(main_end)
    return process.returncode, stdout.decode(), shown.decode()
