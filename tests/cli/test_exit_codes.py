"""What commands end with where they are interrupted, used wrongly, or broken."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.small_cell import ROOT, call


def test_an_internal_error_is_not_dressed_up(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr("dwell.load", broken)
    assert isinstance(call("check", cell).exception, KeyError)


def test_interrupted_work_exits_with_130(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dwell.load", interrupted)
    result = call("check", cell)
    assert (result.exit_code, result.output) == (130, "")


def test_an_interrupt_within_an_exec_has_the_exit_code_of_any_other(tmp_path: Path) -> None:
    """CPython ends `python -m` by a signal for it, which is no exit code."""
    (tmp_path / "sitecustomize.py").write_text(
        "from dwell.cli import commands\n"
        "def interrupted(*_, **more):\n"
        "    exec('raise KeyboardInterrupt')\n"
        "commands.app = interrupted\n",
        encoding="utf-8",
    )
    done = subprocess.run(
        [sys.executable, "-m", "dwell", "check"],
        check=False,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT / 'src'}"},
        timeout=120,
    )
    assert done.returncode == 130
