"""Where a computer keeps what it has of its cells."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import ProblemError
from dwell.live.commands.background import log_of, logs_of
from dwell.live.host.state_folder import logs, state_root


def test_it_is_where_the_desktop_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_root() == tmp_path / "dwell"
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert state_root() == tmp_path / ".local" / "state" / "dwell"
    assert state_root(tmp_path / "other") == tmp_path / "other"


def test_a_log_is_found_by_its_cell_and_process(tmp_path: Path) -> None:
    names = ("hall/agent@E.log", "hall/E/plan@E.log", "yard/agent@E.log", "yard/E/plan@E.log.1")
    for name in names:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert set(logs(tmp_path)) == {"agent@E", "plan@E"}
    assert log_of(tmp_path, "plan@E", "hall") == tmp_path / "hall/E/plan@E.log"
    assert log_of(tmp_path, "agent@E", "yard") == tmp_path / "yard/agent@E.log"
    assert logs_of(tmp_path, "hall").keys() == {"agent@E", "plan@E"}
    with pytest.raises(ProblemError, match="no process 'plan@E' of yard"):
        log_of(tmp_path, "plan@E", "yard")
    with pytest.raises(ProblemError, match="no log in"):
        log_of(tmp_path / "nothing", "plan@E", "hall")
