"""The guard: when it fires, that it holds, and what leaves a fallback."""

from __future__ import annotations

import copy
import heapq
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.control import (
    CellGuard,
    Controller,
    Failures,
    Guard,
    Presence,
    Probation,
    Proposal,
    parts_of,
)
from dwell.cost import hamming
from dwell.errors import PolicyError, ProblemError
from dwell.model import Decision, FrozenDict, QoS, Replicas
from dwell.model.chain import ChainPatience
from dwell.model.instants import EVIDENCE_NS
from tests.cells.deterministic import cell

P = 1000
WHOLE = {"LOC": True, "HYB": True, "SO": True}


def guard(*fallbacks: str, g: int = 3, h: int = 5, placement: str = "SO") -> Guard:
    return Guard(
        fallbacks or ("LOC", "HYB"),
        patience_ns=g * P,
        probe_cycles=h,
        placement=placement,
    )


def released(mine: Guard | Probation, cycles: Sequence[int], start: int = 0) -> None:
    """Release cycles one period apart."""
    for i, cycle in enumerate(cycles):
        mine.released(cycle, start + i * P)


def fires(mine: Guard, now_ns: int) -> bool:
    return mine.check(now_ns, WHOLE) is not None


# ---------------------------------------------------------------------------- when it fires


def test_at_the_start_the_first_cycle_released_is_waited_for() -> None:
    mine = guard()
    assert mine.due_ns is None
    assert not fires(mine, 10**9)
    released(mine, [7, 8, 9], start=50)
    assert mine.due_ns == 50 + 3 * P
    assert not fires(mine, 50 + 3 * P - 1)
    assert fires(mine, 50 + 3 * P)


def test_the_highest_cycle_completed_counts_not_the_one_heard_last() -> None:
    mine = guard()
    released(mine, range(5))
    mine.completed(2, 4 * P)
    assert (mine.newest, mine.due_ns) == (2, 3 * P + 3 * P)
    mine.completed(0, 4 * P + 1)
    mine.completed(2, 4 * P + 2)
    assert (mine.newest, mine.due_ns) == (2, 6 * P)
    mine.completed(4, 4 * P + 3)
    assert mine.due_ns is None
    mine.released(5, 5 * P)
    assert mine.due_ns == 8 * P


def test_gaps_in_the_numbers_are_no_silence() -> None:
    mine = guard()
    released(mine, [0, 1, 2])
    mine.completed(2, 2 * P + 5)
    mine.released(1_000_000, 3 * P)
    assert mine.due_ns == 6 * P
    mine.completed(1_000_000, 4 * P)
    assert mine.due_ns is None


def test_idle_cycles_are_not_waited_for_but_shorten_a_rest() -> None:
    mine = guard(h=4)
    mine.released(0, 0, is_idle=True)
    assert mine.due_ns is None
    mine.released(1, P)
    assert mine.due_ns == P + 3 * P
    mine.adopt("LOC", fallback=True)
    mine.released(2, 5 * P)
    mine.released(3, 6 * P, is_idle=True)
    mine.completed(2, 6 * P)
    mine.released(4, 7 * P, is_idle=True)
    mine.released(5, 8 * P)
    assert mine.due_ns is None  # the rest has been four cycles, two of them idle
    mine.released(6, 9 * P)
    assert mine.due_ns == 12 * P


def test_numbers_that_do_not_grow_and_completions_of_nothing_released_are_ignored() -> None:
    mine = guard()
    released(mine, [10, 11])
    mine.released(3, 2 * P)
    mine.completed(12, 2 * P)
    assert (mine.newest, mine.due_ns) == (-1, 3 * P)
    mine.completed(11, 2 * P)
    assert (mine.newest, mine.due_ns) == (11, None)


def test_a_move_gives_the_new_placement_g_periods() -> None:
    mine = guard()
    released(mine, range(4))
    mine.completed(0, 2 * P)
    mine.adopt("HYB")
    assert mine.due_ns is None
    mine.released(4, 4 * P)
    mine.completed(2, 4 * P + 1)
    assert mine.due_ns == 7 * P
    assert mine.check(7 * P, WHOLE) == "LOC"


def test_it_moves_to_the_first_other_fallback_that_is_whole() -> None:
    mine = guard("LOC", "HYB", "SO")
    released(mine, range(3))
    assert mine.check(3 * P, {"LOC": True, "HYB": True}) == "LOC"
    assert mine.check(3 * P, {"LOC": False, "HYB": True, "SO": True}) == "HYB"
    assert mine.check(3 * P, {"LOC": False, "HYB": False, "SO": True}) is None
    # It stays armed, and looks at what is whole when it is asked again.
    assert mine.due_ns == 3 * P
    assert mine.check(9 * P, lambda name: name == "HYB") == "HYB"


def test_a_fallback_that_was_ordered_is_watched_like_any_placement() -> None:
    mine = guard("LOC", "HYB", placement="LOC")
    released(mine, range(3))
    assert mine.check(3 * P, WHOLE) == "HYB"
    only = guard("LOC", placement="LOC")
    released(only, range(3))
    assert only.due_ns is None
    assert not fires(only, 10**9)


def test_after_its_own_outage_it_begins_anew() -> None:
    mine = guard()
    released(mine, range(3))
    mine.restart()
    assert mine.due_ns is None
    mine.released(3, 20 * P)
    assert mine.due_ns == 23 * P


def test_no_fallbacks_no_guard() -> None:
    mine = Guard((), patience_ns=3 * P, probe_cycles=5, placement="SO")
    released(mine, range(9))
    assert mine.due_ns is None
    assert not fires(mine, 10**9)


@pytest.mark.parametrize(("name", "value"), [("patience_ns", 0), ("probe_cycles", 0)])
def test_settings_out_of_their_range_are_refused(name: str, value: int) -> None:
    of = {"patience_ns": 3 * P, "probe_cycles": 5, name: value}
    patience_ns, probe_cycles = of["patience_ns"], of["probe_cycles"]
    with pytest.raises(ProblemError, match=name):
        Guard(("LOC",), patience_ns=patience_ns, probe_cycles=probe_cycles, placement="SO")


def test_it_keeps_no_more_than_it_needs_while_nothing_completes() -> None:
    mine = guard()
    released(mine, range(100_000))
    assert len(mine._silence.waiting) <= 5
    assert fires(mine, 100_000 * P)
    mine.completed(99_998, 100_000 * P)
    assert mine.due_ns == 99_999 * P + 3 * P


@given(
    g=st.integers(2, 6),
    steps=st.lists(
        st.tuples(st.sampled_from(["release", "complete", "wait"]), st.integers(0, 12)),
        max_size=60,
    ),
)
def test_it_is_the_rule_word_for_word(g: int, steps: list[tuple[str, int]]) -> None:
    mine = guard(g=g)
    releases: dict[int, int] = {}
    newest, now = -1, 0
    for what, number in steps:
        if what == "wait":
            now += number * P // 4
        elif what == "release":
            cycle = max(releases, default=-1) + 1 + number // 4
            releases[cycle] = now
            mine.released(cycle, now)
        elif number in releases:
            newest = max(newest, number)
            mine.completed(number, now)
        after = [at for cycle, at in releases.items() if cycle > newest]
        assert fires(mine, now) == bool(after and now - after[0] >= g * P)


# ------------------------------------------------------------------------- the bound of rule 5


def play(
    g: int,
    latencies: Sequence[int],
    *,
    fault: int | None = None,
    orders: Mapping[int, str] | None = None,
    lost: Callable[[int], bool] = lambda cycle: False,
) -> tuple[list[bool], list[tuple[int, str]]]:
    """Play cycles one period apart; from `fault` on, nothing completes but under LOC.

    Returns
    -------
    done : list of bool
        Whether each cycle completed.
    moves : list of (int, str)
        Moves of the guard, with their instants.
    """
    mine = guard("LOC", g=g)
    done = [False] * len(latencies)
    events = [(cycle * P, 1, cycle) for cycle in range(len(latencies))]
    moves = []
    while events:
        now, kind, cycle = heapq.heappop(events)
        due_ns = mine.due_ns
        # A completion at the very instant comes first, and the release of a cycle after the guard.
        if due_ns is not None and (due_ns, 0) < (now, kind):
            heapq.heappush(events, (now, kind, cycle))
            to = mine.check(due_ns, WHOLE)
            assert to == "LOC"
            assert not mine.on_fallback
            mine.adopt(to, fallback=True)
            moves.append((due_ns, to))
            continue
        if kind == 0:
            done[cycle] = True
            mine.completed(cycle, now)
            continue
        # An order that was given before the guard moved dies with its term.
        if orders and cycle in orders and not mine.on_fallback:
            mine.adopt(orders[cycle])
        mine.released(cycle, now)
        end = now + latencies[cycle]
        survives = mine.placement == "LOC" or fault is None or end < fault
        if survives and not lost(cycle):
            heapq.heappush(events, (end, 0, cycle))
    return done, moves


def longest_gap(done: Sequence[bool]) -> int:
    """Most cycles in a row that did not complete."""
    longest = row = 0
    for completed in done:
        row = 0 if completed else row + 1
        longest = max(longest, row)
    return longest


@given(data=st.data(), g=st.integers(2, 6))
def test_after_a_single_fault_at_most_g_plus_1_cycles_are_lost(data: st.DataObject, g: int) -> None:
    latency = st.integers(0, (g - 1) * P - 1)
    latencies = data.draw(st.lists(latency, min_size=3 * g + 9, max_size=3 * g + 20))
    fault = data.draw(st.integers(0, (g + 5) * P))
    done, moves = play(g, latencies, fault=fault)
    assert longest_gap(done) <= g + 1
    assert [to for _, to in moves] == ["LOC"]
    # From the move on every cycle completes.
    first = -(-moves[0][0] // P)
    assert all(done[first:])


@given(data=st.data(), g=st.integers(2, 6))
def test_an_order_within_the_g_periods_at_most_doubles_that(data: st.DataObject, g: int) -> None:
    latencies = data.draw(
        st.lists(st.integers(0, (g - 1) * P - 1), min_size=4 * g + 9, max_size=4 * g + 20)
    )
    fault = data.draw(st.integers(0, (g + 5) * P))
    order = data.draw(st.integers(0, 3 * g + 5))
    done, moves = play(g, latencies, fault=fault, orders={order: "HYB"})
    assert longest_gap(done) <= 2 * g + 1
    assert len(moves) == 1


@given(data=st.data(), g=st.integers(2, 6))
def test_it_never_fires_while_completions_flow(data: st.DataObject, g: int) -> None:
    latencies = data.draw(st.lists(st.integers(0, (g - 1) * P - 1), min_size=1, max_size=60))
    # Single cycles may be lost between others.
    first = data.draw(st.integers(1, 3))
    _, moves = play(g, latencies, lost=lambda cycle: cycle % 4 == first)
    assert not [at for at, _ in moves if at <= (len(latencies) - 1) * P]


@given(data=st.data(), g=st.integers(2, 6), h=st.integers(1, 40))
def test_it_rests_once_its_own_move_carries_and_is_on_watch_again(
    data: st.DataObject, g: int, h: int
) -> None:
    mine = guard(g=g, h=h)
    released(mine, range(g + 1))
    mine.adopt("LOC", fallback=True)
    first = g + 1
    mine.released(first, first * P)
    assert mine.due_ns == (first + g) * P
    mine.completed(first, first * P + 1)
    for cycle in range(first + 1, first + h):
        assert mine.resting
        mine.released(cycle, cycle * P)
        if data.draw(st.booleans()):
            mine.completed(cycle, cycle * P)
        assert mine.due_ns is None
        assert not fires(mine, cycle * P + 100 * P)
    assert not mine.resting
    mine.released(first + h, (first + h) * P)
    assert mine.due_ns == (first + h + g) * P
    assert mine.on_fallback
    assert mine.check((first + h + g) * P, WHOLE) == "HYB"


def test_an_order_ends_its_rest() -> None:
    mine = guard()
    released(mine, range(3))
    mine.adopt("LOC", fallback=True)
    mine.released(3, 3 * P)
    mine.adopt("LOC")
    assert not mine.resting
    mine.released(4, 4 * P)
    assert mine.due_ns == 7 * P


def test_it_waits_for_the_first_cycle_after_its_rest() -> None:
    mine = guard(h=5)
    mine.adopt("LOC", fallback=True)
    assert mine.waits_for == 0
    # The first three are passed over, for the fourth has completed.
    mine.passed(3)
    mine.released(3, 3 * P)
    assert mine.waits_for == 3
    mine.completed(3, 4 * P)
    assert (mine.resting, mine.waits_for) == (True, 5)
    released(mine, [4, 5], start=4 * P)
    assert (mine.resting, mine.waits_for, mine.due_ns) == (False, 5, 8 * P)


def test_its_rest_doubles_with_every_rest_before_an_order_up_to_32_times() -> None:
    mine = guard(h=2)
    last = -1

    def rest() -> int:
        nonlocal last
        count = 0
        while mine.resting:
            last, count = last + 1, count + 1
            mine.released(last, last * P)
            mine.completed(last, last * P)
        return count

    rests = []
    for name in ("LOC", "HYB") * 4:
        mine.adopt(name, fallback=True)
        rests.append(rest())
    assert rests == [2, 4, 8, 16, 32, 64, 64, 64]
    mine.adopt("SO")
    assert rest() == 0
    mine.adopt("LOC", fallback=True)
    assert rest() == 2


# ------------------------------------------------------------------------------------ rounds


class Cell:
    """Cycles one period apart; only placements that are `able` complete them, after `latency`.

    The guard looks as a stamper's does: at its due instants, and four times a period.
    """

    def __init__(self, mine: Guard, *, latency: int = P // 2) -> None:
        self.guard, self.latency = mine, latency
        self.able: set[str] = set()
        self.whole, self.heard = dict(WHOLE), dict(WHOLE)
        self.done: list[bool] = []
        self.moves: list[str] = []
        self.resting: list[bool] = []
        self._ends: list[tuple[int, int]] = []

    def play(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            cycle = len(self.done)
            now = cycle * P
            self.done.append(False)
            self._look(now)
            self.resting.append(self._rests)
            self.guard.released(cycle, now)
            if self.guard.placement in self.able:
                heapq.heappush(self._ends, (now + self.latency, cycle))
            for quarter in range(1, 5):
                self._look(now + quarter * P // 4 - 1)

    @property
    def _rests(self) -> bool:
        """Whether a cycle that is released is not waited for: a fallback carries, or all failed."""
        mine = self.guard
        return mine.resting and (mine.carries or mine._spent_ns is not None)

    def _look(self, now: int) -> None:
        while self._ends and self._ends[0][0] <= now:
            at, cycle = heapq.heappop(self._ends)
            self.done[cycle] = True
            self.guard.completed(cycle, at)
        to = self.guard.check(now, self.whole, self.heard)
        if to is not None:
            self.moves.append(to)
            self.guard.adopt(to, fallback=True)


def test_a_fallback_under_which_nothing_completes_earns_no_rest() -> None:
    cell = Cell(guard("LOC", "HYB", "EDGE", placement="LOC"))
    cell.whole = cell.heard = {"LOC": True, "HYB": True, "EDGE": True}
    cell.able = {"LOC"}
    cell.play(5)
    cell.able = {"EDGE"}
    cell.play(40)
    assert cell.moves == ["HYB", "EDGE"]
    assert longest_gap(cell.done) <= 2 * (3 + 1)
    assert all(cell.done[5 + 2 * 4 : -1])


def test_what_failed_last_is_tried_last_and_each_once_before_it_rests() -> None:
    cell = Cell(guard("LOC", "HYB", "EDGE", h=10, placement="LOC"))
    cell.whole = cell.heard = {"LOC": True, "HYB": True, "EDGE": True}
    cell.play(4 * 4 + 1)
    assert cell.moves == ["HYB", "EDGE", "LOC"]
    cell.play(8)
    assert cell.moves == ["HYB", "EDGE", "LOC"]
    # After the rest another round, in the order of the failures.
    cell.play(6)
    assert cell.moves == ["HYB", "EDGE", "LOC", "HYB", "EDGE"]
    assert cell.guard.resting


def test_a_fallback_that_is_back_while_the_others_rest_is_tried_at_once() -> None:
    cell = Cell(guard("LOC", "HYB", h=1000))
    cell.whole = cell.heard = {"LOC": False, "HYB": True}
    cell.play(40)
    assert cell.moves == ["HYB"]
    cell.able = {"LOC"}
    cell.whole = cell.heard = WHOLE
    cell.play(3)
    assert cell.moves == ["HYB", "LOC"]
    assert all(cell.done[41:-1])


def test_what_is_heard_but_fails_is_tried_after_what_is_whole() -> None:
    cell = Cell(guard("HYB", "LOC"))
    cell.whole = {"LOC": True, "HYB": False}
    cell.play(12)
    assert cell.moves == ["LOC", "HYB"]


def test_after_a_return_that_fails_it_goes_back_to_what_carried_the_cell() -> None:
    cell = Cell(guard("HYB", "LOC", h=5))
    cell.whole = cell.heard = {"HYB": False, "LOC": True}
    cell.able = {"LOC"}
    cell.play(20)
    assert cell.moves == ["LOC"]
    cell.whole = cell.heard = WHOLE
    cell.guard.adopt("SO")
    cell.play(20)
    assert cell.moves == ["LOC", "LOC"]
    assert longest_gap(cell.done[5:]) <= 3 + 1
    # A return that holds, and fails later: the best first.
    cell.able = {"LOC", "SO"}
    cell.guard.adopt("SO")
    cell.play(20)
    cell.able = {"HYB"}
    cell.play(20)
    assert cell.moves == ["LOC", "LOC", "HYB"]


@pytest.mark.parametrize(("completed", "next_one"), [(9, "LOC"), (10, "HYB")])
def test_what_carried_the_cell_comes_first_until_probe_cycles_after_the_return_have_completed(
    completed: int, next_one: str
) -> None:
    mine = guard("HYB", "LOC", h=5)
    mine.adopt("LOC", fallback=True)
    released(mine, range(5))
    mine.completed(4, 4 * P)
    mine.adopt("SO")
    released(mine, range(5, 13), start=5 * P)
    mine.completed(completed, 12 * P)
    assert mine.check(20 * P, WHOLE) == next_one


def test_an_order_begins_anew() -> None:
    cell = Cell(guard("LOC", "HYB", h=1000))
    cell.play(20)
    assert cell.moves == ["LOC", "HYB"]
    assert cell.guard.resting
    cell.guard.adopt("SO")
    cell.play(5)
    assert cell.moves == ["LOC", "HYB", "LOC"]


@given(data=st.data(), g=st.integers(2, 4), h=st.integers(1, 12), f=st.integers(1, 4))
@pytest.mark.parametrize("open_cycles", [1, 5])
def test_f_plus_1_times_g_plus_n_cycles_at_most_once_a_fallback_can_carry(
    open_cycles: int, data: st.DataObject, g: int, h: int, f: int
) -> None:
    # D is n = `open_cycles` periods; the guard's patience is D and g - 1 periods.
    patience = g + open_cycles - 1
    names = [f"F{i}" for i in range(f)]
    everything = ["SO", *names]
    mine = Guard(
        names,
        patience_ns=patience * P,
        probe_cycles=h,
        placement=data.draw(st.sampled_from(everything)),
    )
    cell = Cell(mine, latency=data.draw(st.integers(0, (patience - 1) * P - 1)))
    subsets = st.sets(st.sampled_from(everything))
    for cycles in data.draw(st.lists(st.integers(1, 3 * patience + h), max_size=5)):
        cell.able, whole, heard = (data.draw(subsets) for _ in range(3))
        cell.heard = {name: name in heard | whole for name in everything}
        cell.whole = {name: name in whole for name in everything}
        if data.draw(st.booleans()):
            mine.adopt(data.draw(st.sampled_from(everything)))
        cell.play(cycles)
    # From now on all are heard, and some can carry the cell.
    begun = len(cell.done)
    cell.able = data.draw(st.sets(st.sampled_from(names), min_size=1))
    cell.heard = dict.fromkeys(everything, True)
    cell.whole = {name: name in cell.whole for name in everything}
    cell.play((f + 2) * (patience + 1) + 70 * h)
    known = range(begun, len(cell.done) - patience)
    lost = itertools.takewhile(lambda cycle: not cell.done[cycle], known)
    stretches = itertools.groupby(lost, key=lambda cycle: cell.resting[cycle])
    for resting, stretch in stretches:
        assert resting or len(list(stretch)) <= (f + 1) * (g + open_cycles)
    assert all(cell.done[-patience - 4 : -patience])


# ---------------------------------------------------------------------------- failures


def test_as_many_failures_in_a_row_as_k_none_of_them_old() -> None:
    failures = Failures(["SO"], 3, 2 * P)
    for cycle in range(4):
        failures.released("SO", cycle, cycle * P)
    assert not failures.failing("SO", 4 * P - 1)
    assert failures.failing("SO", 4 * P)
    failures.completed("SO", 1)
    assert not failures.failing("SO", 5 * P)
    for cycle in range(4, 100, 10):
        failures.released("SO", cycle, cycle * P)
    assert failures.failing("SO", 100 * P)
    assert failures.failing("SO", 74 * P + EVIDENCE_NS)
    assert not failures.failing("SO", 74 * P + EVIDENCE_NS + 1)
    failures.completed("SO", 94)
    assert not failures.failing("SO", 100 * P)


def test_numbers_that_do_not_grow_do_not_shorten_its_rest() -> None:
    mine = guard(h=2)
    mine.released(7, 7 * P)
    mine.adopt("LOC", fallback=True)
    for cycle in (6, 7, 8, 8):
        mine.released(cycle, 8 * P)
    assert mine.resting
    mine.released(9, 9 * P)
    assert not mine.resting


# -------------------------------------------------------------------------------- what is whole


def test_what_a_candidate_needs() -> None:
    problem = cell()
    assert parts_of(problem, "LOC") == {"R", "sense@R", "act@R", "plan@R", "control@R"}
    off = {"R", "E", "R->E", "E->R", "sense@R", "act@E", "plan@R", "control@R"}
    assert parts_of(problem, "OFF") == off


def test_a_candidate_is_whole_while_all_of_it_is_heard_within_g_periods() -> None:
    presence = Presence({"LOC": ["R1"], "SO": ["R1", "E"]}, 3 * P)
    assert presence.missing("SO", 0) == {"R1", "E"}
    presence.heard("R1", 0)
    presence.heard("E", P)
    presence.heard("E", 0)
    assert presence.whole("SO", 3 * P - 1)
    assert presence.missing("SO", 3 * P) == {"R1"}
    presence.heard("R1", 2 * P)
    presence.gone("E")
    assert presence.whole("LOC", 3 * P)
    assert presence.missing("SO", 3 * P) == {"E"}
    problem = cell()
    assert not Presence.of(problem).whole("LOC", 10**12)
    period_ns = round(problem.pipeline.period_ms * 1e6)
    assert Presence.of(problem).within_ns == (problem.controller.guard_cycles - 1) * period_ns


# ----------------------------------------------------------------------------------- the return


def test_replicas_are_whole_while_one_member_is() -> None:
    members = {"BOTH": ("LOC", "SO")}
    presence = Presence({"LOC": ["R1", "R2"], "SO": ["R1", "E"]}, 3 * P, members)
    presence.heard("R1", 0)
    assert presence.missing("BOTH", P) == {"R2"}
    presence.heard("E", P)
    assert presence.whole("BOTH", P)
    assert not presence.whole("BOTH", 3 * P)
    assert presence.missing("BOTH", 3 * P) == {"R1"}


@pytest.mark.parametrize(("fallback", "probed"), [("LOC", "OFF"), ("OFF", "LOC"), ("FAR", "LOC")])
def test_probes_of_replicas_go_through_a_member_that_is_not_in_force(
    fallback: str, probed: str
) -> None:
    problem = cell()
    both = Replicas({name: problem.candidates[name] for name in ("LOC", "OFF")})
    mine = CellGuard(replace(problem, candidates={**problem.candidates, "BOTH": both}))
    assert mine.probed is None
    mine.adopt(fallback, fallback=True)
    mine.probation.want("BOTH")
    assert mine.probed == probed
    for name in {*problem.candidates} - {probed}:
        mine.shadow_sent(0, 0, name)
        mine.shadow_arrived(0, 0, name)
    assert mine.probation.done(0) == 0
    for cycle in range(mine.probation.needed):
        assert not mine.probation.proven("BOTH", cycle)
        mine.shadow_sent(cycle, cycle, probed)
        mine.shadow_arrived(cycle, cycle, probed)
    assert mine.probation.proven("BOTH", mine.probation.needed)


def probation(h: int = 3, health: int = 10) -> Probation:
    return Probation(h, health_cycles=health, patience_ns=3 * P)


def test_h_probes_prove_the_placement_that_is_wanted() -> None:
    mine = probation()
    mine.fell()
    mine.want("SO")
    released(mine, range(4))
    for cycle in (0, 2, 2, 1):
        assert not mine.proven("SO", 2 * P + cycle)
        mine.completed(cycle, 2 * P + cycle)
    assert mine.proven("SO", 3 * P)
    assert not mine.proven("HYB", 3 * P)
    mine.want("SO")
    assert mine.proven("SO", 3 * P)
    mine.want("HYB")
    assert not mine.proven("HYB", 3 * P)
    # A late probe through SO says nothing of HYB.
    mine.completed(3, 3 * P)
    mine.released(4, 4 * P)
    mine.completed(4, 4 * P)
    assert "1 of 3 through 'HYB'" in repr(mine)


def test_the_probes_of_a_wish_begin_with_its_first_cycle() -> None:
    mine = probation(1)
    mine.want("SO", first=2)
    released(mine, range(3))
    for cycle, proven in ((0, False), (1, False), (2, True)):
        mine.completed(cycle, 2 * P + cycle)
        assert mine.proven("SO", 2 * P + cycle) == proven


def test_a_silence_that_would_make_the_guard_fire_begins_the_count_anew() -> None:
    mine = probation()
    mine.want("SO")
    released(mine, range(6))
    mine.completed(0, P)
    mine.completed(1, 2 * P)
    # Cycle 2 is older than three periods; a completion at that very instant would have counted.
    mine.completed(4, 5 * P + 1)
    mine.completed(5, 6 * P)
    assert not mine.proven("SO", 6 * P)
    mine.released(6, 6 * P)
    mine.completed(6, 7 * P)
    assert mine.proven("SO", 7 * P)
    mine.released(7, 7 * P)
    assert not mine.proven("SO", 10 * P)


def test_a_wish_that_ends_forgets_its_probes() -> None:
    mine = probation(1)
    mine.want("SO")
    mine.released(0, 0)
    mine.completed(0, 1)
    assert mine.proven("SO", 1)
    mine.want(None)
    mine.want("SO")
    assert not mine.proven("SO", 1)


def test_h_doubles_with_relapses_and_halves_with_health() -> None:
    mine = probation()
    mine.healthy(100)
    mine.fell()
    assert mine.needed == 3
    mine.left()
    mine.healthy(9)
    mine.fell()
    assert mine.needed == 6
    # Under the fallback nothing that completes is health.
    mine.healthy(1000)
    assert mine.needed == 6
    mine.left()
    mine.fell()
    assert mine.needed == 12
    mine.left()
    mine.healthy(5)
    mine.healthy(5)
    assert mine.needed == 6
    mine.fell()
    assert mine.needed == 6
    mine.left()
    mine.healthy(10_000)
    assert mine.needed == 3


def test_h_has_a_cap() -> None:
    mine = probation()
    for _ in range(40):
        mine.fell()
        mine.left()
    assert mine.needed == 3 * 32


# ------------------------------------------------------------------------------- the controller


class Wishful:
    """Wants one candidate, and remembers every decision and move in a list that all copies have."""

    def __init__(self, name: str) -> None:
        self.name, self.decided, self.told = name, 0, list[str]()

    def start(self, problem: object) -> None:
        """Begin."""

    def adopt(self, name: str) -> None:
        """Note where the cell is."""
        self.told.append(name)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Want the same as ever."""
        self.decided += 1
        return self.name


SEEN = QoS(10.0, 0.0, FrozenDict({"R": 0.1, "E": 0.1}))
OWN = {"R": 0.1, "E": 0.1}


def decide(controller: Controller, seen: QoS = SEEN, *, proven: str | None = None) -> str:
    """Have it decide on a window, and carry that out."""
    return settle(controller, controller.propose_by(seen, OWN), proven=proven)


def settle(controller: Controller, proposal: Proposal, *, proven: str | None = None) -> str:
    """Carry a proposal out, and count its window."""
    placement = controller.settle(proposal, proven=proven)
    controller.looked = controller.looked._replace(window=controller.looked.window + 1)
    return placement


def where(controller: Controller) -> tuple[str, str, int]:
    """Return the incumbent, the one before, and n_d."""
    course = controller.course
    return course.placement, course.previous, course.dwell


def shown(controller: Controller) -> list[tuple[object, ...]]:
    return [row[:6] for row in controller.decisions]


def test_the_guards_move_is_in_the_log_and_in_the_next_windows_cost() -> None:
    controller = Controller(cell(estimator="profile"), policy="dtp")
    initial = decide(controller)
    assert initial == "LOC"
    controller.adopt("OFF")
    assert where(controller) == ("OFF", "LOC", 0)
    assert controller.course.by_guard
    moved = controller.propose_by(SEEN, OWN)
    settle(controller, moved)
    assert shown(controller) == [
        (0, "LOC", "LOC", False, "dwell", 1),
        (1, "LOC", "OFF", True, "guard", 0),
        (1, "OFF", "OFF", False, "dwell", 1),
    ]
    names = controller.decision_columns
    assert {len(row) for row in controller.decisions} == {len(names) + 1}
    stayed = controller.propose_by(SEEN, OWN)
    candidates = controller.problem.candidates
    switching = controller.problem.objective.weights.switching
    assert moved.seen[2] - stayed.seen[2] == pytest.approx(
        switching * hamming(candidates["OFF"], candidates["LOC"])
    )


def test_an_order_under_way_is_void() -> None:
    controller = Controller(cell(estimator="profile"), policy=Wishful("FAR"))
    assert decide(controller) == "FAR"
    controller.adopt("OFF", left="LOC")
    assert shown(controller)[-1] == (1, "LOC", "OFF", True, "guard", 0)
    assert where(controller) == ("OFF", "LOC", 0)
    policy = controller.policy
    assert isinstance(policy, Wishful)
    assert policy.told == ["LOC", "OFF"]


def test_a_fallback_is_left_only_for_what_is_proven() -> None:
    controller = Controller(cell(estimator="profile"), policy=Wishful("FAR"))
    controller.adopt("OFF")
    assert decide(controller) == "OFF"
    assert (controller.course.wanted, controller.course.by_guard) == ("FAR", True)
    assert decide(controller, proven="LOC") == "OFF"
    assert decide(controller, proven="FAR") == "FAR"
    assert (controller.course.wanted, controller.course.by_guard) == (None, False)
    assert shown(controller) == [
        (0, "LOC", "OFF", True, "guard", 0),
        (0, "OFF", "OFF", False, "guard", 0),
        (1, "OFF", "OFF", False, "guard", 0),
        (2, "OFF", "FAR", True, "migrate", 0),
    ]


def test_a_decision_that_is_held_back_has_not_been_made() -> None:
    policy = Wishful("FAR")
    controller = Controller(cell(estimator="profile"), policy=policy)
    controller.adopt("OFF")
    for _ in range(3):
        decide(controller)
    held = controller.policy
    assert isinstance(held, Wishful)
    # The second telling settles the switching term of the move, which one window has paid for.
    assert (held.decided, held.told) == (0, ["OFF", "OFF"])
    assert policy.told == []


def test_after_the_guard_dtp_dwells_then_wants_and_leaves_once_proven() -> None:
    problem = cell(estimator="profile")
    settings = replace(problem.controller, min_dwell=2)
    controller = Controller(replace(problem, controller=settings), policy="dtp")
    controller.adopt("FAR")
    bad = replace(SEEN, l95_ms=60.0, violation_rate=1.0)
    for _ in range(4):
        decide(controller, bad)
    wanted = controller.course.wanted
    assert wanted is not None
    assert [row[4] for row in controller.decisions[1:]] == ["dwell", "dwell", "guard", "guard"]
    assert [row[5] for row in controller.decisions[1:]] == [1, 2, 2, 2]
    assert decide(controller, bad, proven=wanted) == wanted
    assert shown(controller)[-1] == (4, "FAR", wanted, True, "migrate", 0)


def test_an_order_that_was_refused_has_moved_nothing() -> None:
    problem = cell(estimator="profile")
    settings = replace(problem.controller, min_dwell=1)
    controller = Controller(replace(problem, controller=settings), policy="dtp")
    bad = replace(SEEN, l95_ms=60.0, violation_rate=1.0)
    first = controller.propose_by(bad, OWN)
    settle(controller, first)
    refused = controller.propose_by(bad, OWN)
    wanted = refused.decision.name
    assert wanted != "LOC"
    controller.reject(refused, "no answer")
    controller.looked = controller.looked._replace(window=2)
    assert where(controller) == ("LOC", "LOC", 0)
    assert controller.decisions[-1][-1] == f"{wanted}: no answer"
    third = controller.propose_by(bad, OWN)
    settle(controller, third)
    # The same window costs the same as the first one, and the policy dwells on LOC again.
    assert third.seen == first.seen
    assert shown(controller)[1:] == [
        (1, "LOC", "LOC", False, "migrate", 0),
        (2, "LOC", "LOC", False, "dwell", 1),
    ]
    controller.adopt("OFF")
    decide(controller, bad)
    proven = controller.propose_by(bad, OWN)
    assert proven.decision.name == wanted
    controller.reject(proven)
    assert (controller.course.placement, controller.course.by_guard) == ("OFF", True)
    assert shown(controller)[-1] == (4, "OFF", wanted, True, "migrate", 0)


def test_a_proposal_changes_nothing_until_it_is_known_what_comes_of_it() -> None:
    problem = cell(estimator="profile")
    settings = replace(problem.controller, min_dwell=1)
    for policy in ("dtp", "cusum", "work-function", "atp", "latency-first", "LOC"):
        controller = Controller(replace(problem, controller=settings), policy=policy)
        bad = replace(SEEN, l95_ms=60.0, violation_rate=1.0)
        for _ in range(4):
            before = copy.deepcopy(vars(controller.policy)["_standing"]), where(controller)
            proposal = controller.propose_by(bad, OWN)
            again = controller.propose_by(bad, OWN)
            assert (proposal.decision, proposal.after) == (again.decision, again.after)
            assert (vars(controller.policy)["_standing"], where(controller)) == before
            controller.commit(proposal)


def test_a_fallback_that_is_no_candidate_is_refused() -> None:
    controller = Controller(cell(estimator="profile"))
    with pytest.raises(PolicyError, match="'NONE' is no candidate"):
        controller.adopt("NONE")


def test_a_policy_that_cannot_be_told_hears_what_it_lacks() -> None:
    problem = cell(estimator="profile")

    class Deaf:
        def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Decision:
            return Decision(problem.candidates["LOC"], "LOC", False, "hold")

    controller = Controller(problem, policy=Deaf())
    decide(controller)
    controller.adopt("OFF")
    with pytest.raises(PolicyError, match=r"needs adopt\(name\)"):
        decide(controller)


# -------------------------------------------------------------------------------------- chains


def chained(*fallbacks: str, every: int = 2, patience: int = 8, h: int = 5) -> Guard:
    """A guard of cycles (3 periods) and of a chain with an origin in each `every`-th cycle."""
    return Guard(
        fallbacks or ("LOC", "HYB"),
        patience_ns=3 * P,
        probe_cycles=h,
        placement="SO",
        chains={"see": ChainPatience(patience * P, every)},
    )


def test_the_age_of_the_newest_origin_counts_while_cycles_complete() -> None:
    mine = chained()
    for cycle in range(8):
        mine.released(cycle, cycle * P)
        mine.completed(cycle, cycle * P)
    assert (mine.chains, mine.due_ns) == (("see",), 8 * P)
    mine.actuated("see", 4)
    assert mine.due_ns == 4 * P + 8 * P
    mine.actuated("see", 2)
    assert not fires(mine, 12 * P - 1)
    assert fires(mine, 12 * P)


def test_a_placement_carries_the_cell_once_the_chain_has_actuated_from_it() -> None:
    mine = chained("LOC", "HYB", h=2)
    for cycle in range(9):
        mine.released(cycle, cycle * P)
        mine.completed(cycle, cycle * P)
    assert mine.check(8 * P, WHOLE) == "LOC"
    mine.adopt("LOC", fallback=True)
    for cycle in range(9, 13):
        mine.released(cycle, cycle * P)
        mine.completed(cycle, cycle * P)
    mine.actuated("see", 6)  # of the placement before
    assert not mine.carries
    # Its first origin is cycle 10; HYB is next, as LOC has not carried the chain.
    assert mine.due_ns == 18 * P
    assert mine.check(18 * P, WHOLE) == "HYB"
    mine.actuated("see", 10)
    assert mine.carries


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("g", [2, 4])
@pytest.mark.parametrize("m", [1, 3])
def test_f_plus_1_times_g_plus_m_origins_at_most_without_an_actuation(
    m: int, g: int, every: int
) -> None:
    names = ["F0", "F1", "F2"]
    mine = chained(*names, every=every, patience=(m + g - 1) * every)
    whole = dict.fromkeys([*names, "SO"], True)
    lost = 0
    for cycle in range(50, 50 + 4 * (m + g) * every):
        now = cycle * P
        if to := mine.check(now, whole):
            mine.adopt(to, fallback=True)
        if mine.placement == "F2" and cycle % every == 0:
            break
        mine.released(cycle, now)
        mine.completed(cycle, now)
        lost += cycle % every == 0
    assert mine.placement == "F2"
    assert 3 * (m + g - 1) <= lost <= 4 * (g + m)
