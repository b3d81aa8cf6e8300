"""Runs on disk: what is written is what was there, complete or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.errors import RunError, TraceError
from dwell.model import NodeDisturbance
from dwell.model.document import to_document
from dwell.record import SCHEMA_VERSION, Run, open_run

EXAMPLES = Path(__file__).parents[2] / "examples"
META = {"kind": "simulated", "cell": "small", "seed": 1, "problem": {"period_ms": 40.0}}


def tables(latency_ns: int = 5) -> dict[str, pl.DataFrame]:
    return {
        "cycles": pl.DataFrame(
            {
                "cycle": [0, 1],
                "placement": pl.Series(["LOC", "LOC"], dtype=pl.Enum(["LOC", "SO"])),
                "latency_ns": pl.Series([latency_ns, None], dtype=pl.Int64),
            }
        ),
        "windows": pl.DataFrame({"window": [0], "l95_ms": [float("inf")]}),
        "decisions": pl.DataFrame({"window": [0], "delta_j": pl.Series([None], dtype=pl.Float64)}),
    }


def make_run(latency_ns: int = 5, **more: pl.DataFrame) -> Run:
    return Run(META, {**tables(latency_ns), **more})


def same(one: Run, other: Run) -> bool:
    names = ["cycles", "windows", "decisions", *(["jobs"] if one.has_jobs else [])]
    frames = [(getattr(one, name), getattr(other, name)) for name in names]
    return (
        one.meta == other.meta
        and one.has_jobs == other.has_jobs
        and all(a.schema == b.schema and a.equals(b) for a, b in frames)
    )


def test_what_is_opened_is_what_was_saved(tmp_path: Path) -> None:
    run = make_run()
    assert run.save(tmp_path / "deep" / "run") == tmp_path / "deep" / "run"
    opened = open_run(tmp_path / "deep" / "run")
    assert same(run, opened)
    assert opened.meta["schema_version"] == SCHEMA_VERSION
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["run"]


def test_jobs_are_kept_where_there_are_any(tmp_path: Path) -> None:
    run = make_run(jobs=pl.DataFrame({"cycle": [0], "task": ["plan"]}))
    assert same(run, open_run(run.save(tmp_path / "run")))
    without = open_run(make_run().save(tmp_path / "run"))
    assert not without.has_jobs
    with pytest.raises(RunError, match="jobs=True"):
        _ = without.jobs


def test_tables_are_made_once_and_when_asked_for() -> None:
    made = []

    def maker(name: str, table: pl.DataFrame) -> Callable[[], pl.DataFrame]:
        def make() -> pl.DataFrame:
            made.append(name)
            return table

        return make

    run = Run(META, {name: maker(name, table) for name, table in tables().items()})
    assert made == []
    assert run.cycles is run.cycles
    assert made == ["cycles"]


def test_a_simulated_run_survives_the_disk(tmp_path: Path) -> None:
    problem = dwell.load(Path(__file__).parents[2] / "examples" / "canonical.yaml")
    run = dwell.simulate(problem, scenario="network-impairment", seed=3, windows=8, jobs=True)
    assert same(run, open_run(run.save(tmp_path / "run")))


def test_the_columns_that_every_run_has() -> None:
    problem = dwell.load(Path(__file__).parents[2] / "examples" / "canonical.yaml")
    names = ("LOC", "SO", "HYB")
    cycles = "cycle release_ns placement latency_ns missed outcome compute_ns queue_ns network_ns"
    windows = (
        "window placement mixed l95_ms violation_rate seen_l95_ms seen_violation_rate "
        "u_R1 u_E u_R2 cost"
    )
    decisions = [
        *["window", "incumbent", "placement", "migrated", "reason", "dwell", "delta_j"],
        *["last_cycle", "cycles", "dwell_cycles"],
        *(f"j_{name}" for name in names),
        *(f"est_l95_ms_{name}" for name in names),
        *(f"est_violation_rate_{name}" for name in names),
        *(f"est_l95_error_ms_{name}" for name in names),
        *(f"est_violation_error_{name}" for name in names),
        *(f"est_u_{node}_{name}" for node in ("R1", "E", "R2") for name in names),
        *(f"eligible_{name}" for name in names),
        *(f"excess_{name}" for name in names),
    ]
    schemas = []
    for policy in ("dtp", "LOC", "latency-first"):
        run = dwell.simulate(problem, policy=policy, seed=1, windows=4)
        assert set(cycles.split()) <= set(run.cycles.columns)
        assert set(windows.split()) <= set(run.windows.columns)
        assert run.decisions.columns == decisions
        schemas.append((run.cycles.schema, run.windows.schema, run.decisions.schema))
    assert schemas[0] == schemas[1] == schemas[2]


# ------------------------------------------------------------------------------- atomicity


def test_saving_again_replaces_the_run(tmp_path: Path) -> None:
    make_run(1, jobs=pl.DataFrame({"cycle": [0]})).save(tmp_path / "run")
    new = make_run(2)
    new.save(tmp_path / "run")
    assert same(new, open_run(tmp_path / "run"))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_run_may_be_saved_over_its_own_folder(tmp_path: Path) -> None:
    make_run().save(tmp_path / "run")
    open_run(tmp_path / "run").save(tmp_path / "run")
    assert same(make_run(), open_run(tmp_path / "run"))


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, MemoryError])
@pytest.mark.parametrize("where", ["write", "first rename", "second rename"])
def test_a_crash_leaves_the_old_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str, error: type[BaseException]
) -> None:
    make_run(1).save(tmp_path / "run")
    renames = 0
    rename = Path.replace

    def crash(*_: object, **__: object) -> None:
        raise error("crash")

    def crash_at(self: Path, target: Path) -> Path:
        nonlocal renames
        renames += 1
        if renames == (1 if where == "first rename" else 2):
            crash()
        return rename(self, target)

    with monkeypatch.context() as patched:
        if where == "write":
            patched.setattr(Path, "write_text", crash)
        else:
            patched.setattr(Path, "replace", crash_at)
        with pytest.raises(RunError if error is OSError else error):
            make_run(2).save(tmp_path / "run")
    assert same(make_run(1), open_run(tmp_path / "run"))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_crash_leaves_nothing_where_nothing_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crash(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", crash)
    with pytest.raises(KeyboardInterrupt):
        make_run().save(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_is_not_a_run_is_not_overwritten(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "thesis"
    if kind == "file":
        target.write_text("years of work")
    else:
        target.mkdir()
        (target / "chapter.tex").write_text("years of work")
    with pytest.raises(RunError, match="is not a run"):
        make_run().save(target)
    kept = target if kind == "file" else target / "chapter.tex"
    assert kept.read_text() == "years of work"


def test_an_empty_folder_may_become_a_run(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    make_run().save(tmp_path / "run")
    assert same(make_run(), open_run(tmp_path / "run"))


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="cannot be written"):
        make_run().save(tmp_path / "file" / "run")


def test_meta_that_is_no_json_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        Run({"cost": float("nan")}, tables()).save(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


# ----------------------------------------------------------------------- what cannot be read


def write_meta(folder: Path, value: Any) -> None:
    text = value if isinstance(value, str) else json.dumps(value)
    (folder / "run.json").write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    ("meta", "words"),
    [
        ({"schema_version": SCHEMA_VERSION + 1}, f"reads {SCHEMA_VERSION} only"),
        ({"schema_version": 1}, r"run\.json: schema_version is 1; .* make the run again"),
        ({"schema_version": "1"}, "schema_version is '1'"),
        ({}, "schema_version is None"),
        ([], "schema_version is None"),
        ("{", "cannot be read"),
        ("\udcff".encode("utf-8", "surrogateescape").decode("latin-1"), "cannot be read"),
    ],
)
def test_a_damaged_run_or_one_of_another_version_is_refused(
    tmp_path: Path, meta: Any, words: str
) -> None:
    make_run().save(tmp_path / "run")
    write_meta(tmp_path / "run", meta)
    with pytest.raises(RunError, match=words):
        open_run(tmp_path / "run")


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no such folder"):
        open_run(tmp_path / "nope")
    with pytest.raises(RunError, match="not a run"):
        open_run(tmp_path)
    make_run().save(tmp_path / "run")
    (tmp_path / "run" / "windows.parquet").unlink()
    with pytest.raises(RunError, match="without windows"):
        open_run(tmp_path / "run")


def test_a_damaged_table_is_told_when_it_is_asked_for(tmp_path: Path) -> None:
    make_run().save(tmp_path / "run")
    (tmp_path / "run" / "cycles.parquet").write_bytes(b"PAR1 nothing of use PAR1")
    run = open_run(tmp_path / "run")
    assert run.windows.height == 1
    with pytest.raises(RunError, match=r"cycles\.parquet"):
        _ = run.cycles


def test_a_run_has_the_cell_that_it_is_a_run_of(tmp_path: Path) -> None:
    for example in ("canonical", "fan-in", "cloud", "live/cell"):
        problem = dwell.load(EXAMPLES / f"{example}.yaml")
        meta = {"kind": "simulated", "problem": to_document(problem)}
        run = open_run(Run(meta, tables()).save(tmp_path / problem.name))
        assert run.problem == problem
        assert run.problem is run.problem


def test_a_recorded_cell_names_its_traces_without_their_files(tmp_path: Path) -> None:
    (tmp_path / "times.csv").write_text("edge,gap\n4.0,900.0\n6.0,1100.0\n", encoding="utf-8")

    def trace(column: str) -> dict[str, object]:
        return {"trace": {"file": "times.csv", "column": column, "wrap": True}}

    document = to_document(dwell.load(EXAMPLES / "canonical.yaml"))
    document["tasks"]["perception"]["on"]["E"]["exec_ms"] = trace("edge")
    document["nodes"]["E"]["bursts"] = {"every_ms": trace("gap"), "for_ms": 5.0, "threads": 1}
    document["scenarios"]["rare"] = [
        {
            "node": "E",
            "stress_threads": 1,
            "episodes": {"name": "rare", "every_s": trace("gap"), "for_s": 1.0},
        }
    ]
    problem = from_document(document, folder=tmp_path)
    run = dwell.simulate(problem, scenario="rare", policy="SO", seed=1, windows=2)
    folder = run.save(tmp_path / "run")
    (tmp_path / "times.csv").unlink()
    found = open_run(folder).problem
    assert to_document(found) == to_document(problem)
    process = found.pipeline.tasks["perception"].on["E"].exec_ms
    with pytest.raises(TraceError, match=r"times\.csv: a run's record names this trace"):
        _ = process.expectation
    with pytest.raises(TraceError, match=r"times\.csv: a run's record names this trace"):
        process.marginal(np.random.default_rng(1), 3)


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        (None, "does not say which cell it ran"),
        ("canonical", "does not say which cell it ran"),
        ({"dwell": 1, "period_ms": 40.0}, "record of the cell cannot be read: .*nodes"),
    ],
)
def test_a_cell_that_cannot_be_read_is_one_error(problem: object, message: str) -> None:
    run = Run({"problem": problem}, tables())
    with pytest.raises(RunError, match=message):
        _ = run.problem


def test_disturbances_are_those_of_the_scenario_or_as_they_were_played() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    meta = {"problem": to_document(problem), "scenario": "network-impairment"}
    planned = Run(meta, tables())
    assert planned.played is None
    assert planned.disturbances == problem.scenario("network-impairment") != ()
    assert Run({**meta, "scenario": "baseline"}, tables()).disturbances == ()
    assert Run({**meta, "scenario": "unknown"}, tables()).disturbances == ()
    played = [
        {"node": "E", "stress_threads": 2, "at_s": -3.0, "for_s": 1.0},
        {"node": "E", "stress_threads": 2, "at_s": -0.5, "for_s": 2.0},
        {"node": "R1", "stress_threads": 1, "at_s": 4.0, "for_s": 1.5},
        {"link": "R1->E", "down": True, "at_s": 5.0, "for_s": 0.0},
    ]
    told = Run({**meta, "played": played}, tables())
    assert told.disturbances == (
        NodeDisturbance("E", at_s=0.0, for_s=1.5, stress_threads=2),
        NodeDisturbance("R1", at_s=4.0, for_s=1.5, stress_threads=1),
    )
    assert Run({**meta, "played": []}, tables()).disturbances == ()


def test_what_was_played_on_no_node_of_the_cell_is_an_error() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    played = [{"node": "X", "stress_threads": 2, "at_s": 1.0, "for_s": 1.0}]
    run = Run({"problem": to_document(problem), "played": played}, tables())
    with pytest.raises(RunError, match="unknown node 'X'"):
        _ = run.played
