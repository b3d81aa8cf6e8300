"""What is heard on the wire: its records, and how all processes of nodes are reached."""

from __future__ import annotations

import struct
from pathlib import Path

import yaml

import dwell
from dwell.live.local.loopback import on_this_machine
from dwell.live.wire.wiring import wire
from dwell.model import Problem
from dwell_lab.chaos.light_cell import document
from dwell_lab.chaos.wiretap import Records, entry_for

#: Instant, and lengths of key, message and header.
HEAD = struct.Struct("<QIII")


def record(at_ns: int, key: str, payload: bytes, header: bytes) -> bytes:
    name = key.encode()
    return HEAD.pack(at_ns, len(name), len(payload), len(header)) + name + payload + header


def test_records_are_read_as_they_grow_and_never_half_a_one(tmp_path: Path) -> None:
    file = tmp_path / "heard"
    records = Records(file)
    assert list(records.news()) == []
    told = [(1, "dwell/c/stamped", b"one", b""), (2, "dwell/c/in/a/E/main", b"", b"header")]
    whole = b"".join(record(*one) for one in told)
    seen: list[tuple[int, str, bytes, bytes]] = []
    for end in range(len(whole) + 1):
        file.write_bytes(whole[:end])
        seen += records.news()
    assert seen == told


def test_a_tap_connects_to_whoever_listens_on_its_nodes(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(document("SO")), encoding="utf-8")
    problem: Problem = on_this_machine(dwell.load(tmp_path / "cell.yaml"))
    wiring = wire(problem)
    entry = entry_for(wiring, ("E", "R1"))
    assert entry.role.node == "E"
    assert not entry.listen
    ends = {end for session in entry.connect.values() for end in session}
    expected = {
        end
        for one in wiring.entries.values()
        if one.role.node in ("E", "R1")
        for end in one.listen.values()
    }
    assert ends == expected
    assert ends
