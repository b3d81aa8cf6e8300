"""Where a computer keeps what it has of its cells."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import ProblemError
from dwell.live.commands.background import log_of
from dwell.live.host.state_folder import logs, state_root


def test_it_is_where_the_desktop_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_root() == tmp_path / "dwell"
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert state_root() == tmp_path / ".local" / "state" / "dwell"
    assert state_root(tmp_path / "other") == tmp_path / "other"


def test_a_log_is_found_by_its_process_and_where_needed_by_its_cell(tmp_path: Path) -> None:
    names = ("hall/agent@E.log", "hall/E/plan@E.log", "yard/agent@E.log", "yard/E/plan@E.log.1")
    for name in names:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert set(logs(tmp_path)) == {"agent@E", "plan@E"}
    assert log_of(tmp_path, "plan@E", None) == tmp_path / "hall/E/plan@E.log"
    assert log_of(tmp_path, "agent@E", "yard") == tmp_path / "yard/agent@E.log"
    with pytest.raises(ProblemError, match="several cells, hall, yard"):
        log_of(tmp_path, "agent@E", None)
    with pytest.raises(ProblemError, match="no process 'plan@E'; there are agent@E"):
        log_of(tmp_path, "plan@E", "yard")
    with pytest.raises(ProblemError, match="there is no log in"):
        log_of(tmp_path / "nothing", "plan@E", None)
