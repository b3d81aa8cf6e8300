"""A cell with a trace for the delay of its link and one for an execution time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.errors import TraceError
from dwell.model import Trace, TraceTable

LINK, EXEC = "links[0].delay_ms.trace", "tasks.b.on.E.exec_ms.trace"


def trace_cell(link: dict[str, Any], execution: dict[str, Any]) -> dict[str, Any]:
    """Return a cell with a trace for the delay of its link and one for an execution time."""
    return {
        "dwell": 1,
        "period_ms": 66,
        "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
        "links": [{"from": "R", "to": "E", "delay_ms": {"trace": link}}],
        "tasks": {
            "a": {"on": {"R": {"exec_ms": 1}}},
            "b": {"on": {"E": {"exec_ms": {"trace": execution}}}},
        },
        "flows": [{"from": "a", "to": "b"}],
        "candidates": {"LOC": {}},
    }


def read_tables(
    folder: Path, file: str, columns: tuple[str, str] = ("up", "work"), **how: object
) -> tuple[TraceTable, TraceTable]:
    """Return the tables of the link and of the execution."""
    link, execution = ({"file": file, "column": column, **how} for column in columns)
    problem = from_document(trace_cell(link, execution), folder=folder)
    return table_of(problem.fabric.links["R->E"].delay_ms), table_of(
        problem.pipeline.tasks["b"].on["E"].exec_ms
    )


def table_of(process: object) -> TraceTable:
    assert isinstance(process, Trace)
    return process.table


def faults_of(
    folder: Path, file: str, columns: tuple[str, str] = ("up", "work"), **how: object
) -> dict[str, str]:
    with pytest.raises(TraceError) as caught:
        read_tables(folder, file, columns, **how)
    return {fault.path: fault.message for fault in caught.value.faults}
