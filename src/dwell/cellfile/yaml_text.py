"""YAML text to plain values, with the line of each, by the core schema of YAML 1.2.

The parser (PyYAML) knows YAML 1.1, in which ``on``, ``off``, ``yes`` and ``NO`` are truth values,
``12:30`` is a number, ``1e3`` is a text and ``<<`` merges mappings. Its resolvers are replaced
here by the core schema's (YAML 1.2.2, section 10.3.2). Depth and the number of values, aliases
expanded, are bounded; tags that make objects are refused.
"""

from __future__ import annotations

import math
import os
import re
import stat
from collections.abc import Hashable

import yaml

from dwell.cellfile.document_faults import Faults
from dwell.model.dotted_paths import Step, dotted

MAX_BYTES = 4_000_000
MAX_DEPTH = 40
MAX_VALUES = 100_000

TAG = "tag:yaml.org,2002:"
RESOLVERS = (
    ("null", r"(?:~|null|Null|NULL|)", ["~", "n", "N", ""]),
    ("bool", r"(?:true|True|TRUE|false|False|FALSE)", list("tTfF")),
    ("int", r"(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)", list("-+0123456789")),
    (
        "float",
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))",
        list("-+.0123456789"),
    ),
)


class _Loader(yaml.SafeLoader):
    """The safe parser with the resolvers of YAML 1.2 and a bound on depth."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self.depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            problem = f"it is nested deeper than {MAX_DEPTH} levels"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1


for _name, _pattern, _first in RESOLVERS:
    _Loader.add_implicit_resolver(f"{TAG}{_name}", re.compile(f"{_pattern}\\Z"), _first)


def read_yaml(path: str, faults: Faults, what: str = "cell", begin: str = "dwell: 1") -> object:
    """Read a file into dicts, lists, strings, numbers, truth values and None.

    Parameters
    ----------
    faults : Faults
        Takes faults of the YAML text, and the line of every value.
    what, begin : str
        Kind of the file and its first line, for messages.

    Raises
    ------
    ProblemError
        If it is not YAML.
    """
    text = _read_text(path, faults, what)
    root = None if text is None else _composed(text, faults)
    if root is None and not faults:
        faults.add("", f"the file is empty; a {what} file begins with `{begin}`")
    value = None if root is None else _Builder(faults).build(root, ())
    if faults.at(""):
        raise faults.error()
    return value


def read_value(text: str, faults: Faults, path: str) -> object:
    """Read the text of an option as one value; record its faults at `path`.

    Returns
    -------
    object
        None if the text is empty or faulty.
    """
    inner = Faults()
    root = _composed(text, inner)
    value = None if root is None else _Builder(inner).build(root, ())
    for fault in inner.error().faults:
        faults.add(path, str(fault))
    return value


def yaml_of(document: object) -> str:
    """Return plain values as YAML: keys in their order, without references."""

    class Plain(yaml.SafeDumper):
        def ignore_aliases(self, data: object) -> bool:
            return True

    return yaml.dump(document, Dumper=Plain, sort_keys=False, width=100, allow_unicode=True)


def _composed(text: str, faults: Faults) -> yaml.Node | None:
    """Return the node of a text; None if it is empty, or after a fault."""
    try:
        root: yaml.Node | None = yaml.compose(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = " ".join(filter(None, (error.context, error.problem)))
        at = f" (column {mark.column + 1})" if mark else ""
        message = f"not a YAML document: {problem}{at}"
        faults.add("", message, line=mark.line + 1 if mark else None)
        return None
    except yaml.reader.ReaderError as error:
        code = ord(text[error.position])
        message = f"character U+{code:04X} is not allowed in YAML; remove it"
        faults.add("", message, line=text.count("\n", 0, error.position) + 1)
        return None
    except (ValueError, OverflowError) as error:  # the parser's own, on an escape like \UFFFFFFFF
        faults.add("", f"not a YAML document: {error}")
        return None
    return root


def _open_at_once(path: str, flags: int) -> int:
    """Open a file as `open` does; a pipe without a writer is not waited for."""
    return os.open(path, flags | os.O_NONBLOCK)


def _read_text(path: str, faults: Faults, what: str) -> str | None:
    try:
        with open(path, "rb", opener=_open_at_once) as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                faults.add("", f"not a regular file; name a {what} file")
                return None
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        faults.add("", "no such file; check the path")
    except IsADirectoryError:
        faults.add("", f"this is a folder; name the {what} file in it")
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        faults.add("", f"cannot be read: {reason}")
    else:
        if len(data) > MAX_BYTES:
            faults.add("", f"longer than {MAX_BYTES} bytes, the most a {what} file may have")
            return None
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            byte = data[error.start]
            message = f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8 text"
            faults.add("", message, line=data.count(b"\n", 0, error.start) + 1)
    return None


class _Builder:
    """Plain values from nodes. Aliases are expanded: each value has one path."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self.count = 0
        self.open: set[int] = set()

    def build(self, node: yaml.Node, steps: tuple[Step, ...]) -> object:
        self.count += 1
        if self.count > MAX_VALUES:
            if self.count == MAX_VALUES + 1:
                message = f"more than {MAX_VALUES} values, aliases expanded; use fewer aliases"
                self.faults.add("", message, line=node.start_mark.line + 1)
            return None
        if len(steps) > MAX_DEPTH:
            if not self.faults.at(""):
                message = f"nested deeper than {MAX_DEPTH} levels, aliases expanded"
                self.faults.add("", message, line=node.start_mark.line + 1)
            return None
        path = dotted(steps)
        self.faults.lines.setdefault(path, node.start_mark.line + 1)
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node, path)
        if id(node) in self.open:
            self.faults.add(path, "this alias contains itself; write the value out")
            return None
        if node.tag not in (f"{TAG}map", f"{TAG}seq"):
            self.faults.add(path, f"the tag {_tag(node)} is not allowed; remove it")
            return None
        self.open.add(id(node))
        value = self._mapping(node, steps) if isinstance(node, yaml.MappingNode) else None
        if isinstance(node, yaml.SequenceNode):
            value = [self.build(item, (*steps, i)) for i, item in enumerate(node.value)]
        self.open.discard(id(node))
        return value

    def _mapping(self, node: yaml.MappingNode, steps: tuple[Step, ...]) -> object:
        values: dict[Hashable, object] = {}
        first: dict[Hashable, int] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                message = "a key must be a text, not a mapping or a list"
                self.faults.add(dotted(steps), message, line=line)
                continue
            path = dotted((*steps, key_node.value))
            key = self._scalar(key_node, path)
            if not isinstance(key, str):
                if self.faults.at(path):
                    continue
                key = self.faults.take_as_text(path, key, key_node.value, line)
            if key in values:
                message = f"the key {key!r} is given again (first in line {first[key]}); keep one"
                self.faults.add(path, message, line=line)
            else:
                first[key] = self.faults.lines[path] = line
                values[key] = self.build(value_node, (*steps, key))
        return values

    def _scalar(self, node: yaml.ScalarNode, path: str) -> object:
        kind, text = node.tag.removeprefix(TAG), node.value
        try:
            if kind == "str":
                # JSON writes a character beyond U+FFFF as two escapes, which YAML keeps apart.
                return str(text).encode("utf-16", "surrogatepass").decode("utf-16")
            if kind == "null":
                return None
            if kind == "bool":
                return {"true": True, "false": False}[text.lower()]
            if kind == "int":
                return _whole(text)
            if kind == "float":
                return _real(text)
        except UnicodeDecodeError:
            self.faults.add(path, "half of a character (a lone \\uD800 to \\uDFFF); remove it")
        except (KeyError, ValueError):
            self.faults.add(path, f"{text!r} is not a value of the tag {_tag(node)}; remove it")
        else:
            self.faults.add(path, f"the tag {_tag(node)} is not allowed; remove it")
        return None


def _tag(node: yaml.Node) -> str:
    return str(node.tag).replace(TAG, "!!")


def _whole(text: str) -> int | float:
    if text.startswith(("0o", "0x")):
        return int(text, 0)
    # Python refuses thousands of digits; such a number is beyond every bound.
    return int(text) if len(text) < 400 else math.copysign(math.inf, float(text))


def _real(text: str) -> float:
    return float(re.sub(r"\.(inf|nan)", r"\1", text.lower()))
