"""The journal: killed at any moment, torn at any byte, it gives back what was whole."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from dwell.errors import RunError, UnwritableError
from dwell.record import Journal, Run, open_run, require_free, seal_run
from dwell.record.journal import JOURNAL, note_in_journal, read_plain_journal
from dwell_lab.chaos.disk import SmallDisk, limit_file_size, may_mount

COLUMNS: dict[str, dict[str, Any]] = {
    "cycles": {"cycle": "Int64", "placement": ["LOC", "SO"], "latency_ns": "Int64"},
    "windows": {"window": "Int64", "l95_ms": "Float64", "unproven": "Boolean"},
    "decisions": {"window": "Int64", "reason": "String"},
}
META = {"kind": "live", "cell": "small", "problem": {"period_ms": 40.0}}
W = 3


def rows_of(window: int) -> dict[str, list[tuple[Any, ...]]]:
    first = window * W
    cycles: list[tuple[Any, ...]] = [(first + i, "LOC", 1000 + first + i) for i in range(W)]
    if window:
        # The last cycle of the window before has completed since.
        cycles = [(first - 1, "LOC", 7), *cycles]
    cycles[-1] = (first + W - 1, "SO", None)
    return {
        "cycles": cycles,
        "windows": [(window, float("inf") if window == 1 else 20.5, False)],
        "decisions": [(window, "hold")],
    }


def start(folder: Path, **more: Any) -> Journal:
    return Journal(folder, **{"run": "7", "meta": META, "columns": COLUMNS, **more})


def write(folder: Path, windows: int) -> list[int]:
    """Write a journal; return its length before and after every window."""
    journal = start(folder)
    lengths = [(folder / JOURNAL).stat().st_size]
    for window in range(windows):
        journal.append(rows_of(window))
        lengths.append((folder / JOURNAL).stat().st_size)
    journal.close()
    return lengths


def assert_holds(run: Run, windows: int) -> None:
    assert run.windows["window"].to_list() == list(range(windows))
    assert run.decisions.rows() == [(window, "hold") for window in range(windows)]
    expected = [1000 + cycle if (cycle + 1) % W else 7 for cycle in range(windows * W)]
    if windows:
        expected[-1] = None  # type: ignore[call-overload]
    assert run.cycles["latency_ns"].to_list() == expected
    assert run.cycles["cycle"].to_list() == list(range(windows * W))
    assert run.meta["windows"] == windows


def test_what_was_written_is_read_while_it_is_written(tmp_path: Path) -> None:
    journal = start(tmp_path / "deep" / "run")
    for window in range(3):
        assert journal.following("windows") == window
        assert journal.following("cycles") == window * W
        assert_holds(open_run(journal.folder), window)
        journal.append(rows_of(window))
    run = open_run(journal.folder)
    assert_holds(run, 3)
    assert run.windows["l95_ms"].to_list() == [20.5, float("inf"), 20.5]
    assert dict(run.cycles.schema) == {
        "cycle": pl.Int64(),
        "placement": pl.Enum(["LOC", "SO"]),
        "latency_ns": pl.Int64(),
    }
    assert dict(run.windows.schema) == {
        "window": pl.Int64(),
        "l95_ms": pl.Float64(),
        "unproven": pl.Boolean(),
    }
    assert run.meta["cell"] == "small"
    assert run.meta["recovered"] == {
        "sealed": False,
        "opened": 1,
        "torn_bytes": 0,
        "damaged_bytes": 0,
        "damaged_places": 0,
        "missing_cycles": 0,
        "missing_windows": 0,
    }
    journal.close()
    journal.close()
    with pytest.raises(RunError, match="closed"):
        journal.append(rows_of(3))


def test_a_run_is_gone_on_with(tmp_path: Path) -> None:
    write(tmp_path / "run", 2)
    journal = start(tmp_path / "run", meta={**META, "policy": "dtp"})
    assert (journal.following("windows"), journal.following("cycles")) == (2, 2 * W)
    assert journal.cut_bytes == 0
    journal.append(rows_of(2), origin_ns=5)
    assert journal.meta == {**META, "policy": "dtp", "origin_ns": 5}
    run = open_run(tmp_path / "run")
    assert_holds(run, 3)
    assert run.meta["recovered"]["opened"] == 2
    assert run.meta["policy"] == "dtp"
    assert run.meta["origin_ns"] == 5
    journal.close()
    assert start(tmp_path / "run").meta["origin_ns"] == 5


def test_a_journal_of_another_version_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as earlier:
        earlier.setattr("dwell.record.journal.SCHEMA_VERSION", 1)
        earlier.setattr("dwell.record.schema.SCHEMA_VERSION", 1)
        write(tmp_path / "run", 2)
    for read in (open_run, start):
        with pytest.raises(RunError, match=r"journal\.bin: schema_version is 1; .* run again"):
            read(tmp_path / "run")


def test_sealing_writes_what_a_run_has(tmp_path: Path) -> None:
    write(tmp_path / "run", 3)
    from_journal = open_run(tmp_path / "run")
    run = seal_run(tmp_path / "run", note="over")
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "cycles.parquet",
        "decisions.parquet",
        "run.json",
        "windows.parquet",
    ]
    assert_holds(run, 3)
    for name in ("cycles", "windows", "decisions"):
        sealed, before = getattr(run, name), getattr(from_journal, name)
        assert sealed.schema == before.schema
        assert sealed.equals(before)
    assert run.meta["recovered"]["sealed"] is True
    assert run.meta["note"] == "over"
    assert_holds(seal_run(tmp_path / "run"), 3)


def test_more_can_be_said_of_a_run_that_is_sealed(tmp_path: Path) -> None:
    write(tmp_path / "run", 3)
    before = seal_run(tmp_path / "run", note="over").meta
    run = seal_run(tmp_path / "run", played=[])
    assert_holds(run, 3)
    assert run.meta == {**before, "played": []}
    assert open_run(tmp_path / "run").meta == run.meta


def test_a_kill_while_sealing_leaves_the_journal_or_the_tables(tmp_path: Path) -> None:
    write(tmp_path / "run", 2)
    kept = (tmp_path / "run" / JOURNAL).read_bytes()
    # Before the end: some tables, no run.json.
    (tmp_path / "run" / "cycles.parquet").write_bytes(b"half of")
    (tmp_path / "run" / ".windows.parquet.draft").write_bytes(b"half of")
    assert_holds(open_run(tmp_path / "run"), 2)
    assert_holds(seal_run(tmp_path / "run"), 2)
    assert not list((tmp_path / "run").glob(".*"))
    # After it: run.json, and the journal not yet removed.
    (tmp_path / "run" / JOURNAL).write_bytes(kept[:40])
    assert_holds(open_run(tmp_path / "run"), 2)
    with pytest.raises(RunError, match="finished run"):
        start(tmp_path / "run")
    assert_holds(seal_run(tmp_path / "run"), 2)
    assert not (tmp_path / "run" / JOURNAL).exists()


def test_cut_at_every_byte(tmp_path: Path) -> None:
    lengths = write(tmp_path / "run", 3)
    file = tmp_path / "run" / JOURNAL
    whole = file.read_bytes()
    header = lengths[0] // 2
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        if length < header:
            with pytest.raises(RunError, match=r"journal\.bin.*before it began"):
                open_run(tmp_path / "run")
            journal = start(tmp_path / "run")
        else:
            there = sum(length >= end for end in lengths[1:])
            run = open_run(tmp_path / "run")
            assert_holds(run, there)
            torn = run.meta["recovered"]["torn_bytes"]
            assert torn == length - max(end for end in (header, *lengths) if end <= length)
            journal = start(tmp_path / "run")
            assert journal.cut_bytes == torn
        # Whatever was torn, the run goes on behind it.
        for window in range(journal.following("windows"), 3):
            journal.append(rows_of(window))
        journal.close()
        after = open_run(tmp_path / "run")
        assert_holds(after, 3)
        assert after.meta["recovered"]["torn_bytes"] == 0
        assert after.meta["recovered"]["damaged_places"] == 0


def test_damage_at_any_byte_costs_one_window(tmp_path: Path) -> None:
    lengths = write(tmp_path / "run", 4)
    file = tmp_path / "run" / JOURNAL
    whole = file.read_bytes()
    generator = random.Random(3)
    heads = [end + i for end in lengths[:-1] for i in range(12)]
    for at in [*heads, *range(0, len(whole), 5)]:
        changed = bytearray(whole)
        changed[at] ^= 1 << generator.randrange(8)
        file.write_bytes(changed)
        run = open_run(tmp_path / "run")
        hit = sum(at >= end for end in lengths) - 1
        expected = [window for window in range(4) if window != hit]
        assert run.windows["window"].to_list() == expected
        recovered = run.meta["recovered"]
        lost = recovered["torn_bytes"] + recovered["damaged_bytes"]
        begin = 0 if hit < 0 else lengths[hit]
        assert lost in {lengths[hit + 1] - begin, lengths[0] // 2}


def test_many_damaged_places_and_noise_never_crash(tmp_path: Path) -> None:
    write(tmp_path / "run", 6)
    file = tmp_path / "run" / JOURNAL
    whole = file.read_bytes()
    generator = random.Random(5)
    for _ in range(150):
        changed = bytearray(whole)
        for _ in range(generator.randrange(1, 30)):
            begin = generator.randrange(len(changed))
            length = generator.choice((0, 1, 4, 50))
            changed[begin : begin + length] = generator.randbytes(generator.choice((0, 1, 4, 60)))
        file.write_bytes(changed)
        try:
            run = open_run(tmp_path / "run")
        except RunError as error:
            assert str(file) in str(error)  # noqa: PT017
            continue
        for window, reason in run.decisions.rows():
            assert window in range(6)
            assert reason == "hold"


@pytest.mark.parametrize(
    "content",
    [
        [],
        {"rows": {"cycles": []}},
        {"run": "7"},
        {"run": "7", "columns": 5, "opened": 1},
        {"run": "7", "columns": {"cycles": {"cycle": "Int64"}}, "opened": 1},
        {"run": "7", "columns": COLUMNS, "opened": 1, "rows": {"what": [[1]]}},
        {"run": "7", "columns": COLUMNS, "opened": 1, "rows": {"cycles": [["x", "LOC", 1]]}},
        {"run": "7", "columns": COLUMNS, "opened": 1, "rows": {"cycles": [[1, "NO", 1]]}},
        {"run": "7", "columns": COLUMNS, "opened": 1, "rows": {"cycles": 5}},
        {"run": "7", "columns": COLUMNS, "opened": 1, "meta": 5},
    ],
)
def test_what_is_whole_but_no_journal_is_an_error(tmp_path: Path, content: object) -> None:
    from dwell.record.journal import framed

    (tmp_path / JOURNAL).write_bytes(framed(content))  # type: ignore[arg-type]
    with pytest.raises(RunError, match=r"journal\.bin"):
        open_run(tmp_path)


def test_folders_that_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "run", 1)
    with pytest.raises(RunError, match="of run 7, not 8"):
        start(tmp_path / "run", run="8")
    fewer = {name: kinds for name, kinds in COLUMNS.items() if name != "windows"}
    with pytest.raises(RunError, match="other columns"):
        start(tmp_path / "run", columns=fewer)
    with pytest.raises(RunError, match="not been sealed"):
        require_free(tmp_path / "run")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(RunError, match="not a run"):
        start(tmp_path / "notes")
    with pytest.raises(RunError, match="not a folder"):
        start(tmp_path / "notes" / "a.txt")
    with pytest.raises(RunError, match="Int63"):
        start(tmp_path / "odd", columns={"cycles": {"cycle": "Int63"}})
    with pytest.raises(TypeError, match="cannot be written"):
        start(tmp_path / "odd", meta={"what": object()})
    assert not (tmp_path / "odd").exists()


def test_rows_that_do_not_fit_are_refused_before_they_are_written(tmp_path: Path) -> None:
    journal = start(tmp_path / "run")
    with pytest.raises(RunError, match="has 1 values; it has 3 columns"):
        journal.append({"cycles": [(1,)]})
    with pytest.raises(RunError, match="has 1 values; it has 0 columns"):
        journal.append({"jobs": [(1,)]})
    assert_holds(open_run(tmp_path / "run"), 0)


def test_two_writers_are_one_too_many(tmp_path: Path) -> None:
    journal = start(tmp_path / "run")
    with pytest.raises(RunError, match="another process"):
        start(tmp_path / "run")
    with pytest.raises(RunError, match="still going on"):
        seal_run(tmp_path / "run")
    journal.append(rows_of(0))
    journal.close()
    assert_holds(seal_run(tmp_path / "run"), 1)


@contextmanager
def full_at(length: int) -> Iterator[None]:
    """Let no file of this process grow beyond a length, as on a disk that is full."""
    limit_file_size(os.getpid(), length)
    try:
        yield
    finally:
        limit_file_size(os.getpid(), None)


def test_what_finds_no_room_leaves_no_damage_and_can_be_appended_again(tmp_path: Path) -> None:
    journal = start(tmp_path / "run")
    journal.append(rows_of(0))
    # Room for a part of the next window.
    with full_at(journal.file.stat().st_size + 40):
        for _ in range(3):
            with pytest.raises(UnwritableError, match=r"journal\.bin: cannot be written \("):
                journal.append(rows_of(1))
        assert_holds(open_run(journal.folder), 1)
        assert journal.following("windows") == 1
    journal.append(rows_of(1))
    run = open_run(journal.folder)
    assert_holds(run, 2)
    assert not any(run.meta["recovered"][f"{what}_bytes"] for what in ("torn", "damaged"))


def test_a_journal_without_room_for_its_beginning_begins_later(tmp_path: Path) -> None:
    with full_at(10):
        journal = start(tmp_path / "run")
        with pytest.raises(UnwritableError):
            journal.append(rows_of(0))
    journal.append(rows_of(0))
    assert_holds(open_run(tmp_path / "run"), 1)
    journal.close()
    # One that goes on is to know where, whether or not it may say that it does.
    with full_at(10):
        again = start(tmp_path / "run")
        assert again.following("windows") == 1
    again.append(rows_of(1))
    assert open_run(tmp_path / "run").meta["recovered"]["opened"] == 2
    assert_holds(open_run(tmp_path / "run"), 2)


def test_windows_that_were_never_written_are_counted(tmp_path: Path) -> None:
    journal = start(tmp_path / "run")
    for window in (0, 3):
        journal.append({**rows_of(window), "cycles": rows_of(window)["cycles"][-W:]})
    recovered = open_run(tmp_path / "run").meta["recovered"]
    assert (recovered["missing_windows"], recovered["missing_cycles"]) == (2, 2 * W)
    journal.close()
    assert seal_run(tmp_path / "run").meta["recovered"]["missing_windows"] == 2


@pytest.mark.skipif(not may_mount(), reason="nobody but root mounts a disk")
def test_a_full_disk_keeps_a_run_from_being_sealed_and_loses_nothing(tmp_path: Path) -> None:
    with SmallDisk(tmp_path / "disk") as disk:
        write(disk.folder / "run", 2)
        disk.fill()
        with pytest.raises(RunError, match="cannot be written"):
            seal_run(disk.folder / "run")
        assert_holds(open_run(disk.folder / "run"), 2)
        disk.clear()
        assert_holds(seal_run(disk.folder / "run"), 2)
        assert {path.suffix for path in (disk.folder / "run").iterdir()} == {".parquet", ".json"}


WRITER = """
import json, sys
from dwell.record import Journal
columns, meta, rows = json.load(open(sys.argv[2]))
journal = Journal(sys.argv[1], run="7", meta=meta, columns=columns)
print("begun", journal.following("windows"), flush=True)
for window in range(journal.following("windows"), len(rows)):
    journal.append(rows[window])
    print(window, flush=True)
"""


def test_a_process_that_is_killed_loses_no_more_than_the_window_it_was_writing(
    tmp_path: Path,
) -> None:
    windows = 4000
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps([COLUMNS, META, [rows_of(window) for window in range(windows)]]))
    folder = tmp_path / "run"
    generator = random.Random(os.urandom(8))
    said = 0
    for attempt in range(8):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(folder), str(plan)],
            stdout=subprocess.PIPE,
            text=True,
        ) as writer:
            assert writer.stdout is not None
            word, following = writer.stdout.readline().split()
            assert word == "begun"
            assert int(following) == said
            for _ in range(generator.randrange(300)):
                writer.stdout.readline()
            time.sleep(generator.random() * 2e-3)
            writer.send_signal(signal.SIGKILL)
            lines = writer.stdout.read().split()
        run = open_run(folder)
        there = run.meta["windows"]
        assert_holds(run, there)
        if lines:
            # The last one may have been written without having been said.
            assert there - int(lines[-1]) in {1, 2}
        said = there
        assert run.meta["recovered"]["opened"] == attempt + 1
    assert_holds(seal_run(folder), said)


SEALER = """
import sys
import polars
from dwell.record import seal_run
print("begun", flush=True)
seal_run(sys.argv[1])
"""


def test_a_process_that_is_killed_while_it_seals_loses_nothing(tmp_path: Path) -> None:
    write(tmp_path / "run", 50)
    generator = random.Random(os.urandom(8))
    for _ in range(2):
        with subprocess.Popen(
            [sys.executable, "-c", SEALER, str(tmp_path / "run")], stdout=subprocess.PIPE
        ) as sealer:
            assert sealer.stdout is not None
            sealer.stdout.readline()
            time.sleep(generator.random() * 15e-3)
            sealer.send_signal(signal.SIGKILL)
        assert_holds(open_run(tmp_path / "run"), 50)
    assert_holds(seal_run(tmp_path / "run"), 50)


READER = """
import sys
for extra in ("msgspec", "zenoh", "psutil"):
    sys.modules[extra] = None
from dwell.record import open_run
print(open_run(sys.argv[1]).meta["windows"])
"""


def test_a_journal_says_the_same_without_polars(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    write(folder, 30)
    with (folder / JOURNAL).open("ab") as stream:
        stream.write(b"torn")
    note_in_journal(folder, scenario="storm")
    run, (meta, tables) = open_run(folder), read_plain_journal(folder)
    assert_holds(run, 30)
    for name in COLUMNS:
        assert tables[name] == getattr(run, name).to_dict(as_series=False)
    assert meta == {**META, "scenario": "storm"}
    assert meta.items() <= run.meta.items()
    with contextlib.closing(start(folder)), pytest.raises(RunError, match="cannot be written"):
        note_in_journal(folder, scenario="calm")


def test_a_journal_is_read_without_what_wrote_it(tmp_path: Path) -> None:
    write(tmp_path / "run", 3)
    command = [sys.executable, "-c", READER, str(tmp_path / "run")]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "3\n"
