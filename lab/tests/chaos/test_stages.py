"""Stages of a cell that faults befall, and the witness of what its actuator is told."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from dwell.live.stage import Message
from dwell_lab.chaos import stages
from dwell_lab.chaos.actuations import Actuations
from dwell_lab.chaos.stages import FRAME_BYTES, TOLD, Control, Perception, Planning, Sensing

EXEC_MS = {
    "sensing": {"R1": 1.0},
    "perception": {"E": 20.0},
    "planning": {"R2": 1.0},
    "control": {"R2": 1.0},
}


class Behind:
    """An actuator that the witness stands before."""

    calls: list[str]

    def __init__(self) -> None:
        type(self).calls = []

    def apply(self, command: Message) -> None:
        self.calls.append(f"apply {command.cycle}")

    def hold(self) -> None:
        self.calls.append("hold")

    def zero(self) -> None:
        self.calls.append("zero")


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    told = {
        "exec_ms": EXEC_MS,
        "observed": str(tmp_path / "log"),
        "failing": str(tmp_path / "failing"),
        "actuators": {"control": f"{__name__}:Behind"},
    }
    monkeypatch.setenv(TOLD, json.dumps(told))
    return tmp_path / "log"


def here(who: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["dwell", "--who", who])


def test_a_command_says_where_its_cycle_went(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    message = Message(b"", cycle=7, released_ns=1_000)
    for kind, who in (
        (Sensing, "sensing@R1"),
        (Perception, "perception@E.1"),
        (Planning, "planning@R2"),
        (Control, "control@R2"),
    ):
        here(who, monkeypatch)
        begin_s = time.monotonic()
        message = kind().process({"before": message})
        took_ms = (time.monotonic() - begin_s) * 1e3
        task, _, rest = who.partition("@")
        assert took_ms >= EXEC_MS[task][rest.partition(".")[0]]
        assert isinstance(message.payload, bytes)
        assert (len(message.payload) == FRAME_BYTES) == (kind is Sensing)
    witness = stages.Witness()
    witness.apply(Message(message.payload, cycle=8))
    witness.hold()
    seen = Actuations(log)
    start, applied, held = seen.since(0)
    assert (start.what, held.what) == (stages.START, stages.HOLD)
    # The runtime says cycle 8, the command itself 7.
    assert (applied.what, applied.cycle, applied.said) == (stages.APPLY, 8, 7)
    assert applied.released_ns == 1_000
    assert applied.placement == "HYB"
    assert applied.pid == os.getpid()


def test_the_cells_own_actuator_is_called_behind_the_witness(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here("sink.control@R2", monkeypatch)
    witness = stages.Witnessed()
    witness.apply(Message(b"anything", cycle=3, released_ns=5))
    witness.hold()
    witness.zero()
    assert Behind.calls == ["apply 3", "hold", "zero"]
    applied = Actuations(log).last()
    assert applied is not None
    assert (applied.cycle, applied.released_ns) == (3, 5)
