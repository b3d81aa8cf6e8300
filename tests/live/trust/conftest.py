"""What tests of trust share."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.live.trust.authority import Authority


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    made = Authority.create(tmp_path / "keys", "cell")
    made.issue("R1", "node", ["127.0.0.1", "robot.local"])
    made.issue("controller", "controller", ["127.0.0.1"])
    return made
