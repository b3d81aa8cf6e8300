"""Shards of a study: played apart and merged, they are the study; anything else is refused."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dwell.errors import ProblemError, RunError
from dwell.study import Shard, load_study, merge_shards, run_shard, run_study
from tests.cli.small_cell import SMALL, assert_refused, call, interrupt_at_first_sign, read_json
from tests.study.test_study import make_study
from tests.study.test_study_folder import assert_same_files, parts_in

STUDY = make_study(references=True)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the study as one process plays it."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    run_study(STUDY, folder=folder, processes=1)
    return folder


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with all three shards of the study."""
    folder = tmp_path_factory.mktemp("shards") / "out"
    for place in (3, 1, 2):
        assert run_shard(STUDY, Shard(place, 3), folder=folder, processes=1) == 4
    return folder


@pytest.fixture
def shards(played: Path, tmp_path: Path) -> Path:
    return shutil.copytree(played, tmp_path / "out")


@pytest.mark.parametrize("of", [1, 2, 3, 7])
def test_shards_hold_every_item_once(of: int) -> None:
    spans = [Shard(place, of).span(5) for place in range(1, of + 1)]
    assert [item for span in spans for item in span] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("text", ["0/2", "3/2", "2", "1/0", "-1/2", "a/b", "1/2/3", "1.5/2", "٢/٤"])
def test_what_is_no_shard_is_refused(text: str) -> None:
    with pytest.raises(ProblemError, match="it must be i/n with i from 1 to n, as 2/4"):
        Shard.read(text)


def test_merged_shards_are_the_study(shards: Path, whole: Path) -> None:
    result = merge_shards(STUDY, shards)
    assert_same_files(shards, whole)
    assert result.runs.equals(run_study(STUDY, processes=1).runs)
    # Nothing is left to do, and to merge again does no harm.
    seen: list[tuple[int, int]] = []
    run_study(STUDY, folder=shards, processes=1, progress=lambda *count: seen.append(count))
    assert seen == [(12, 12)]
    merge_shards(STUDY, shards)
    assert_same_files(shards, whole)


def test_what_a_folder_had_before_does_not_count(shards: Path, whole: Path) -> None:
    def stop(done: int, _: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(STUDY, folder=shards, processes=1, progress=stop)
    merge_shards(STUDY, shards)
    assert_same_files(shards, whole)


def test_more_shards_than_items_may_be_empty(tmp_path: Path, whole: Path) -> None:
    counts = [
        run_shard(STUDY, Shard(place, 7), folder=tmp_path / "out", processes=1)
        for place in range(1, 8)
    ]
    assert sorted(counts) == [0, 2, 2, 2, 2, 2, 2]
    merge_shards(STUDY, tmp_path / "out")
    assert_same_files(tmp_path / "out", whole)


def test_a_shard_goes_on_where_it_was_stopped(shards: Path) -> None:
    second = shards / "shards" / "2-of-3"
    known = parts_in(second)
    gone = next(iter(known))
    (second / "parts" / gone).unlink()
    with pytest.raises(RunError, match=r"2-of-3 is not finished: .* of 4 .* `--shard 2/3`"):
        merge_shards(STUDY, shards)
    assert not (shards / "study.json").exists()
    run_shard(STUDY, Shard(2, 3), folder=shards, processes=1)
    left = {name: known[name] for name in known if name != gone}
    assert parts_in(second).items() >= left.items()
    merge_shards(STUDY, shards)


def refused(shards: Path, message: str) -> None:
    """Assert that a merge is refused, and touches nothing."""
    before = sorted(path.name for path in shards.iterdir())
    with pytest.raises(RunError, match=message):
        merge_shards(STUDY, shards)
    assert sorted(path.name for path in shards.iterdir()) == before


def test_a_missing_shard_is_named(shards: Path) -> None:
    shutil.rmtree(shards / "shards" / "2-of-3")
    refused(shards, "missing shard 2/3 of the study; play it with `--shard 2/3`")
    shutil.rmtree(shards / "shards")
    refused(shards, "shards holds no shard; play each of them with `--shard i/n`")


def test_shards_with_the_same_runs_are_named(shards: Path) -> None:
    folder = shards / "shards"
    shutil.copytree(folder / "2-of-3", folder / "2-of-3-copy")
    refused(shards, "2-of-3 and .*2-of-3-copy hold the same runs; remove one of them")
    shutil.rmtree(folder / "2-of-3-copy")
    run_shard(STUDY, Shard(2, 2), folder=shards, processes=1)
    refused(shards, "2-of-2 and .*2-of-3 hold the same runs")


def test_a_folder_that_is_no_shard_is_named(shards: Path, whole: Path) -> None:
    shutil.copytree(whole, shards / "shards" / "whole")
    refused(shards, "whole does not hold a shard of a study; remove it")


def test_a_shard_of_other_software_is_named(shards: Path) -> None:
    mark = shards / "shards" / "3-of-3" / "study.json"
    described = json.loads(mark.read_text())
    described["software"]["numpy"] = "1.0"
    mark.write_text(json.dumps({**described, "digest": "another"}))
    refused(shards, r"(?s)3-of-3 holds another study, .*software\.numpy: '1\.0' there, '\d")


def test_a_shard_of_another_file_is_named(shards: Path) -> None:
    with pytest.raises(RunError, match=r"(?s)1-of-3 holds another study.*windows: 6 there, 7 now"):
        merge_shards(replace(STUDY, windows=7), shards)
    with pytest.raises(RunError, match=r"(?s)1-of-3 holds another study.*seeds: 1, 2, 3 there"):
        run_shard(replace(STUDY, seeds=(1, 2)), Shard(1, 3), folder=shards, processes=1)


POLICY = """\
class Last:
    def decide(self, *, observed, estimates):
        return list(estimates)[-1]
"""
OWN = """\
dwell-study: 1
name: own
cell: small.yaml
windows: 6
seeds: 4
policies: {LOC: LOC, mine: "hall_choice:Last"}
"""


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a study with a policy of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(SMALL)
    (tmp_path / "hall_choice.py").write_text(POLICY)
    path = tmp_path / "study.yaml"
    path.write_text(OWN)
    return path


def test_the_commands_play_and_merge_shards(study: Path) -> None:
    run_study(load_study(study), folder=Path("whole"), processes=1)
    arguments = ("--out", "out", "--processes", "1")
    done = call("study", study, *arguments, "--shard", "1/2")
    assert (done.exit_code, done.stdout) == (0, "shard 1/2: 8 runs in out/shards/1-of-2\n")
    assert_refused(call("study", study, "--out", "out", "--merge"), "missing shard 2/2")
    found = read_json(call("study", study, *arguments, "--shard", "2/2", "--json"))
    expected = {"study": "own", "folder": "out/shards/2-of-2", "shard": "2/2", "runs": 8}
    assert found == expected
    merged = call("study", study, "--out", "out", "--merge")
    assert merged.exit_code == 0, merged.output
    assert merged.stdout.endswith("tables: out\n")
    assert_same_files(Path("out"), Path("whole"))
    assert_refused(call("study", study, "--merge", "--shard", "1/2"), "give --shard or --merge")
    assert_refused(call("study", study, "--shard", "3/2"), "error: shard: '3/2' is not allowed")


def test_a_shard_of_another_source_of_an_own_class_is_named(study: Path) -> None:
    command = (sys.executable, "-m", "dwell", "study", study, "--out", "out", "--processes", "1")
    for shard in ("1/2", "2/2"):
        subprocess.run((*command, "--shard", shard), check=True, capture_output=True)
        study.with_name("hall_choice.py").write_text(f"{POLICY}# {shard}\n")
    merged = subprocess.run((*command, "--merge"), capture_output=True, text=True, check=False)
    assert merged.returncode == 2
    assert "1-of-2 was played with another source of hall_choice:Last" in merged.stderr
    assert not Path("out/study.json").exists()


def test_an_interrupted_shard_says_how_to_go_on(study: Path) -> None:
    arguments = ["study", str(study), "--seeds", "4000", "--processes", "1", "--out", "out"]
    arguments += ["--shard", "2/2"]
    code, stdout, shown = interrupt_at_first_sign(arguments, study.parent, sign="cycles/s")
    assert (code, stdout) == (130, "")
    assert "of 8000 runs are finished and stay in out/shards/2-of-2; the same" in shown
