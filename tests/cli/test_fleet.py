"""`dwell fleet`: what it prints, saves and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dwell.record import FleetRun, open_fleet
from dwell.study.capacity import FleetPlayer
from dwell.study.played_sizes import PlayedSize, Sizes
from tests.cli.small_cell import ROOT, SMALL, assert_refused, call, read_json

FLEET = """\
dwell-fleet: 1
name: pair
shared: [E]
cells:
  - {cell: small.yaml, count: 2, scenario: stress}
phases: even
coordination: none
"""


@pytest.fixture
def fleet(cell: Path) -> Path:
    """Return a fleet of two small cells, in the current folder."""
    path = cell.with_name("pair.yaml")
    path.write_text(FLEET, encoding="utf-8")
    return path


def test_a_fleet_is_played_saved_and_summed_up(fleet: Path) -> None:
    result = call("fleet", "run", fleet, "--windows", "12", "--policy", "OFF")
    assert (result.exit_code, result.stderr) == (0, "")
    first, *_ = result.stdout.splitlines()
    assert first == ("pair: 2 cells; shared: E; phases: even; coordination: none; seed 1; 2.4 s")
    assert "saved to runs/pair-OFF-none-even-1" in result.stdout
    run = open_fleet("runs/pair-OFF-none-even-1")
    assert [one.windows.height for one in run.cells.values()] == [12, 12]
    assert run.phases_ms == {"small-01": 0.0, "small-02": 10.0}
    assert {one.meta["policy"] for one in run.cells.values()} == {"Static(initial='OFF')"}


def test_as_json_the_worst_cell_is_first(fleet: Path) -> None:
    found = read_json(call("fleet", "run", fleet, "--windows", "12", "--policy", "LOC", "--json"))
    rates = [row["violation_rate"] for row in found["cells"]]
    assert rates == sorted(rates, reverse=True)
    assert {row["cell"] for row in found["cells"]} == {"small-01", "small-02"}
    assert (found["moves"], found["guard_moves"], found["rounds"]) == (0, 0, [])
    assert set(found["load"]) == {"E"}
    assert found["run"] == "runs/pair-LOC-none-even-1"
    run = open_fleet(found["run"])
    windows = run.cells[found["cells"][0]["cell"]].windows
    mean = windows.filter(~windows["warmup"])["violation_rate"].mean()
    assert mean == pytest.approx(rates[0])


@pytest.mark.parametrize(
    ("phases", "offsets"), [("sync", [0, 0]), ("3,4.5", [3, 4.5]), ("even", [0, 10])]
)
def test_phases_are_a_word_or_a_list(fleet: Path, phases: str, offsets: list[float]) -> None:
    arguments = ("fleet", "run", fleet, "--windows", "6", "--phases", phases, "--json")
    assert [*read_json(call(*arguments))["phases_ms"].values()] == offsets


def test_the_same_command_writes_the_same_again_and_another_does_not(fleet: Path) -> None:
    arguments = ("fleet", "run", fleet, "--windows", "6", "--out", "here")
    assert call(*arguments).exit_code == 0
    assert call(*arguments).exit_code == 0
    assert_refused(call(*arguments, "--seed", "2"), "here holds the runs of another fleet")
    Path("notes").mkdir()
    Path("notes/a.txt").write_text("")
    assert_refused(call(*arguments[:-1], "notes"), "notes exists and is no fleet's")


def test_an_interrupted_fleet_says_how_many_runs_are_whole(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: FleetRun, path: Path) -> Path:
        next(iter(self.cells.values())).save(path / "small-01")
        raise KeyboardInterrupt

    monkeypatch.setattr(FleetRun, "save", interrupted)
    result = call("fleet", "run", fleet, "--windows", "6", "--out", "here")
    assert result.exit_code == 130
    assert "interrupted: 1 of 2 runs are whole in here; the same command makes" in result.stderr


def test_a_shared_node_that_nobody_uses_is_warned_of(fleet: Path) -> None:
    cell = fleet.with_name("small.yaml")
    cell.write_text(SMALL.replace("  OFF: {plan: E}\n", ""), encoding="utf-8")
    result = call("fleet", "run", fleet, "--windows", "6", "--policy", "LOC")
    assert result.exit_code == 0
    assert "shared.E: no candidate of any cell uses this node" in result.stderr


def test_a_limit_without_effect_is_warned_of(fleet: Path) -> None:
    text = fleet.read_text(encoding="utf-8")
    for objective, warns in (("sum", True), ("served", False)):
        fleet.write_text(f"{text}objective: {objective}\nlimit: 0.1\n", encoding="utf-8")
        options = ("--windows", "6", "--policy", "LOC", "--out", objective)
        result = call("fleet", "run", fleet, *options)
        assert result.exit_code == 0
        assert ("limit: it has no effect with objective sum; remove it" in result.stderr) == warns


def test_a_length_in_seconds(fleet: Path) -> None:
    found = read_json(call("fleet", "run", fleet, "--seconds", "1.25", "--json"))
    assert found["seconds"] == 1.25
    text = call("fleet", "run", fleet, "--seconds", "0.1")
    assert_refused(text, "seconds: 0.1 is not allowed; it must be at least the longest window, 0.2")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--policy", "OF"), ("unknown policy 'OF'", "OFF")),
        (("--estimator", "corected"), ("unknown estimator 'corected'", "corrected")),
        (("--coordination", "legder"), ("'legder'", "none, random, ledger")),
        (("--phases", "evn"), ("'evn'", "did you mean 'even'?")),
        (("--phases", "1,2,3"), ("3 phases for 2 cells",)),
    ],
)
def test_what_is_unknown_is_refused(
    fleet: Path, options: tuple[str, ...], words: tuple[str, ...]
) -> None:
    assert_refused(call("fleet", "run", fleet, "--windows", "6", *options), *words)


def test_a_cell_is_no_fleet_and_a_fleet_is_no_cell(fleet: Path) -> None:
    cell = fleet.with_name("small.yaml")
    assert_refused(call("fleet", "run", cell), f"{cell}:1: dwell: this is a cell, not a fleet")
    for command in ("run", "check"):
        assert_refused(call(command, fleet), f"{fleet}:1: dwell-fleet: this is a fleet, not")
    assert_refused(call("study", fleet), f"{fleet}:1: dwell-fleet: this is a fleet, not a study")


def test_faults_are_told_all_at_once(fleet: Path) -> None:
    fleet.write_text(FLEET.replace("[E]", "[E, X]").replace("even", "evn").replace("stress", "s"))
    result = call("fleet", "run", fleet)
    assert (result.exit_code, result.stdout) == (2, "")
    paths = [line.split(": ")[1] for line in result.stderr.splitlines()]
    assert paths == ["shared[1]", "cells[0].scenario", "phases"]


def test_the_example_is_a_fleet_that_can_be_played(tmp_path: Path) -> None:
    example = ROOT / "examples" / "fleet.yaml"
    result = call(
        *("fleet", "run", example, "--windows", "7", "--coordination", "none"),
        *("--out", tmp_path / "hall"),
    )
    assert result.exit_code == 0, result.output
    told = json.loads((tmp_path / "hall" / "fleet.json").read_text())
    assert (told["file"], len(told["cells"])) == (str(example), 12)


#: Few enough cycles for a test.
FEW = ("--most", "6", "--processes", "1")


@pytest.fixture
def crowd(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a fleet of cells of which a few fill the edge."""
    text = SMALL.replace("cores: 4", "cores: 1, scheduler: fifo").replace(
        "E: {exec_ms: 2}", "E: {exec_ms: 6}"
    )
    fleet.with_name("small.yaml").write_text(text, encoding="utf-8")
    monkeypatch.setattr("dwell.study.capacity.CYCLES", 400)
    return fleet


def test_a_capacity_as_json(crowd: Path) -> None:
    """P = 20 ms, jobs of 6 ms one after another, 5 ms before: two are done by 17 ms, three by 23.

    Of the late ones each first waits 3 ms for its stressed robot.
    """
    command = ("fleet", "capacity", crowd, "--policy", "OFF", "--phases", "sync", *FEW, "--json")
    found = read_json(call(*command))
    assert {name: found[name] for name in ("robots", "at_least", "interval", "limit")} == {
        "robots": 2,
        "at_least": False,
        "interval": [2, 2],
        "limit": 0.05,
    }
    assert (found["limit_on"], found["phases"], found["policy"]) == (
        "violation_rate",
        "sync",
        "OFF",
    )
    assert found["limits"] == {"resource": "E", "share": pytest.approx(12 / 15, abs=1e-3)}
    assert (found["robots_at_limit"], found["searched"]) == (2, "every size")
    assert [point["robots"] for point in found["curve"]] == [1, 2, 3]
    assert set(found["curve"][0]) == {
        *("robots", "violation_rate", "low", "high", "phases_error", "cycles_error", "utilisation")
    }
    assert found["curve"][1]["utilisation"] == {"E": pytest.approx(0.6, abs=0.01)}
    assert "what_if" not in found
    assert found["report"] is None
    assert read_json(call(*command, "--out", "page.html"))["report"] == "page.html"
    assert Path("page.html").is_file()


def test_a_capacity_on_a_terminal_with_what_would_change_it(crowd: Path) -> None:
    command = ("fleet", "capacity", crowd, "--policy", "OFF", "--phases", "sync", *FEW)
    result = call(*command, "--what-if", "--figures", "figures")
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert lines[1].split() == ["robots", "2", "[2,", "2]"]
    assert [
        line.rsplit("  ", 1)[0].split() for line in lines if line.startswith("a core more")
    ] == [["a", "core", "more", "on", "E", "4"]]
    (even,) = [line.split() for line in lines if line.startswith("phases evenly spread")]
    assert even[3:] == ["3", "[3,", "3]"]
    assert "report: capacity/pair-OFF-sync.html" in result.stdout
    asked = call(*command, "--asked", "5", "--out", "asked.html")
    assert "5 asked: 3 too many; served with a core more on E, 2 times" in asked.stdout
    assert {path.name for path in Path("figures").iterdir()} >= {"capacity.svg", "capacity.pdf"}
    page = Path("capacity/pair-OFF-sync.html").read_text(encoding="utf-8")
    assert "all cells begin their cycles at one instant" in page
    # The same question is answered again; the answer to another does not replace the page.
    other = call(*command, "--limit", "0.3")
    assert (other.exit_code, "was made from something else" in other.stderr) == (2, True)
    assert Path("capacity/pair-OFF-sync.html").read_text(encoding="utf-8") == page
    assert call(*command, "--what-if").exit_code == 0


def test_an_interrupted_capacity_keeps_its_sizes_and_goes_on(
    crowd: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("fleet", "capacity", crowd, "--policy", "OFF", "--phases", "sync", *FEW, "--json")
    whole = read_json(call(*command))
    assert not Path("capacity").exists()
    play = FleetPlayer.__call__

    def interrupted(self: FleetPlayer, unit: Sizes) -> list[PlayedSize]:
        if unit.seed > 3:
            raise KeyboardInterrupt
        return play(self, unit)

    with monkeypatch.context() as patched:
        patched.setattr(FleetPlayer, "__call__", interrupted)
        result = call(*command)
    assert (result.exit_code, result.stdout) == (130, "")
    file = Path("capacity/pair-OFF-sync.played")
    assert f"interrupted: the results of 18 runs are in {file}; the same command" in result.stderr

    def others(self: FleetPlayer, unit: Sizes) -> list[PlayedSize]:
        assert unit.seed > 3
        return play(self, unit)

    with monkeypatch.context() as patched:
        patched.setattr(FleetPlayer, "__call__", others)
        assert read_json(call(*command)) == whole
    assert not Path("capacity").exists()


def test_a_capacity_warns_of_cells_that_are_played_for_long(
    crowd: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dwell.study.capacity.MANY_CYCLES", 399)
    command = ("fleet", "capacity", crowd, "--policy", "OFF", "--phases", "sync", "--most", "1")
    result = call(*command, "--processes", "1", "--json")
    assert result.exit_code == 0
    assert f"{crowd}: warning: cells[0].cell: a run counts 400 cycles of small" in result.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--policy", "LOC"), ("policy: LOC never uses a shared node (E)", "name another one")),
        (("--policy", "OF"), ("unknown policy 'OF'", "OFF")),
        (("--policy", "OFF", "--phases", "1,2"), ("phases: ",)),
        (("--policy", "OFF", "--limit", "5"), ("--limit: 5 is not allowed", "between 0 and 1")),
    ],
)
def test_a_capacity_that_cannot_be_answered_is_refused(
    crowd: Path, options: tuple[str, ...], words: tuple[str, ...]
) -> None:
    assert_refused(call("fleet", "capacity", crowd, *FEW, *options), *words)


def test_the_plan_of_a_fleet(crowd: Path) -> None:
    result = call("fleet", "plan", crowd, "--phases", "sync")
    assert (result.exit_code, result.stderr) == (0, "")
    head, best, phi, *_ = result.stdout.splitlines()
    assert "phases: sync; seed 1" in head
    assert best.startswith("best: ")
    assert phi.startswith("Φ/n ")
    told = json.loads(call("fleet", "plan", crowd, "--phases", "sync", "--json").stdout)
    assert {"fleet", "seed", "phases", "phi", "table_phi", "cells"} == set(told)
    assert set(told["cells"][0]) == {"cell", "placement", "violation_rate", "l95_ms"}


def test_a_plan_names_the_cells_that_stay_above_a_limit(crowd: Path) -> None:
    """The edge has no room for four cells, and their robots are too slow."""
    crowd.write_text(FLEET.replace("count: 2", "count: 4"), encoding="utf-8")
    command = ("fleet", "plan", crowd, "--phases", "sync")
    found = read_json(call(*command, "--limit", "0.05", "--json"))
    assert found["limit"] == 0.05
    assert found["above"] == [one["cell"] for one in found["cells"] if one["violation_rate"] > 0.05]
    assert 0 < len(found["above"]) < 4
    text = call(*command, "--limit", "0.05").stdout
    names = ", ".join(found["above"])
    assert text.endswith(f"\n{len(found['above'])} of 4 cells stay above 5 %: {names}\n")
    assert_refused(call(*command, "--limit", "5"), "--limit: 5 is not allowed", "between 0 and 1")
    crowd.write_text(FLEET, encoding="utf-8")
    assert call(*command, "--limit", "0.05").stdout.endswith("\n0 of 2 cells stay above 5 %\n")
    crowd.write_text(f"{FLEET}objective: served\nlimit: 0.2\n", encoding="utf-8")
    assert call(*command).stdout.endswith("\n0 of 2 cells stay above 20 %\n")
