"""Policies and estimators of a user's own, named ``module:Class``, wherever a name is taken."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest

import dwell
from dwell.cellfile import load_without_traces
from dwell.control import Controller
from dwell.errors import PolicyError
from tests.cli.small_cell import SMALL, assert_refused, call, read_json

POLICY = """\
from dataclasses import replace


class Fastest:
    def __init__(self, names):
        self.names = names

    @classmethod
    def from_problem(cls, problem):
        return cls(list(problem.candidates))

    def decide(self, *, observed, estimates):
        return min(self.names, key=lambda name: estimates[name].l95_ms)


class Last:
    def decide(self, *, observed, estimates):
        return list(estimates)[-1]


class Wants:
    def __init__(self, names, more, bound=1):
        pass

    def decide(self, *, observed, estimates):
        return "LOC"


class Empty:
    pass


class Fails:
    def __init__(self):
        raise ValueError("no table")

    def decide(self, *, observed, estimates):
        return "LOC"


class Rewrites:
    # Writes what it believes into the estimates.
    def decide(self, *, observed, estimates):
        estimates["OFF"] = replace(estimates["OFF"], l95_ms=1.0)
        return "OFF"


class Forgets:
    # Drops the placement that is active, then takes the best of the others.
    def decide(self, *, observed, estimates):
        estimates.pop("LOC")
        return min(estimates, key=lambda name: estimates[name].l95_ms)


class OddError(Exception):
    # Pickles, and cannot be made again.
    def __init__(self, what, where):
        super().__init__(what)


class Late:
    # Fails after a rehearsal of one window.
    windows = 0

    def decide(self, *, observed, estimates):
        self.windows += 1
        if self.windows == 3:
            raise OddError("lost", "here")
        return "LOC"


made = Last()
"""

ESTIMATOR = """\
from dwell.estimators import Corrected, Profile, Scaling, Shadow


class MyProfile(Profile):
    pass


class MyShadow(Shadow):
    pass


class MyScaling(Scaling):
    pass


class MyCorrected(Corrected):
    pass


class Wants(Corrected):
    def __init__(self, problem, table):
        super().__init__(problem)


class Bare:
    def start(self, problem):
        self.profile = Profile(problem)

    def estimate(self, *arguments, **more):
        return self.profile.estimate(*arguments, **more)
"""


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a cell with modules beside it, in a folder that is not the current one."""
    folder = tmp_path / "hall"
    (folder / "own").mkdir(parents=True)
    (folder / "small.yaml").write_text(SMALL, encoding="utf-8")
    (folder / "own" / "__init__.py").write_text("", encoding="utf-8")
    (folder / "own" / "choice.py").write_text(POLICY, encoding="utf-8")
    (folder / "guess.py").write_text(ESTIMATOR, encoding="utf-8")
    (folder / "raises.py").write_text("raise RuntimeError('no camera')\n", encoding="utf-8")
    (folder / "syntax.py").write_text("def (:\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return folder / "small.yaml"


@pytest.mark.parametrize("name", ["own.choice:Fastest", "own.choice:Last"])
def test_a_run_records_the_name_and_opens_without_the_module(cell: Path, name: str) -> None:
    path = list(sys.path)
    told = read_json(call("run", cell, "--policy", name, "--windows", "6", "--json"))
    assert sys.path == path
    assert told["policy"] == name
    shutil.rmtree(cell.parent)
    kept = dwell.open_run(told["run"])
    assert kept.meta["policy"] == name
    assert set(kept.windows["placement"][1:]) == {"OFF"}


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("guess:Bare", "profile"),
        ("guess:MyProfile", "profile"),
        ("guess:MyShadow", "shadow"),
        ("guess:MyScaling", "scaling"),
        ("guess:MyCorrected", "corrected"),
    ],
)
def test_an_estimator_is_made_and_started(cell: Path, name: str, same: str) -> None:
    stress = ("--scenario", "stress", "--windows", "12")
    found = call("run", cell, "--estimator", name, *stress, "--out", "mine")
    assert found.exit_code == 0, found.output
    call("run", cell, "--estimator", same, *stress, "--out", "ours")
    mine, ours = dwell.open_run("mine"), dwell.open_run("ours")
    assert mine.meta["estimator"] == name
    assert mine.decisions.equals(ours.decisions)


def test_a_subclass_of_ours_that_wants_more_is_refused(cell: Path) -> None:
    found = call("run", cell, "--estimator", "guess:Wants")
    told = "estimator 'guess:Wants': Wants.from_problem(problem) failed: TypeError: "
    assert_refused(found, told, "missing 1 required positional argument: 'table'")


def test_a_policy_and_an_estimator_in_one_name(cell: Path) -> None:
    name = "own.choice:Last+guess:Bare"
    told = read_json(call("run", cell, "--policy", name, "--windows", "3", "--json"))
    meta = dwell.open_run(told["run"]).meta
    assert (meta["policy"], meta["estimator"]) == tuple(name.split("+"))


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("absent:Last", "no module 'absent', neither in "),
        ("own.absent:Last", "no module 'own.absent', neither in "),
        ("raises:Last", "importing raises failed: RuntimeError: no camera (raises.py:1)"),
        ("syntax:Last", "importing syntax failed: SyntaxError: "),
        ("own.choice:Lost", "own.choice has no class 'Lost'; did you mean 'Last'?"),
        ("own.choice:made", "'made' in own.choice is no class"),
        ("own.choice:Wants", "the class wants arguments (names, more); give them defaults"),
        ("own.choice:Empty", "the class is no policy: it has no method decide"),
        ("own.choice:Fails", "Fails() failed: ValueError: no table (choice.py:"),
    ],
)
def test_bad_classes(cell: Path, name: str, told: str) -> None:
    found = call("run", cell, "--policy", name)
    assert found.exit_code == 2
    assert found.stderr.startswith(f"error: policy {name!r}: ")
    assert told in found.stderr
    assert len(found.stderr.splitlines()) == 1
    cell.write_text(f"{SMALL}controller: {{policy: '{name}'}}\n", encoding="utf-8")
    checked = call("check", cell)
    assert checked.exit_code == 2
    assert checked.stderr.startswith(f"{cell}: controller.policy: ")
    assert told in checked.stderr
    known = json.loads(call("check", cell, "--json").stdout)
    assert [fault["path"] for fault in known["faults"]] == ["controller.policy"]


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("Rewrites", "decide at window 0 failed: TypeError: FrozenDict cannot be changed; "),
        ("Forgets", "decide at window 0 failed: TypeError: FrozenDict cannot be changed; "),
        ("Late", "decide at window 0 failed: OddError: lost (choice.py:"),
    ],
)
def test_a_policy_that_fails_in_a_run_is_named(cell: Path, kind: str, told: str) -> None:
    found = call("run", cell, "--policy", f"own.choice:{kind}", "--windows", "5")
    assert_refused(found, f"error: {kind}: {told}", "(choice.py:")


def test_a_policy_that_fails_in_a_worker_process_is_named(cell: Path) -> None:
    study = cell.parent / "study.yaml"
    text = "dwell-study: 1\ncell: small.yaml\nwindows: 5\npolicies: {late: 'own.choice:Late'}\n"
    study.write_text(text, encoding="utf-8")
    found = call("study", study, "--processes", "2")
    assert_refused(found, "error: Late: decide at window 0 failed: OddError: lost (choice.py:")


@pytest.mark.parametrize("name", ["own.choice:", ":Last", "own choice:Last", "own:choice:Last"])
def test_what_is_no_class_path_is_an_unknown_policy(cell: Path, name: str) -> None:
    found = call("run", cell, "--policy", name)
    assert found.exit_code == 2
    assert found.stderr.startswith(f"error: unknown policy {name!r}; ")


def test_a_cell_file_names_classes(cell: Path) -> None:
    own = "controller: {policy: 'own.choice:Last', estimator: 'guess:Bare'}\n"
    cell.write_text(SMALL + own, encoding="utf-8")
    assert call("check", cell).exit_code == 0
    live = Controller(load_without_traces(cell))
    assert live.described()["policy"] == "own.choice:Last"
    assert live.described()["estimator"] == "guess:Bare"


def test_a_study_and_a_live_cell_name_a_subclass_of_ours(cell: Path) -> None:
    study = cell.parent / "study.yaml"
    study.write_text(
        "dwell-study: 1\nname: own\ncell: small.yaml\nwindows: 5\nseeds: 1\npolicies:\n"
        "  ours: {policy: dtp, estimator: corrected}\n"
        "  mine: {policy: dtp, estimator: 'guess:MyCorrected'}\n",
        encoding="utf-8",
    )
    assert call("study", study, "--processes", "1").exit_code == 0
    runs = pl.read_parquet("studies/own/runs.parquet")
    ours, mine = (runs.filter(policy=name).drop("policy") for name in ("ours", "mine"))
    assert ours.equals(mine)
    cell.write_text(f"{SMALL}controller: {{estimator: 'guess:MyCorrected'}}\n", encoding="utf-8")
    assert call("check", cell).exit_code == 0
    live = Controller(load_without_traces(cell))
    assert live.described()["estimator"] == "guess:MyCorrected"
    assert (live.learns, live.supports) == (True, True)
    corrected = Controller(dwell.load(cell), None, "corrected")
    assert live.shadow_fractions == corrected.shadow_fractions


def test_two_folders_have_modules_of_one_name(cell: Path, tmp_path: Path) -> None:
    other = tmp_path / "yard"
    shutil.copytree(cell.parent, other)
    text = POLICY.replace("list(estimates)[-1]", "list(estimates)[0]")
    (other / "own" / "choice.py").write_text(text, encoding="utf-8")
    placed = []
    for folder in (cell.parent, other, cell.parent):
        problem = dwell.load(folder / "small.yaml")
        run = dwell.simulate(problem, policy="own.choice:Last", seed=1, windows=4)
        placed.append(run.windows["placement"].to_list()[-1])
    assert placed == ["OFF", "LOC", "OFF"]


def test_a_folder_without_a_module_does_not_get_the_one_of_another(
    cell: Path, tmp_path: Path
) -> None:
    dwell.simulate(dwell.load(cell), policy="own.choice:Last", seed=1, windows=4)
    bare = tmp_path / "bare"
    bare.mkdir()
    shutil.copy(cell, bare)
    with pytest.raises(PolicyError, match="no module 'own'"):
        dwell.simulate(dwell.load(bare / cell.name), policy="own.choice:Last", seed=1, windows=4)


def test_a_study_over_processes_plays_a_changed_module_again_and_nothing_else(cell: Path) -> None:
    study = cell.parent / "study.yaml"
    text = (
        "dwell-study: 1\nname: own\ncell: small.yaml\nwindows: 5\nseeds: 2\nreferences: true\n"
        "policies: {LOC: LOC, 'own.choice:Last': 'own.choice:Last', mine: 'own.choice:Last'}\n"
    )
    study.write_text(text, encoding="utf-8")
    command = (sys.executable, "-m", "dwell", "study", study, "--processes", "2")
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    # A slow study prints its progress on stderr.
    assert found.returncode == 0
    runs = pl.read_parquet("studies/own/runs.parquet")
    costs = {name: table["cost"].to_list() for (name,), table in runs.group_by("policy")}
    assert costs["own.choice:Last"] == costs["mine"] != costs["LOC"]
    parts = {part.name: part.stat().st_ino for part in Path("studies/own/parts").iterdir()}
    module = cell.parent / "own" / "choice.py"
    module.write_text(POLICY.replace("[-1]", "[0]"), encoding="utf-8")
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0
    changed = pl.read_parquet("studies/own/runs.parquet")
    own = pl.col("policy").is_in(["own.choice:Last", "mine"])
    assert changed.filter(~own).equals(runs.filter(~own))
    assert changed.filter(policy="mine")["cost"].to_list() == costs["LOC"] != costs["mine"]
    left = {part.name: part.stat().st_ino for part in Path("studies/own/parts").iterdir()}
    kept = left.items() & parts.items()
    assert {one["policy"][0] for one in map(part_named, kept)} == {"LOC", "clairvoyant"}
    assert len(left) == len(parts) == 2 * len(kept)


def part_named(named: tuple[str, int]) -> pl.DataFrame:
    return pl.read_parquet(Path("studies/own/parts") / named[0])
