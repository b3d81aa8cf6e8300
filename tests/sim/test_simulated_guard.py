"""The guard in the simulator by hand, in milliseconds: when it moves, holds, and lets go."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import dwell
from dwell.control import guard as control_guard
from dwell.kernels.arrays import back_ns
from dwell.kernels.realisation import LinkSegment, NodeChange
from dwell.model import (
    Constant,
    ControllerSettings,
    Execution,
    Flow,
    Link,
    Node,
    NodeDisturbance,
    Problem,
    Task,
)
from dwell.sim import simulate_realisation
from tests.cells.generated import MS, make_problem, make_realisation
from tests.reference.simulator import way_back
from tests.reference.test_against import Case, Played, Replay, differences
from tests.reference.test_against import play as play_case
from tests.reference.test_against import reference as reference_of

CANONICAL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
MOVES = {"LOC": {"act": "R"}, "OFF": {"act": "E"}, "ALT": {"act": "X"}}
NODES = ("R", "E", "X")


def cell(start_ms: float = 0.0, **settings: Any) -> Problem:
    """Return a cell with windows of four cycles of 10 ms; OFF takes 5 ms a cycle, LOC 3 ms.

    It begins on OFF; the guard waits 30 ms, and hears of everything at once, for the sink is on R.
    """
    links = [
        Link(a, b, Constant(1.0)) for a, b in itertools.permutations(NODES, 2) if "R" in (a, b)
    ]
    return make_problem(
        [Node(name, "robot" if name == "R" else "edge", 8) for name in NODES],
        [
            Task("sense", {"R": Execution(Constant(1.0))}),
            Task(
                "act",
                {name: Execution(Constant(1.0)) for name in NODES},
                start_ms=start_ms,
            ),
            Task("move", {"R": Execution(Constant(1.0))}),
        ],
        [Flow("sense", "act"), Flow("act", "move")],
        links=links,
        candidates=MOVES,
        period_ms=10.0,
        window_cycles=4,
        controller=ControllerSettings(
            **{"on": "R", "initial": "OFF", "fallbacks": ("LOC", "ALT"), **settings}
        ),
    )


def play(
    problem: Problem,
    script: Sequence[str] = ("OFF",),
    *,
    down: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    windows: int = 8,
    **more: Any,
) -> Played:
    """Play orders, the last of them at every close that follows, as the reference does.

    `down` says from when until when, in milliseconds, nodes and links are down.
    """
    changes, segments = [], []
    for name, intervals in (down or {}).items():
        for begin, end in intervals:
            for at_ms, is_down in ((begin, True), (end, False)):
                if "->" in name:
                    segments.append(
                        LinkSegment(round(at_ms * MS), name, is_down, 0.0, float("inf"), ())
                    )
                else:
                    changes.append(NodeChange(round(at_ms * MS), name, 0, is_down))
        if "->" in name:
            segments.append(LinkSegment(0, name, False, 0.0, float("inf"), ()))
    real = make_realisation(
        problem,
        windows=windows,
        node_changes=changes,
        segments=sorted(segments, key=lambda segment: segment.at_ns),
        **more,
    )
    names = [*script, *[script[-1]] * windows][:windows]
    case = Case(problem, real, (problem.initial, *names[:-1], names[-1])[:windows], guarded=True)
    found = play_case(case)
    assert list(differences(case, found, reference_of(case), 0)) == []
    return found


def moves(found: Played) -> list[tuple[int, str, str]]:
    """Moves of the guard: window that begins with it, from where, to where."""
    assert found.decisions is not None
    guard = found.decisions.filter((pl.col("reason") == "guard") & pl.col("migrated"))
    return guard.select("window", "incumbent", "placement").rows()


def placements(found: Played) -> list[tuple[str, int]]:
    """Placements in the order of cycles, and of how many each."""
    return [
        (name, sum(1 for _ in group))
        for name, group in itertools.groupby(found.cycles["placement"].to_list())
    ]


def lost(found: Played) -> list[int]:
    return found.cycles.filter(pl.col("outcome") != "done")["cycle"].to_list()


# ------------------------------------------------------------------------------------- it fires


def test_it_leaves_a_node_that_went_down_and_cuts_the_window_short() -> None:
    # Cycle 4 reaches E at 42 ms; the guard fires at 70 ms, before cycle 7 is released.
    found = play(cell(), down={"E": [(42, 10_000)]})
    assert lost(found) == [4, 5, 6]
    assert moves(found) == [(1, "OFF", "LOC")]
    assert placements(found) == [("OFF", 7), ("LOC", 24)]
    assert found.windows["first_cycle"].to_list() == [0, 7, 11, 15, 19, 23, 27]
    assert not found.windows["mixed"].any()


def test_the_completion_it_waits_for_may_come_at_the_very_instant() -> None:
    slow = {("act", "E"): [1.0, 26.0, *[1.0] * 30]}
    found = play(cell(), exec_ms=slow)
    assert found.cycles["latency_ns"][1] == 30 * MS
    assert moves(found) == []
    slower = {("act", "E"): [1.0, 26.000001, *[1.0] * 30]}
    assert moves(play(cell(), exec_ms=slower)) == [(1, "OFF", "LOC")]


def test_it_hears_of_completions_after_the_way_back() -> None:
    problem = cell()
    tasks = dict(problem.pipeline.tasks)
    tasks["move"] = Task("move", {"E": Execution(Constant(1.0))})
    placed = {name: {**moved, "move": "E"} for name, moved in MOVES.items()}
    fabric = problem.fabric
    far = make_problem(
        list(fabric.nodes.values()),
        list(tasks.values()),
        list(problem.pipeline.flows),
        links=[*fabric.links.values(), Link("X", "E", Constant(1.0))],
        candidates=placed,
        period_ms=10.0,
        window_cycles=4,
        controller=replace(problem.controller, fallbacks=("ALT",)),
    )
    assert {back_ns(far, placement.first) for placement in far.candidates.values()} == {MS}
    # 1 + 1 + 26 + 1 ms, and a way back of 1 ms.
    on_time = {("act", "E"): [1.0, 26.0, *[1.0] * 30]}
    assert moves(play(far, exec_ms=on_time)) == []
    late = {("act", "E"): [1.0, 26.000001, *[1.0] * 30]}
    assert moves(play(far, exec_ms=late)) == [(1, "OFF", "ALT")]


def test_the_way_back_is_the_shortest_and_nothing_where_there_is_none() -> None:
    nodes = [Node(name, "robot", 1) for name in "ABCD"]
    chain = [Task("a", {"A": Execution(Constant(1.0))}), Task("b", {"D": Execution(Constant(1.0))})]
    links = [
        Link("A", "D", Constant(1.0)),
        Link("D", "A", Constant(9.0)),
        Link("D", "C", Constant(2.0)),
        Link("C", "B", Constant(2.5)),
        Link("B", "A", Constant(3.0)),
    ]
    for some, expected_ms in ((links, 7.5), (links[:2], 9.0), (links[:1], 0.0)):
        problem = make_problem(nodes, chain, [Flow("a", "b")], links=some)
        assert back_ns(problem, problem.candidates["LOC"].first) == expected_ms * MS
        assert way_back(problem, problem.candidates["LOC"].first) == expected_ms * MS


def test_single_losses_are_no_reason_while_others_come_in_time() -> None:
    # Every third cycle meets the outage of a millisecond; the next one completes in time.
    blinks = [(10 * k + 1.5, 10 * k + 2.5) for k in range(1, 32, 3)]
    found = play(cell(), down={"E": blinks})
    assert lost(found) == list(range(1, 32, 3))
    assert moves(found) == []


def test_it_begins_anew_when_its_own_node_was_down() -> None:
    # Cycles 4 and 5 are lost with R; when R is up again, nothing is wrong with OFF.
    found = play(cell(), down={"R": [(42, 58)]})
    assert lost(found) == [4, 5]
    assert moves(found) == []
    # A longer outage, in which it would have fired.
    found = play(cell(), down={"R": [(42, 158)]})
    assert lost(found) == list(range(4, 16))
    assert moves(found) == []
    # E went down, too: the first cycle released after R is up is the one that is waited for.
    found = play(cell(), down={"R": [(42, 158)], "E": [(42, 10_000)]})
    assert moves(found) == [(4, "OFF", "LOC")]
    assert placements(found)[0] == ("OFF", 19)


# --------------------------------------------------------------------------- what it moves to


def test_it_takes_the_first_fallback_whose_parts_were_heard() -> None:
    problem = cell(fallbacks=("ALT", "LOC"))
    assert moves(play(problem, down={"E": [(42, 10_000)]})) == [(1, "OFF", "ALT")]
    together = {"E": [(42, 10_000)], "X": [(42, 10_000)]}
    assert moves(play(problem, down=together)) == [(1, "OFF", "LOC")]
    # It fires at 70 ms. What was heard last 21 ms before is missed, node or link; 19 ms before, not
    # yet. What went down with E is missed.
    for part in ("X", "R->X", "X->R"):
        early = {"E": [(42, 10_000)], part: [(49, 10_000)]}
        assert moves(play(problem, down=early)) == [(1, "OFF", "LOC")]
        late = {"E": [(42, 10_000)], part: [(51, 10_000)]}
        # X is tried, completes nothing, and is left again.
        found = play(problem, down=late)
        assert moves(found) == [(1, "OFF", "ALT"), (1, "ALT", "LOC")]
        assert lost(found) == list(range(4, 10))


def test_workers_that_are_still_starting_are_not_there() -> None:
    problem = cell(start_ms=40.0, fallbacks=("ALT",))
    # X is up at 20 ms, and its worker ready at 60 ms.
    found = play(problem, down={"E": [(42, 10_000)], "X": [(0, 20)]})
    assert moves(found) == [(1, "OFF", "ALT")]
    assert placements(found)[0] == ("OFF", 7)
    # Here it is ready at 95 ms: the guard stays armed until then.
    found = play(problem, down={"E": [(42, 10_000)], "X": [(0, 55)]})
    assert placements(found)[:2] == [("OFF", 10), ("ALT", 20)]


def test_it_stays_armed_while_no_fallback_is_whole() -> None:
    problem = cell(fallbacks=("ALT",))
    found = play(problem, down={"E": [(42, 10_000)], "X": [(30, 133)]})
    assert placements(found)[:2] == [("OFF", 14), ("ALT", 16)]
    # Completions flow again before X is up: no reason to move any more.
    found = play(problem, down={"E": [(42, 105)], "X": [(30, 133)]})
    assert moves(found) == []
    assert lost(found) == [4, 5, 6, 7, 8, 9, 10]


def test_it_does_not_move_to_where_it_is() -> None:
    problem = cell(fallbacks=("OFF",))
    found = play(problem, down={"E": [(42, 10_000)]})
    assert moves(found) == []
    # Once another placement has been ordered, OFF is somewhere else.
    found = play(problem, ("OFF", "OFF", "ALT"), down={"E": [(42, 60)], "X": [(100, 10_000)]})
    assert moves(found) == [(3, "ALT", "OFF")]
    # Here OFF was silent before, and the guard had nowhere to go.
    found = play(problem, ("OFF", "OFF", "ALT"), down={"E": [(42, 125)], "X": [(100, 10_000)]})
    assert moves(found) == [(3, "ALT", "OFF")]


def test_it_rests_after_its_own_move() -> None:
    problem = cell(fallbacks=("ALT", "LOC"))
    down = {"E": [(42, 10_000)], "X": [(102, 10_000)]}
    found = play(problem, ("OFF", "ALT"), down=down)
    assert moves(found) == [(1, "OFF", "ALT")]
    assert placements(found) == [("OFF", 7), ("ALT", 24)]
    # A rest of six cycles, for 7 to 12; cycle 13 is old enough at 160 ms.
    found = play(cell(fallbacks=("ALT", "LOC"), probe_cycles=6), ("OFF", "ALT"), down=down)
    assert moves(found) == [(1, "OFF", "ALT"), (3, "ALT", "LOC")]
    assert placements(found) == [("OFF", 7), ("ALT", 9), ("LOC", 16)]


def test_a_fallback_that_the_policy_wants_is_watched_without_an_order() -> None:
    problem = cell(fallbacks=("ALT", "LOC"), probe_cycles=6)
    down = {"E": [(42, 10_000)], "X": [(162, 10_000)]}
    found = play(problem, ("OFF", "ALT"), down=down)
    assert moves(found) == [(1, "OFF", "ALT"), (4, "ALT", "LOC")]
    assert lost(found) == [4, 5, 6, 16, 17, 18]


def test_its_own_moves_in_a_row_double_its_rest() -> None:
    problem = cell(fallbacks=("ALT", "OFF"), probe_cycles=3)
    down = {"E": [(42, 62), (152, 10_000)], "X": [(42, 52), (112, 132)]}
    found = play(problem, ("OFF", "ALT", "OFF", "OFF", "ALT"), down=down, windows=12)
    # To ALT at cycle 7, on watch from cycle 10; to OFF at cycle 14, on watch from cycle 20: OFF has
    # been silent since cycle 15.
    assert [(left, to) for _, left, to in moves(found)] == [
        *(("OFF", "ALT"), ("ALT", "OFF"), ("OFF", "ALT"))
    ]
    assert placements(found)[:3] == [("OFF", 7), ("ALT", 7), ("OFF", 9)]


@pytest.mark.usefixtures("_early_health")
def test_an_order_that_stamps_nothing_before_the_guard_moves_does_not_count() -> None:
    problem = cell(fallbacks=("ALT", "OFF"), probe_cycles=1, order_delay_ms=45.0)
    # Ordered at 190 ms to take effect with cycle 24; X is lost with cycle 19, OFF with cycle 23.
    down = {"E": [(42, 62), (232, 10_000)], "X": [(192, 240)]}
    found = play(problem, down=down, windows=12)
    assert [(left, to) for _, left, to in moves(found)] == [
        *(("OFF", "ALT"), ("ALT", "OFF"), ("OFF", "ALT"))
    ]
    # The second move of its own in a row: a rest of two cycles.
    assert placements(found)[:3] == [("OFF", 7), ("ALT", 15), ("OFF", 5)]


@pytest.mark.usefixtures("_early_health")
def test_what_is_ordered_while_it_rests_is_watched_at_once() -> None:
    problem = cell(fallbacks=("ALT", "OFF"), probe_cycles=3)
    down = {"E": [(42, 62), (152, 240), (332, 10_000)], "X": [(112, 132)]}
    found = play(problem, down=down, windows=14)
    # The third rest would be that of cycles 23 to 34; OFF is proven and ordered for cycle 31.
    assert placements(found)[:5] == [("OFF", 7), ("ALT", 7), ("OFF", 9), ("ALT", 8), ("OFF", 5)]
    assert lost(found) == [4, 5, 6, 11, 12, 13, *range(15, 23), 33, 34, 35]


def test_a_fallback_that_was_ordered_is_watched() -> None:
    found = play(cell(fallbacks=("ALT", "LOC")), ("ALT",), down={"X": [(62, 10_000)]})
    assert moves(found) == [(2, "ALT", "LOC")]


# ------------------------------------------------------------------------------------ rounds


def stuck(*nodes: str) -> dict[tuple[str, str], list[float]]:
    """Execution times, in twelve windows, of stages that end no more from cycle 4 on."""
    return {("act", node): [1.0] * 4 + [1000.0] * 44 for node in nodes}


def test_each_fallback_is_tried_once_and_then_it_rests() -> None:
    problem = cell(fallbacks=("OFF", "ALT", "LOC"), probe_cycles=5)
    found = play(problem, exec_ms=stuck(*NODES), windows=12)
    # ALT, LOC, and OFF last, as it has failed first; each for three cycles; a rest of five cycles
    # from cycle 16 on, and cycle 21 is old enough at 240 ms. Then in the order of the failures.
    assert [(left, to) for _, left, to in moves(found)][:5] == [
        *(("OFF", "ALT"), ("ALT", "LOC"), ("LOC", "OFF")),
        *(("OFF", "ALT"), ("ALT", "LOC")),
    ]
    assert placements(found)[:5] == [("OFF", 7), ("ALT", 3), ("LOC", 3), ("OFF", 11), ("ALT", 3)]


def test_windows_close_while_it_rests() -> None:
    problem = cell(fallbacks=("ALT", "LOC"), probe_cycles=9)
    found = play(problem, exec_ms=stuck(*NODES), windows=12)
    windows = found.windows.filter(pl.col("first_cycle") > 10)
    assert len(windows) >= 2
    assert windows["violation_rate"].to_list() == [1.0] * len(windows)


def test_what_is_back_while_the_others_rest_is_tried_at_once() -> None:
    problem = cell(fallbacks=("LOC", "ALT"), probe_cycles=1000)
    found = play(problem, down={"X": [(42, 203)]}, exec_ms=stuck("R", "E"), windows=12)
    # LOC for three cycles, and a rest; X is back at 203 ms.
    assert placements(found)[:3] == [("OFF", 7), ("LOC", 14), ("ALT", 24)]
    assert lost(found) == list(range(4, 21))


@pytest.mark.usefixtures("_early_health")
def test_after_a_return_that_fails_it_goes_back_to_what_carried_the_cell() -> None:
    problem = cell(fallbacks=("ALT", "LOC"), probe_cycles=3)
    # X is not there when E goes, and LOC carries the cell; OFF is proven, ordered and fails.
    down = {"E": [(42, 62), (150, 10_000)], "X": [(30, 90)]}
    found = play(problem, down=down, windows=12)
    assert [(left, to) for _, left, to in moves(found)][:2] == [("OFF", "LOC"), ("OFF", "LOC")]


# ------------------------------------------------------------------------------ orders and moves


def test_an_order_under_way_is_void() -> None:
    # The order is given at 80 ms and would stamp cycle 13; the guard fires at 100 ms.
    problem = cell(order_delay_ms=45.0)
    found = play(problem, ("OFF", "ALT", "OFF"), down={"E": [(72, 10_000)]})
    assert placements(found)[:2] == [("OFF", 10), ("LOC", 20)]
    assert found.decisions is not None
    rows = found.decisions.select("window", "incumbent", "placement", "reason").rows()
    assert rows[1:3] == [(1, "OFF", "ALT", "migrate"), (2, "OFF", "LOC", "guard")]


def test_a_move_gives_the_new_placement_g_periods() -> None:
    # Cycles 7 and 8 are lost with E; the order moves the cell at 80 ms, and X has 30 ms.
    down = {"E": [(72, 10_000)], "X": [(80, 10_000)]}
    found = play(cell(), ("OFF", "ALT"), down=down)
    assert moves(found) == [(2, "ALT", "LOC")]
    assert placements(found)[:3] == [("OFF", 8), ("ALT", 3), ("LOC", 20)]
    assert lost(found) == [7, 8, 9, 10]


def test_until_an_order_takes_effect_the_old_placement_is_watched() -> None:
    # Two orders in a row that take time; the silence of the first placement is nothing afterwards.
    problem = cell(order_delay_ms=15.0)
    found = play(problem, ("ALT", "OFF"), down={"E": [(32, 48)]})
    assert moves(found) == []
    assert placements(found)[:3] == [("OFF", 6), ("ALT", 6), ("OFF", 20)]


def test_it_cuts_a_cold_migration_short() -> None:
    problem = cell(start_ms=61.0, migration="cold", fallbacks=("ALT",))
    found = play(problem, ("LOC", "OFF"), down={"E": [(72, 10_000)]}, windows=12)
    # Ordered at 40 ms, ready at 101 ms; the guard fires at 100 ms.
    assert moves(found) == [(1, "OFF", "ALT")]
    assert placements(found) == [("OFF", 10), ("ALT", 36)]


def test_a_window_that_closes_at_the_instant_of_a_move_closes_first() -> None:
    found = play(cell(), down={"E": [(52, 10_000)]})
    assert moves(found) == [(2, "OFF", "LOC")]
    assert found.windows["first_cycle"].to_list()[:3] == [0, 4, 8]


def test_a_window_in_its_grace_is_cut_short_too() -> None:
    found = play(cell(close_grace_ms=15.0), down={"E": [(52, 10_000)]})
    assert moves(found) == [(1, "OFF", "LOC")]
    assert found.windows["first_cycle"].to_list()[:3] == [0, 8, 12]


def test_the_run_ends_with_the_last_close_where_no_window_can_follow() -> None:
    found = play(cell(), down={"E": [(42, 10_000)]}, windows=2)
    assert moves(found) == []
    # The guard fires as cycle 4, the first one that it has not heard of, is two periods old.
    assert found.cycles["lead"].to_list() == [False] * 4 + [True] * 3


# ------------------------------------------------------------------------------------ the return


@pytest.fixture
def _early_health(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_guard, "HEALTH_WINDOWS", 2)


@pytest.mark.usefixtures("_early_health")
def test_it_returns_by_an_order_once_probes_have_completed() -> None:
    found = play(cell(probe_cycles=3), down={"E": [(42, 152)]}, windows=10)
    # Moved at cycle 7; from the close at cycle 11 on OFF is wanted, and probes are sent. They are
    # lost until E is up again; those of cycles 15 to 18 complete before the close at cycle 19.
    assert placements(found) == [("OFF", 7), ("LOC", 12), ("OFF", 20)]
    assert found.decisions is not None
    rows = found.decisions.select("window", "placement", "migrated", "reason").rows()
    assert rows[:5] == [
        (0, "OFF", False, "hold"),
        (1, "LOC", True, "guard"),
        (1, "LOC", False, "guard"),
        (2, "LOC", False, "guard"),
        (3, "OFF", True, "migrate"),
    ]
    assert found.windows["shadow_cycles"].to_list()[:5] == [0, 0, 4, 4, 0]
    shadows = found.jobs.filter("shadow")
    assert set(shadows["task"]) == {"act"}
    assert set(shadows["node"]) == {"E"}


@pytest.mark.usefixtures("_early_health")
def test_a_relapse_doubles_the_probes() -> None:
    twice = {"E": [(42, 100), (212, 260)]}
    found = play(cell(probe_cycles=3), down=twice, windows=16)
    assert moves(found) == [(1, "OFF", "LOC"), (5, "OFF", "LOC")]
    # Of the four probes of a window three are enough; then six are needed: a window more.
    held = [count for name, count in placements(found) if name == "LOC"]
    assert held == [8, 12]


@pytest.mark.usefixtures("_early_health")
def test_probes_need_the_time_of_an_order_to_begin() -> None:
    found = play(cell(order_delay_ms=11.0, probe_cycles=3), down={"E": [(42, 100)]}, windows=10)
    # Wanted at 110 ms: cycles from 13 on, of which two complete before the close at 150 ms.
    assert found.windows["shadow_cycles"].to_list()[2:4] == [2, 4]
    assert placements(found) == [("OFF", 7), ("LOC", 14), ("OFF", 16)]


def test_without_enough_probes_it_stays() -> None:
    found = play(cell(), down={"E": [(42, 100)]}, windows=8)
    assert placements(found) == [("OFF", 7), ("LOC", 24)]
    assert found.windows["shadow_cycles"].to_list() == [0, 0, 4, 4, 4, 4, 4]


# ------------------------------------------------------------------------------------ who has it


def simulated(policy: object, guard: bool, **settings: Any) -> dwell.Run:
    problem = cell(**settings)
    outage = make_realisation(problem, windows=8, node_changes=[NodeChange(42 * MS, "E", 0, True)])
    chosen: Any = policy
    return simulate_realisation(problem, outage, policy=chosen, guard=guard)


class Unguarded(Replay):
    """A policy that is not to be moved by anybody else."""

    guarded = False


@pytest.mark.parametrize(
    ("policy", "guard", "settings"),
    [
        (lambda: Replay(["OFF"] * 9), False, {}),
        (lambda: Replay(["OFF"] * 9), True, {"fallbacks": ()}),
        (lambda: Unguarded(["OFF"] * 9), True, {}),
        (lambda: "OFF", True, {}),
    ],
    ids=["not asked for", "no fallbacks", "a policy that is left alone", "it never moves"],
)
def test_who_has_no_guard(
    policy: Callable[[], object], guard: bool, settings: Mapping[str, Any]
) -> None:
    run = simulated(policy(), guard, **settings)
    assert set(run.cycles["placement"]) == {"OFF"}
    assert "guard" not in run.decisions["reason"].to_list()


@pytest.mark.parametrize("policy", ["dtp", "latency-first"])
def test_the_bound_on_the_canonical_cell(policy: str) -> None:
    problem = dwell.load(CANONICAL)
    down = NodeDisturbance("E", at_s=60.0, for_s=40.0, down=True)
    problem = replace(problem, scenarios={"down": (down,)})

    def longest(guard: bool) -> int:
        run = dwell.simulate(
            problem, scenario="down", policy=policy, seed=2, windows=40, guard=guard
        )
        assert run.meta["guard"] is guard
        missing = run.cycles["latency_ns"].is_null().to_list()
        return max(sum(1 for _ in row) for gone, row in itertools.groupby(missing) if gone)

    assert longest(guard=False) > 1000
    assert longest(guard=True) <= problem.controller.guard_cycles + 1


@pytest.mark.parametrize("estimator", ["shadow", "corrected", "scaling"])
def test_probes_do_not_disturb_who_learns(estimator: str) -> None:
    problem = dwell.load(CANONICAL)
    run = dwell.simulate(
        problem,
        scenario="network-impairment",
        policy="latency-first",
        estimator=estimator,
        seed=1,
        windows=60,
        guard=True,
    )
    plain = dwell.simulate(
        problem,
        scenario="network-impairment",
        policy="latency-first",
        estimator=estimator,
        seed=1,
        windows=60,
    )
    # Up to the first move of the guard nothing differs.
    guarded = run.decisions.filter(pl.col("reason") == "guard")
    until = guarded["window"].min() if guarded.height else run.windows.height
    before = pl.col("window") < until
    assert run.decisions.filter(before).equals(plain.decisions.filter(before))


def test_where_it_does_not_fire_nothing_changes() -> None:
    problem = cell(order_delay_ms=3.0, close_grace_ms=4.0)
    problem = replace(
        problem, scenarios={"busy": (NodeDisturbance("R", at_s=0.2, stress_threads=9),)}
    )
    for policy in ("dtp", "latency-first", "work-function"):
        on, off = (
            dwell.simulate(problem, scenario="busy", policy=policy, seed=1, windows=30, guard=guard)
            for guard in (True, False)
        )
        for table in ("cycles", "windows", "decisions"):
            assert getattr(on, table).equals(getattr(off, table))


def test_orders_stay_apart_and_moves_of_the_guard_are_counted_apart() -> None:
    problem = dwell.load(CANONICAL)
    run = dwell.simulate(
        problem, scenario="edge-cpu-stress", policy="dtp", seed=3, windows=150, guard=True
    )
    decisions = run.decisions
    assert decisions["window"].is_sorted()
    assert decisions["window"].max() == run.windows.height - 1
    moves = decisions.filter("migrated").select("window", "reason").rows()
    assert {reason for _, reason in moves} >= {"guard", "infeasible"}
    # A row of the guard has the number of the window that it begins, an order's that of the window
    # at whose close it was given: N_min windows of dwell come before it in either case.
    for (before, why), (window, reason) in itertools.pairwise(moves):
        if reason != "guard":
            assert window - before > problem.controller.min_dwell - (why == "guard")
    # One row a window, and one for every move of the guard.
    assert decisions.height == run.windows.height + [reason for _, reason in moves].count("guard")
