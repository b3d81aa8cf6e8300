"""A small cell, and commands that are run on it in this process."""

from __future__ import annotations

import json
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
    """Run a command."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def read_json(result: Result) -> Any:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)
