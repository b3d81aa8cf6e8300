"""The reproduction stands on what a user of Dwell has: public names, and nothing else."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "reproduction"
FILES = sorted(FOLDER.rglob("*.py"))
PUBLIC = (
    "dwell",
    *(f"dwell.{name}" for name in ("model", "policies", "estimators", "study", "report")),
)


def names_of(file: Path) -> Iterator[tuple[str, str]]:
    """Yield the module and the name of everything that a file has from Dwell."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "dwell":
            yield from ((str(node.module), name.name) for name in node.names)
        elif isinstance(node, ast.Import):
            yield from ((name.name, "") for name in node.names if name.name.startswith("dwell."))
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "dwell":
            yield "dwell", node.attr


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(FOLDER)))
def test_only_public_names_are_used(file: Path) -> None:
    for module, name in names_of(file):
        assert module in PUBLIC, f"{module} is not public"
        assert name in (*import_module(module).__all__, "__version__"), f"{module}.{name}"


def test_there_is_something_to_look_at() -> None:
    assert {module for file in FILES for module, _ in names_of(file)} >= {"dwell", "dwell.study"}
