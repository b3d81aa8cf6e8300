"""Targets: what a name leads to, and what is said when it leads nowhere."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.calibration.target import find_callable
from dwell.errors import ProfileError
from dwell.model.user_classes import importable_from

MODULE = """\
import functools

def perceive(): return "perceived"

class Stage:
    def process(self, inputs): return inputs
    def __call__(self): return "called"

class Silent:
    def process(self, inputs): return inputs

class Tree:
    stage = Stage()

stage = Stage()
silent = Silent()
half = functools.partial(stage.process, 7)
frames = [1, 2]
async def later(): ...
def frames_forever():
    yield 1
class Asynchronous:
    async def __call__(self): ...
asynchronous = Asynchronous()
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Return a folder with modules that are found from it."""
    package = tmp_path / "a_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "stages.py").write_text(MODULE)
    (package / "broken.py").write_text("x = 1\nimport not_installed\n")
    (package / "failing.py").write_text("\n\nraise RuntimeError('no camera')\n")
    (package / "leaving.py").write_text("raise SystemExit(3)\n")
    (package / "wrong.py").write_text("def f(:\n")
    with importable_from(str(tmp_path)):
        yield tmp_path
    for name in [name for name in sys.modules if name.startswith("a_package")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("name", "returns"),
    [
        ("perceive", "perceived"),
        ("stage", "called"),
        ("half", 7),
        ("Tree.stage.__call__", "called"),
    ],
)
def test_functions_objects_and_methods(folder: Path, name: str, returns: object) -> None:
    assert find_callable(f"a_package.stages:{name}", "--task t")() == returns


def test_a_method_takes_inputs(folder: Path) -> None:
    assert find_callable("a_package.stages:silent.process", "--task t")({"a": 1}) == {"a": 1}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("stages", "not of the form package.module:function"),
        ("a_package.stages:", "not of the form package.module:function"),
        ("a package:f", "not of the form package.module:function"),
        (":f", "not of the form package.module:function"),
        ("no_such:f", "no module 'no_such'"),
        ("a_package.no_such:f", "no module 'a_package.no_such'"),
        ("a_package.broken:f", "importing 'a_package.broken' failed: ModuleNotFoundError: .*not_"),
        ("a_package.broken:f", r"\(broken.py:2\)"),
        ("a_package.failing:f", r"failed: RuntimeError: no camera \(failing.py:3\)"),
        ("a_package.leaving:f", "failed: SystemExit: 3"),
        ("a_package.wrong:f", r"failed: SyntaxError: .*\(wrong.py, line 1\)"),
        (
            "a_package.stages:percieve",
            "a_package.stages has no 'percieve'; did you mean 'perceive'",
        ),
        ("a_package.stages:Tree.stag", "a_package.stages.Tree has no 'stag'; did you mean 'stage'"),
        ("a_package.stages:frames", "is of type list, not a function"),
        ("a_package.stages:Stage", "is a class, not a function.*name its method"),
        ("a_package.stages:silent", "is of type Silent, .*module:object.process"),
        ("a_package.stages:later", "is async"),
        ("a_package.stages:asynchronous", "is async"),
        ("a_package.stages:frames_forever", "is a generator"),
    ],
)
def test_what_cannot_be_timed(folder: Path, name: str, words: str) -> None:
    with pytest.raises(ProfileError, match=f"^--task t: .*{words}"):
        find_callable(name, "--task t")


def test_where_modules_are_looked_for_is_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(ProfileError, match=re.escape(str(folder))):
        find_callable("no_such:f", "--task t")


def test_the_path_is_given_back(tmp_path: Path) -> None:
    before = list(sys.path)
    with importable_from(str(tmp_path)):
        assert sys.path == [str(tmp_path.resolve()), *before]
    assert sys.path == before
