from __future__ import annotations

from pathlib import Path

from dwell_lab.chaos.actuations import Actuations, Seen, out_of_order, unsafe
from dwell_lab.chaos.stages import APPLY, HOLD, NODES, RECORD, START

MS = 1_000_000


def applied(cycle: int, at_ms: int, said: int | None = None) -> Seen:
    return Seen(APPLY, "SO", 1, cycle, cycle if said is None else said, 0, at_ms * MS)


def test_the_log_is_read_as_it_grows_and_never_half_a_record(tmp_path: Path) -> None:
    path = tmp_path / "observed"
    log = Actuations(path)
    assert log.last() is None
    edge = NODES.index("E")
    records = [
        RECORD.pack(START, 0, 0, 7, 0, 0, 0, 1),
        RECORD.pack(APPLY, edge, edge, 7, 4, 4, 10, 20),
        RECORD.pack(APPLY, 0, 2, 7, 6, 6, 50, 60),
    ]
    path.write_bytes(records[0] + records[1] + records[2][:9])
    last = log.last()
    assert last == Seen(APPLY, "SO", 7, 4, 4, 10, 20)
    path.write_bytes(b"".join(records))
    assert [one.placement for one in log.since(20)] == ["SO", "LOC"]
    assert log.healthy() == 1
    assert log.healthy("SO") == 0


def test_nothing_twice_nothing_out_of_order_nothing_of_another_cycle() -> None:
    assert out_of_order([applied(1, 0), applied(3, 1), applied(4, 2)]) == []
    assert out_of_order([applied(1, 0), applied(1, 1)])
    assert out_of_order([applied(2, 0), applied(1, 1)])
    assert out_of_order([applied(2, 0, said=1)])


def test_a_silence_that_the_actuator_is_not_told_of() -> None:
    before, later = applied(1, 0), applied(9, 400)
    told = Seen(HOLD, "?", 1, 0, 0, 0, 120 * MS)
    late = Seen(HOLD, "?", 1, 0, 0, 0, 300 * MS)
    assert unsafe([before, told, later], 160) == []
    assert unsafe([before, later], 500) == []
    assert unsafe([before, later], 160)
    assert unsafe([before, late, later], 160)
