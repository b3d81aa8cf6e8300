"""Fleet files: what they say, and what is wrong with them, all at once."""

from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell import load_fleet
from dwell.errors import ProblemError
from dwell.study import load_study

EXAMPLES = Path(__file__).parents[2] / "examples"


def faults_of(folder: Path, text: str) -> list[str]:
    """Return what is told of a fleet file, without its folder."""
    file = folder / "fleet.yaml"
    file.write_text(text.replace("EXAMPLES", str(EXAMPLES)))
    with pytest.raises(ProblemError) as told:
        load_fleet(file)
    return str(told.value).replace(f"{folder}/", "").splitlines()


def test_the_example_is_a_fleet_of_twelve() -> None:
    fleet = load_fleet(EXAMPLES / "fleet.yaml")
    cells = fleet.cells
    assert (fleet.name, fleet.shared, fleet.coordination) == ("hall", ("E",), "ledger")
    assert [cell.name for cell in cells][::11] == ["canonical-01", "canonical-12"]
    assert [cell.streams for cell in cells][:2] == ["", "canonical-2/"]
    assert {cell.entry.scenario for cell in cells} == {"robot-cpu-stress"}
    assert fleet.unused() == ()
    assert len(fleet.with_count(3).cells) == 3


def test_a_limit_is_5_per_cent_where_cells_are_to_be_served(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    text = f"dwell-fleet: 1\ncells: [{{cell: {EXAMPLES / 'canonical.yaml'}}}]\n"
    for objective, limit, known in (
        ("objective: served", "", 0.05),
        ("objective: served", "limit: 0.1", 0.1),
        ("objective: sum", "", None),
        ("", "limit: 0.1", 0.1),
    ):
        file.write_text(f"{text}{objective}\n{limit}\n")
        fleet = load_fleet(file)
        assert fleet.limit == known
        has_effect = fleet.objective == "served" or limit == ""
        assert [fault.path for fault in fleet.without_effect()] == ([] if has_effect else ["limit"])


@pytest.mark.parametrize("limit", ["-0.1", "0", "1", "5", "NaN", "much"])
def test_a_limit_is_a_share(tmp_path: Path, limit: str) -> None:
    (fault,) = faults_of(
        tmp_path,
        "dwell-fleet: 1\ncells: [{cell: EXAMPLES/canonical.yaml}]\nobjective: served\n"
        f"limit: {limit}\n",
    )
    assert "fleet.yaml:4: limit: " in fault
    assert "it must be a number above 0 and below 1" in fault


def test_copies_are_counted_over_all_entries_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    cell = EXAMPLES / "canonical.yaml"
    file.write_text(
        f"dwell-fleet: 1\nshared: [E]\ncells:\n  - {{cell: {cell}, count: 2}}\n"
        f"  - {{cell: {cell}, scenario: edge-cpu-stress, phase_ms: 5}}\n"
    )
    fleet = load_fleet(file)
    assert fleet.name == "fleet"
    assert [(cell.name, cell.copy) for cell in fleet.cells] == [
        ("canonical-01", 1),
        ("canonical-02", 2),
        ("canonical-03", 3),
    ]
    assert fleet.cells[2].entry.phase_ms == 5


def test_every_fault_of_keys_is_told_at_once(tmp_path: Path) -> None:
    assert faults_of(
        tmp_path,
        """dwell-fleet: 1
shared: E
cells:
  - {cell: EXAMPLES/canonical.yaml, count: 0, scenario: robot-cpu-stres}
  - {cell: nope.yaml}
  - {count: 2}
  - {cell: EXAMPLES/fan-in.yaml, phase_ms: 50, policy: dpt, weight: 1}
phases: evn
coordination: legder
objective: best
estimator: corected
""",
    ) == [
        "fleet.yaml:2: shared: 'E' is not allowed; it must be a list; for none, write []",
        "fleet.yaml:4: cells[0].count: 0 is not allowed; it must be a whole number from 1 to 1000",
        "fleet.yaml:4: cells[0].scenario: unknown scenario 'robot-cpu-stres'; did you mean "
        "'robot-cpu-stress'? (scenarios here: baseline, robot-cpu-stress, edge-cpu-stress, "
        "network-impairment, network-impairment-mild)",
        "fleet.yaml:5: cells[1].cell: nope.yaml: no such file; check the path",
        "fleet.yaml:6: cells[2].cell: missing; add it: the cell file, relative to this file's "
        "folder",
        "fleet.yaml:7: cells[3].weight: unknown key 'weight'; known: count, scenario, policy, "
        "estimator, phase_ms, cell",
        "fleet.yaml:7: cells[3].policy: unknown policy 'dpt'; did you mean 'dtp'? (policies here: "
        "dtp, atp, atp-thresholds, latency-first, work-function, cusum, replicate, LOC, PARTS, "
        "VISION, EDGE)",
        "fleet.yaml:7: cells[3].phase_ms: 50 is not allowed; it must be less than period_ms, 50",
        "fleet.yaml:8: phases: 'evn' is not allowed; it must be one of sync, even, random, or a "
        "list of ms; did you mean 'even'?",
        "fleet.yaml:9: coordination: 'legder' is not allowed; it must be one of none, random, "
        "ledger; did you mean 'ledger'?",
        "fleet.yaml:10: objective: 'best' is not allowed; it must be one of sum, worst, served",
        "fleet.yaml:11: estimator: unknown estimator 'corected'; did you mean 'corrected'?",
    ]


def test_shared_nodes_are_one_in_all_cells(tmp_path: Path) -> None:
    assert faults_of(
        tmp_path,
        """dwell-fleet: 1
shared: [E, Q, E]
cells:
  - {cell: EXAMPLES/canonical.yaml, count: 2}
  - {cell: EXAMPLES/fan-in.yaml}
phases: [1, 100]
""",
    ) == [
        "fleet.yaml:2: shared[1]: canonical has no node 'Q'; known: R1, E, R2",
        "fleet.yaml:2: shared[1]: fan-in has no node 'Q'; known: R1, R2, E",
        "fleet.yaml:2: shared[2]: 'E' is given twice; name each once",
        "fleet.yaml:5: cells[1].cell: E.accelerators is {'gpu': 1}, and {} in canonical; a shared "
        "node is one",
        "fleet.yaml:6: phases: 2 phases for 3 cells; give one for each, in the order of the file",
    ]


def test_no_fault_hides_another(tmp_path: Path) -> None:
    """A cell that is missing, or wrong in itself, leaves the others to be looked at."""
    other = (EXAMPLES / "canonical.yaml").read_text()
    for here, there in (
        ("name: canonical", "name: other"),
        ("cores: 8\n", "cores: 4\n"),
        ("tier: edge", "tier: cloud"),
    ):
        other = other.replace(here, there)
    (tmp_path / "other.yaml").write_text(other)
    (tmp_path / "broken.yaml").write_text("dwell: 1\nnodes: 3\n")
    told = faults_of(
        tmp_path,
        """dwell-fleet: 1
shared: [E, edge]
cells:
  - {cell: EXAMPLES/canonical.yaml, count: 2}
  - {cell: nope.yaml}
  - {cell: broken.yaml, scenario: none}
  - {cell: other.yaml, scenario: none}
phases: [1, 2, 3]
""",
    )
    assert [line.partition(": ")[2].partition(": ")[0] for line in told] == [
        "shared[1]",
        "shared[1]",
        "cells[1].cell",
        *["cells[2].cell"] * sum("broken.yaml" in line for line in told),
        "cells[3].scenario",
        "cells[3].cell",
        "cells[3].cell",
        "phases",
    ]
    assert told[-1].endswith("3 phases for 5 cells; give one for each, in the order of the file")
    assert [line.split(" is ")[0].split()[-1] for line in told if "a shared" in line] == [
        "E.tier",
        "E.cores",
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("dwell-fleet: 1\ncells: []\n", "cells: the list is empty; name at least one cell"),
        (
            "dwell-fleet: 1\ncells: [{cell: EXAMPLES/canonical.yaml}]\nphases: [100]\n",
            "phases[0]: 100 is not allowed; it must be at least 0 and less than period_ms, 33.3333",
        ),
        (
            "dwell: 1\n",
            "dwell: this is a cell, not a fleet, which begins with `dwell-fleet: 1`; run "
            "it by `dwell run FILE`",
        ),
        (
            "dwell-study: 1\n",
            "dwell-study: this is a study, not a fleet, which begins with `dwell-fleet: 1`; run "
            "it by `dwell study FILE`",
        ),
    ],
)
def test_what_is_no_fleet(tmp_path: Path, text: str, told: str) -> None:
    (fault,) = faults_of(tmp_path, text)
    assert fault.partition(": ")[2] == told


def test_two_cells_of_one_name_are_a_fault(tmp_path: Path) -> None:
    other = (EXAMPLES / "canonical.yaml").read_text().replace("cores: 8", "cores: 4")
    (tmp_path / "canonical.yaml").write_text(other)
    told = faults_of(
        tmp_path,
        "dwell-fleet: 1\ncells:\n  - {cell: EXAMPLES/canonical.yaml}\n  - {cell: canonical.yaml}\n",
    )
    assert told == [
        "fleet.yaml:4: cells[1].cell: 'canonical' is the name of another cell, too; give it its own"
    ]


def test_a_fleet_is_no_cell_and_no_study(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text("dwell-fleet: 1\n")
    with pytest.raises(ProblemError, match="1: dwell-fleet: this is a fleet, not a cell, which"):
        dwell.load(file)
    with pytest.raises(ProblemError, match="1: dwell-fleet: this is a fleet, not a study, "):
        load_study(file)
