"""LiveWindows: what the simulator's messages would have shown is what the simulator's windows do;
and every way in which messages are lost, late, doubled, or about something that has changed.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import polars.testing
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dwell
from dwell.control import ClosedWindow, Controller, Evidence
from dwell.errors import LiveError
from dwell.estimators import Corrected, Profile
from dwell.live.roles.live_windows import LiveWindows
from dwell.live.roles.offsets import Offsets
from dwell.live.roles.run_rows import Resume, columns_of
from dwell.live.wire.messages import Completion, Hop, Load, Stamp
from dwell.model import Caps, Execution, Flow, FrozenDict, Link, Node, Problem, QoS, Task
from dwell.model.fabric import accelerator_tiers
from dwell.model.instants import NEVER_NS
from dwell.model.process import Constant
from tests.cells.generated import make_problem
from tests.live.replayed import (
    SYNCHRONOUS,
    UNKNOWN,
    Clocks,
    Event,
    Played,
    messages_of,
    recorded,
    replay,
    settle,
    simulate,
    work_of,
)

MS, S = 1_000_000, 1_000_000_000
CANONICAL = Path(__file__).parents[3] / "examples" / "canonical.yaml"

# ------------------------------------------------------------------- a simulated run, played live


@pytest.fixture(scope="module")
def cell() -> Problem:
    problem = dwell.load(CANONICAL)
    controller = dataclasses.replace(
        problem.controller,
        estimator="shadow",
        shadow_fraction=0.1,
        order_lead_cycles=2,
        decide_cycles=40,
        min_dwell=1,
        min_improvement=0.0,
        fallbacks=(),
    )
    return dataclasses.replace(problem, controller=controller, window_cycles=40)


@pytest.fixture(scope="module")
def stressed(cell: Problem) -> Played:
    return simulate(cell, "robot-cpu-stress")


@pytest.fixture(scope="module")
def impaired(cell: Problem) -> Played:
    # It moves, since it begins where it should not stay.
    controller = dataclasses.replace(cell.controller, initial="SO")
    return simulate(dataclasses.replace(cell, controller=controller), "network-impairment")


def known_at_close(evidence: Evidence, window: ClosedWindow) -> np.ndarray[Any, Any]:
    """Cycles that had completed at the close: of the others no message tells."""
    return np.asarray(window.latency_ns <= window.close_ns - window.release_ns)


@pytest.mark.parametrize("name", ["stressed", "impaired"])
def test_the_controller_is_given_what_the_simulators_is(
    name: str, request: pytest.FixtureRequest
) -> None:
    played: Played = request.getfixturevalue(name)
    _, _, closed, evidence, _ = replay(played, SYNCHRONOUS, messages_of(played, Clocks()))
    # The last window closes with a release that is not in the record.
    assert len(closed) == len(played.seen.windows) - 1
    assert (played.run.cycles["placement"].to_physical().diff() != 0).sum() >= 1
    for mine, theirs, shown, there in zip(
        closed, played.seen.windows, evidence, played.seen.evidence, strict=False
    ):
        assert (mine.open_ns, mine.close_ns) == (theirs.open_ns, theirs.close_ns)
        assert np.array_equal(mine.release_ns, theirs.release_ns)
        done = known_at_close(there, theirs)
        assert np.array_equal(mine.latency_ns[done], theirs.latency_ns[done])
        assert (mine.latency_ns[~done] == NEVER_NS).all()
        assert np.allclose(mine.core_ns, theirs.core_ns, rtol=1e-9, atol=10)
        assert np.array_equal(shown.placement, there.placement)
        assert np.array_equal(shown.shadow_placement, there.shadow_placement)
        for what in ("ready_ns", "start_ns", "end_ns", "arrived_ns"):
            ours, known = getattr(shown.cycles, what), getattr(there.cycles, what)
            assert np.array_equal(ours[done], known[done])
            if what == "arrived_ns":
                assert (ours[~done, -1] == UNKNOWN).all()
            assert shown.shadows is not None
            assert there.shadows is not None
            ours, known = getattr(shown.shadows, what), getattr(there.shadows, what)
            stopped = (there.shadows.arrived_ns[:, -1] >= 0) & (there.shadow_placement >= 0)
            assert np.array_equal(ours[stopped], known[stopped])
            assert (ours[~stopped] == UNKNOWN).all()
            assert stopped.any() or name == "impaired"


@pytest.mark.parametrize("name", ["stressed", "impaired"])
def test_core_time_that_processes_tell_is_evidence_as_in_the_simulator(
    name: str, request: pytest.FixtureRequest
) -> None:
    played: Played = request.getfixturevalue(name)
    messages = messages_of(played, Clocks(), work_of(played))
    _, _, _, evidence, _ = replay(played, SYNCHRONOUS, messages)
    for theirs, shown, there in zip(
        played.seen.windows, evidence, played.seen.evidence, strict=False
    ):
        done = known_at_close(there, theirs)
        of = (shown.cycles, there.cycles, shown.shadows, there.shadows)
        ours, known, of_shadows, known_of_shadows = (
            instants.work_ns for instants in of if instants is not None
        )
        assert ours is not None
        assert known is not None
        assert np.array_equal(ours[done], known[done])
        assert (known[done] > 0).all()
        assert of_shadows is not None
        assert known_of_shadows is not None
        stopped = of_shadows.max(axis=1) > 0
        assert np.array_equal(of_shadows[stopped], known_of_shadows[stopped])
        assert stopped.any() or name == "impaired"
        assert (there.shadows_share, shown.shadows_share) == (True, False)


def giving(evidence: Evidence) -> Callable[[], Evidence]:
    return lambda: evidence


@pytest.mark.parametrize("name", ["stressed", "impaired"])
def test_the_present_of_a_live_cell_is_the_simulators(
    name: str, request: pytest.FixtureRequest
) -> None:
    """What differs is what nobody can tell live: shadows that have not ended."""
    played: Played = request.getfixturevalue(name)
    messages = messages_of(played, Clocks(), work_of(played))
    _, _, closed, evidence, _ = replay(played, SYNCHRONOUS, messages)
    presents = []
    for windows, shown in ((closed, evidence), (played.seen.windows, played.seen.evidence)):
        controller = Controller(played.problem, "LOC", "corrected")
        estimator = controller.estimator
        assert isinstance(estimator, Corrected)
        for window, of in zip(windows, shown, strict=False):
            shown_again = dataclasses.replace(window, evidence=giving(of))
            controller.settle(controller.propose(shown_again))
        presents.append(estimator.present)
    live, simulated = presents
    assert live.down == simulated.down == frozenset()
    assert set(live.demands) == set(simulated.demands)
    for part, values in live.demands.items():
        known = simulated.demands[part]
        assert np.median(values) == pytest.approx(np.median(known), rel=0.1)
    assert live.threads == pytest.approx(simulated.threads, abs=0.3)
    assert bool(simulated.threads) == (name == "stressed")
    assert bool(simulated.demands) == (name == "impaired")


def test_the_record_is_the_simulators(stressed: Played, tmp_path: Path) -> None:
    messages = messages_of(stressed, Clocks(), work_of(stressed))
    _, controller, _, _, rows = replay(stressed, SYNCHRONOUS, messages)
    live, simulated = recorded(tmp_path, controller, rows), stressed.run
    for table in ("cycles", "windows", "decisions"):
        mine, theirs = getattr(live, table), getattr(simulated, table)
        common = theirs.columns
        assert mine.columns[: len(common)] == common
        assert mine.select(common).schema == theirs.schema
    count = len(live.windows)
    assert count == len(simulated.windows) - 1
    same = pl.col("window") < count
    # Of jobs that had not completed, or of a shadow that had not ended, no message tells: estimates
    # may differ a little.
    estimated = pl.selectors.starts_with("est_", "j_", "delta_j", "excess_")
    left = ["shadow_bytes", *pl.selectors.expand_selector(simulated.decisions, estimated)]
    for mine, theirs in (
        (live.windows, simulated.windows.filter(same)),
        (live.decisions, simulated.decisions.filter(same)),
    ):
        theirs = theirs.drop(left, strict=False)
        # Utilisation goes through whole nanoseconds.
        pl.testing.assert_frame_equal(mine.select(theirs.columns), theirs, abs_tol=1e-6)
    assert live.decisions["migrated"].any()
    # Bytes of shadows that never came to their end are not known.
    assert (live.windows["shadow_bytes"] <= simulated.windows["shadow_bytes"][:count]).all()
    assert live.windows["shadow_bytes"].sum() > 0
    cycles = simulated.cycles[: len(live.cycles)]
    parts = ["latency_ns", "compute_ns", "queue_ns", "network_ns"]
    for name in ("cycle", "release_ns", "placement", "missed", *parts):
        assert live.cycles[name].to_list() == cycles[name].to_list(), name
    done = cycles["outcome"] == "done"
    assert (live.cycles["outcome"] == "done").to_list() == done.to_list()
    assert set(live.cycles["outcome"].cast(pl.String)) <= {"done", "dropped"}
    assert live.cycles["number"].to_list() == [5000 + cycle for cycle in cycles["cycle"]]
    assert live.cycles["lead"].sum() == live.windows["lead"].sum() > 0
    assert live.cycles.columns == list(columns_of(controller)["cycles"])
    assert not live.windows["unproven"].any()


def test_late_completions_are_recorded_though_they_came_too_late_to_be_seen(
    stressed: Played, tmp_path: Path
) -> None:
    chosen = random.Random(2)

    def late(event: Event) -> int:
        return 3 * S if event[1] == 1 and chosen.random() < 0.1 else 0

    _, controller, closed, _, rows = replay(
        stressed, SYNCHRONOUS, messages_of(stressed, Clocks()), late=late
    )
    run = recorded(tmp_path, controller, rows)
    count = len(run.windows) - 2
    final = stressed.run.windows[:count]
    # The late ones come for several windows more; their last ones are known by then.
    for name in ("l95_ms", "violation_rate"):
        assert run.windows[name][:count].to_list() == final[name].to_list()
    seen, theirs = run.windows["seen_violation_rate"][:count], final["seen_violation_rate"]
    assert (seen > theirs).sum() > count / 2
    assert sum((window.latency_ns == NEVER_NS).sum() for window in closed) > 40


def test_clocks_that_are_apart(stressed: Played, tmp_path: Path) -> None:
    clocks = Clocks({"E": -3_000_000 * S, "R2": 10 * S})
    offsets = Offsets("E", "R1")
    delay_ns = 200_000
    end_ns = stressed.run.cycles["release_ns"].max()
    assert isinstance(end_ns, int)

    def comparing(t_ns: int) -> Callable[[LiveWindows, int], None]:
        def compare(windows: LiveWindows, at_ns: int) -> None:
            for one in ("R1", "E", "R2"):
                for other in ("R1", "E", "R2"):
                    sent_ns = clocks.at(one, t_ns - delay_ns)
                    offsets.sample(one, other, sent_ns, clocks.at(other, t_ns))

        return compare

    samples = [(t_ns, 0, comparing(t_ns)) for t_ns in range(0, end_ns, 100 * MS)]
    exact, _, reference, _, _ = replay(stressed, SYNCHRONOUS, messages_of(stressed, Clocks()))
    windows, controller, closed, evidence, rows = replay(
        stressed,
        offsets,
        [*samples, *messages_of(stressed, clocks)],
        late=lambda event: 100_000 if event[1] in {1, 3} else 0,
        now=lambda t_ns: clocks.at("E", t_ns),
    )
    assert exact.last is not None
    assert windows.last is not None
    assert windows.last.number == exact.last.number
    bound_ns = windows.last.bound_ns
    assert delay_ns <= bound_ns <= delay_ns + 50_000
    for mine, theirs in zip(closed, reference, strict=True):
        both = (mine.latency_ns < NEVER_NS) & (theirs.latency_ns < NEVER_NS)
        assert both.sum() >= 30
        assert np.abs(mine.latency_ns - theirs.latency_ns)[both].max() <= bound_ns
    first = evidence[0].cycles
    assert ((first.end_ns >= first.ready_ns) | (first.end_ns < 0)).all()
    cycles = recorded(tmp_path, controller, rows).cycles.drop_nulls("compute_ns")
    total = pl.col("compute_ns") + pl.col("queue_ns") + pl.col("network_ns")
    assert (cycles.select(total).to_series() == cycles["latency_ns"]).all()
    assert (
        (cycles.select(pl.min_horizontal("compute_ns", "queue_ns", "network_ns")) >= 0)
        .to_series()
        .all()
    )


# ---------------------------------------------------------------------------- a cell made by hand

W = 5
P = 40 * MS


def small(*, sinks: int = 1, grace_ms: float = 0.0, window_cycles: int = W) -> Problem:
    """One source, and as many sinks behind it; the source may run on A or B."""
    either = {node: Execution(Constant(1.0)) for node in ("A", "B")}
    tasks = [Task("see", either)]
    tasks += [Task(f"act{i}", {"A": Execution(Constant(1.0))}) for i in range(sinks)]
    problem = make_problem(
        [Node("A", "robot", cores=2), Node("B", "edge", cores=2)],
        tasks,
        [Flow("see", f"act{i}", 1000) for i in range(sinks)],
        links=[Link("A", "B", Constant(1.0)), Link("B", "A", Constant(1.0))],
        candidates={
            name: {"see": node, **{f"act{i}": "A" for i in range(sinks)}}
            for name, node in (("NEAR", "A"), ("FAR", "B"))
        },
    )
    pipeline = dataclasses.replace(problem.pipeline, period_ms=40.0, deadline_ms=40.0)
    settings_ = dataclasses.replace(
        problem.controller, close_grace_ms=grace_ms, on="B", decide_cycles=window_cycles
    )
    return dataclasses.replace(
        problem, pipeline=pipeline, controller=settings_, window_cycles=window_cycles
    )


class Hand:
    """A cell whose messages are made one by one; latency is 10 ms."""

    def __init__(self, problem: Problem | None = None, *, resume: Resume | None = None) -> None:
        self.problem = problem or small()
        self.controller = Controller(self.problem, "NEAR")
        self.offsets = Offsets("B", "A", system_bound_ns=0)
        self.windows = LiveWindows(self.problem, self.offsets, self.controller, resume=resume)
        self.table: dict[str, dict[Any, dict[str, Any]]] = {"cycles": {}, "windows": {}}

    def stamp(self, cycle: int, term: int = 1, *, at_ns: int | None = None, run: int = 1) -> Stamp:
        at_ns = cycle * P if at_ns is None else at_ns
        return Stamp(run, cycle, term, "NEAR" if term % 2 else "FAR", at_ns)

    def release(self, cycles: Iterable[int], term: int = 1, **more: Any) -> None:
        for cycle in cycles:
            stamp = self.stamp(cycle, term, **more)
            self.windows.stamped(stamp, stamp.released_ns)

    def done(
        self, cycle: int, term: int = 1, *, sink: int = 0, ms: float = 10, **more: Any
    ) -> None:
        stamp = self.stamp(cycle, term, **more)
        done_ns = stamp.released_ns + round(ms * MS)
        done = Completion(stamp, f"act{sink}", done_ns, "actuated", (), "A")
        self.windows.completed(done, done_ns)

    def settle(self, window: ClosedWindow) -> None:
        """Have a closed window decided on."""
        settle(self.windows, self.controller, window)

    def close(self) -> list[int]:
        """Close every window that is due; return the numbers of the last one's cycles."""
        numbers: list[int] = []
        while self.windows.due_ns(1 << 60) is not None:
            self.settle(self.windows.close())
            assert self.windows.last is not None
            numbers = [cycle.number for cycle in self.windows.last.cycles]
        return numbers

    def record(self) -> None:
        columns = columns_of(self.controller)
        for table, rows in self.windows.record.rows().items():
            for row in rows:
                named = dict(zip(columns[table], row, strict=True))
                if table in self.table:
                    self.table[table][row[0]] = named

    def column(self, table: str, name: str) -> list[Any]:
        return [row[name] for _, row in sorted(self.table[table].items())]


def test_a_window_closes_a_grace_after_the_first_cycle_beyond_it() -> None:
    hand = Hand(small(grace_ms=7))
    hand.release(range(W))
    assert hand.windows.due_ns(W * P) is None
    with pytest.raises(LiveError, match="no window is due"):
        hand.windows.close()
    hand.release([W])
    assert hand.windows.due_ns(W * P) == W * P + 7 * MS
    hand.done(0)
    hand.done(4, ms=46)
    window = hand.windows.close()
    assert window.latency_ns.tolist() == [10 * MS, NEVER_NS, NEVER_NS, NEVER_NS, 46 * MS]
    assert (window.open_ns, window.close_ns) == (0, W * P + 7 * MS)
    assert hand.windows.due_ns(W * P) is None
    hand.release(range(W + 1, 2 * W + 1))
    hand.settle(window)
    assert hand.close() == [5, 6, 7, 8, 9]


@pytest.mark.parametrize("window_cycles", [1, W])
def test_a_window_of_early_frames_closes_when_its_last_deadline_has_passed(
    window_cycles: int,
) -> None:
    hand = Hand(small(window_cycles=window_cycles))
    # Frames come 15 ms after each other, and so D = 40 ms is over two frames after the next one.
    gap_ns = 15 * MS
    cycles = range(4 * window_cycles)
    for cycle in cycles:
        hand.release([cycle], at_ns=cycle * gap_ns)
        hand.done(cycle, ms=40, at_ns=cycle * gap_ns)
    closes = []
    for window in range(3):
        last_ns = ((window + 1) * window_cycles - 1) * gap_ns
        assert hand.windows.due_ns(0) == last_ns + 40 * MS
        closed = hand.windows.close()
        closes.append(closed.close_ns)
        assert closed.close_ns == last_ns + 40 * MS
        hand.settle(closed)
    hand.record()
    assert closes == sorted(closes)
    assert set(hand.column("windows", "violation_rate")) == {0.0}
    assert set(hand.column("windows", "seen_violation_rate")) == {0.0}


def test_after_a_migration_the_window_starts_with_the_first_cycle_of_the_new_placement() -> None:
    hand = Hand()
    hand.release(range(W + 2))
    assert hand.close() == [0, 1, 2, 3, 4]
    hand.release(range(W + 2, 3 * W), 2)
    assert hand.close() == [7, 8, 9, 10, 11]
    hand.record()
    assert hand.column("cycles", "number") == list(range(12))
    assert hand.column("cycles", "lead") == [False] * 5 + [True] * 2 + [False] * 5
    assert hand.column("windows", "first_cycle") == [0, 7]
    assert hand.column("windows", "lead") == [0, 2]
    assert hand.column("windows", "term") == [1, 2]
    assert hand.column("windows", "placement") == ["NEAR", "FAR"]
    assert hand.column("windows", "mixed") == [False, False]


def test_a_guard_move_in_the_middle_of_a_window_ends_it() -> None:
    hand = Hand()
    hand.release(range(3))
    hand.release(range(3, 6), 2)
    # And at once another.
    hand.release(range(6, 12), 3)
    assert hand.close() == [6, 7, 8, 9, 10]
    hand.record()
    assert hand.column("windows", "lead") == [6]


def test_a_window_that_is_complete_closes_though_the_guard_moves_in_its_grace() -> None:
    hand = Hand(small(grace_ms=100))
    hand.release(range(W + 1))
    hand.release(range(W + 1, W + 3), 2)
    assert hand.windows.due_ns(0) is not None
    assert hand.close() == [0, 1, 2, 3, 4]
    hand.release(range(W + 3, 2 * W + 2), 2)
    assert hand.close() == [6, 7, 8, 9, 10]


def test_a_window_is_complete_where_the_first_cycle_beyond_it_is_of_a_new_term() -> None:
    hand = Hand()
    hand.release(range(W))
    hand.release(range(W, 2 * W + 1), 2)
    hand.settle(hand.windows.close())
    hand.settle(hand.windows.close())
    hand.record()
    assert hand.column("windows", "lead") == [0, 0]
    assert hand.column("windows", "term") == [1, 2]


def test_a_close_is_not_later_than_a_grace_after_the_stamp_was_heard() -> None:
    hand = Hand(small(grace_ms=7))
    hand.release(range(W))
    # The clocks are not as good as their bound says.
    hand.windows.stamped(hand.stamp(W), W * P - 3 * MS)
    assert hand.windows.due_ns(W * P) == W * P + 4 * MS


def test_what_happened_after_the_close_is_no_evidence_and_no_success() -> None:
    hand = Hand()
    hand.release(range(W))
    # The camera was early: the window closes with its last deadline, 40 ms after its last release.
    hand.release([W], at_ns=(W - 1) * P + 30 * MS)
    for cycle, ms in ((3, 35), (4, 45)):
        end_ns = cycle * P + ms * MS
        hop = Hop(
            "act0", "A", end_ns - 9 * MS, end_ns - 8 * MS, end_ns, (("see", end_ns - 9 * MS),)
        )
        done = Completion(hand.stamp(cycle), "act0", end_ns, "actuated", (hop,), "A")
        # The controller woke up late.
        hand.windows.completed(done, end_ns)
    window = hand.windows.close()
    assert window.evidence is not None
    known = window.evidence().cycles
    assert known.end_ns[3:, 1].tolist() == [3 * P + 35 * MS, UNKNOWN]
    assert known.ready_ns[4, 1] == 4 * P + 36 * MS
    hand.settle(window)
    hand.record()
    assert hand.column("cycles", "latency_ns")[3:] == [35 * MS, 45 * MS]
    assert hand.column("cycles", "missed")[3:] == [False, True]
    rates = ("violation_rate", "seen_violation_rate")
    assert [hand.column("windows", name) for name in rates] == [[0.8], [0.8]]


def test_while_an_order_is_under_way_no_window_begins() -> None:
    hand = Hand()
    hand.release(range(W + 1))
    hand.close()
    hand.windows.ordered(1, 1)
    hand.release(range(W + 1, 4 * W))
    assert hand.windows.due_ns(0) is None
    hand.release(range(4 * W, 5 * W + 1), 2)
    assert hand.close() == [20, 21, 22, 23, 24]
    hand.record()
    assert hand.column("windows", "lead") == [0, 15]
    # One that is refused: windows were contiguous all the time.
    hand.windows.ordered(1, 2)
    hand.release(range(5 * W + 1, 7 * W + 1), 2)
    assert hand.windows.due_ns(0) is None
    hand.windows.refused()
    assert hand.close() == [30, 31, 32, 33, 34]


def test_an_order_for_where_the_guard_has_moved_the_cell_by_then_keeps_no_window_open() -> None:
    """Its cycles were heard before anybody said so."""
    hand = Hand()
    hand.release(range(W + 1))
    hand.close()
    hand.release(range(W + 1, 3 * W), 2)
    hand.windows.ordered(1, 1)
    hand.release(range(3 * W, 4 * W + 2), 2)
    assert hand.close() == [16, 17, 18, 19, 20]


def test_cycles_are_known_by_stamp_or_by_completion_and_doubles_are_dropped() -> None:
    hand = Hand()
    hand.release([0, 1, 3])
    for cycle in (1, 2, 2, 1, 0):
        hand.done(cycle)
    hand.done(1, ms=99)
    # Of cycle 4 nothing is heard.
    hand.release([5, 3, 0])
    window = hand.windows.close()
    # Of 3 it may not have been heard either that it has completed.
    assert window.latency_ns.tolist() == [10 * MS] * 3
    assert window.release_ns.tolist() == [0, P, 2 * P]
    assert hand.windows.last is not None
    assert hand.windows.last.heard == 4
    assert hand.windows.last.unproven
    hand.settle(window)
    hand.record()
    assert hand.column("cycles", "heard") == [True] * 4 + [False]
    assert hand.column("cycles", "missed") == [False] * 5
    assert hand.column("windows", "violation_rate") == [0.0]
    # Now it is.
    hand.done(4, at_ns=4 * P + MS)
    hand.record()
    assert hand.column("cycles", "heard") == [True] * 5
    assert hand.column("cycles", "latency_ns")[4] is not None
    assert hand.column("windows", "heard") == [4]


def test_numbers_that_a_restarted_stamper_left_out_were_no_cycles() -> None:
    hand = Hand()
    hand.release(range(3))
    # 1000 numbers on, three periods later.
    for i in range(3):
        stamp = hand.stamp(1000 + i, at_ns=(6 + i) * P)
        hand.windows.stamped(stamp, stamp.released_ns)
    assert hand.close() == [0, 1, 2, 1000, 1001]
    hand.record()
    assert hand.column("cycles", "cycle") == [0, 1, 2, 3, 4]
    assert hand.column("cycles", "number") == [0, 1, 2, 1000, 1001]


def test_a_later_run_begins_a_window() -> None:
    hand = Hand()
    hand.release(range(3))
    for i in range(W + 1):
        stamp = hand.stamp(i, run=2, at_ns=(10 + i) * P)
        hand.windows.stamped(stamp, stamp.released_ns)
    # Late news of the one before; one of them cannot be.
    hand.release([4])
    hand.release([5], at_ns=12 * P)
    assert hand.close() == [0, 1, 2, 3, 4]
    hand.record()
    assert hand.column("cycles", "run") == [1] * 4 + [2] * 5
    assert hand.windows.ignored == 1


def test_a_stamper_whose_clock_begins_anew() -> None:
    hand = Hand()
    hand.release(range(100, 103))
    for i in range(W + 1):
        stamp = hand.stamp(2000 + i, at_ns=5 + i * P)
        hand.windows.stamped(stamp, (105 + i) * P)
    assert hand.close() == [2000, 2001, 2002, 2003, 2004]
    hand.record()
    # The record goes on at the controller's clock.
    assert hand.column("cycles", "release_ns") == [i * P for i in (0, 1, 2, 5, 6, 7, 8, 9)]
    assert hand.column("windows", "lead") == [3]


@pytest.mark.parametrize("released_ns", [-NEVER_NS, NEVER_NS - 1])
def test_a_cycle_that_is_taken_back_takes_its_clock_back(released_ns: int) -> None:
    hand = Hand()
    # Each false stamp is the first of a clock that begins anew.
    for cycle in range(2, 8):
        hand.release([cycle - 1])
        hand.windows.stamped(hand.stamp(cycle, at_ns=released_ns), cycle * P)
        hand.windows.forget(1, cycle)
    hand.release(range(7, 20))
    assert hand.close()[-1] > 7
    hand.record()
    numbers = hand.column("cycles", "number")
    assert hand.column("cycles", "release_ns") == [(number - 1) * P for number in numbers]


def test_what_is_left_after_a_cycle_is_taken_back_still_tells_false_clocks() -> None:
    hand = Hand()
    # Nothing is heard of cycle 2, which is the last that is left.
    hand.release([1, 3])
    hand.windows.forget(1, 3)
    hand.windows.stamped(hand.stamp(3, at_ns=NEVER_NS - 1), 3 * P)
    hand.release(range(4, 8))
    hand.close()
    hand.record()
    assert max(hand.column("cycles", "release_ns")) < 10 * P


@pytest.mark.parametrize(("released_ns", "expected"), [(-NEVER_NS, 0), (NEVER_NS - 1, 2)])
def test_a_cycle_between_two_others_was_released_between_them(
    released_ns: int, expected: int
) -> None:
    hand = Hand()
    hand.release([1, 3])
    hand.windows.stamped(hand.stamp(2, at_ns=released_ns), 3 * P)
    hand.release(range(4, 8))
    hand.close()
    hand.record()
    assert hand.column("cycles", "release_ns")[:3] == [0, expected * P, 2 * P]


def test_every_sink_has_to_report() -> None:
    hand = Hand(small(sinks=3))
    hand.release(range(W + 1))
    for sink in (0, 1, 2):
        hand.done(0, sink=sink, ms=10 + sink)
        if sink != 1:
            hand.done(1, sink=sink)
    hand.done(1, sink=0)
    window = hand.windows.close()
    assert window.latency_ns[:2].tolist() == [12 * MS, NEVER_NS]
    hand.settle(window)
    hand.done(1, sink=1, ms=31)
    hand.record()
    assert hand.column("cycles", "latency_ns")[:2] == [12 * MS, 31 * MS]


def test_what_is_lost_is_told_from_what_is_under_way() -> None:
    hand = Hand()
    hand.release(range(W + 1))
    for cycle in (0, 2):
        hand.done(cycle)
    hand.close()
    hand.record()
    assert hand.column("cycles", "outcome") == ["done", "dropped", "done", "in_flight", "in_flight"]
    hand.done(4, ms=38)
    hand.record()
    assert hand.column("cycles", "outcome") == ["done", "dropped", "done", "dropped", "done"]
    assert hand.column("cycles", "missed") == [False, True, False, True, False]
    assert hand.column("windows", "violation_rate") == [0.4]
    # The controller had seen three misses.
    assert hand.column("windows", "seen_violation_rate") == [0.6]


def test_what_the_stamper_heard_is_done_until_the_sink_says_when() -> None:
    hand = Hand()
    hand.release(range(W + 2))
    hand.done(0)
    hand.windows.measured(1, [(1, 13 * MS, 0), (2, 17 * MS, 0)])
    hand.close()
    # Not yet said when the window closed.
    hand.windows.measured(1, [(3, 19 * MS, 0)])
    hand.record()
    assert hand.column("cycles", "outcome") == ["done"] * 4 + ["in_flight"]
    assert hand.column("cycles", "latency_ns")[1:4] == [13 * MS, 17 * MS, 19 * MS]
    assert hand.column("windows", "seen_violation_rate") == [0.4]
    assert hand.column("windows", "violation_rate") == [0.2]
    hand.done(2, ms=16)
    hand.record()
    assert hand.column("cycles", "latency_ns")[1:4] == [13 * MS, 16 * MS, 19 * MS]


def test_a_restarted_controller_starts_at_the_first_stamp_it_hears() -> None:
    before = Hand()
    before.release(range(8))
    before.close()
    before.record()
    hand = Hand(resume=Resume(window=1, cycle=5, origin_ns=0))
    # The completion of a cycle before it is of no use to it.
    hand.release([9])
    hand.done(7)
    hand.release(range(10, 15))
    assert hand.close() == [9, 10, 11, 12, 13]
    hand.record()
    assert list(hand.table["windows"]) == [1]
    assert list(hand.table["cycles"]) == [5, 6, 7, 8, 9]
    assert hand.column("cycles", "release_ns") == [i * P for i in range(9, 14)]
    assert hand.windows.ignored == 1


def test_a_run_whose_stampers_clock_began_anew_while_no_controller_looked() -> None:
    hand = Hand(resume=Resume(window=1, cycle=5, origin_ns=100 * P))
    hand.release(range(W + 1))
    assert hand.close() == [0, 1, 2, 3, 4]
    hand.record()
    assert hand.column("cycles", "release_ns") == [i * P for i in range(W)]


def test_a_window_of_which_nothing_was_heard_says_so() -> None:
    hand = Hand()
    hand.release([0, *range(11, 16)])
    for heard in (1, 0, 4):
        hand.settle(hand.windows.close())
        assert hand.windows.last is not None
        assert hand.windows.last.heard == heard
    hand.record()
    assert hand.column("cycles", "number") == list(range(15))
    assert hand.column("windows", "heard") == [1, 0, 4]


def test_clocks_that_were_never_compared() -> None:
    hand = Hand()
    hand.offsets = Offsets("B", "A")
    hand.windows = LiveWindows(hand.problem, hand.offsets, hand.controller)
    for cycle in range(W + 1):
        stamp = hand.stamp(cycle)
        hand.windows.stamped(stamp, stamp.released_ns + 500 * S)
        done = Completion(stamp, "act0", 77, "actuated", (), "B")
        hand.windows.completed(done, stamp.released_ns + 500 * S + 12 * MS)
    # By the controller's own clock.
    assert hand.windows.due_ns(600 * S) == W * P + 500 * S
    window = hand.windows.close()
    assert window.latency_ns.tolist() == [12 * MS] * W
    assert hand.windows.last is not None
    assert hand.windows.last.unproven
    hand.settle(window)
    hand.record()
    assert hand.column("windows", "bound_ms") == [None]
    assert hand.column("windows", "unproven") == [True]


@pytest.mark.parametrize(("bound_ms", "unproven"), [(7.9, False), (8.1, True)])
def test_a_bound_beyond_a_fifth_of_the_deadline_is_marked(bound_ms: float, unproven: bool) -> None:
    hand = Hand()
    hand.offsets = Offsets("B", "A", system_bound_ns=round(bound_ms * MS))
    hand.windows = LiveWindows(hand.problem, hand.offsets, hand.controller)
    hand.release(range(W + 1))
    stamp = hand.stamp(2)
    hand.windows.completed(Completion(stamp, "act0", 2 * P + 5 * MS, "actuated", (), "B"))
    hand.close()
    hand.record()
    assert hand.column("windows", "unproven") == [unproven]
    assert hand.column("windows", "bound_ms") == [bound_ms]


def test_messages_about_what_does_not_exist_are_ignored() -> None:
    hand = Hand()
    hand.windows.stamped(Stamp(1, 0, 1, "NOWHERE", 0))
    hand.windows.completed(Completion(hand.stamp(0), "see", 5, "actuated", (), "A"))
    hand.windows.loaded(Load("C", 1, 0, 0, 0, 0))
    assert hand.windows.ignored == 3
    assert hand.windows.origin_ns is None
    hops = (Hop("no", "X", 1, 2, 3, (("see", 1),)), Hop("act0", "A", 1, 2, 3, (("act0", 1),)))
    hand.release(range(W + 1))
    hand.windows.completed(Completion(hand.stamp(0), "act0", 5 * MS, "behind", hops, "A"))
    window = hand.windows.close()
    assert window.evidence is not None
    assert window.evidence().cycles.end_ns[0].tolist() == [UNKNOWN, 3]
    hand.settle(window)
    hand.record()
    assert hand.column("cycles", "actuated")[0] is False
    assert hand.column("cycles", "compute_ns")[0] == 1


def test_where_a_cycle_was_lost_is_inferred() -> None:
    hand = Hand(small(sinks=2, window_cycles=6))
    # Under FAR the source is on B, and both its messages cross the link.
    hand.release(range(7), 2)

    def tell(cycle: int, sink: str, outcome: str, *hops: Hop) -> None:
        done = Completion(hand.stamp(cycle, 2), sink, cycle * P + 12, outcome, hops, "A")
        hand.windows.completed(done)

    def see(cycle: int) -> Hop:
        at_ns = cycle * P
        return Hop("see", "B", at_ns + 1, at_ns + 2, at_ns + 3)

    def act(cycle: int, sink: int, *, ends: bool = True) -> Hop:
        at_ns = cycle * P + 10
        end_ns = at_ns + 1 if ends else UNKNOWN
        return Hop(f"act{sink}", "A", at_ns, end_ns, end_ns, (("see", at_ns - 5),))

    for sink in (0, 1):
        tell(0, f"act{sink}", "actuated", see(0), act(0, sink))
    # Of 1 nothing is heard, of 2 one sink; 3 was replaced before a sink, 4 before the source.
    tell(2, "act0", "actuated", see(2), act(2, 0))
    tell(3, "act0", "replaced", see(3), act(3, 0, ends=False))
    tell(4, "see", "replaced", Hop("see", "B", 4 * P + 1, UNKNOWN, UNKNOWN))
    tell(5, "see", "actuated", see(5))
    window = hand.windows.close()
    assert window.evidence is not None
    known = window.evidence().cycles
    no = UNKNOWN
    ends = [[3, 11, 11], [P, no, no], [2 * P + 3, 2 * P + 11, no], [3 * P + 3, no, no]]
    assert known.end_ns[:4].tolist() == ends
    assert known.ready_ns[:, 0].tolist() == [1, no, 2 * P + 1, 3 * P + 1, 4 * P + 1, no]
    assert known.end_ns[4].tolist() == [no] * 3
    assert (known.arrived_ns >= 0).tolist() == [
        [True, True],
        [False, False],
        [True, False],
        [True, False],
        [False, False],
        [False, False],
    ]
    assert hand.windows.ignored == 1
    hand.settle(window)
    hand.record()
    outcomes = ["done", "in_flight", "in_flight", "replaced", "replaced", "in_flight"]
    assert hand.column("cycles", "outcome") == outcomes


def test_memory_is_bounded() -> None:
    hand = Hand()
    for first in range(0, 4_000, 100):
        hand.release(range(first, first + 100))
        if first % 3:
            hand.done(first)
        hand.close()
        hand.record()
        hand.table["cycles"].clear()
    windows = hand.windows
    stamps = windows._by_key
    assert len(stamps) < 2000
    assert len(windows.record._windows) < 2000 / W
    assert len(windows.record._in_flight) < 2000
    # Nobody says what has become of an order.
    windows.ordered(1, 1)
    hand.release(range(4_000, 12_000))
    assert len(stamps) < 4000


@given(data=st.data())
def test_in_any_order_and_with_any_losses_windows_are_w_cycles_apart(data: st.DataObject) -> None:
    """Stamps and completions lost, doubled and late: releases never go back, nothing is twice."""
    generator = random.Random(data.draw(st.integers(0, 10_000)))
    hand = Hand()
    term = 1
    events: list[tuple[float, Stamp, Completion | None]] = []
    for cycle in range(data.draw(st.integers(20, 120))):
        term += generator.random() < 0.05
        stamp = hand.stamp(cycle, term)
        done = Completion(stamp, "act0", stamp.released_ns + 9 * MS, "actuated", (), "A")
        for message in generator.choices((None, done), k=generator.randrange(5)):
            late_ns = generator.choice((0, 0, 0, 1, 5)) * P * generator.random()
            said_ns = stamp.released_ns if message is None else done.done_ns
            events.append((said_ns + late_ns, stamp, message))
    for at_ns, about, report in sorted(events, key=lambda event: event[0]):
        if report is None:
            hand.windows.stamped(about, round(at_ns))
        else:
            hand.windows.completed(report, round(at_ns))
        hand.close()
        hand.record()
    numbers = hand.column("cycles", "number")
    assert numbers == sorted(set(numbers))
    releases = hand.column("cycles", "release_ns")
    assert releases == sorted(releases)
    assert list(hand.table["cycles"]) == list(range(len(numbers)))
    firsts = hand.column("windows", "first_cycle")
    assert all(b - a >= W for a, b in itertools.pairwise(firsts))
    lead = hand.column("cycles", "lead")
    assert all(not any(lead[first : first + W]) for first in firsts)
    assert sum(lead) == len(lead) - W * len(firsts)


# ------------------------------------------------------------------------------- utilisation


def load(at_ms: float, busy_ms: float, *, node: str = "A", life: int = 1) -> Load:
    return Load(node, life, round(at_ms * MS), round(busy_ms * MS), 0, 0)


def used_ms(hand: Hand) -> float:
    hand.release(range(W + 1))
    return float(hand.windows.close().core_ns[0, 0]) / 1e6


def test_counters_are_read_between_reports() -> None:
    hand = Hand()
    # 2 cores of work from -50 ms on, in reports every 100 ms that a window of 200 ms cuts.
    for at_ms in range(-50, 351, 100):
        hand.windows.loaded(load(at_ms, 1000 + 2 * at_ms))
    assert used_ms(hand) == pytest.approx(400)


@pytest.mark.parametrize(("last_ms", "expected_ms"), [(150, 200), (50, 150), (-50, 50)])
def test_a_node_that_falls_silent_is_taken_for_idle_after_one_report(
    last_ms: int, expected_ms: float
) -> None:
    hand = Hand()
    for at_ms in range(-250, last_ms + 1, 100):
        hand.windows.loaded(load(at_ms, 1000 + at_ms))
    assert used_ms(hand) == pytest.approx(expected_ms)


def test_an_agent_that_begins_to_count_anew_costs_one_report() -> None:
    hand = Hand()
    for at_ms in (-100, 0, 100):
        hand.windows.loaded(load(at_ms, 5000 + at_ms))
    for at_ms in (150, 200, 250):
        hand.windows.loaded(load(at_ms, at_ms - 150, life=2))
    hand.windows.loaded(load(220, 9000))
    hand.windows.loaded(load(200, 50, life=2))
    assert used_ms(hand) == pytest.approx(150)


def job(task: str, ms: float, node: str = "A") -> Hop:
    return Hop(task, node, 0, 0, 1, cpu_ns=round(ms * MS))


def busy_window(hand: Hand) -> ClosedWindow:
    """A window in which processes on A took 100 ms, and all on it 160."""
    for at_ms in (-100, 400):
        counted = round(0.8 * (100 + at_ms) * MS), round(0.5 * (100 + at_ms) * MS)
        hand.windows.loaded(Load("A", 1, at_ms * MS, *counted, 0))
    window = hand.windows.close()
    assert window.core_ns[0, 0] / 1e6 == pytest.approx(160)
    return window


def own_ms(hand: Hand) -> float:
    return float(busy_window(hand).core_ns[1, 0]) / 1e6


def test_own_work_is_that_of_the_jobs_as_far_as_they_tell() -> None:
    hand = Hand(small(sinks=2))
    hand.release(range(W + 1))
    assert own_ms(hand) == pytest.approx(100)
    told = Hand(small(sinks=2))
    told.release(range(W + 1))
    for cycle in range(3):
        for sink in (0, 1):
            # Both sinks tell of the source's job; one of them is elsewhere, and one job not told.
            hops = (job("see", 5), job(f"act{sink}", 7, "AB"[sink]), Hop("act9", "A", 0, 0, 1))
            done = Completion(told.stamp(cycle), f"act{sink}", P, "actuated", hops, "A")
            told.windows.completed(done, P)
    assert own_ms(told) == pytest.approx(3 * (5 + 7))


def test_a_candidate_on_the_same_jobs_is_as_busy_as_the_incumbent() -> None:
    """What processes take beside their jobs would be missing from every alternative."""
    hand = Hand()
    profile = Profile(hand.problem)
    job_ms = profile.own["NEAR"]["A"] * P / MS * hand.problem.fabric.nodes["A"].capacity
    hand.release(range(W + 1))
    for cycle in range(W):
        done = Completion(hand.stamp(cycle), "act0", P, "actuated", (job("see", job_ms),), "A")
        hand.windows.completed(done, P)
    used, own, _ = hand.controller.utilisation(busy_window(hand))
    seen = QoS(10.0, 0.0, FrozenDict(zip(hand.controller.resources, used.tolist(), strict=True)))
    mine = dict(zip(hand.controller.resources, own.tolist(), strict=True))
    estimates = profile.estimate(observed=seen, incumbent="NEAR", own=mine)
    assert estimates["NEAR"].utilisation["A"] == pytest.approx(used[0])


def accelerated(**kinds: int) -> Problem:
    """The small cell, whose source needs an accelerator of A there."""
    problem = small()
    nodes = dict(problem.fabric.nodes)
    nodes["A"] = dataclasses.replace(nodes["A"], accelerators=kinds)
    tasks, see = dict(problem.pipeline.tasks), problem.pipeline.tasks["see"]
    on = {**see.on, "A": dataclasses.replace(see.on["A"], accelerator=next(iter(kinds)))}
    tasks["see"] = dataclasses.replace(see, on=on)
    return dataclasses.replace(
        problem,
        fabric=dataclasses.replace(problem.fabric, nodes=nodes),
        pipeline=dataclasses.replace(problem.pipeline, tasks=tasks),
    )


def accelerated_window(
    hand: Hand, *, hook: float = -1.0, told: int = 3, term: int = 1
) -> dict[str, list[float | None]]:
    """Busy, own and shadow ms of every resource, of jobs of 15 ms on A; None for not measured."""
    hand.release(range(W + 1), term)
    for at_ms in (-100, 400):
        hand.windows.loaded(Load("A", 1, at_ms * MS, (100 + at_ms) * MS, 0, 0, hook))
    for cycle in range(told):
        hops = (Hop("see", "A", 0, 1 * MS, 16 * MS), Hop("act0", "A", 0, 0, 1, cpu_ns=7 * MS))
        done = Completion(hand.stamp(cycle, term), "act0", P, "actuated", hops, "A")
        hand.windows.completed(done, P)
    core_ms = (hand.windows.close().core_ns / MS).T.tolist()
    return {
        name: [None if math.isnan(ms) else round(ms, 6) for ms in each]
        for name, each in zip(hand.controller.resources, core_ms, strict=True)
    }


def test_the_hook_of_a_node_is_that_of_its_only_kind_of_accelerators() -> None:
    hand = Hand(accelerated(gpu=2))
    used = accelerated_window(hand, hook=0.6)
    # Of both places; what the CPU does is apart.
    assert used["A.gpu"] == [0.6 * 2 * W * P / MS, 3 * 15, 0]
    assert used["A"] == [W * P / MS, 3 * 7, 0]
    assert used["B"] == [0, 0, 0]


@pytest.mark.parametrize(("kinds", "hook"), [({"gpu": 1}, -1.0), ({"gpu": 1, "npu": 1}, 0.6)])
def test_without_a_hook_of_its_own_an_accelerator_is_as_busy_as_its_jobs_keep_it(
    kinds: dict[str, int], hook: float
) -> None:
    used = accelerated_window(Hand(accelerated(**kinds)), hook=hook)
    assert used["A.gpu"] == [3 * 15, 3 * 15, 0]
    if "npu" in kinds:
        # Nothing of the placement runs there.
        assert used["A.npu"] == [0, 0, 0]


def test_an_accelerator_that_no_job_tells_of_is_not_measured() -> None:
    hand = Hand(accelerated(gpu=1))
    assert accelerated_window(hand, told=0)["A.gpu"] == [None, None, 0]
    elsewhere = Hand(accelerated(gpu=1))
    assert accelerated_window(elsewhere, told=0, term=2)["A.gpu"] == [0, 0, 0]


def test_caps_and_j_do_without_an_accelerator_that_was_not_measured() -> None:
    problem = accelerated(gpu=1)
    objective = dataclasses.replace(
        problem.objective,
        caps=Caps(utilisation=0.9),
        accelerators=accelerator_tiers(problem.fabric.nodes, problem.objective.tiers),
    )
    hand = Hand(dataclasses.replace(problem, objective=objective))
    hand.controller = Controller(hand.problem, "dtp")
    hand.windows = LiveWindows(hand.problem, hand.offsets, hand.controller)
    hand.release(range(W + 1))
    assert len(hand.close()) == W
    (row,) = hand.controller.decisions
    decision = dict(zip(hand.controller.decision_columns, row, strict=False))
    hand.record()
    assert hand.column("windows", "u_A.gpu") == [None]
    assert decision["est_u_A.gpu_NEAR"] is None
    assert decision["eligible_FAR"] is True


def test_a_node_nobody_reports_of_is_idle() -> None:
    hand = Hand()
    hand.windows.loaded(load(100, 5000))
    assert used_ms(hand) == 0.0


def test_instants_that_cannot_be_are_those_of_a_clock_that_was_set() -> None:
    """The sink's clock is a second behind, or ahead, and nobody has compared it since."""
    for ahead_ns in (-S, S):
        hand = Hand()
        hand.offsets = Offsets("A", "A", system_bound_ns=MS)
        hand.windows = LiveWindows(hand.problem, hand.offsets, hand.controller)
        for cycle in range(W + 1):
            stamp = hand.stamp(cycle)
            hand.windows.stamped(stamp, stamp.released_ns)
            done_ns = stamp.released_ns + 10 * MS + ahead_ns
            done = Completion(stamp, "act0", done_ns, "actuated", (), "B")
            hand.windows.completed(done, stamp.released_ns + 12 * MS)
        window = hand.windows.close()
        # By the controller's own clock.
        assert window.latency_ns.tolist() == [12 * MS] * W
        assert hand.windows.last is not None
        assert hand.windows.last.unproven


def test_a_window_on_both_sides_of_a_silence_counts_what_it_knows() -> None:
    hand = Hand()
    hand.release([0, 1, 2, 6, 7])
    for cycle in (0, 1):
        hand.done(cycle)
    window = hand.windows.close()
    # Of 2 the stamp was the last that was heard.
    assert window.latency_ns.tolist() == [10 * MS] * 2
    hand.settle(window)
    hand.record()
    assert hand.column("cycles", "missed") == [False] * W
    assert hand.column("windows", "unproven") == [True]
    assert hand.column("windows", "violation_rate") == [0.0]
