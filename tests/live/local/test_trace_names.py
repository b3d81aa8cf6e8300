"""Trace files keep their place where a cell is written somewhere else."""

from __future__ import annotations

from pathlib import Path

from dwell.live.local.trace_names import move_traces, rename_traces


def test_every_trace_of_a_cell_is_renamed_wherever_it_stands() -> None:
    values = {
        "links": [{"delay_ms": {"trace": {"file": "a.csv", "column": "up"}}}, {"delay_ms": 2}],
        "tasks": {"b": {"on": {"E": {"exec_ms": {"trace": {"file": "/far/b.csv"}}}}}},
        "trace": "no declaration",
    }
    move_traces(values, Path("/cell"))
    assert values["links"][0]["delay_ms"]["trace"] == {"file": "/cell/a.csv", "column": "up"}  # type: ignore[index]
    assert values["tasks"]["b"]["on"]["E"]["exec_ms"]["trace"]["file"] == "/far/b.csv"  # type: ignore[index]
    assert values["trace"] == "no declaration"
    rename_traces(values, lambda name: Path(name).name)
    assert values["links"][0]["delay_ms"]["trace"]["file"] == "a.csv"  # type: ignore[index]
