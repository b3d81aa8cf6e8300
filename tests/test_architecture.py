"""The page on the architecture, held against the sources."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
SOURCES = ROOT / "src" / "dwell"
PACKAGES = {path.parent.name for path in SOURCES.glob("*/__init__.py")}
MODULES = {path.stem for path in SOURCES.glob("[a-z]*.py")}


def test_every_room_has_its_sentence() -> None:
    section = PAGE.partition("## The rooms")[2].partition("\n## ")[0]
    rooms = re.findall(r"^- `(\w+)`: ", section, re.MULTILINE)
    assert sorted(rooms) == sorted({"dwell_lab"} | PACKAGES | MODULES)


def test_every_room_is_in_the_picture() -> None:
    picture = PAGE.partition("```text")[2].partition("```")[0]
    assert set(re.findall(r"[a-z]+", picture)) >= PACKAGES | MODULES


NAMED = {
    name for name in re.findall(r"`(\w+(?:\.\w+)+)`", PAGE) if name.partition(".")[0] in PACKAGES
}


@pytest.mark.parametrize("name", sorted(NAMED))
def test_what_the_page_names_is_there(name: str) -> None:
    package, _, member = name.rpartition(".")
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


#: Modules and public classes of one name in two packages, each with the reason. (A module of `cli`
#: and of `live.commands` has the name of its command.)
MODULES_OF_TWO = {
    "fleet": ["model", "sim"],  # the definition of a fleet; the simulation of its cells
    "process": ["live", "model"],  # a cell's process on this computer; random processes
    "protocol": ["estimators", "policies"],  # the same part of two packages of one kind
    "registry": ["estimators", "policies"],  # the same
    "timeline": ["live", "report"],  # of a scenario's changes; of a run's figure
}
CLASSES_OF_TWO = {
    "Message": ["estimators", "live"],  # a flow on a link; a stage's input or output
    "Phase": ["kernels", "report"],  # when a kernel checks a quota; a stretch of a run
    "Sink": ["live"],  # the process of a sink task; an actuator that publishes on a ROS topic
    "Source": ["cellfile", "live"],  # the file of a trace; a stage that reads a ROS topic
}


def test_names_of_modules_are_unique() -> None:
    places = defaultdict(list)
    for path in SOURCES.rglob("[a-z]*.py"):
        if package_of(path) != "cli" and path.parent.name != "commands":
            places[path.stem].append(package_of(path))
    assert twice(places) == MODULES_OF_TWO


def test_names_of_public_classes_are_unique() -> None:
    places = defaultdict(list)
    for path in SOURCES.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(package_of(path))
    assert twice(places) == CLASSES_OF_TWO


#: Modules that import what a string names: the façades when a name of theirs is asked for, the
#: entry points of classes (rows of the registries, other packages' declarations), and those that
#: import a user's modules or packages of others. Everything else imports in so many words.
BY_NAME = {
    *("__init__", "control/__init__", "estimators/__init__", "model/__init__", "policies/__init__"),
    *("record/__init__", "report/__init__", "sim/__init__", "study/__init__"),
    "model/entry_points",
    *("calibration/target", "live/stage", "model/user_classes"),
    *("cli/doctor", "study/cluster"),
}


@cache
def trees() -> dict[str, ast.Module]:
    """Return the syntax tree of each source, by name."""
    return {
        str(path.relative_to(SOURCES).with_suffix("")): ast.parse(path.read_text(encoding="utf-8"))
        for path in SOURCES.rglob("*.py")
    }


def test_only_facades_and_entry_points_import_by_name() -> None:
    calls = {"import_module", "__import__", "attach_stub"}
    found = {
        name
        for name, tree in trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and calls & {getattr(node.func, "id", ""), getattr(node.func, "attr", "")}
    }
    assert found == BY_NAME


def strings(tree: ast.AST) -> Iterator[str]:
    """Yield all strings of a source, and the parts of those that are composed."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_a_string_names_modules_of_its_own_package_alone() -> None:
    """Rows of a registry and of a façade, and programs that are started, are of the same one."""
    named = {
        name: {
            match[1]
            for text in strings(tree)
            if (match := re.fullmatch(r"dwell\.(\w*)(?:\.[\w.]*)?(?::\w*)?", text))
            and (match[1] in {"", *PACKAGES, *MODULES})
        }
        for name, tree in trees().items()
        if name != "__init__"
    }
    abroad = {name: some - {name.partition("/")[0]} for name, some in named.items()}
    assert not {name: some for name, some in abroad.items() if some}


def test_only_the_command_imports_the_facade() -> None:
    """The façade may import all, so that what it is imported by would be above all."""
    found = {
        name.rpartition("/")[0]
        for name, tree in trees().items()
        for node in ast.walk(tree)
        if (isinstance(node, ast.Import) and any(one.name == "dwell" for one in node.names))
        or (isinstance(node, ast.ImportFrom) and node.module == "dwell")
    }
    assert found == {"cli", "live/commands"}


SIMULATOR = (
    *("cost", "kernels", "policies", "estimators", "cellfile", "record", "control", "sim"),
    *("study", "report", "files"),
)
LIVE = ("live", "live.transport", "live.wire", "live.trust", "live.roles")
#: What may import the façade, which may import all.
COMMANDS = ("cli", "live.commands", "lab")
#: Packages, each with the packages and modules that its files may import. Besides, all may import
#: `errors`, `display` and `version`, and all but `files` may import `model`.
MAY_IMPORT = {
    "errors": (),
    "files": (),
    "display": (),
    "version": (),
    "model": (),
    "cost": (),
    "kernels": (),
    "policies": ("cost",),
    "estimators": ("cost", "kernels"),
    "cellfile": ("files", "policies.registry", "estimators.registry"),
    "record": ("cellfile", "files"),
    "control": ("cost", "policies", "estimators"),
    "sim": ("control", "record", "kernels", "estimators.searched_cell"),
    "study": (
        "sim",
        "record",
        "cellfile",
        "control",
        "cost",
        "policies",
        "estimators",
        "kernels",
        "files",
    ),
    "report": ("study", "record", "policies.registry", "estimators.registry", "files"),
    "live": (),
    "live.wire": ("cellfile",),
    "live.transport": ("live", "live.wire"),
    "live.trust": ("live.wire", "files"),
    "live.roles": (
        *("live", "live.transport", "live.wire", "live.trust", "control", "record"),
        "study.metric",
    ),
    "live.ros2": ("live", "live.wire"),
    "live.host": (*LIVE, "live.ros2", "control", "record", "cellfile", "files"),
    "live.local": (*LIVE, "live.host", "sim", "record", "cellfile", "files"),
    "dash": (*LIVE, "live.host", "record", "cellfile", "study"),
    "calibration": ("record", "cellfile", "sim", "files"),
    "cli": SIMULATOR,
    "live.commands": (
        *SIMULATOR,
        *LIVE,
        *("live.ros2", "live.host", "live.local", "dash", "calibration", "cli"),
    ),
    "lab": (*SIMULATOR, *LIVE, "live.host", "live.local", "calibration", "cli"),
}


def room(module: str) -> str:
    """Return the row of a module in the table; empty for the façade."""
    parts = module.split(".")
    if parts[0] == "dwell_lab":
        return "lab"
    deeper = ".".join(parts[1:3])
    return deeper if deeper in MAY_IMPORT else "".join(parts[1:2])


def test_every_file_imports_what_its_package_may() -> None:
    graph = grimp.build_graph("dwell", "dwell_lab", cache_dir=None)
    assert {room(one) for one in graph.modules} - {"", "__main__"} == MAY_IMPORT.keys()
    wrong = [
        f"{importer} imports {imported}"
        for importer in graph.modules
        if room(importer) in MAY_IMPORT
        for imported in graph.find_modules_directly_imported_by(importer)
        if not may_import(room(importer), imported)
    ]
    assert not wrong


def may_import(importer: str, imported: str) -> bool:
    """Whether the table lets a package import a module."""
    target = room(imported)
    always = {importer, "errors", "display", "version", *(["model"] if importer != "files" else [])}
    if target in always or (not target and importer in COMMANDS):
        return True
    rows = MAY_IMPORT[importer]
    return target in rows or imported.removeprefix("dwell.") in rows


#: Functions with more lines than `MOST_LINES`; the list may only shrink.
LONG = {
    "dwell/kernels/arrays.py:_Layout._tables",
    "dwell/live/host/node.py:run_agent",
    "dwell/live/host/node.py:run_controller",
    "dwell/live/roles/worker.py:Worker.__init__",
}
#: Most lines of a function without its docstring; of a command also without its options.
MOST_LINES = 60


def functions(tree: ast.AST, prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield the functions of a source with their names, those of classes as Class.name."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield f"{prefix}{node.name}", node
        inner = f"{node.name}." if isinstance(node, ast.ClassDef) else prefix
        yield from functions(node, inner)


def lines_of(function: ast.FunctionDef, *, is_command: bool) -> int:
    """Return the number of lines of a function without its docstring."""
    statements = function.body
    documented = ast.get_docstring(function, clean=False) is not None
    first, last = statements[0], statements[-1]
    body = (last.end_lineno or 0) - first.lineno + 1
    docstring = (first.end_lineno or 0) - first.lineno + 1 if documented else 0
    return body - docstring + (0 if is_command else first.lineno - function.lineno)


def test_a_function_fits_a_screen() -> None:
    found = set()
    for folder in (SOURCES.parent, ROOT / "lab" / "src"):
        for path in folder.rglob("*.py"):
            is_command = path.parent.name in ("cli", "commands")
            for name, function in functions(ast.parse(path.read_text(encoding="utf-8"))):
                if lines_of(function, is_command=is_command) > MOST_LINES:
                    found.add(f"{path.relative_to(folder)}:{name}")
    assert found == LONG


def test_no_file_stands_on_itself() -> None:
    """However many files lie between, and where types alone are imported, too; façades aside."""
    graph = grimp.build_graph("dwell", cache_dir=None)
    facades = {one for one in graph.modules if graph.find_children(one)}
    below = {
        one: graph.find_modules_directly_imported_by(one) - facades
        for one in graph.modules - facades
    }
    assert len(below) > 300
    assert list(TopologicalSorter(below).static_order())


def test_what_shows_itself_does_after_an_import_of_the_package_alone() -> None:
    """Nothing that makes what is shown is imported before it is shown."""
    script = (
        "import dwell, sys; problem = dwell.load('examples/canonical.yaml'); "
        "before = [name for name in sys.modules if name.startswith('dwell.report')]; "
        "assert problem.summary() and problem._repr_html_(); print(before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert done.stdout == "[]\n"


def test_a_live_process_imports_no_command_and_no_report() -> None:
    script = (
        "import sys, dwell.live.host.node_command, dwell.live.host.role_process; "
        "print([name for name in sys.modules if name.split('.')[:2] in "
        "(['dwell', 'cli'], ['dwell', 'report'], ['dwell', 'testbed'], ['typer'])])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    )
    assert done.stdout == "[]\n"
