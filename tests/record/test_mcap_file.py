"""MCAP files of runs: what is read back is the run; a disk that is full loses what it must."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from jsonschema.validators import validator_for
from mcap.reader import make_reader

import dwell
from dwell.files import write_whole
from dwell.model import Problem
from dwell.record import Run, open_run
from dwell.record.mcap_file import NAMESPACE, McapFile, write_mcap
from tests.cells.small import make_problem

OLD_RUNS = Path(__file__).parents[1] / "regression/data/old-runs"


def written(run: Run, folder: Path) -> Path:
    file = folder / "run.mcap"
    write_whole(file, lambda draft: write_mcap(run, draft))
    return file


def read(file: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield topic, instant and content of every message, each held against its schema."""
    with file.open("rb") as stream:
        validators: dict[str, Any] = {}
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            if channel.topic not in validators:
                found = json.loads(schema.data)
                of = validator_for(found)
                of.check_schema(found)
                validators[channel.topic] = of(found)
            content = json.loads(message.data)
            assert content.keys() <= validators[channel.topic].schema["properties"].keys()
            validators[channel.topic].validate(content)
            yield channel.topic, message.log_time, content


def metadata(file: Path) -> dict[str, str]:
    with file.open("rb") as stream:
        (found,) = make_reader(stream).iter_metadata()
    assert found.name == NAMESPACE
    return found.metadata


def known(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table without what JSON cannot say."""
    return [
        {
            name: value
            for name, value in row.items()
            if value is not None and not (isinstance(value, float) and math.isinf(value))
        }
        for row in table.iter_rows(named=True)
    ]


@pytest.fixture(scope="module")
def run() -> Run:
    cell = make_problem()
    return dwell.simulate(cell, scenario="network-impairment", seed=1, windows=8, jobs=True)


def test_every_row_is_read_back_in_the_order_of_instants(run: Run, tmp_path: Path) -> None:
    messages = list(read(written(run, tmp_path)))
    for name in ("cycles", "windows", "decisions"):
        table = getattr(run, name)
        assert [content for topic, _, content in messages if topic == f"/{name}"] == known(table)
    jobs = run.jobs.sort("ready_ns", maintain_order=True)
    assert [content for topic, _, content in messages if topic == "/jobs"] == known(jobs)
    instants = [at_ns for _, at_ns, _ in messages]
    assert instants == sorted(instants)


def test_a_simulated_run_counts_from_its_beginning(run: Run, tmp_path: Path) -> None:
    file = written(run, tmp_path)
    problem = run.problem
    close_ns = {}
    for topic, at_ns, content in read(file):
        if topic == "/cycles":
            assert at_ns == content["release_ns"]
            close_ns[content["cycle"]] = at_ns + round(problem.pipeline.period_ms * 1e6)
        elif topic == "/windows":
            last = content["first_cycle"] + problem.window_cycles - 1
            assert at_ns == close_ns[last]
    found = metadata(file)
    assert found["cell"] == problem.name
    assert found["seed"] == "1"
    assert found["clock"] == "ns since the beginning of the run"


def test_a_schema_says_what_the_columns_are(run: Run, tmp_path: Path) -> None:
    with written(run, tmp_path).open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    schemas = {one.name: json.loads(one.data) for one in summary.schemas.values()}
    assert schemas.keys() == {"dwell.cycles", "dwell.windows", "dwell.decisions", "dwell.jobs"}
    cycles = schemas["dwell.cycles"]["properties"]
    assert list(cycles) == run.cycles.columns
    assert cycles["latency_ns"] == {
        "type": "integer",
        "description": "Release to completion of the last sink. Unit: ns. "
        "Absent: no sink completed the cycle.",
    }
    assert cycles["placement"]["enum"] == list(run.problem.candidates)
    # Viewers know one type a property, and none that is null.
    for schema in schemas.values():
        assert {one["type"] for one in schema["properties"].values()} <= {
            *("integer", "number", "boolean", "string")
        }


@pytest.mark.parametrize("folder", ["live-journal", "live-sealed"])
def test_a_live_run_stands_at_the_time_of_day(folder: str, tmp_path: Path) -> None:
    run = open_run(OLD_RUNS / folder)
    file = written(run, tmp_path)
    windows = [(at_ns, one) for topic, at_ns, one in read(file) if topic == "/windows"]
    assert len(windows) == len(run.windows)
    for at_ns, window in windows:
        assert abs(at_ns - window["closed_unix_ns"]) < 1e9
    assert metadata(file)["clock"] == "ns since 1970, UTC"
    assert metadata(file)["kind"] == "live"


def test_runs_that_were_written_before_can_be_exported(tmp_path: Path) -> None:
    run = open_run(OLD_RUNS / "simulated")
    topics = [topic for topic, _, _ in read(written(run, tmp_path))]
    assert topics.count("/cycles") == len(run.cycles)


FULL = """
import resource, sys
from pathlib import Path
import tests.record.test_mcap_file as these
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
print(these.fill(Path(sys.argv[1])))
"""


def fill(file: Path) -> int:
    """Write rows until there is no room, finish the file, and return how many were written."""
    problem: Problem = make_problem()
    with file.open("wb") as stream:
        made = McapFile(stream, problem, {"cycles": ["cycle", "latency_ns"]})
        for cycle in range(200_000):
            try:
                made.add((cycle, "cycles", {"cycle": cycle, "latency_ns": cycle**3}))
            except OSError:
                break
        made.finish({"recorded": cycle})
    return cycle


@pytest.mark.parametrize("mebibytes", [1.2, 2.1])
def test_where_there_is_no_room_left_all_before_can_be_read(
    mebibytes: float, tmp_path: Path
) -> None:
    """A limit on the size of files stands in for the disk's."""
    limit, file = int(mebibytes * (1 << 20)), tmp_path / "full.mcap"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(file), str(limit)],
        cwd=Path(__file__).parents[2],
        check=True,
        capture_output=True,
        text=True,
    )
    recorded = int(done.stdout)
    assert 0 < recorded < 200_000
    assert file.stat().st_size <= limit
    assert [content["cycle"] for _, _, content in read(file)] == list(range(recorded))
    assert metadata(file) == {"recorded": str(recorded)}
