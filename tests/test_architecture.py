"""The page on the architecture, held against the sources."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
SOURCES = ROOT / "src" / "dwell"
PACKAGES = {path.parent.name for path in SOURCES.glob("*/__init__.py")}
MODULES = {path.stem for path in SOURCES.glob("[a-z]*.py")}


def test_every_room_has_its_sentence() -> None:
    table = PAGE.partition("## The rooms")[2].partition("\n## ")[0]
    rooms = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert sorted(rooms) == sorted(PACKAGES | MODULES)


def test_every_room_is_in_the_picture() -> None:
    picture = PAGE.partition("```text")[2].partition("```")[0]
    assert set(re.findall(r"[a-z]+", picture)) >= PACKAGES | MODULES


NAMED = {name for name in re.findall(r"`(\w+\.\w+)`", PAGE) if name.partition(".")[0] in PACKAGES}


@pytest.mark.parametrize("name", sorted(NAMED))
def test_what_the_page_names_is_there(name: str) -> None:
    package, _, member = name.partition(".")
    found = find_spec(f"dwell.{package}.{member}")
    if found is None:
        assert hasattr(import_module(f"dwell.{package}"), member), name
