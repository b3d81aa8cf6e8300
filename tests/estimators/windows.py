"""Windows of evidence made by hand: instants in milliseconds, None for one that never came.

Those of the chain of `tests.cells.deterministic` have cycles under LOC that take what is declared,
and shadows through OFF.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dwell.estimators import Evidence, Instants
from dwell.estimators.evidence import UNKNOWN

MS = 1_000_000

#: Of one cycle: readiness and end of each job, then arrival of each message.
Row = tuple[Sequence[float | None], Sequence[float | None], Sequence[float | None]]

#: A cycle of the chain, or a shadow, of which nothing ever came.
GONE: Row = ([None] * 4, [None] * 4, [None] * 3)


def instants(rows: Sequence[Row]) -> Instants:
    """Return the instants of cycles."""
    ready, end, arrived = ([row[i] for row in rows] for i in range(3))
    return Instants(_table(ready), _table(end), _table(arrived))


def window(
    rows: Sequence[Row],
    *,
    close_ms: float,
    release_ms: Sequence[float] | None = None,
    placement: Sequence[int] | None = None,
    shadows: Sequence[Row | None] | None = None,
    through: Sequence[int] | None = None,
) -> Evidence:
    """Return a window; its cycles ran under candidate 0 unless `placement` says otherwise.

    `shadows` has a row for each cycle, None where it was sent through no alternative, and `through`
    the candidates that those were sent through (1 where it is not given).
    """
    count = len(rows)
    nothing = [[None] * len(part) for part in rows[0]]
    sent = [row is not None for row in shadows or [None] * count]
    other = [1] * count if through is None else list(through)
    return Evidence.of(
        close_ns=round(close_ms * MS),
        release_ns=_table([release_ms or [0.0] * count])[0],
        placement=np.array(placement or [0] * count, np.int16),
        cycles=instants(rows),
        shadow_placement=np.where(sent, other, -1).astype(np.int16),
        shadows=(
            None
            if shadows is None
            else instants(
                [(nothing[0], nothing[1], nothing[2]) if r is None else r for r in shadows]
            )
        ),
    )


def local_row(begin_ms: float) -> Row:
    """A cycle of the chain under LOC."""
    ends = [begin_ms + ms for ms in (2.0, 10.0, 16.0, 17.0)]
    return [begin_ms, *ends[:3]], ends, ends[:3]


def off_row(begin_ms: float, extra_ms: float = 0.0) -> Row:
    """The shadow through OFF of such a cycle, with an extra delay on the way up."""
    up = begin_ms + 2.0 + 1.0 + extra_ms
    return [None, up, up + 4.0, None], [None, up + 3.0, up + 10.0, None], [up, up + 4.0, up + 10.0]


def seen_window(*, extra_ms: float | None = None, lost: int = 0) -> Evidence:
    """Ten cycles of the chain; with shadows if there is an extra delay, the first of them lost."""
    starts = [40.0 * i for i in range(10)]
    sent: list[Row] | None = None
    if extra_ms is not None:
        sent = [GONE if i < lost else off_row(at, extra_ms) for i, at in enumerate(starts)]
    cycles = [local_row(at) for at in starts]
    return window(cycles, close_ms=400.0, release_ms=starts, shadows=sent)


def _table(rows: Sequence[Sequence[float | None]]) -> NDArray[np.int64]:
    table = [[UNKNOWN if ms is None else round(ms * MS) for ms in row] for row in rows]
    return np.array(table, np.int64).reshape(len(rows), -1)
