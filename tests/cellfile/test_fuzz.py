"""Whatever stands in a file, reading it ends in a problem or in faults that say where they are."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dwell.cellfile import from_document, load
from dwell.errors import ProblemError
from dwell.model import Problem
from tests.cellfile.faulty import DOCUMENT
from tests.cellfile.test_cell import EXAMPLE

RICH: dict[str, Any] = {
    **copy.deepcopy(DOCUMENT),
    "release_jitter_ms": {"uniform": {"low": 0, "high": 1}},
}
RICH["nodes"]["E"] |= {
    "accelerators": {"gpu": 1},
    "quota": {"cpu": 0.4, "period_ms": 4},
    "bursts": {"every_ms": {"exponential": {"mean": 100}}, "for_ms": 5, "threads": 2},
}
RICH["links"][0] |= {
    "on_loss": {"retransmit_ms": 20},
    "bursts": {"every_ms": 9, "for_ms": 1, "add_delay_ms": {"gamma": {"mean": 1, "cv": 1}}},
}
RICH["tasks"]["planning"] |= {"input": {"queue": 4}, "workers": 2}
RICH["tasks"]["planning"]["on"]["E"] = {
    "exec_ms": {"trace": {"file": "none.csv", "column": "a", "by": "time", "group": ["run"]}}
}

NUMBERS = (0, -1, 1, 3, 0.5, -0.5, 1e308, 10**400, math.nan, math.inf, -math.inf)
WORDS = ("", "x", "NO", "R1", "E", "LOC", "5", "1e3", "\ud800", "a\nb", "trace", "latest")
ODD: st.SearchStrategy[object] = st.sampled_from((None, True, False, *NUMBERS, *WORDS))
ODDER = ODD | st.lists(ODD, max_size=2) | st.dictionaries(st.text(max_size=3), ODD, max_size=2)


def _places(value: object, steps: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the place of every value inside."""
    items = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        items = enumerate(value)  # type: ignore[assignment]
    for key, item in items:
        yield (*steps, key)
        yield from _places(item, (*steps, key))


def _mutate(document: dict[str, Any], data: st.DataObject) -> None:
    """Delete, replace, rename or move one value somewhere."""
    places = list(_places(document))
    steps = data.draw(st.sampled_from(places))
    parent: Any = document
    for step in steps[:-1]:
        parent = parent[step]
    key, action = steps[-1], data.draw(st.sampled_from(("delete", "odd", "rename", "other")))
    if action == "delete":
        del parent[key]
    elif action == "rename" and isinstance(parent, dict):
        parent[data.draw(st.text(max_size=5) | st.just(f"{key}s") | st.sampled_from("Ex"))] = (
            parent.pop(key)
        )
    elif action == "other":
        found: Any = document
        for step in data.draw(st.sampled_from(places)):
            found = found[step]
        parent[key] = copy.deepcopy(found)
    else:
        parent[key] = data.draw(ODDER)


def _outcome(read: Callable[[], Problem]) -> Problem | ProblemError:
    try:
        return read()
    except ProblemError as error:
        return error


@settings(suppress_health_check=list(HealthCheck))
@given(st.data())
def test_a_mutated_document_is_read_or_refused_with_paths(data: st.DataObject) -> None:
    document = copy.deepcopy(RICH)
    if data.draw(st.booleans()):
        document["tasks"]["planning"]["on"]["E"]["exec_ms"] = 3  # instead of a missing file
    for _ in range(data.draw(st.integers(1, 4))):
        if document:
            _mutate(document, data)
    outcome = _outcome(lambda: from_document(document))
    if isinstance(outcome, ProblemError):
        assert any(fault.path for fault in outcome.faults)
        assert all(fault.message for fault in outcome.faults)
        assert len(str(outcome).splitlines()) == len(outcome.faults)
        assert str(outcome).encode()


@settings(suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_mutated_file_is_read_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    text = bytearray(EXAMPLE.read_bytes())
    pieces = st.binary(max_size=3) | st.sampled_from((b"{", b"]", b": ", b"\n", b"&a ", b"*a "))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at : at + data.draw(st.integers(0, 8))] = data.draw(pieces)
    path = tmp_path / "cell.yaml"
    path.write_bytes(text)
    outcome = _outcome(lambda: load(path))
    if isinstance(outcome, ProblemError):
        assert outcome.faults
        assert str(outcome).startswith(str(path))


@settings(suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_file_is_read_as_its_document_is(data: st.DataObject, tmp_path: Path) -> None:
    document = copy.deepcopy(DOCUMENT)
    _mutate(document, data)
    path = tmp_path / "cell.yaml"
    # Quoted, for PyYAML takes the text 1e3 for one that needs no quotes.
    path.write_text(yaml.safe_dump(document, default_style='"'), encoding="utf-8")
    plain, written = _outcome(lambda: from_document(document)), _outcome(lambda: load(path))
    if isinstance(plain, Problem):
        assert written == plain
    else:
        assert isinstance(written, ProblemError)
