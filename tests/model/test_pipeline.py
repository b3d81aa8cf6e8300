"""Pipeline: its order, and what a shadow cannot share."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import ProblemError
from dwell.model import Constant, Execution, Flow, Pipeline, Task

EXECUTION = Execution(Constant(1.0))


@pytest.mark.parametrize(
    ("make", "path", "words"),
    [
        (lambda: Task("a", {}), "on", "at least one node"),
        (lambda: Task("a", {"R": EXECUTION}, depth=-1), "input", "a whole number from 0"),
        (lambda: Flow("a", "b", -1), "bytes", "from 0 to 1e12"),
        (lambda: Pipeline({"b": Task("a", {"R": EXECUTION})}, (), 1, 1), "tasks.b", "its key"),
        (lambda: Pipeline({}, (), 1, 64.5), "deadline_ms", "at most 64 period_ms = 64"),
    ],
)
def test_what_a_constructor_refuses(make: Callable[[], object], path: str, words: str) -> None:
    with pytest.raises(ProblemError) as caught:
        make()
    (fault,) = caught.value.faults
    assert fault.path == path
    assert words in fault.message


def pipeline(*flows: tuple[str, str], tasks: str = "abcd") -> Pipeline:
    on = {"R": EXECUTION, "E": EXECUTION}
    named = {name: Task(name, on) for name in tasks}
    return Pipeline(named, tuple(Flow(*flow) for flow in flows), 10.0, 10.0)


DIAMOND = pipeline(("a", "b"), ("a", "c"), ("b", "d"), ("c", "d"))


def test_every_flow_points_forward() -> None:
    order = pipeline(("d", "a"), ("a", "b"), ("d", "c")).topological()
    assert order == ("d", "a", "c", "b")
    assert DIAMOND.topological() == ("a", "b", "c", "d")


def test_tasks_on_a_cycle_are_left_out() -> None:
    assert pipeline(("a", "b"), ("b", "c"), ("c", "b")).topological() == ("a", "d")


def test_inputs_and_outputs_are_flows() -> None:
    assert [flow.source for flow in DIAMOND.inputs("d")] == ["b", "c"]
    assert [flow.target for flow in DIAMOND.outputs("a")] == ["b", "c"]
    assert DIAMOND.inputs("a") == DIAMOND.outputs("d") == ()


@pytest.mark.parametrize(
    ("moved", "apart"), [("", ""), ("b", "bd"), ("d", "d"), ("a", "abcd"), ("bc", "bcd")]
)
def test_what_runs_elsewhere_and_all_behind_it_is_not_shared(moved: str, apart: str) -> None:
    active = dict.fromkeys("abcd", "R")
    other = {**active, **dict.fromkeys(moved, "E")}
    assert DIAMOND.diverging(active, other) == frozenset(apart)


@pytest.mark.parametrize(
    ("flows", "shown"),
    [
        ([("a", "b"), ("b", "c"), ("c", "d")], "a → b → c → d"),
        ([("a", "b"), ("a", "c"), ("b", "d"), ("c", "d")], "a → b → d; a → c → d"),
        ([("a", "c"), ("b", "c"), ("c", "d")], "a → c → d; b → c"),
        ([("a", "d"), ("b", "c")], "a → d; b → c"),
        ([], "a; b; c; d"),
    ],
)
def test_a_pipeline_is_shown_by_its_flows(flows: list[tuple[str, str]], shown: str) -> None:
    assert str(pipeline(*flows)) == shown
    assert shown.replace("→", "->") in repr(pipeline(*flows))


@given(st.sets(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=15))
def test_of_the_chains_every_step_is_a_flow_and_every_flow_a_step(
    pairs: set[tuple[int, int]],
) -> None:
    flows = {("abcdefg"[low], "abcdefg"[high]) for low, high in pairs if low < high}
    chains = pipeline(*sorted(flows), tasks="abcdefg").ways()
    steps = [step for chain in chains for step in itertools.pairwise(chain)]
    assert sorted(steps) == sorted(flows)
    assert {name for chain in chains for name in chain} == set("abcdefg")
