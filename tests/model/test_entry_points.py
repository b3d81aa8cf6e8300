from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dwell.errors import PolicyError
from dwell.model.entry_points import class_at, class_named, names_with
from dwell.model.frozen import FrozenDict

GROUP = "dwell.tested"


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package, with one class that is there and one that is not."""
    (tmp_path / "their_module.py").write_text("class Theirs: pass\n")
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    lines = ["theirs = their_module:Theirs", "broken = their_module:Gone", "ours = their_module:X"]
    (info / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines]))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])


@pytest.mark.usefixtures("other")
def test_ours_come_first_and_once() -> None:
    assert names_with(["ours", "also"], GROUP) == ("ours", "also", "broken", "theirs")


@pytest.mark.usefixtures("other")
def test_a_class_of_another_package_is_imported() -> None:
    found = class_named("theirs", None, GROUP, "policy", PolicyError)
    assert found.__name__ == "Theirs"
    assert class_named("nobody's", None, GROUP, "policy", PolicyError) is None


@pytest.mark.usefixtures("other")
def test_one_that_cannot_be_imported_names_its_package() -> None:
    words = r"policy 'broken' of the package theirs \(their_module:Gone\) cannot be imported"
    with pytest.raises(PolicyError, match=words):
        class_named("broken", None, GROUP, "policy", PolicyError)


def test_ours_are_found_without_looking_elsewhere() -> None:
    path = "dwell.model.frozen:FrozenDict"
    assert class_at(path) is FrozenDict
    assert class_named("x", path, GROUP, "policy", PolicyError) is FrozenDict
