"""What is said of faults: of cell files, of study files, and of values given in Python."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

import dwell
from dwell import model
from dwell.cellfile import from_document, load_without_traces
from dwell.cellfile.overrides import load_with
from dwell.cellfile.study_paths import with_settings
from dwell.errors import DwellError
from dwell.estimators import registry as estimators
from dwell.policies import ATP, Cusum
from dwell.policies import registry as policies
from dwell.study import Contender, Point, load_study

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parent / "data"
CASES = DATA / "messages.yaml"
FILE = DATA / "messages.txt"
#: What cases in Python may name, beside the classes of `dwell.model` and what is read for them.
NAMES: dict[str, Any] = {
    "ATP": ATP,
    "Contender": Contender,
    "Cusum": Cusum,
    "Path": Path,
    "Point": Point,
    "from_document": from_document,
    "load": dwell.load,
    "load_with": load_with,
    "load_without_traces": load_without_traces,
    "make_estimator": estimators.by_name,
    "make_policy": policies.by_name,
    "replace": replace,
    "simulate": dwell.simulate,
    "with_settings": with_settings,
}


def messages() -> str:
    """Return every case, the kind of its error and what that says.

    The examples are copied to a folder of their own, and each edited copy read there by its
    relative name.
    """
    cases = yaml.safe_load(CASES.read_text(encoding="utf-8"))
    with TemporaryDirectory() as folder, contextlib.chdir(folder):
        for path in (ROOT / "examples").rglob("*.yaml"):
            copy = Path(path.relative_to(ROOT / "examples"))
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, copy)
        for name, text in cases["files"].items():
            _write(name, text)
        blocks = [*_edited(cases["edits"]), *_whole(cases["texts"]), *_python(cases["python"])]
        here = str(Path.cwd())
    return "\n".join(block.replace(here, "FOLDER") for block in blocks)


def _edited(edits: dict[str, list[str]]) -> Iterator[str]:
    """Yield what is said of each example with each of its edits, which are a line each."""
    for name, cases in edits.items():
        text = Path(name).read_text(encoding="utf-8")
        for case in cases:
            changed = text
            for edit in case.splitlines():
                changed = edited(changed, edit)
            yield _block(f"# {name}", case, partial(_read, name, changed))
        _write(name, text)


def _whole(texts: dict[str, list[str]]) -> Iterator[str]:
    """Yield what is said of documents of their own."""
    for name, cases in texts.items():
        for text in cases:
            yield _block(f"# {name}", text, partial(_read, name, text))


def _python(cases: list[str]) -> Iterator[str]:
    """Yield what is said of expressions."""
    classes = {name: getattr(model, name) for name in dir(model)}
    examples = {
        "canonical": dwell.load("canonical.yaml"),
        "fan_in": dwell.load("fan-in.yaml"),
        "study": load_study("studies/first.yaml"),
    }
    for case in cases:
        yield _block("# Python", case, partial(eval, case, {**classes, **NAMES, **examples}))


def _read(name: str, text: str) -> object:
    _write(name, text)
    if name == "fleet.yaml":
        return dwell.load_fleet(name)
    return load_study(name) if name.startswith("studies/") else dwell.load(name)


def _write(name: str, text: str) -> None:
    """Write a file; a lone surrogate stands for a byte."""
    Path(name).write_bytes(text.encode("utf-8", "surrogateescape"))


def _block(head: str, case: str, make: Callable[[], object]) -> str:
    """Return a case as the file has it, every sign to be seen, and what is said of it."""
    lines = (
        "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in line)
        for line in case.split("\n")
    )
    shown = "\n".join((head, *(f"    {line}" for line in lines if line)))
    try:
        made = make()
    except DwellError as error:
        return f"{shown}\n{type(error).__name__}\n{error}\n"
    raise AssertionError(f"{shown}\nis no fault: {made!r}")


# ------------------------------------------------------------------------------------ edits


def edited(text: str, edit: str) -> str:
    r"""Return a YAML text with one thing changed, every other line as it is.

    Parameters
    ----------
    edit : str
        ``PATH = VALUE`` puts YAML in the place of what is there, or adds a key before all others;
        ``remove PATH`` takes a key away; ``OLD ==> NEW`` changes the text, in which OLD stands
        once; ``\n`` and ``\t`` are the signs that they mean.
    """
    old, arrow, new = edit.partition(" ==> ")
    if arrow:
        before, after = (part.replace(r"\n", "\n").replace(r"\t", "\t") for part in (old, new))
        assert text.count(before) == 1, f"{before!r} is there {text.count(before)} times"
        return text.replace(before, after)
    if edit.startswith("remove "):
        return _removed(text, edit.removeprefix("remove "))
    path, equals, value = edit.partition(" = ")
    assert equals, edit
    parent, key, found = _place(text, path)
    if found is not None:
        begin, end = found.start_mark.index, _end(text, found)
        # Nothing stands right behind the colon.
        return f"{text[:begin]}{' ' if begin == end else ''}{value}{text[end:]}"
    if parent.flow_style:
        at = text.index("{", parent.start_mark.index) + 1
        return f"{text[:at]}{key}: {value}, {text[at:]}"
    first = parent.value[0][0].start_mark
    return f"{text[: first.index]}{key}: {value}\n{' ' * first.column}{text[first.index :]}"


def _removed(text: str, path: str) -> str:
    parent, key, found = _place(text, path)
    assert found is not None, path
    begins = [name.start_mark.index for name, _ in parent.value]
    names = [name.value for name, _ in parent.value]
    at = names.index(key)
    last = at == len(names) - 1
    return text[: begins[at]] + text[_end(text, found) if last else begins[at + 1] :]


def _place(text: str, path: str) -> tuple[Any, str, Any]:
    """Return the node around a place, its key there, and what is there; None where nothing is.

    Of the keys that a path may begin with the longest is taken; where there is none, all of the
    rest is the key.
    """
    node: Any = yaml.compose(text, yaml.CSafeLoader)
    parent, key, rest = node, "", path
    while rest:
        parent = node
        index = re.match(r"\[(\d+)\]\.?", rest)
        if index is not None:
            key, node, rest = index[0], node.value[int(index[1])], rest[index.end() :]
            continue
        inner = {name.value: value for name, value in node.value}
        known = [name for name in inner if re.match(rf"{re.escape(name)}(?=[.\[]|$)", rest)]
        if not known:
            return parent, rest, None
        key = max(known, key=len)
        node, rest = inner[key], rest[len(key) :].removeprefix(".")
    return parent, key, node


def _end(text: str, node: yaml.Node) -> int:
    """Return where a node ends; that of a block is where the next one begins."""
    begin = node.start_mark.index
    return begin + len(text[begin : node.end_mark.index].rstrip())
