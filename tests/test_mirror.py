"""Tests mirror the package: `src/dwell/A/B.py` is tested by `tests/A/test_B.py`."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "src" / "dwell"

#: Modules without a test file of their name, by package: nothing runs them but what is tested
#: through the module that uses them, or they only declare. The list may only become shorter.
WITHOUT = {
    "cellfile": """
        study_form
    """,
    "model": """
        dotted_paths
    """,
    "live": """
        node
    """,
    "testbed/chaos": """
        harness
    """,
    "testbed": """
        testbed
    """,
}


def modules() -> set[str]:
    """Return modules as paths below the package."""
    found = (path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))
    return {str(path.with_suffix("")) for path in found if not path.stem.startswith("__")}


def test_every_module_has_a_test_file_of_its_name_but_for_those_listed() -> None:
    listed = {f"{package}/{name}" for package, names in WITHOUT.items() for name in names.split()}
    listed = {name.removeprefix("./") for name in listed}
    without = {
        name
        for name in modules()
        if not (TESTS / name).with_name(f"test_{Path(name).name}.py").is_file()
    }
    assert without == listed
