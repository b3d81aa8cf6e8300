"""YAML text to plain values: the core schema of YAML 1.2, and what is refused."""

from __future__ import annotations

import json
import math
import os
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cellfile.document_faults import Faults
from dwell.cellfile.yaml_text import read_value, read_yaml
from dwell.errors import Fault, ProblemError
from dwell.model.dotted_paths import dotted


def _read(path: Path, text: str | bytes) -> tuple[object, list[Fault]]:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    faults = Faults()
    value = None
    with suppress(ProblemError):
        value = read_yaml(str(path), faults)
    return value, list(faults.error().faults)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{on: off, yes: no, NO: Yes, y: n}", {"on": "off", "yes": "no", "NO": "Yes", "y": "n"}),
        ("[true, True, TRUE, false, 'true']", [True, True, True, False, "true"]),
        ("[1e3, 1E-2, .5, -1., +2.5e+3, 010]", [1000.0, 0.01, 0.5, -1.0, 2500.0, 10]),
        (
            "[12:30, 1_000, 2024-01-02, 0b1, 1e, e1]",
            ["12:30", "1_000", "2024-01-02", "0b1", "1e", "e1"],
        ),
        ("[0o17, 0x1F, -5, +5]", [15, 31, -5, 5]),
        ("[~, null, Null, , '']", [None, None, None, None, ""]),
        ("{<<: a, =: b}", {"<<": "a", "=": "b"}),
        ("[.inf, -.Inf, +.INF]", [math.inf, -math.inf, math.inf]),
        ("[!!str 5, !!float 1.5, !!int 3]", ["5", 1.5, 3]),
        ("a: &x {b: 1}\nc: *x", {"a": {"b": 1}, "c": {"b": 1}}),
        ("\ufeffa: 1", {"a": 1}),
        ('"\\ud83d\\ude00"', "😀"),
        ("R1->E", "R1->E"),
    ],
)
def test_values_follow_the_core_schema(text: str, value: object, tmp_path: Path) -> None:
    found, faults = _read(tmp_path / "f.yaml", text.replace(", ,", ", ~,"))
    assert faults == []
    assert found == value
    assert repr(found) == repr(value)


def test_nan_is_a_number_and_a_huge_one_is_infinite(tmp_path: Path) -> None:
    value, faults = _read(tmp_path / "f.yaml", f"[.nan, 1e999, -{'9' * 5000}]")
    assert faults == []
    assert isinstance(value, list)
    assert math.isnan(value[0])
    assert value[1:] == [math.inf, -math.inf]


@pytest.mark.parametrize(
    ("text", "path", "line", "words"),
    [
        ("a: 1\nb: 2\na: 3", "a", 3, ("'a'", "again", "line 1")),
        ("x:\n  - {k: 1, k: 2}", "x[0].k", 2, ("'k'", "again")),
        ("a: 1\n2: 3", "2", 2, ("2", "quotes")),
        ("a: 1\ntrue: 3", "true", 2, ("true", "quotes")),
        ("? [a]\n: 1", "", 1, ("a key must be a text",)),
        ("a: !!python/object:os.system x", "a", 1, ("!!python/object:os.system", "not allowed")),
        ("a: !mine {b: 1}", "a", 1, ("!mine", "not allowed")),
        ("a: !!set {b}", "a", 1, ("!!set", "not allowed")),
        ("a: !!int x", "a", 1, ("'x'", "!!int")),
        ("a: !!binary YQ==", "a", 1, ("!!binary",)),
        ("a: &x [1, *x]", "a[1]", 1, ("contains itself",)),
        ("a:\n\t- b", "", 2, ("not a YAML document",)),
        ("a: [1, 2", "", 1, ("not a YAML document", "',' or ']'")),
        ("a: *nobody", "", 1, ("not a YAML document", "nobody")),
        ("a: 1\n---\na: 2", "", 2, ("single document",)),
        ('a: "\\UFFFFFFFF"', "", None, ("not a YAML document",)),
        ('a: "\\ud800"', "a", 1, ("half of a character",)),
        ("a: 1\nb: \x07", "", 2, ("U+0007",)),
        ("[" * 60, "", 1, ("deeper than 40",)),
        (b"a: 1\nb: \xc3(", "", 2, ("0xc3", "UTF-8")),
    ],
)
def test_what_is_refused(
    text: str | bytes, path: str, line: int | None, words: tuple[str, ...], tmp_path: Path
) -> None:
    _, faults = _read(tmp_path / "f.yaml", text)
    (fault,) = faults
    assert (fault.path, fault.line) == (path, line)
    for word in words:
        assert word in fault.message


def test_an_alias_bomb_is_refused(tmp_path: Path) -> None:
    levels = ["a0: &a0 [1, 2, 3, 4, 5, 6, 7, 8, 9]"]
    levels += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    _, faults = _read(tmp_path / "f.yaml", "\n".join(levels))
    (fault,) = faults
    assert "more than 100000 values" in fault.message


def test_aliases_that_nest_too_deep_are_refused(tmp_path: Path) -> None:
    levels = ["a0: &a0 [1]", *(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 2_000))]
    _, faults = _read(tmp_path / "f.yaml", "\n".join(levels))
    (fault,) = faults
    assert "nested deeper than 40 levels" in fault.message


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    file = tmp_path / "f.yaml"
    os.mkfifo(file)
    with pytest.raises(ProblemError, match="not a regular file; name a cell file"):
        read_yaml(str(file), Faults(str(file)))


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.text()
        | st.floats(allow_nan=False, allow_infinity=False),
        # YAML wants a key within 1024 characters, of which an escaped one takes twelve.
        lambda inner: st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=80), inner, max_size=4),
        max_leaves=12,
    ),
    st.booleans(),
)  # fmt: skip
def test_json_is_read_as_json(value: object, escaped: bool) -> None:
    with TemporaryDirectory() as folder:
        text = json.dumps(value, ensure_ascii=True, indent=2 if escaped else None)
        found, faults = _read(Path(folder) / "f.json", text)
    assert faults == []
    assert found == value


@pytest.mark.parametrize(
    ("steps", "path"),
    [((), ""), (("a",), "a"), (("links", 0, "from"), "links[0].from"), (("a", 0, 1), "a[0][1]")],
)
def test_paths_are_dotted(steps: tuple[str | int, ...], path: str) -> None:
    assert dotted(steps) == path


def test_the_line_of_a_path_is_that_of_what_is_around_it(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text("a:\n  b:\n    - c: 1\n    - d: 2\n")
    faults = Faults()
    read_yaml(str(path), faults)
    lines = {where: faults.line(where) for where in ("a.b[1].d", "a.b[1].x.y", "a.b", "a.z", "q")}
    assert lines == {"a.b[1].d": 4, "a.b[1].x.y": 4, "a.b": 2, "a.z": 1, "q": 1}


@pytest.mark.parametrize(
    ("text", "value", "message"),
    [
        ("4e1", 40.0, ""),
        ("{a: [on, ~]}", {"a": ["on", None]}, ""),
        ("", None, ""),
        ("{a: 1", None, "not a YAML document: while parsing a flow mapping"),
        ("{a: 1, a: 2}", {"a": 1}, "a: the key 'a' is given again (first in line 1); keep one"),
    ],
)
def test_a_text_that_is_one_value_has_its_faults_at_one_place(
    text: str, value: object, message: str
) -> None:
    faults = Faults()
    assert read_value(text, faults, "here") == value
    found = faults.error().faults
    assert [fault.path for fault in found] == (["here"] if message else [])
    assert all(fault.message.startswith(message) for fault in found)
