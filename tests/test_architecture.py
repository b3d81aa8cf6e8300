"""The page on the architecture, held against the sources."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
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


def package_of(path: Path) -> str:
    """Return the package, or the module at the top, that a source belongs to."""
    return path.relative_to(SOURCES).parts[0].removesuffix(".py")


def twice(places: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Return the names that stand more than once, with the packages that have them."""
    found = {name: list(packages) for name, packages in places.items()}
    return {name: sorted(set(some)) for name, some in found.items() if len(some) > 1}


def listed(kind: str) -> dict[str, list[str]]:
    """Return the names of the page's table of modules or classes, with their packages."""
    table = PAGE.partition(f"| {kind} | packages | why |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| (`.*?) \| (`.*?) \| \S.* \|$", table, re.MULTILINE)
    return {
        name: re.findall(r"`(\w+)`", packages)
        for names, packages in rows
        for name in re.findall(r"`(\w+)`", names)
    }


def test_no_module_has_the_name_of_another_one_but_for_those_listed() -> None:
    places = defaultdict(list)
    for path in SOURCES.rglob("[a-z]*.py"):
        if package_of(path) != "cli":
            places[path.stem].append(package_of(path))
    assert twice(places) == listed("module")


def test_no_public_class_has_the_name_of_another_one_but_for_those_listed() -> None:
    places = defaultdict(list)
    for path in SOURCES.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(package_of(path))
    assert twice(places) == listed("class")
