"""Faults of a document: each once, in the order of its lines, on one line each."""

from __future__ import annotations

import pytest

from dwell.cellfile.document_faults import Faults
from dwell.errors import Fault, ProblemError, TraceError
from dwell.model.dotted_paths import dotted


@pytest.mark.parametrize(
    ("steps", "path"),
    [
        (("links", 0, "from"), "links[0].from"),
        ((), ""),
        (("nodes", ""), "nodes.''"),
        (("scenarios", "s", 1, 2), "scenarios.s[1][2]"),
    ],
)
def test_a_path_is_written_as_people_do(steps: tuple[str | int, ...], path: str) -> None:
    assert dotted(steps) == path


def test_faults_come_once_and_in_the_order_of_their_lines() -> None:
    faults = Faults("cell.yaml")
    faults.lines |= {"b": 9, "a": 2, "a.x[0]": 4}
    for path in ("b", "a.x[0].y", "a.x", "b"):
        faults.add(path, "no")
    faults.add("b", "nor this")
    assert len(faults) == 4
    assert [(fault.path, fault.line) for fault in faults.error().faults] == [
        ("a.x", 2),
        ("a.x[0].y", 4),
        ("b", 9),
        ("b", 9),
    ]


def test_what_is_at_a_path_and_what_touches_it() -> None:
    faults = Faults()
    faults.add("nodes.R1.cores", "no")
    assert faults.at("nodes.R1.cores")
    assert not faults.at("nodes.R1")
    assert faults.touches("nodes.R1")
    assert faults.touches("nodes.R1.cores.more")
    assert not faults.touches("nodes.R")
    assert not faults.touches("nodes.R1.core")


def test_what_cannot_be_made_leaves_its_faults_beneath_its_path() -> None:
    def make(value: int) -> int:
        if value < 0:
            raise ProblemError([Fault("mean", "below 0"), Fault("", "all of it")])
        return value

    faults = Faults()
    assert faults.attempt("tasks.a", make, 3) == 3
    faults.add("tasks.a.mean", "known already")
    assert faults.attempt("tasks.a", make, -1) is None
    told = [(fault.path, fault.message) for fault in faults.error().faults]
    assert told == [("tasks.a.mean", "known already"), ("tasks.a", "all of it")]


def test_only_traces_at_fault_are_a_trace_error() -> None:
    faults = Faults()
    faults.add("links[0]", "no such file", kind=TraceError)
    assert type(faults.error()) is TraceError
    faults.add("name", "no\x1b[2Jname\n")
    error = faults.error()
    assert type(error) is ProblemError
    assert str(error).splitlines()[-1] == r"name: no\x1b[2Jname\n"


def test_a_refusal_is_the_only_fault() -> None:
    faults = Faults("cell.yaml")
    faults.add("a", "no")
    with pytest.raises(ProblemError) as caught:
        faults.refuse("", "another format")
    assert [fault.message for fault in caught.value.faults] == ["another format"]
