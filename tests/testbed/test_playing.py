"""Playing: changes at their times, notes of them, and waiting for a cell."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.errors import LiveError
from dwell.model import Problem
from dwell.testbed.playing import (
    Played,
    come_up,
    interruptible,
    longest_run,
    make_folder,
    play,
    undisturbed,
)
from dwell.testbed.timeline import Change, changes_of
from tests.report.live_runs import PERIOD_NS, live_run
from tests.testbed.light_cell import document


@pytest.fixture
def problem() -> Problem:
    return from_document(document())


class Clock:
    """Time that passes by sleeping only."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.at_s = 0.0
        monkeypatch.setattr("dwell.testbed.playing.time.sleep", self.sleep)

    def sleep(self, seconds: float) -> None:
        self.at_s += seconds

    def now_s(self) -> float:
        return self.at_s


def test_changes_are_made_at_their_times_with_looks_between(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    made: list[tuple[float, str, bool]] = []
    looks: list[float] = []

    def apply(change: Change) -> None:
        made.append((clock.at_s, type(change.item).__name__[:4], change.begins))

    changes = changes_of(problem, "impaired")
    play(changes, 2.75, clock.now_s, apply, looks.append)
    # What ends at 3 s is beyond the end.
    assert made == [(1.0, "Link", True), (1.0, "Link", True), (1.0, "Node", True)]
    assert looks == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert clock.at_s == 2.75


def test_a_change_between_two_looks_is_not_late(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    made: list[float] = []
    item = problem.scenario("impaired")[-1]
    changes = [Change(0.3, 0, item, begins=True), Change(0.7, 0, item, begins=False)]
    play(changes, 1.0, clock.now_s, lambda change: made.append(clock.at_s), lambda at_s: None)
    assert made == pytest.approx([0.3, 0.7])


def test_the_run_is_told_what_was_played_when(problem: Problem, tmp_path: Path) -> None:
    folder = live_run(origin_ns=10 * PERIOD_NS).save(tmp_path / "run")
    played = Played(problem, "impaired", 7)
    last = len(problem.scenario("impaired")) - 1
    played.begun_ns[last] = 20 * PERIOD_NS
    played.ended_ns[last] = 30 * PERIOD_NS
    assert played.active() == []
    meta = played.note(folder, pressure={"failed": False}).meta
    assert (meta["scenario"], meta["seed"], meta["pressure"]) == ("impaired", 7, {"failed": False})
    (told,) = meta["played"]
    assert told["node"] == "E"
    assert told["at_s"] == pytest.approx(10 * PERIOD_NS / 1e9, abs=1e-3)
    assert told["for_s"] == pytest.approx(10 * PERIOD_NS / 1e9, abs=1e-3)
    assert longest_run(tmp_path) == folder
    assert longest_run(tmp_path, "another cell") is None
    assert longest_run(tmp_path / "nothing") is None


def test_a_cell_is_up_when_everybody_is_ready(tmp_path: Path) -> None:
    states = iter([False, True])

    def ask(patience_s: float) -> Mapping[str, Any]:
        ready = next(states)
        return {"processes": {"a@E": {"ready": ready, "note": ""}}, "origin_ns": 5}

    assert come_up(ask, ["a@E"], tmp_path)["origin_ns"] == 5


def test_who_is_missing_is_told_with_what_is_known(tmp_path: Path) -> None:
    def ask(patience_s: float) -> Mapping[str, Any]:
        return {"processes": {"a@E": {"ready": False, "note": "no such module"}}}

    with pytest.raises(LiveError, match=r"a@E no such module; b@E has not been heard; see the"):
        come_up(ask, ["a@E", "b@E"], tmp_path, patience_s=0.2)

    def nobody(patience_s: float) -> Mapping[str, Any]:
        raise LiveError("nobody")

    with pytest.raises(LiveError, match="the controller has not answered"):
        come_up(nobody, ["a@E"], tmp_path, patience_s=0.1)


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(LiveError, match="is not a testbed's"):
        make_folder(tmp_path, ".mark", "a testbed's")
    assert (tmp_path / "thesis.tex").exists()


def test_being_ended_interrupts_but_not_the_way_down() -> None:
    with interruptible():
        with undisturbed():
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
