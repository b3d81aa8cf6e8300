"""Files in shared memory that nobody holds any more."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from dwell.live.transport import orphans
from dwell.live.transport.orphans import remove_orphans


@pytest.fixture(autouse=True)
def _old_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orphans, "YOUNG_S", 0.0)


def test_what_nobody_holds_is_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in ("1.zenoh", "2.zenoh", "other"):
        (tmp_path / name).write_bytes(b"x")
    held = os.open(tmp_path / "2.zenoh", os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_SH)
        assert remove_orphans(tmp_path) == 1
    finally:
        os.close(held)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2.zenoh", "other"]


def test_a_young_file_may_be_without_its_lock_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orphans, "YOUNG_S", 3600.0)
    (tmp_path / "1.zenoh").write_bytes(b"x")
    assert remove_orphans(tmp_path) == 0


def test_links_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "kept").write_bytes(b"x")
    (tmp_path / "1.zenoh").symlink_to(tmp_path / "kept")
    assert remove_orphans(tmp_path) == 0
    assert (tmp_path / "kept").exists()
