"""The kernel's tables: what Python hands over is what the kernel takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.kernels.rows import Tables, row_types

CELL = Path(__file__).parents[2] / "examples" / "canonical.yaml"


def test_tables_are_the_kernel_s_in_its_order() -> None:
    assert Tables._fields == tuple(row_types())


def test_fields_of_a_row_do_not_overlap() -> None:
    for kind in row_types().values():
        fields = sorted((offset, one.itemsize) for one, offset, *_ in (kind.fields or {}).values())
        ends = [offset + size for offset, size in fields]
        assert all(end <= begin for end, (begin, _) in zip(ends, fields[1:], strict=False))
        assert not ends or ends[-1] <= kind.itemsize


@pytest.mark.parametrize("table", ["stamps", "sites"])
def test_a_table_of_other_rows_is_refused(table: str) -> None:
    problem = dwell.load(CELL)
    tables = lay_out([(problem, dwell.draw(problem, seed=1, windows=1))]).tables
    wrong: Any = np.zeros((1, 3), np.float32)
    gaps: Any = np.repeat(getattr(tables, table), 2)[::2]
    with pytest.raises(TypeError, match=f"^{table} has rows of float32, not of "):
        tables._replace(**{table: wrong}).addresses()
    with pytest.raises(TypeError, match=f"^{table} has rows of "):
        tables._replace(**{table: gaps}).addresses()


def test_a_call_ends_after_a_number_of_events_and_goes_on() -> None:
    problem = dwell.load(CELL)
    real = dwell.draw(problem, seed=1, windows=3)
    whole, parted = lay_out([(problem, real)]), lay_out([(problem, real)])
    parted.tables.clock["budget"] = 7
    play(whole)
    play(parted)
    assert np.array_equal(whole.tables.latency_ns, parted.tables.latency_ns)
    assert np.array_equal(whole.tables.closed, parted.tables.closed)
