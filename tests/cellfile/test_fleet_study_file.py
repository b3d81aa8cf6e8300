"""Study files over a fleet: what they say, and what is wrong with them, all at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.cellfile.study_file import read_study
from dwell.errors import ProblemError

EXAMPLES = Path(__file__).parents[2] / "examples"
FLEET = f"""\
dwell-fleet: 1
name: hall
shared: [E]
cells:
  - {{cell: {EXAMPLES}/canonical.yaml, count: 2, scenario: robot-cpu-stress}}
  - {{cell: {EXAMPLES}/canonical.yaml}}
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    (tmp_path / "hall.yaml").write_text(FLEET)
    return tmp_path / "study.yaml"


def faults_of(file: Path, text: str) -> list[str]:
    """Return what is told of a study file, without its folder."""
    file.write_text(text)
    with pytest.raises(ProblemError) as told:
        read_study(file)
    return str(told.value).replace(f"{file.parent}/", "").splitlines()


def test_parameters_of_a_fleet_are_put_into_it(study: Path) -> None:
    study.write_text(
        "dwell-study: 1\nfleet: hall.yaml\npolicies: [SO, dtp+corrected]\nseeds: 3\nwindows: 9\n"
        "parameters:\n  fleet.count: [1, 4]\n  fleet.phases: [sync, even]\n"
        "  fleet.coordination: [ledger]\nlabels: {fleet.count: robots}\n"
    )
    found = read_study(study)
    assert [dict(point.values) for point in found.points][1] == {
        "fleet.count": 1,
        "fleet.phases": "even",
        "fleet.coordination": "ledger",
    }
    fleets = [point.fleet for point in found.points]
    assert all(fleet is not None for fleet in fleets)
    assert [len(fleet.cells) for fleet in fleets if fleet is not None] == [2, 2, 5, 5]
    assert [fleet.phases for fleet in fleets if fleet is not None] == ["sync", "even"] * 2
    assert found.scenarios == ("robot-cpu-stress",)
    assert [(one.policy, one.estimator) for one in found.policies] == [
        ("SO", None),
        ("dtp", "corrected"),
    ]
    assert (found.seeds, found.windows, found.references) == ((1, 2, 3), 9, False)


def test_without_parameters_there_is_one_point(study: Path) -> None:
    study.write_text("dwell-study: 1\nfleet: hall.yaml\npolicies: [SO]\n")
    (point,) = read_study(study).points
    assert dict(point.values) == {}
    assert point.problem.name == "canonical"


def test_every_fault_is_told_at_once(study: Path) -> None:
    assert faults_of(
        study,
        """dwell-study: 1
fleet: hall.yaml
cell: canonical.yaml
references: true
scenarios: [robot-cpu-stres]
policies: {dpt: dpt, tuned: {policy: dtp, controller.min_dwel: 2}}
windows: 5
parameters:
  fleet.count: [0, 2.5]
  fleet.phases: [evn]
  fleet.coordination: [legder]
  fleet.size: [1]
  period_ms: [20]
""",
    ) == [
        "study.yaml:3: cell: unknown key 'cell'; known: dwell-study, fleet, name, windows, seeds, "
        "policies, parameters, zip, metrics, labels, scenarios",
        "study.yaml:4: references: unknown key 'references'; known: dwell-study, fleet, name, "
        "windows, seeds, policies, parameters, zip, metrics, labels, scenarios",
        "study.yaml:5: scenarios[0]: canonical has no scenario 'robot-cpu-stres'; did you mean "
        "'robot-cpu-stress'?",
        "study.yaml:6: policies.dpt: unknown policy 'dpt'; did you mean 'dtp'? (policies here: "
        "dtp, atp, atp-thresholds, latency-first, work-function, cusum, replicate, LOC, SO, HYB)",
        "study.yaml:6: policies.tuned.controller.min_dwel: unknown key 'min_dwel'; did you mean "
        "'min_dwell'?",
        "study.yaml:7: windows: 5 is not allowed; it must be more than the 5 windows of warm-up",
        "study.yaml:9: parameters.fleet.count[0]: 0 is not allowed; it must be a whole number from "
        "1 to 1000",
        "study.yaml:9: parameters.fleet.count[1]: 2.5 is not allowed; it must be a whole number "
        "from 1 to 1000",
        "study.yaml:10: parameters.fleet.phases[0]: 'evn' is not allowed; it must be one of sync, "
        "even, random, or a list of ms; did you mean 'even'?",
        "study.yaml:11: parameters.fleet.coordination[0]: 'legder' is not allowed; it must be one "
        "of none, random, ledger",
        "study.yaml:12: parameters.fleet.size: unknown parameter of a fleet 'fleet.size'; did you "
        "mean 'fleet.phases'?",
        "study.yaml:13: parameters.period_ms: unknown parameter of a fleet 'period_ms'; known: "
        "fleet.count, fleet.phases, fleet.coordination",
    ]


def test_a_fleet_that_is_wrong_or_missing_is_told(study: Path) -> None:
    (study.parent / "hall.yaml").write_text(FLEET.replace("[E]", "[Q]"))
    assert faults_of(study, "dwell-study: 1\nfleet: hall.yaml\npolicies: [SO]\n") == [
        "study.yaml:2: fleet: hall.yaml:3: shared[0]: canonical has no node 'Q'; known: R1, E, R2"
    ]
    assert faults_of(study, "dwell-study: 1\nfleet: nope.yaml\npolicies: [SO]\n") == [
        "study.yaml:2: fleet: nope.yaml: no such file; check the path"
    ]
    assert faults_of(study, "dwell-study: 1\nfleet:\npolicies: [SO]\n") == [
        "study.yaml:2: fleet: nothing is given; give a value: the fleet file, relative to this "
        "file's folder"
    ]


def test_a_count_that_does_not_go_with_listed_phases_is_told(study: Path) -> None:
    (study.parent / "hall.yaml").write_text(FLEET + "phases: [1, 2, 3]\n")
    assert faults_of(
        study,
        "dwell-study: 1\nfleet: hall.yaml\npolicies: [SO]\nparameters:\n  fleet.count: [2, 3]\n",
    ) == [
        "study.yaml:5: parameters.fleet.count[1]: 3 phases for 4 cells; give one for each, in the "
        "order of the file"
    ]
