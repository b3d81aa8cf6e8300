"""A study in a folder: what is finished stays, and nothing tells how it came to be."""

from __future__ import annotations

import fcntl
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from dwell.errors import RunError, SimulationError
from dwell.study import Contender, Point, Study, load_study, open_study, run_study
from tests.study.test_study import make_study

ROOT = Path(__file__).parents[2]
TABLES = ("runs", "costs", "latencies")

CELL = """\
dwell: 1
period_ms: 20
window_cycles: 20
warmup_windows: 1
nodes:
  R: {tier: robot, cores: 1}
  E: {tier: edge, cores: 4}
links:
  - {from: R, to: E, both_ways: true, delay_ms: {lognormal: {mean: 1, cv: 0.3}}}
tasks:
  sense: {on: {R: {exec_ms: 1}}}
  plan: {on: {R: {exec_ms: {lognormal: {mean: 8, cv: 0.2}}}, E: {exec_ms: 2}}}
flows:
  - {from: sense, to: plan}
candidates:
  LOC: {plan: R}
  OFF: {plan: E}
scenarios:
  stress: [{node: R, at_s: 10, for_s: 20, stress_threads: 3}]
"""

STUDY = """\
dwell-study: 1
name: small
cell: cell.yaml
windows: 50
seeds: 10
policies: [LOC, dtp]
parameters:
  links[0].delay_ms: [1, 4]
  objective.weights.switching: [0, 1]
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a study file and, in `whole`, what it comes to without a break."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")
    (folder / "study.yaml").write_text(STUDY, encoding="utf-8")
    run_study(load_study(folder / "study.yaml"), folder=folder / "whole", processes=1)
    return folder


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished `make_study()`."""
    folder = tmp_path_factory.mktemp("small") / "small"
    run_study(make_study(), folder=folder, processes=1)
    return folder


def parts_in(folder: Path) -> dict[str, tuple[int, int]]:
    """Return every part with what changes when it is written again."""
    found = {}
    for path in (folder / "parts").glob("*.parquet"):
        status = path.stat()
        found[path.name] = (status.st_ino, status.st_mtime_ns)
    return found


def assert_same_files(one: Path, other: Path) -> None:
    for name in TABLES:
        file = f"{name}.parquet"
        assert (one / file).read_bytes() == (other / file).read_bytes(), name
    assert [path.name for path in one.rglob(".*")] == []


# ---------------------------------------------------------------------------------- killed


def start(folder: Path, out: Path, processes: int) -> subprocess.Popen[bytes]:
    command = ["study", str(folder / "study.yaml"), "--out", str(out)]
    return subprocess.Popen(
        [sys.executable, "-m", "dwell", *command, "--processes", str(processes)],
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        stdout=subprocess.DEVNULL,
    )


def kill_when(process: subprocess.Popen[bytes], out: Path, parts: int) -> None:
    """Kill a study as soon as it has so many parts."""
    while len(parts_in(out)) < parts:
        assert process.poll() is None, "it ended by itself"
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


def test_a_study_that_is_killed_again_and_again_ends_with_the_same_bytes(
    whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    known: dict[str, tuple[int, int]] = {}
    for processes, more in ((1, 1), (2, 2)):
        kill_when(start(whole, out, processes), out, len(known) + more)
        found = parts_in(out)
        assert found.items() >= known.items(), "a finished item was repeated"
        assert not (out / "runs.parquet").exists()
        known = found
    run_study(load_study(whole / "study.yaml"), folder=out, processes=1)
    assert parts_in(out).items() >= known.items(), "a finished item was repeated"
    assert_same_files(out, whole / "whole")


def test_an_interrupt_counts_what_workers_have_finished_since(whole: Path, tmp_path: Path) -> None:
    seen: list[int] = []

    def interrupt(done: int, _: int) -> None:
        seen.append(done)
        if len(seen) == 2:
            raise KeyboardInterrupt

    study = load_study(whole / "study.yaml")
    with pytest.raises(KeyboardInterrupt):
        run_study(study, folder=tmp_path / "out", processes=2, progress=interrupt)
    there = [
        pl.read_parquet(tmp_path / "out" / "parts" / name) for name in parts_in(tmp_path / "out")
    ]
    assert seen[-1] == sum(map(len, there)) >= seen[1] > 0


def test_what_a_kill_may_leave_is_cleared(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(small, out)
    (missing, *_), draft = sorted((out / "parts").glob("*.parquet")), b"half of it"
    missing.unlink()
    missing.with_name(f".{missing.name}.draft").write_bytes(draft)
    (out / ".runs.parquet.draft").write_bytes(draft)
    (out / "runs.parquet").unlink()
    known = parts_in(out)
    run_study(make_study(), folder=out, processes=1)
    assert parts_in(out).items() >= known.items()
    assert_same_files(out, small)


def test_a_study_killed_at_its_very_beginning_starts_again(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "parts").mkdir(parents=True)
    (out / ".study.json.draft").write_text("{", encoding="utf-8")
    run_study(make_study(), folder=out, processes=1)
    assert_same_files(out, small)


def test_a_finished_study_does_nothing_again(small: Path) -> None:
    known, seen = parts_in(small), []
    before = {name: (small / f"{name}.parquet").read_bytes() for name in TABLES}
    result = run_study(make_study(), folder=small, progress=lambda *count: seen.append(count))
    assert seen == [(12, 12)]
    assert parts_in(small) == known
    for name in TABLES:
        assert (small / f"{name}.parquet").read_bytes() == before[name]
        assert getattr(result, name).equals(pl.read_parquet(small / f"{name}.parquet"))


def test_a_folder_holds_what_memory_would(small: Path) -> None:
    result = run_study(make_study(), processes=1)
    for name in TABLES:
        assert getattr(result, name).equals(pl.read_parquet(small / f"{name}.parquet"))


def test_labels_may_be_given_later_and_are_read_again(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(small, out)
    assert open_study(out).labels == {}
    points = tuple(Point({"period_ms": 1}, point.problem) for point in make_study().points)
    with pytest.raises(SimulationError, match="'perid_ms' is none of the parameters; did you mean"):
        replace(make_study(), points=points, labels={"perid_ms": "P"})


def test_a_study_of_parameters_keeps_their_labels(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole / "whole", out)
    known = parts_in(out)
    path = "objective.weights.switching"
    labelled = replace(load_study(whole / "study.yaml"), labels={path: "ω_S"})
    run_study(labelled, folder=out, processes=1)
    assert parts_in(out) == known
    assert open_study(out).labels == {path: "ω_S"}
    assert open_study(out).shown_parameter(f"parameter.{path}") == "ω_S"
    assert_same_files(out, whole / "whole")


# ------------------------------------------------------------------------------ other studies


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"seeds": (1, 2)}, "seeds: 1, 2, 3 there, 1, 2 now"),
        ({"windows": 9}, "windows: 6 there, 9 now"),
        ({"contenders": (Contender("LOC", "LOC"),)}, "policies.dtp: a mapping there, nothing now"),
        (
            {
                "contenders": (
                    Contender("LOC", "LOC"),
                    Contender("dtp", "dtp", settings={"controller.min_dwell": 2}),
                )
            },
            "policies.dtp.settings.controller.min_dwell: nothing there, 2 now",
        ),
    ],
)
def test_a_folder_of_another_study_is_refused(
    small: Path, change: dict[str, object], difference: str
) -> None:
    known = parts_in(small)
    study: Study = replace(make_study(), **change)  # type: ignore[arg-type]
    with pytest.raises(RunError, match="holds another study") as caught:
        run_study(study, folder=small, processes=1)
    assert difference in str(caught.value)
    assert parts_in(small) == known


def test_a_folder_of_other_versions_is_refused(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(small, out)
    described = json.loads((out / "study.json").read_text(encoding="utf-8"))
    described["software"]["numpy"] = "1.0"
    described["digest"] = "another"
    (out / "study.json").write_text(json.dumps(described), encoding="utf-8")
    with pytest.raises(RunError, match=r"software\.numpy: '1\.0' there, '\d"):
        run_study(make_study(), folder=out, processes=1)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("important", encoding="utf-8")
    with pytest.raises(RunError, match="is no study; choose another folder"):
        run_study(make_study(), folder=tmp_path, processes=1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(RunError, match="is not a folder"):
        run_study(make_study(), folder=tmp_path / "thesis.tex", processes=1)


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_folder_with_a_broken_description_is_refused(
    small: Path, tmp_path: Path, text: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(small, out)
    (out / "study.json").write_text(text, encoding="utf-8")
    with pytest.raises(RunError, match=r"out"):
        run_study(make_study(), folder=out, processes=1)


def test_two_at_a_time_do_not_share_a_folder(small: Path) -> None:
    handle = os.open(small, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(RunError, match="is in use: another process"):
            run_study(make_study(), folder=small, processes=1)
    finally:
        os.close(handle)
    run_study(make_study(), folder=small, processes=1)


def test_a_part_that_cannot_be_read_is_named(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(small, out)
    part = sorted((out / "parts").glob("*.parquet"))[2]
    part.write_bytes(part.read_bytes()[:-100])
    with pytest.raises(RunError, match=rf"{part.name}: cannot be read .* remove it"):
        run_study(make_study(), folder=out, processes=1)
    part.unlink()
    run_study(make_study(), folder=out, processes=1)
    assert_same_files(out, small)


# ----------------------------------------------------------------------------- no room, no way


@contextmanager
def file_sizes_restored() -> Iterator[None]:
    """Take back what the test does to the largest size of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def allow_files_of(size: int) -> None:
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))


def test_where_files_cannot_grow_finished_items_stay(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def refuse_files(done: int, _: int) -> None:
        if done == 8:
            allow_files_of(1000)

    with (
        file_sizes_restored(),
        pytest.raises(
            SimulationError, match=r"File too large\)\n8 of 12 runs are finished and stay"
        ),
    ):
        run_study(make_study(), folder=out, processes=1, progress=refuse_files)
    known = parts_in(out)
    assert len(known) == 4
    run_study(make_study(), folder=out, processes=1)
    assert parts_in(out).items() >= known.items()
    assert_same_files(out, small)


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a file system with room for some parts; only root may make one."""
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("only root can make a small file system")
    disk = tmp_path / "disk"
    disk.mkdir()
    made = subprocess.run(
        [mount, "-t", "tmpfs", "-o", "size=64k", "none", disk], check=False, capture_output=True
    )
    if made.returncode:
        pytest.skip(f"no small file system: {made.stderr.decode().strip()}")
    yield disk
    subprocess.run(["umount", disk], check=True)


def test_on_a_full_disk_finished_items_stay(full_disk: Path, small: Path) -> None:
    out = full_disk / "out"
    with pytest.raises(SimulationError, match="No space left on device") as caught:
        run_study(make_study(), folder=out, processes=1)
    known = parts_in(out)
    assert 0 < len(known) < 6
    assert f"{2 * len(known)} of 12 runs are finished and stay" in str(caught.value)
    subprocess.run(["mount", "-o", "remount,size=1m", full_disk], check=True)
    run_study(make_study(), folder=out, processes=1)
    assert parts_in(out).items() >= known.items()
    assert_same_files(out, small)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(SimulationError, match=r"file/out: cannot be written \(Not a directory\)"):
        run_study(make_study(), folder=tmp_path / "file" / "out", processes=1)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(SimulationError, match=r"cannot be written \(Permission denied\)"):
        run_study(make_study(), folder=tmp_path / "out", processes=1)


def test_a_folder_that_goes_away_ends_the_study(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def remove(done: int, _: int) -> None:
        if done:
            shutil.rmtree(out)

    with pytest.raises(SimulationError, match="cannot be written"):
        run_study(make_study(), folder=out, processes=1, progress=remove)


def test_a_folder_of_another_version_is_refused_by_name(small: Path, tmp_path: Path) -> None:
    out = shutil.copytree(small, tmp_path / "out")
    path = out / "study.json"
    described = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**described, "dwell-study-folder": 1, "digest": "another"}))
    with pytest.raises(RunError, match=r"study\.json: version 1 of a study's folder, and this"):
        open_study(out)
    with pytest.raises(RunError, match=r"dwell-study-folder: 1 there, 2 now"):
        run_study(make_study(), folder=out, processes=1)
