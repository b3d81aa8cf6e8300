"""Study files: what they declare, and every fault at once where they are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dwell.cellfile import load
from dwell.cellfile.study_file import read_study
from dwell.errors import ProblemError, TraceError
from dwell.model import Constant, LogNormal, NodeDisturbance, Trace
from tests.cellfile.small_study import LEAST, faults, read, write

# ------------------------------------------------------------------------------- what is right


def test_the_least_study_has_defaults(folder: Path) -> None:
    study = read(folder, LEAST)
    problem = load(folder / "cell.yaml")
    assert study.name == "study"
    assert [(point.values, point.problem) for point in study.points] == [({}, problem)]
    assert study.scenarios == tuple(problem.scenarios)
    assert [(one.name, one.policy, one.estimator) for one in study.policies] == [
        ("LOC", "LOC", None)
    ]
    assert (study.seeds, study.windows, study.references) == (tuple(range(1, 21)), 300, False)


def test_a_policys_name_may_bring_its_estimator(folder: Path) -> None:
    study = read(
        folder,
        """\
        dwell-study: 1
        cell: cell.yaml
        policies:
          cusum+corrected: cusum+corrected
          dtp+shadow: {controller.min_dwell: 0}
          believer: {policy: dtp+corrected, estimator: corrected}
        """,
    )
    assert [(one.name, one.policy, one.estimator) for one in study.policies] == [
        ("cusum+corrected", "cusum", "corrected"),
        ("dtp+shadow", "dtp", "shadow"),
        ("believer", "dtp", "corrected"),
    ]


def test_a_policy_with_two_estimators_or_an_unknown_one_is_refused(folder: Path) -> None:
    wrong = """\
        dwell-study: 1
        cell: cell.yaml
        policies:
          a: {policy: dtp+corrected, estimator: shadow}
          b: dtp+correct
          c: dpt+corrected
        """
    told = faults(folder, wrong)
    assert "'dtp+corrected' names its estimator" in told["policies.a.estimator"]
    assert "unknown estimator 'correct'" in told["policies.b.estimator"]
    assert "unknown policy 'dpt'" in told["policies.c"]


def test_everything_that_a_study_may_say(folder: Path) -> None:
    study = read(
        folder,
        """\
        dwell-study: 1
        name: all of it
        cell: cell.yaml
        scenarios:
          baseline:
          edge-crash: [{node: E, at_s: 5, down: true}]
          step:
            - {node: R1, at_s: 10, for_s: 20, stress_threads: 4}
        windows: 50
        seeds: {from: 101, count: 3}
        references: true
        policies:
          LOC: LOC
          dtp:
          eager: {policy: dtp, estimator: shadow, controller.min_dwell: 0,
                  objective.weights.switching: 0.1}
        parameters:
          objective.weights.switching: [0, 0.5]
          links[0].delay_ms: [1, {lognormal: {mean: 2, cv: 0.5}}]
          controller.escape: [false, true]
        """.replace("  dtp:\n", "  dtp: dtp\n"),
    )
    assert (study.name, study.windows, study.seeds) == ("all of it", 50, (101, 102, 103))
    assert study.references
    assert study.scenarios == ("baseline", "edge-crash", "step")
    assert [
        (one.name, one.policy, one.estimator, dict(one.settings)) for one in study.policies
    ] == [
        ("LOC", "LOC", None, {}),
        ("dtp", "dtp", None, {}),
        (
            "eager",
            "dtp",
            "shadow",
            {"controller.min_dwell": 0, "objective.weights.switching": 0.1},
        ),
    ]
    assert [tuple(point.values.values()) for point in study.points] == [
        (switching, delay, escape)
        for switching in (0.0, 0.5)
        for delay in ("1", '{"lognormal": {"mean": 2, "cv": 0.5}}')
        for escape in (False, True)
    ]
    first, last = study.points[0].problem, study.points[-1].problem
    assert first.objective.weights.switching == 0
    assert last.objective.weights.switching == 0.5
    assert (first.controller.escape, last.controller.escape) == (False, True)
    assert first.fabric.links["R1->E"].delay_ms == Constant(1)
    # The cell says both ways.
    assert last.fabric.links["E->R1"].delay_ms == LogNormal(2, 0.5)
    for problem in (first, last):
        assert problem.scenarios["step"] == (NodeDisturbance("R1", 10, 20, stress_threads=4),)
        assert problem.scenarios["edge-crash"] == (NodeDisturbance("E", 5, down=True),)


def test_parameters_may_be_in_the_studys_own_scenarios(folder: Path) -> None:
    study = read(
        folder,
        f"""\
{LEAST}
scenarios:
  step: [{{node: R1, stress_threads: 4}}]
parameters:
  scenarios.step[0].at_s: [1, 2]
""",
    )
    starts = [point.problem.scenarios["step"][0].at_s for point in study.points]
    assert starts == [1, 2]


def test_paths_that_are_zipped_go_together_and_the_rest_is_a_grid(folder: Path) -> None:
    study = read(
        folder,
        f"""\
{LEAST}
parameters:
  objective.targets.latency_ms: [20, 30, 30]
  controller.min_dwell: [1, 2]
  period_ms: [40, 50, 60]
zip: [[period_ms, objective.targets.latency_ms]]
labels: {{period_ms: P = D (ms)}}
""",
    )
    # The first path of a group stands before what goes with it.
    assert [tuple(point.values) for point in study.points] == [
        ("period_ms", "objective.targets.latency_ms", "controller.min_dwell")
    ] * 6
    assert [tuple(point.values.values()) for point in study.points] == [
        (period_ms, target_ms, dwell)
        for period_ms, target_ms in ((40, 20), (50, 30), (60, 30))
        for dwell in (1, 2)
    ]
    assert [point.problem.pipeline.period_ms for point in study.points] == [40, 40, 50, 50, 60, 60]
    assert study.points[2].problem.objective.targets.latency_ms == 30
    assert study.labels == {"period_ms": "P = D (ms)"}


def test_only_what_is_no_group_multiplies_the_number_of_points(folder: Path) -> None:
    many = ", ".join(map(str, range(1, 201)))
    parameters = f"{{window_cycles: [{many}], controller.min_dwell: [{many}]}}"
    more = f"parameters: {parameters}\nzip: [[window_cycles, controller.min_dwell]]\n"
    assert len(read(folder, f"{LEAST}{more}").points) == 200
    more = more.replace("zip: [[window_cycles, controller.min_dwell]]", "")
    assert "40000 points are more than 10000" in faults(folder, f"{LEAST}{more}")["parameters"]


def test_traces_are_read_once_for_all_points(folder: Path) -> None:
    data = folder / "data"
    data.mkdir()
    pl.DataFrame({"a": np.linspace(1, 2, 50)}).write_parquet(data / "times.parquet")
    text = (folder / "cell.yaml").read_text(encoding="utf-8")
    assert "exec_ms: 18" in text
    trace = "exec_ms: {trace: {file: times.parquet, column: a}}"
    (folder / "cell.yaml").write_text(text.replace("exec_ms: 18", trace), encoding="utf-8")
    study = read(folder, f"{LEAST}traces: data\nparameters: {{controller.min_dwell: [1, 2]}}\n")
    tables = []
    for point in study.points:
        process = point.problem.pipeline.tasks["perception"].on["R1"].exec_ms
        assert isinstance(process, Trace)
        tables.append(process.table)
    assert tables[0] is tables[1]
    found = faults(folder, f"{LEAST}parameters: {{controller.min_dwell: [1, 2]}}\n")
    assert "times.parquet" in found["cell"]


# ------------------------------------------------------------------------------- what is wrong


def test_every_fault_is_told_at_once_with_its_line(folder: Path) -> None:
    path = write(
        folder,
        """\
        dwell-study: 1
        nmae: typo
        cell: cell.yaml
        scenarios:
          rain:
          step: [{node: R9, at_s: -1, stress_threads: 4}]
        windows: 0
        seeds: [1, 1]
        policies:
          LOC: dtp
          dpt: dpt
          a: {polisy: dtp}
          b: {policy: dtp, controller.min_dwell: -1}
          c: {policy: dtp, objective.wieghts.edge: 1}
          d: {policy: dtp, estimator: shadows}
          e: {policy: dtp, controller.policy: LOC}
          clairvoyant: SO
        references: true
        parameters:
          objective.weights.switching: [0, -1]
          links[9].delay_ms: [1]
          nodes.R7.cores: [1]
          nodes.E.coers: [1]
          controller.order_delay_ms: 3
          controller.close_grace_ms: []
          a..b: [1]
        """,
    )
    with pytest.raises(ProblemError) as caught:
        read_study(path, references=("clairvoyant",))
    found = [(fault.line, fault.path) for fault in caught.value.faults]
    assert found == [
        (2, "nmae"),
        (5, "scenarios.rain"),
        (6, "scenarios.step[0].at_s"),
        (6, "scenarios.step[0].node"),
        (7, "windows"),
        (8, "seeds"),
        (10, "policies.LOC"),
        (11, "policies.dpt"),
        (12, "policies.a.polisy"),
        (13, "policies.b.controller.min_dwell"),
        (14, "policies.c.objective.wieghts.edge"),
        (15, "policies.d.estimator"),
        (16, "policies.e.controller.policy"),
        (17, "policies.clairvoyant"),
        (20, "parameters.objective.weights.switching[1]"),
        (21, "parameters.links[9].delay_ms"),
        (22, "parameters.nodes.R7.cores"),
        (23, "parameters.nodes.E.coers[0]"),
        (24, "parameters.controller.order_delay_ms"),
        (25, "parameters.controller.close_grace_ms"),
        (26, "parameters.a..b"),
    ]
    assert str(caught.value).startswith(f"{path}:2: nmae: unknown key 'nmae'; did you mean 'name'?")


@pytest.mark.parametrize(
    ("more", "path", "message"),
    [
        ("seeds: 0", "seeds", "0 is not allowed; it must be a whole number from 1 to 100000"),
        ("seeds: yes", "seeds", "'yes' is not allowed; it must be a number of seeds, a list of"),
        ("seeds: []", "seeds", "the list is empty; name at least one seed"),
        ("seeds: [-1]", "seeds", "-1 is not allowed; it must be a whole number from 0 to"),
        ("seeds: {from: 1}", "seeds", "`count` is missing; write it as {from: 101, count: 20}"),
        ("seeds: {from: 1, to: 3}", "seeds", "unknown key 'to'; known: from, count"),
        ("scenarios: rain", "scenarios", "'rain' is not allowed; it must be a list of scenarios"),
        ("scenarios: []", "scenarios", "the list is empty; name at least one of scenarios"),
        ("scenarios: {}", "scenarios", "the mapping is empty; name at least one scenario"),
        ("scenarios: [baseline, baseline]", "scenarios", "'baseline' is given twice"),
        ("scenarios: [crash]", "scenarios.crash", "the cell has no scenario 'crash'; did you mean"),
        ("scenarios: {step: 5}", "scenarios.step", "5 is not allowed; it must be a list"),
        ("scenarios: {baseline: [{node: E}]}", "scenarios.baseline", "must stay empty"),
        ("windows: many", "windows", "'many' is not allowed; it must be a whole number from 1"),
        ("parameters: [1]", "parameters", "a list is not allowed; it must be a mapping of paths"),
        ("name: a/b", "name", "'a/b' is not a name"),
        ("references: 1", "references", "1 is not allowed; it must be true or false"),
        (
            "parameters: {controller.min_dwell: [1, 1.0]}",
            "parameters.controller.min_dwell",
            "a value is given twice",
        ),
        (
            "parameters: {warmup_windows: [300]}",
            "windows",
            "300 is not allowed; it must be more than the 300 windows of warm-up",
        ),
        (
            "windows: 10000\nparameters: {window_cycles: [50, 1000000]}",
            "windows",
            "10000 windows of window_cycles = 1000000 are 10000000000 cycles; a run has",
        ),
        (
            "parameters: {objective.weights: [{edge: 1}], objective.weights.edge: [2]}",
            "parameters.objective.weights.edge",
            "is a part of objective.weights; give one of them",
        ),
        (
            "parameters: {window_cycles: [" + ", ".join(map(str, range(1, 10_003))) + "]}",
            "parameters",
            "10002 points are more than 10000; give fewer",
        ),
    ],
)
def test_what_is_wrong_is_told_where_it_is(
    folder: Path, more: str, path: str, message: str
) -> None:
    found = faults(folder, f"{LEAST}{more}\n")
    assert list(found) == [path]
    assert found[path].startswith(message)


THREE = "parameters: {period_ms: [40, 50], deadline_ms: [40, 30], window_cycles: [5, 6, 7]}"


@pytest.mark.parametrize(
    ("more", "path", "message"),
    [
        (
            "zip: [[period_ms, window_cycles]]",
            "zip[0]",
            "values differ in number: period_ms has 2, window_cycles has 3; give as many of each",
        ),
        (
            "zip: [[period_ms, deadlin_ms]]",
            "zip[0][1]",
            "'deadlin_ms' is none of the parameters; did you mean 'deadline_ms'?",
        ),
        (
            "zip: [[period_ms, deadline_ms], [window_cycles, period_ms]]",
            "zip[1][1]",
            "period_ms is in zip[0], too; name it once",
        ),
        (
            "zip: [[period_ms, period_ms]]",
            "zip[0][1]",
            "period_ms is in zip[0], too; name it once",
        ),
        ("zip: [[period_ms]]", "zip[0]", "a group of 1 path; name at least two that go together"),
        ("zip: [[]]", "zip[0]", "a group of 0 paths; name at least two that go together"),
        ("zip: [period_ms]", "zip[0]", "'period_ms' is not allowed; it must be a li"),
        ("zip: period_ms", "zip", "'period_ms' is not allowed; it must be a list"),
        ("zip: [[period_ms, 5]]", "zip[0][1]", "5 is not allowed; it must be a text"),
        (
            "labels: {perid_ms: P}",
            "labels.perid_ms",
            "'perid_ms' is none of the parameters; did you mean 'period_ms'?",
        ),
        ("labels: {period_ms: ''}", "labels.period_ms", "'' is not allowed; it must be a text"),
        ("labels: {period_ms: 5}", "labels.period_ms", "5 is not allowed; it must be a text"),
        ("labels: P", "labels", "'P' is not allowed; it must be a mapping"),
    ],
)
def test_a_group_or_a_label_that_is_wrong_is_told_with_its_line(
    folder: Path, more: str, path: str, message: str
) -> None:
    with pytest.raises(ProblemError) as caught:
        read(folder, f"{LEAST}{THREE}\n{more}\n")
    (found,) = caught.value.faults
    assert (found.path, found.line) == (path, 5)
    assert found.message.startswith(message)


def test_the_first_path_of_a_group_tells_its_points_apart(folder: Path) -> None:
    more = "parameters: {period_ms: [40, 40], window_cycles: [5, 6]}\n"
    found = faults(folder, f"{LEAST}{more}zip: [[period_ms, window_cycles]]\n")
    assert found == {"parameters.period_ms": "a value is given twice; give each once"}


def test_groups_without_parameters_are_refused(folder: Path) -> None:
    found = faults(folder, f"{LEAST}zip: [[period_ms, deadline_ms]]\n")
    assert found["zip[0][0]"] == "'period_ms' is none of the parameters; none is declared"


@pytest.mark.parametrize(
    ("policies", "path", "message"),
    [
        ("dtp", "policies", "'dtp' is not allowed; it must be a list of policies, or a mapping"),
        ("[dtp, dtp]", "policies", "'dtp' is given twice; name each once"),
        ("{dtp: 5}", "policies.dtp", "5 is not allowed; it must be a policy's name, or a mapping"),
        ("{dtp: {policy: []}}", "policies.dtp.policy", "a list is not allowed; it must be a text"),
        ("{d: {policy: dtp, controller: {}}}", "policies.d.controller", "unknown key 'controller'"),
        ("{d: {policy: dtp, controller.: 1}}", "policies.d.controller.", "not a path; write it"),
        ("{a/b: dtp}", "policies.a/b", "'a/b' is not a name"),
        (
            "{d: {policy: dtp, estimator: shadow, controller.shadow_fraction: 0.9}}",
            "policies.d.controller.shadow_fraction",
            "0.9 of the cycles through each of 2 alternatives is more than all cycles",
        ),
    ],
)
def test_policies_that_are_wrong(folder: Path, policies: str, path: str, message: str) -> None:
    found = faults(folder, f"{LEAST.replace('[LOC]', policies)}")
    assert list(found) == [path]
    assert found[path].startswith(message)


def test_settings_are_checked_at_every_point(folder: Path) -> None:
    text = LEAST.replace("[LOC]", "{d: {policy: dtp, estimator: shadow}}")
    more = "parameters: {controller.shadow_fraction: [0.1, 0.9]}\n"
    found = faults(folder, text + more)
    assert found == {
        "policies.d": "controller.shadow_fraction: 0.9 of the cycles through each of 2 "
        "alternatives is more than all cycles; at most 0.5"
    }


def test_values_that_only_together_make_no_cell_are_named_together(folder: Path) -> None:
    more = "parameters: {period_ms: [40, 0.5], objective.weights.edge: [1, 2]}\n"
    found = faults(folder, LEAST + more)
    assert found["parameters"].endswith("(at period_ms = 0.5, objective.weights.edge = 2)")
    assert "deadline_ms" in found["parameters"]


def test_a_fault_of_the_cell_is_told_with_its_own_line(folder: Path) -> None:
    text = (folder / "cell.yaml").read_text(encoding="utf-8")
    (folder / "cell.yaml").write_text(text.replace("tier: edge", "tier: egde"), encoding="utf-8")
    with pytest.raises(ProblemError) as caught:
        read(folder, f"{LEAST}windows: 0\n")
    first, second = caught.value.faults
    assert (first.path, first.line) == ("cell", 2)
    assert first.message.startswith(f"{folder / 'cell.yaml'}:")
    assert first.message.endswith(
        "'egde' is not allowed; it must be one of robot, edge, cloud; did you mean 'edge'?"
    )
    assert second.path == "windows"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty; a study file begins with `dwell-study: 1`"),
        ("- 1", "a study file is a mapping that begins with `dwell-study: 1`; this is a list"),
        ("dwell: 1", "this is a cell, not a study, which begins with `dwell-study: 1`; run it by"),
        ("dwell-study: 2", "schema version 2 is newer than this Dwell, which reads 1"),
        ("dwell-study: true", "true is not allowed; write `dwell-study: 1`"),
        ("{", "not a YAML document"),
        ("cell: cell.yaml", "missing; add it: version of this format"),
        ("dwell-study: 1", "missing; add it: the cell file, relative to this file's folder"),
        ("dwell-study: 1\ncell: ''\npolicies: {}", "cell: the text is empty"),
        ("dwell-study: 1\ncell: 5\npolicies: {}", "cell: 5 is not allowed; it must be a text"),
        ("dwell-study: 1\ncell: cell.yaml\npolicies: {}", "policies: the mapping is empty"),
        ("dwell-study: 1\ncell: none.yaml", "none.yaml: no such file; check the path"),
        ("dwell-study: 1\ncell: study.yaml", "study.yaml:1: dwell-study: this is a study, not"),
    ],
)
def test_what_is_no_study_is_refused(folder: Path, text: str, message: str) -> None:
    with pytest.raises(ProblemError, match=r"study\.yaml") as caught:
        read(folder, text)
    assert message in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match=r"none\.yaml: no such file"):
        read_study(tmp_path / "none.yaml")
    with pytest.raises(ProblemError, match="this is a folder; name the study file in it"):
        read_study(tmp_path)


def test_a_trace_at_fault_is_one_of_the_cell(folder: Path) -> None:
    text = f"{LEAST}parameters: {{'links[0].delay_ms': [{{trace: {{file: no.csv, column: a}}}}]}}\n"
    found = faults(folder, text)
    assert list(found) == ["parameters.links[0].delay_ms[0]"]
    assert "no.csv" in found["parameters.links[0].delay_ms[0]"]
    assert not issubclass(ProblemError, TraceError)


ODD = st.sampled_from((None, True, 0, -1, 1.5, 10**400, float("nan"), "", "x", "LOC", "a..b"))
ODDER = ODD | st.lists(ODD, max_size=2) | st.dictionaries(st.text(max_size=3), ODD, max_size=2)
KEYS = ("dwell-study", "name", "traces", "scenarios", "windows", "seeds", "references", "policies")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from((*KEYS, "parameters", "zip", "labels", "odd")), ODDER, max_size=4
    )
)
def test_whatever_stands_there_ends_in_a_study_or_in_faults(
    folder: Path, odd: dict[str, object]
) -> None:
    document = {"dwell-study": 1, "cell": "cell.yaml", "policies": ["LOC"], **odd}
    try:
        study = read(folder, yaml.safe_dump(document))
    except ProblemError as error:
        found: tuple[object, ...] = error.faults
    else:
        found = study.points
    assert found


# ----------------------------------------------------------------------------- dotted paths
