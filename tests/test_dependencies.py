"""What pyproject.toml declares is what the package imports: nothing more, nothing less."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from dwell.errors import FURTHER, OPTIONAL, missing_package
from dwell.kernels.library import INSTALL_AGAIN
from dwell.kernels.library_file import NAME
from tests.kernels.compilers import run_with

ROOT = Path(__file__).parents[1]
DISTRIBUTIONS = packages_distributions()

#: Tools that are run, not imported.
NOT_IMPORTED = {"ipykernel", "pytest-xdist"}
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
    return {plain(found) for name in others for found in DISTRIBUTIONS.get(name, [])}


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
    all_of_them = [*declared, *(one for extra in extras for one in extra)]
    assert imported("src") == named(all_of_them) - {project["project"]["name"]}


def test_the_examples_need_the_package_and_their_own_group(project: dict[str, Any]) -> None:
    own = named(project["dependency-groups"]["demo"])
    assert own <= imported("examples")
    assert imported("examples") - own <= imported("src")


def test_the_reproduction_needs_the_package_and_its_own_group(project: dict[str, Any]) -> None:
    own = named(project["dependency-groups"]["reproduction"])
    assert own <= imported("reproduction")
    assert imported("reproduction") - own <= imported("src") | {"dwell", "reproduction"}


def test_every_extra_names_the_packages_that_messages_say_it_brings(
    project: dict[str, Any],
) -> None:
    extras = project["project"]["optional-dependencies"]
    for module, (_, extra) in OPTIONAL.items():
        distributions = {plain(name) for name in DISTRIBUTIONS[module]}
        assert distributions & named(extras[extra]), (module, extra)


@pytest.mark.parametrize("module", sorted({*OPTIONAL, *FURTHER}))
def test_what_is_missing_is_named_with_the_line_that_installs_it(module: str) -> None:
    error = missing_package(ModuleNotFoundError("", name=f"{module}.part"))
    assert error is not None
    assert "pip install" in str(error)


def test_a_module_that_is_not_ours_is_no_missing_package() -> None:
    assert missing_package(ModuleNotFoundError("", name="stages")) is None


def test_a_simulation_without_a_package_says_how_to_get_it(tmp_path: Path) -> None:
    """In a process of its own: this one has imported them."""
    script = (
        "import sys; sys.modules['polars'] = None; from dwell.cli import main; "
        "main(['run', 'canonical.yaml', '--windows', '2', '--out', sys.argv[1]])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "out"],
        cwd=ROOT / "examples",
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.endswith("is not installed; pip install 'dwell-placement[sim]'\n")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("command", ["run", "study"])
def test_a_simulation_without_the_kernel_says_how_to_get_it(command: str, tmp_path: Path) -> None:
    left_out = shutil.ignore_patterns(NAME, "__pycache__")
    shutil.copytree(ROOT / "src" / "dwell", tmp_path / "dwell", ignore=left_out)
    cell, study = ROOT / "examples" / "canonical.yaml", tmp_path / "study.yaml"
    study.write_text(
        f"dwell-study: 1\nname: small\ncell: {cell}\n"
        "policies: [LOC, dtp]\nscenarios: [baseline]\nseeds: 1\n",
        encoding="utf-8",
    )
    words = (cell,) if command == "run" else (study, "--processes", "2")
    options = ("--windows", "6", "--out", tmp_path / "out")
    done = run_with(tmp_path, "-m", "dwell", command, *words, *options)
    file = tmp_path / "dwell" / "kernels" / NAME
    lacking = f"the compiled kernel {file} is missing; {INSTALL_AGAIN}"
    assert done.returncode == 1
    assert done.stderr.endswith(f"error: {lacking}\n")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("module", "work", "extra"),
    [
        (
            "msgspec",
            "from dwell.live.host.role_command import main; "
            "sys.exit(main(['--cell', 'live/cell.yaml', '--who', 'stamper@R1', '--state', '/']))",
            "live",
        ),
    ],
)
def test_a_package_that_is_missing_is_named_to_programs(module: str, work: str, extra: str) -> None:
    script = f"import sys; sys.modules[{module!r}] = None; {work}"
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT / "examples",
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert f"is not installed; pip install 'dwell-placement[{extra}]'" in done.stderr


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
