"""Columns that are made of a cell's names: none of them is called as another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.model import Constant, Execution, Link, Node, Problem, Task
from dwell.model.fabric import Resource, resources_of
from dwell.model.table_columns import ENDS, TEMPLATES, clash_faults, columns_of
from dwell.record import column_types, open_run
from dwell.study import compare
from dwell.study.summary import summarise
from tests.cells.examples import CELLS, EXAMPLES
from tests.cells.generated import make_problem

CELL = """\
dwell: 1
period_ms: 10
window_cycles: 20
nodes: {edge: {tier: edge}, edge_gpu: {tier: edge}}
links: [{from: edge, to: edge_gpu, both_ways: true, delay_ms: 0}]
tasks:
  a: {on: {edge: {exec_ms: 1}}}
  b: {on: {edge: {exec_ms: 4}, edge_gpu: {exec_ms: 2}}}
flows: [{from: a, to: b}]
candidates:
  local: {b: edge}
  gpu_local: {b: edge_gpu}
"""


def cpus(*names: str) -> list[Resource]:
    """Return nodes without accelerators as resources."""
    return list(resources_of({name: Node(name, "edge") for name in names}))


def on_two(nodes: tuple[str, str], candidates: tuple[str, str]) -> Problem:
    """Return one task that may run on either of two nodes."""
    first, second = nodes
    return make_problem(
        [Node(name, "edge") for name in nodes],
        [Task("a", {name: Execution(Constant(1.0)) for name in nodes})],
        links=[Link(first, second, Constant(0.0)), Link(second, first, Constant(0.0))],
        candidates=dict(zip(candidates, ({"a": first}, {"a": second}), strict=True)),
    )


def test_both_pairs_are_named_at_the_line_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(CELL, encoding="utf-8")
    with pytest.raises(ProblemError) as error:
        dwell.load(file)
    (fault,) = error.value.faults
    assert (fault.path, fault.line) == ("candidates.local", 11)
    pairs = ("node edge, candidate gpu_local", "node edge_gpu, candidate local")
    assert all(part in fault.message for part in ("'est_u_edge_gpu_local'", *pairs))


@pytest.mark.parametrize(
    ("nodes", "candidates", "column", "path"),
    [
        (("edge", "cycles"), ("A", "B"), "shadow_cycles", "nodes.cycles"),
        (("bytes", "edge"), ("A", "B"), "shadow_bytes", "nodes.bytes"),
        (("edge", "edge_low"), ("A", "B"), "node_edge_low", "nodes.edge"),
        (("R", "E"), ("LOC", "LOC_high"), "share_LOC_high", "candidates.LOC"),
        (("a", "a_b"), ("b_c", "c"), "est_u_a_b_c", "candidates.c"),
    ],
)
def test_a_name_that_meets_another_column_is_refused(
    nodes: tuple[str, str], candidates: tuple[str, str], column: str, path: str
) -> None:
    (fault,) = clash_faults(cpus(*nodes), candidates)
    assert fault.path == path
    assert f"two columns '{column}'" in fault.message
    with pytest.raises(ProblemError, match=column):
        dwell.simulate(on_two(nodes, candidates), seed=1, windows=1)


def with_accelerators(**nodes: Mapping[str, int]) -> Problem:
    """Return a task on the first of some nodes with accelerators."""
    made = [Node(name, "edge", accelerators=kinds) for name, kinds in nodes.items()]
    return make_problem(made, [Task("a", {made[0].name: Execution(Constant(1.0))})])


def test_a_node_and_an_accelerator_of_one_name_are_refused_with_both_named() -> None:
    problem = with_accelerators(**{"E": {"gpu": 1}, "E.gpu": {}})
    (fault,) = clash_faults(resources_of(problem.fabric.nodes), ["LOC"])
    assert fault.path == "nodes.E.accelerators.gpu"
    assert "node E.gpu and accelerator gpu of node E" in fault.message
    with pytest.raises(ProblemError, match=r"'E\.gpu'"):
        dwell.simulate(problem, seed=1, windows=1)


def test_two_accelerators_of_one_name_are_refused_with_both_named() -> None:
    problem = with_accelerators(**{"a": {"b.c": 1}, "a.b": {"c": 1}})
    (fault,) = clash_faults(resources_of(problem.fabric.nodes), ["LOC"])
    assert fault.path == "nodes.a.b.accelerators.c"
    assert "accelerator b.c of node a and accelerator c of node a.b" in fault.message


def test_columns_of_an_accelerator_and_a_node_that_meet_are_refused_with_both_named() -> None:
    resources = resources_of(with_accelerators(E={"gpu": 1}, **{"E.gpu_x": {}}).fabric.nodes)
    (fault,) = clash_faults(resources, ["x_y", "y"])
    assert (fault.path, "'est_u_E.gpu_x_y'" in fault.message) == ("candidates.x_y", True)
    for part in ("accelerator gpu of node E, candidate x_y", "node E.gpu_x, candidate y"):
        assert part in fault.message


def test_a_cell_without_accelerators_has_the_columns_of_its_nodes_alone() -> None:
    problem = on_two(("R", "E"), ("LOC", "OFF"))
    columns = [name for name in column_types("windows", problem) if name.startswith("u_")]
    assert columns == ["u_R", "u_E"]


def test_accelerators_follow_the_nodes() -> None:
    problem = with_accelerators(R={"npu": 2, "dsp": 1}, E={"gpu": 1})
    columns = [name for name in column_types("windows", problem) if name.startswith("u_")]
    assert columns == ["u_R", "u_E", "u_R.npu", "u_R.dsp", "u_E.gpu"]


@pytest.mark.parametrize("name", CELLS)
def test_the_examples_columns_are_apart(name: str) -> None:
    problem = dwell.load(EXAMPLES / f"{name}.yaml")
    assert not list(clash_faults([*problem.fabric.resources.values()], tuple(problem.candidates)))


def test_what_no_clash_is_found_for_has_as_many_columns_as_are_declared() -> None:
    """Names that contain what other columns begin and end with, and each other."""
    resources, candidates = cpus("u", "u_j", "est_u"), ("j", "l95_ms", "u_j_u")
    assert not list(clash_faults(resources, candidates))
    for templates in TEMPLATES.values():
        names = [one.name for of in templates for one in columns_of(of, resources, candidates)]
        assert len(set(names)) == len(names)


@pytest.mark.parametrize("candidates", [("scenario", "policy"), ("seed", "cycles")])
def test_names_of_columns_are_names_of_placements(candidates: tuple[str, str]) -> None:
    """A table has them with what they are the names of in front."""
    problem = on_two(("R", "E"), candidates)
    run = dwell.simulate(problem, seed=1, windows=3)
    assert run.decisions.columns == list(column_types("decisions", problem))
    row = summarise(run, problem, {"scenario": "s", "policy": "p", "seed": 1}).row
    assert row["scenario"] == "s"
    table = compare(problem, policies=("dtp",), seeds=(1, 2), windows=3, processes=1).table()
    wanted = {f"share_{name}{end}" for name in candidates for end in ENDS}
    assert wanted <= set(table.columns)


def test_a_run_that_was_recorded_before_opens(tmp_path: Path) -> None:
    problem = on_two(("R", "E"), ("local", "gpu"))
    run = dwell.simulate(problem, seed=1, windows=3)
    run.save(tmp_path / "run")
    file = tmp_path / "run" / "run.json"
    text = file.read_text(encoding="utf-8").replace('"E"', '"R_gpu"').replace('"gpu"', '"gpu_gpu"')
    file.write_text(text.replace('"local"', '"gpu"'), encoding="utf-8")
    opened = open_run(tmp_path / "run")
    assert tuple(opened.problem.fabric.nodes) == ("R", "R_gpu")
    assert list(clash_faults(cpus("R", "R_gpu"), tuple(opened.problem.candidates)))
