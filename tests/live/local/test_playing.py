"""Playing: changes at their times, notes of them, and waiting for a cell."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dwell.cellfile import from_document
from dwell.errors import LiveError
from dwell.live.local.playing import (
    Played,
    interruptible,
    longest_run,
    make_folder,
    play,
    undisturbed,
)
from dwell.live.local.testbed import come_up
from dwell.live.local.timeline import Change, NodeState, timeline_of
from dwell.model import Problem
from tests.cells.light import document
from tests.report.live_runs import PERIOD_NS, live_run


@pytest.fixture
def problem() -> Problem:
    return from_document(document())


class Clock:
    """Time that passes by sleeping only."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.at_s = 0.0
        # In that module alone: threads that other tests have left sleep, too.
        own = SimpleNamespace(sleep=self.sleep, monotonic=time.monotonic)
        monkeypatch.setattr("dwell.live.local.playing.time", own)

    def sleep(self, seconds: float) -> None:
        self.at_s += seconds

    def now_s(self) -> float:
        return self.at_s


def test_changes_are_made_at_their_times_with_looks_between(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    made: list[tuple[float, str]] = []
    looks: list[float] = []

    def apply(change: Change) -> None:
        made.append((clock.at_s, change.place))

    changes = timeline_of(problem, "impaired", seed=1, seconds=2.75).changes
    play(changes, 2.75, clock.now_s, apply, looks.append)
    # What ends at 3 s is beyond the end.
    assert made == [(1.0, "E"), (1.0, "R1->E"), (1.0, "E->R1")]
    assert looks == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert clock.at_s == 2.75


def test_a_change_between_two_looks_is_not_late(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    made: list[float] = []
    changes = [Change(round(at_s * 1e9), "E", NodeState(1)) for at_s in (0.3, 0.7)]
    play(changes, 1.0, clock.now_s, lambda change: made.append(clock.at_s), lambda at_s: None)
    assert made == pytest.approx([0.3, 0.7])


def test_the_run_is_told_what_was_played_when(problem: Problem, tmp_path: Path) -> None:
    folder = live_run(origin_ns=10 * PERIOD_NS).save(tmp_path / "run")
    timeline = timeline_of(problem, "impaired", seed=7, seconds=60)
    played = Played(problem, "impaired", 7, timeline)
    begin, end = [change for change in timeline.changes if change.place == "E"]
    played.changed(begin, 20 * PERIOD_NS)
    assert [item.place for item in played.active()] == ["E"]
    played.changed(end, 30 * PERIOD_NS)
    assert played.active() == []
    meta = played.note(folder, pressure={"failed": False}).meta
    assert (meta["scenario"], meta["seed"], meta["pressure"]) == ("impaired", 7, {"failed": False})
    (told,) = meta["played"]
    assert told["node"] == "E"
    assert told["at_s"] == pytest.approx(10 * PERIOD_NS / 1e9, abs=1e-3)
    assert told["for_s"] == pytest.approx(10 * PERIOD_NS / 1e9, abs=1e-3)
    assert longest_run(tmp_path) == folder
    assert longest_run(tmp_path / "nothing") is None


def test_episodes_and_ramps_are_told_as_they_were_played(tmp_path: Path) -> None:
    episodes = {"name": "x", "every_s": 2, "for_s": 1}
    items = [
        {"node": "E", "stress_threads": 4, "for_s": 6, "episodes": episodes},
        {"node": "R1", "stress_threads": 31, "at_s": 1, "for_s": 8, "ramp_s": 3},
        {"node": "R2", "stress_threads": 31, "at_s": 4, "ramp_s": 3},
    ]
    problem = from_document(document(scenarios={"some": items}))
    timeline = timeline_of(problem, "some", seed=1, seconds=20)
    played = Played(problem, "some", 1, timeline)
    for change in timeline.changes:
        if change.at_s < 5:
            played.changed(change, change.at_ns)
    folder = live_run(origin_ns=1).save(tmp_path / "run")
    told = played.note(folder, (0, 5_000_000_000)).meta["played"]
    times = [(item["node"], item["at_s"], item.get("for_s"), item["ramp_s"]) for item in told]
    assert times == [("E", 2, 1, 0), ("R1", 1, 8, 3), ("R2", 4, None, 3)]
    # What has begun, and goes on.
    assert [item.place for item in played.active()] == ["R1", "R2"]
    for change in timeline.changes:
        played.changed(change, change.at_ns)
    told = played.note(folder, (0, 20_000_000_000)).meta["played"]
    times = [(item["node"], item["at_s"], item.get("for_s"), item["ramp_s"]) for item in told]
    assert times == [("E", 2, 1, 0), ("E", 5, 1, 0), ("R1", 1, 8, 3), ("R2", 4, None, 3)]


def test_what_began_after_the_last_release_was_on_for_no_time(
    problem: Problem, tmp_path: Path
) -> None:
    folder = live_run(origin_ns=1).save(tmp_path / "run")
    timeline = timeline_of(problem, "impaired", seed=1, seconds=9)
    played = Played(problem, "impaired", 1, timeline)
    for change in timeline.changes[:3]:
        played.changed(change, change.at_ns)
    told = played.note(folder, (0, 900_000_000))
    assert [item["for_s"] for item in told.meta["played"]] == [0.0] * 3
    assert told.played == ()


def test_a_cell_is_up_when_everybody_is_ready(tmp_path: Path) -> None:
    states = iter([False, True])

    def ask(patience_s: float) -> Mapping[str, Any]:
        ready = next(states)
        return {"processes": {"a@E": {"ready": ready, "note": ""}}, "origin_ns": 5}

    assert come_up(ask, ["a@E"], tmp_path, patience_s=30.0)["origin_ns"] == 5


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
