"""What commands end with where they are interrupted, used wrongly, or broken."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.small_cell import call


def test_an_internal_error_is_not_dressed_up(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr("dwell.cellfile.load", broken)
    assert isinstance(call("check", cell).exception, KeyError)


def test_interrupted_work_exits_with_130(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dwell.cellfile.load", interrupted)
    result = call("check", cell)
    assert (result.exit_code, result.output) == (130, "")
