"""What pyproject.toml declares is what the package imports: nothing more, nothing less."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = packages_distributions()

#: Tools that are run, not imported.
NOT_IMPORTED = {"pytest-xdist"}
#: Parts of others, which pin them.
PARTS = {"pydantic-core"}
#: What imports by name; its first argument is a module.
BY_NAME = {"import_module", "importorskip"}


def imported(*folders: str) -> set[str]:
    """Distributions of what is imported below, wherever in a file."""
    names = {
        name.partition(".")[0]
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        for name in modules(ast.parse(path.read_text(encoding="utf-8")))
    }
    others = names - sys.stdlib_module_names - {"dwell", "tests", "benchmarks", "examples"}
    return {plain(found) for name in others for found in DISTRIBUTIONS.get(name, [])} - PARTS


def modules(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if called in BY_NAME:
                yield str(node.args[0].value)


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def named(requirements: list[Any]) -> set[str]:
    return {
        plain(re.split(r"[\s<>=!~;\[]", one)[0]) for one in requirements if isinstance(one, str)
    }


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_package_uses_what_it_declares_and_no_more(project: dict[str, Any]) -> None:
    declared = project["project"]["dependencies"]
    extras = project["project"]["optional-dependencies"].values()
    assert imported("src") == named([*declared, *(one for extra in extras for one in extra)])


def test_the_tests_use_what_their_group_has(project: dict[str, Any]) -> None:
    group = named(project["dependency-groups"]["test"]) - NOT_IMPORTED
    assert group <= imported("tests", "benchmarks")


def test_everything_is_pinned_by_hash() -> None:
    for path in (ROOT / "requirements").glob("*.txt"):
        text = path.read_text(encoding="utf-8")
        pins = re.findall(
            r"^[\w.-]+(?:\[[\w,]+\])?==\S+.*?(?=^\S|\Z)", text, re.MULTILINE | re.DOTALL
        )
        assert pins, path
        assert all("--hash=sha256:" in pin for pin in pins), path
        assert "://" not in text, path


@pytest.mark.parametrize("folder", ["src", "docs", "examples", "README.md", "CHANGELOG.md"])
def test_nobody_is_told_to_install_the_strangers_package(folder: str) -> None:
    """`dwell` on the package index is somebody else's; ours is `dwell-placement`."""
    suffixes = {".py", ".md", ".yaml", ".ipynb", ".toml"}
    place = ROOT / folder
    files = [place] if place.is_file() else [p for p in place.rglob("*") if p.suffix in suffixes]
    assert files
    pattern = re.compile(
        r"(?:pip|uv|pipx|poetry)[a-z ]* (?:install|add) [^\n`]*?\bdwell(?!-placement)\b"
    )
    for file in files:
        found = pattern.search(file.read_text(encoding="utf-8"))
        assert found is None, f"{file.relative_to(ROOT)}: {found}"
