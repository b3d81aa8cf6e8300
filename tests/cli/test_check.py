"""`dwell check`: what it says of a cell, and what it warns of."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

import dwell
from dwell.model.document import to_document
from tests.cells.camera import CAMERA
from tests.cells.many import document_of
from tests.cli.small_cell import CANONICAL, SMALL, assert_refused, call, read_json


def test_check_sums_up_a_cell(cell: Path) -> None:
    result = call("check", cell)
    assert (result.exit_code, result.stderr) == (0, "")
    for words in ("small: no faults", "can move: plan (R, E)", "scenarios: baseline, stress"):
        assert words in result.stdout
    rows = [line.split() for line in result.stdout.splitlines()]
    assert ["LOC", "9.0", "0.00", "45", "0"] in rows
    assert ["OFF", "4.0", "0.00", "5", "2"] in rows


def test_check_as_json(cell: Path) -> None:
    found = read_json(call("check", cell, "--json"))
    assert found["valid"] is True
    assert found["warnings"] == []
    assert found["candidates"]["OFF"]["l95_ms"] == found["candidates"]["OFF"]["uncut_l95_ms"] == 4.0
    assert found["candidates"]["OFF"]["is_settled"] is True
    assert found["candidates"]["OFF"]["own_work"] == pytest.approx({"R": 0.05, "E": 0.025})


def test_check_shows_all_that_j_and_caps_look_at(cell: Path) -> None:
    objective = (
        "objective: {weights: {age: 1}, targets: {age_ms: 50}, caps: {misses: {m: 1, k: 20}}}"
    )
    cell.write_text(f"{SMALL}\n{objective}\n", encoding="utf-8")
    found = read_json(call("check", cell, "--json"))["candidates"]["OFF"]
    # A latency of 4 ms, and half of 20 ms.
    assert found["age_ms"] == pytest.approx(14)
    assert (found["age_error_ms"], found["misses"]) == (0.0, 0.0)
    rows = [line.split() for line in call("check", cell).stdout.splitlines()]
    assert ["OFF", "4.0", "0.00", "5", "2", "14.0", "0.00"] in rows


@pytest.mark.parametrize(("estimator", "windows"), [("profile", 3), ("corrected", 0)])
def test_check_says_how_often_it_decides_and_how_long_it_stays(
    cell: Path, estimator: str, windows: int
) -> None:
    controller = f"controller: {{estimator: {estimator}, decide_cycles: 5, min_dwell_cycles: 8}}"
    cell.write_text(f"{SMALL}\n{controller}\n", encoding="utf-8")
    found = read_json(call("check", cell, "--json"))
    assert found["controller"] == {
        "policy": "dtp",
        "estimator": estimator,
        "decide_cycles": 5,
        "min_dwell": windows,
        "min_dwell_cycles": 8,
    }
    line = f"decisions: dtp with {estimator}, every 5 cycles; N_min {windows} windows"
    assert line in call("check", cell).stdout.splitlines()


def test_l95_of_a_cell_that_loses_cycles_is_a_number(cell: Path) -> None:
    # Three of four messages are lost.
    lossy = SMALL.replace(
        "both_ways: true, delay_ms: 1", "both_ways: true, delay_ms: 1, loss: 0.75"
    )
    cell.write_text(lossy, encoding="utf-8")
    result = call("check", cell)
    assert "OFF: lost in 100 % of windows" in result.stdout
    assert "OFF 80.0" in " ".join(result.stdout.split())
    found = read_json(call("check", cell, "--json"))["candidates"]["OFF"]
    assert (found["l95_ms"], found["uncut_l95_ms"]) == (pytest.approx(80.0, abs=0.1), None)
    assert found["lost_windows"] > 0.99


def test_check_of_a_scenario_beyond_the_bound_says_so(cell: Path) -> None:
    late = SMALL.replace("stress_threads: 3", "stress_threads: 3, at_s: 600")
    cell.write_text(late, encoding="utf-8")
    assert "simulate" not in call("check", cell, "--scenario", "stress").stderr
    cell.write_text(late.replace("600", "6000"), encoding="utf-8")
    result = call("check", cell, "--scenario", "stress")
    assert "scenarios.stress: the disturbance of R begins at 6000 s, and prices simulate" in (
        result.stderr
    )


def test_check_prints_every_fault_with_its_line(cell: Path) -> None:
    text = SMALL.replace("tier: edge", "tier: egde").replace("{plan: E}", "{plan: X}")
    cell.write_text(text, encoding="utf-8")
    result = call("check", cell)
    assert (result.exit_code, result.stdout) == (2, "")
    places = [line.split(" ")[0] for line in result.stderr.splitlines()]
    assert places == [f"{cell}:7:", f"{cell}:17:"]
    found = call("check", cell, "--json")
    assert (found.exit_code, found.stderr) == (2, "")
    assert [fault["line"] for fault in json.loads(found.stdout)["faults"]] == [7, 17]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "exec_ms: 8",
            "exec_ms: 30",
            ("candidates.LOC: its own work takes 155% of the cores of R",),
        ),
        ("OFF: {plan: E}", "OFF: {plan: R}", ("candidates.OFF: is the same placement as LOC",)),
        ("stress_threads: 3", "at_s: 1", ("scenarios.stress[0]: does nothing to R",)),
        (
            "tier: edge, cores: 4}",
            "tier: edge, cores: 4, quota: {cpu: 0.08, period_ms: 100}}",
            ("takes 125% of the quota of E (0.08 of 4 cores)", "raise nodes.E.quota.cpu"),
        ),
        (
            "candidates:",
            "objective: {caps: {latency_ms: 5}}\ncandidates:",
            ("candidates.LOC: L95 is 9.0 ms undisturbed, over the cap of 5 ms",),
        ),
        (
            "E: {exec_ms: 2}}}",
            "E: {exec_ms: 37.5, workers: 2}}}\ncontroller: {guard_cycles: 3, fallbacks: [LOC]}",
            ("controller.guard_cycles: 3 is tight for OFF", "40.5 ms", "40.0 ms"),
        ),
        (
            "E: {exec_ms: 2}}}",
            "E: {exec_ms: 2}}}\ncontroller: {fallbacks: [LOC], close_grace_ms: 59}\n"
            "live: {hosts: {R: {port: 7000}}}",
            ("controller.close_grace_ms: 59 is less", "of 60 ms", "7 cycles", "instead of 4"),
        ),
        (
            "E: {exec_ms: 2}}}",
            "E: {exec_ms: 2, workers: 2}}}\nlive: {hosts: {R: {port: 7000}}}",
            ("tasks.plan.on.E.workers: 2 is for the simulator", "one job at a time"),
        ),
    ],
)
def test_check_warns(cell: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    cell.write_text(SMALL.replace(old, new), encoding="utf-8")
    result = call("check", cell)
    assert result.exit_code == 0, result.stderr
    assert result.stderr.count("warning: ") == 1
    for word in words:
        assert word in result.stderr
    assert len(read_json(call("check", cell, "--json"))["warnings"]) == 1


@pytest.mark.parametrize(
    ("jitter", "warned"),
    [
        ("{exponential: {mean: 1000}}", True),
        ("{uniform: {low: 0, high: 25}}", True),
        ("{uniform: {low: 0, high: 19}}", False),
        ("2", False),
    ],
)
def test_a_jitter_of_releases_beyond_the_period_is_warned_of(
    cell: Path, jitter: str, warned: bool
) -> None:
    text = cell.read_text(encoding="utf-8")
    cell.write_text(f"{text}\nrelease_jitter_ms: {jitter}\n", encoding="utf-8")
    found = read_json(call("check", cell, "--json"))["warnings"]
    assert [one["path"] for one in found if one["path"] == "release_jitter_ms"] == (
        ["release_jitter_ms"] if warned else []
    )


def test_no_warning_about_a_guard_that_is_off_or_has_nowhere_to_go(cell: Path) -> None:
    slow = SMALL.replace("E: {exec_ms: 2}}}", "E: {exec_ms: 37.5, workers: 2}}}")
    for controller in ("", "controller: {fallbacks: [OFF]}\n"):
        cell.write_text(slow + controller, encoding="utf-8")
        assert "controller.guard_cycles" not in call("check", cell).stderr


@pytest.mark.parametrize(("grace_ms", "warned"), [(59, True), (60, False)])
def test_a_cell_with_stages_is_warned_of_closing_before_its_guard_acts(
    cell: Path, grace_ms: int, warned: bool
) -> None:
    """Before it has hosts, and so before anything is started."""
    document = to_document(dwell.load(cell))
    document["controller"] = {
        **document.get("controller", {}),
        "fallbacks": ["OFF"],
        "guard_cycles": 3,
        "close_grace_ms": grace_ms,
    }
    cell.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert "close_grace_ms" not in call("check", cell).stderr
    for name, task in document["tasks"].items():
        task["run"] = f"stages:{name}"
    cell.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert ("warning: controller.close_grace_ms: 59" in call("check", cell).stderr) is warned


def test_examples_are_without_faults_and_warnings() -> None:
    for path in (CANONICAL, CANONICAL.with_name("fan-in.yaml"), CANONICAL.with_name("cloud.yaml")):
        result = call("check", path)
        assert (result.exit_code, result.stderr) == (0, "")


def test_traces_may_be_elsewhere(cell: Path, tmp_path: Path) -> None:
    text = SMALL.replace("delay_ms: 1}", "delay_ms: {trace: {file: t.csv, column: up}}}")
    cell.write_text(text, encoding="utf-8")
    assert_refused(call("check", cell), "--traces")
    folder = tmp_path / "measured"
    folder.mkdir()
    (folder / "t.csv").write_text("up\n" + "1.5\n" * 400, encoding="utf-8")
    assert call("check", cell, "--traces", folder).exit_code == 0
    found = read_json(call("run", cell, "--traces", folder, "--windows", "4", "--json"))
    assert found["summary"]["cycles"] == 40
    absolute = SMALL.replace(
        "delay_ms: 1}", f"delay_ms: {{trace: {{file: {folder}/t.csv, column: up}}}}}}"
    )
    cell.write_text(absolute, encoding="utf-8")
    assert call("check", cell, "--traces", tmp_path).exit_code == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("E: {exec_ms: 2}", "E: {exec_ms: 30}", "plan takes 30 ms a job on E"),
        ("to: plan}", "to: plan, bytes: 160000}", "64 Mbit/s over R->E, which carries 20"),
    ],
)
def test_check_warns_of_stages_and_links_that_cannot_keep_up(
    cell: Path, old: str, new: str, words: str
) -> None:
    assert old in SMALL
    text = SMALL.replace("delay_ms: 1}", "delay_ms: 1, rate_mbps: 20}")
    cell.write_text(text, encoding="utf-8")
    assert call("check", cell).stderr == ""
    cell.write_text(text.replace(old, new), encoding="utf-8")
    result = call("check", cell)
    assert result.exit_code == 0
    assert words in result.stderr


def test_every_one_of_many_candidates_is_priced(tmp_path: Path) -> None:
    cell = tmp_path / "many.yaml"
    cell.write_text(yaml.safe_dump(document_of(100), sort_keys=False), encoding="utf-8")
    result = call("check", cell)
    assert (result.exit_code, result.stderr) == (0, "")
    rows = [line.split() for line in result.stdout.splitlines()]
    (head,) = (place for place, row in enumerate(rows) if row[:1] == ["candidate"])
    names = list(document_of(100)["candidates"])
    assert [row[0] for row in rows[head + 1 :] if row[0] != "shadows:"] == names
    assert list(read_json(call("check", cell, "--json"))["candidates"]) == names


def test_check_says_why_shadows_are_few(cell: Path) -> None:
    # Under LOC `plan` sends its result back over the link that the 8 ms of a shadow's image hold.
    cell.write_text(f"{CAMERA}controller: {{shadow_fraction: 0.05}}\n", encoding="utf-8")
    assert "shadows" not in call("check", cell).stdout
    auto = f"{CAMERA}controller: {{estimator: corrected, shadow_fraction: auto"
    cell.write_text(f"{auto}, min_improvement: 0.2}}\n", encoding="utf-8")
    said = call("check", cell).stdout
    assert "shadows: 0.05 under OFF\n" in said
    assert re.search(r"^shadows: 0.01; at 0.05 LOC would miss 4\.\d\d points more$", said, re.M)
    found = read_json(call("check", cell, "--json"))["candidates"]
    assert {name: one["shadow_fraction"] for name, one in found.items()} == {
        "LOC": 0.01,
        "OFF": 0.05,
    }
    assert [one["fraction"] for one in found["LOC"]["shadow_prices"]] == [0.05, 0.02, 0.01]
    assert found["LOC"]["shadow_prices"][0]["violation_rate"] == pytest.approx(0.045, abs=0.005)
    cell.write_text(f"{auto}}}\n", encoding="utf-8")
    said = call("check", cell).stdout
    assert "shadows: 0; at 0.005 LOC would miss 0." in said
    assert "under LOC the estimator learns from the incumbent alone\n" in said


def test_check_prices_no_shadows_for_an_estimator_without(cell: Path) -> None:
    cell.write_text(f"{SMALL}controller: {{estimator: profile}}\n", encoding="utf-8")
    assert "shadows" not in call("check", cell).stdout
    assert "shadow_fraction" not in read_json(call("check", cell, "--json"))["candidates"]["LOC"]


def test_check_refuses_a_share_that_is_no_number(cell: Path) -> None:
    cell.write_text(f"{SMALL}controller: {{shadow_fraction: free}}\n", encoding="utf-8")
    assert_refused(
        call("check", cell), "controller.shadow_fraction", "'free'", "auto or a number from 0 to 1"
    )
