"""What a controller says is wrong with its cell, on the in-memory network."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from dwell.live.roles.health import diagnose, silent_after_ns, window_late_ns
from dwell.live.stage import Message
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.signing import Seals
from dwell.live.wire.wiring import roles
from dwell.model import Problem
from tests.live.memory_transport import Clock
from tests.live.small_world import EXEC_MS, MS, Arm, Bench, Passing, World, canonical, on


class Raising(Passing):
    """A stage that sees nothing."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        raise ValueError("no light")


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(20, fallbacks=("LOC", "HYB", "SO"), estimator="profile")


def running(problem: Problem, **more: Any) -> World:
    world = World(problem, policy="LOC", **more)
    world.run(5_000)
    return world


def silence_ms(world: World) -> float:
    return silent_after_ns(world.problem) / MS


def test_a_cell_that_is_well_has_no_headline(problem: Problem) -> None:
    for mode in ("control", "advise"):
        world = running(replace(problem, live=replace(problem.live, mode=mode)))
        found = world.status
        assert (found["health"], found["headline"]) == ("ok", None)
        assert found["window"]["age_ms"] <= problem.window_cycles * problem.pipeline.period_ms
        assert all(one["heard"] and one["ready"] for one in found["processes"].values())


def test_without_the_relay_the_controller_says_that_it_hears_nobody(problem: Problem) -> None:
    world = running(problem)
    world.kill("agent@E")
    world.run(silence_ms(world) / 2)
    assert world.status["health"] == "ok"
    world.run(silence_ms(world))
    found = world.status
    assert found["health"] == "silent"
    assert "the controller hears nobody since" in found["headline"]
    assert "the relay, agent E, is silent" in found["headline"]
    assert not any(one["ready"] for one in found["processes"].values())
    world.start("agent@E")
    world.run(2_000)
    assert world.status["headline"] is None


def test_what_was_never_heard_counts_from_the_controllers_beginning(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    for role in roles(world.problem):
        if role.kind != "controller":
            world.kill(role.who)
    world.run(window_late_ns(world.problem) / MS + 1_000)
    found = world.status
    assert found["health"] == "silent"
    assert "no window since" in found["headline"]


@pytest.mark.parametrize("who", ["perception@E", "agent@R1"])
def test_a_frozen_process_is_named_and_windows_go_on(problem: Problem, who: str) -> None:
    world = running(problem)
    world.network.freeze(who)
    world.run(silence_ms(world) + 2_000)
    found = world.status
    assert found["health"] == "degraded"
    assert found["headline"].startswith(f"{who} is silent since ")
    world.network.thaw(who)
    world.run(2_000)
    assert world.status["health"] == "ok"


def test_a_node_that_is_gone_is_named_once(problem: Problem) -> None:
    world = running(problem)
    there = [role.who for role in roles(world.problem) if role.node == "R2"]
    for who in there:
        world.kill(who)
    world.run(window_late_ns(world.problem) / MS)
    headline = world.status["headline"]
    assert "nothing is heard of R2 since" in headline
    assert not any(who in headline for who in there)


def test_without_a_stamper_there_is_no_window(problem: Problem) -> None:
    world = running(problem)
    world.kill("stamper@R1")
    world.run(window_late_ns(world.problem) / MS + 2_000)
    found = world.status
    assert found["health"] == "stalled"
    assert "no window since" in found["headline"]
    assert "stamper@R1 is silent since" in found["headline"]


def test_windows_that_stop_are_told_though_everybody_is_heard(problem: Problem) -> None:
    world = World(
        replace(problem, live=replace(problem.live, release="frames")),
        policy="LOC",
    )
    # No frame ever comes.
    world.run(window_late_ns(world.problem) / MS + 2_000)
    found = world.status
    assert all(one["heard"] for one in found["processes"].values())
    assert found["health"] == "stalled"
    assert "no window since" in found["headline"]


def test_windows_without_a_completed_cycle_are_told_with_a_reason(problem: Problem) -> None:
    world = World(problem, policy="LOC", stages={"control": Raising})
    world.run(8_000)
    found = world.status
    assert found["health"] == "stalled"
    assert "no light" in found["headline"]


def test_a_process_that_is_not_ready_is_told_with_a_reason(problem: Problem) -> None:
    world = running(problem)
    found = world.status
    found["processes"]["planning@E"] |= {"ready": False, "note": "no model\nand more"}
    health, headline = diagnose(world.problem, found)
    assert (health, headline) == ("degraded", "planning@E is not ready: no model")


def test_who_differs_is_named_and_not_called_silent(problem: Problem) -> None:
    world = running(problem)
    found = world.status
    found["processes"]["agent@R1"] |= {"heard": False, "ready": False}
    found["strangers"] = {"agent@R1": "agent@R1 has another cell file"}
    assert diagnose(world.problem, found) == ("degraded", "agent@R1 has another cell file")


def test_of_a_node_that_is_drained_nothing_need_be_heard(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, relay="R1"))
    world = running(cell)
    role = world.cell
    role.wishes.drained.add("E")
    for process in roles(world.problem):
        if process.node == "E" and process.kind != "controller":
            world.kill(process.who)
    world.run(silence_ms(world) + 2_000)
    assert world.status["headline"] is None


def test_another_version_on_a_node_that_is_drained_is_named_and_no_fault(
    problem: Problem,
) -> None:
    world = running(problem)
    world.cell.wishes.drained.add("R2")
    found = world.status
    why = "planning@R2 runs Dwell 9.9"
    found["strangers"] = {"planning@R2": why, "planning@R2.shadow": why}
    assert diagnose(world.problem, found) == ("ok", None)
    found["drained"] = []
    assert diagnose(world.problem, found) == ("degraded", f"{why}; {why}")


def test_a_headline_names_a_few_and_counts_the_others(problem: Problem) -> None:
    world = running(problem)
    found = world.status
    workers = [who for who in found["processes"] if who.startswith(("perception", "planning"))]
    for who in workers:
        found["processes"][who] |= {"ready": False}
    _, headline = diagnose(world.problem, found)
    assert headline is not None
    assert f"and {len(workers) - 3} more" in headline


# ------------------------------------------------------------------- what the cycles say


class Refusing(Arm):
    """An actuator that raises."""

    def apply(self, command: Message) -> None:
        raise OSError("the bus is off")


class Fifth(Passing):
    """A stage that raises in one cycle of five."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        if next(iter(inputs.values())).cycle % 5 == 0:
            raise ValueError("too dark")
        return super().process(inputs)


def two_windows(world: World) -> None:
    """Let two windows close, whenever the last one did."""
    cell = world.problem
    world.run(3 * cell.window_cycles * cell.pipeline.period_ms + cell.controller.close_grace_ms)


def told(world: World) -> tuple[str, str]:
    found = world.status
    return found["health"], found["headline"] or ""


def test_an_actuator_that_refuses_every_command_degrades_the_cell(problem: Problem) -> None:
    world = running(problem)
    arm, world.sink.actuator = world.sink.actuator, Refusing()
    world.run(500)
    health, headline = told(world)
    assert health == "degraded"
    assert "sink.control@R2 has applied nothing since" in headline
    assert "apply() raised OSError: the bus is off" in headline
    two_windows(world)
    health, headline = told(world)
    assert health == "degraded"
    assert "V_D is 100.00 % in the last 3 windows" in headline
    assert world.status["window"]["violation_rate"] == 1.0
    world.sink.actuator = arm
    two_windows(world)
    assert told(world) == ("ok", "")
    assert world.status["guard_moves"] == world.status["migrations"] == 0


@pytest.mark.parametrize(("degraded_at", "health"), [(0.1, "degraded"), (0.3, "ok")])
def test_a_stage_that_fails_now_and_then_degrades_the_cell(
    problem: Problem, degraded_at: float, health: str
) -> None:
    live = replace(problem.live, degraded_at=degraded_at, max_age_ms=200)
    world = running(replace(problem, live=live), stages={"perception": Fifth})
    found, headline = told(world)
    assert found == health
    if health == "degraded":
        # A stage that sends nothing is no link that loses something.
        assert "do not reach" not in headline
        why = r"V_D is 20.00 % in the last 3 windows: perception on R1: cycle \d+: process\(\)"
        assert re.search(f"{why} raised ValueError: too dark", headline)
        world.worker("perception@R1").stage = Passing("perception")
        two_windows(world)
        assert told(world) == ("ok", "")


def test_commands_that_are_stale_by_a_clock_degrade_the_cell(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, clock="system"))
    world = running(cell, clocks={"R2": Clock(5_000 * MS)})
    assert not world.cycles
    health, headline = told(world)
    assert health == "degraded"
    assert "sink.control@R2 has applied nothing since" in headline
    assert "older than max_age_ms" in headline
    assert world.status["window"]["violation_rate"] == 1.0
    world.network.set_clock("R2", Clock())
    two_windows(world)
    assert told(world) == ("ok", "")


def test_images_that_do_not_arrive_are_named(problem: Problem) -> None:
    cell = replace(on(problem, "SO"), controller=replace(problem.controller, initial="SO"))
    world = World(replace(cell, controller=replace(cell.controller, fallbacks=())), policy="SO")
    world.run(5_000)
    assert told(world) == ("ok", "")
    # Beats get through.
    cut = world.network.cut("sensing@R1", "perception@E", key="**/in/**")
    world.run(700)
    assert told(world)[0] == "degraded"
    two_windows(world)
    health, headline = told(world)
    assert health == "stalled"
    assert "images of sensing@R1 do not reach perception@E" in headline
    world.network.heal(cut)
    two_windows(world)
    assert told(world) == ("ok", "")


def test_a_candidate_whose_shadows_all_fail_is_named(problem: Problem) -> None:
    settings = replace(problem.controller, estimator="shadow", shadow_fraction=0.2)
    world = running(replace(problem, controller=settings))
    assert told(world) == ("ok", "")
    cut = world.network.cut("sensing@R1", "perception@E.shadow", key="**/in/**")
    world.run(2_000)
    health, headline = told(world)
    assert health == "degraded"
    for name in ("SO", "HYB"):
        assert f"the last 4 shadows through {name} have failed: images of sensing@R1" in headline
    assert "do not reach perception@E" in headline
    world.network.heal(cut)
    world.run(2_000)
    assert told(world) == ("ok", "")


def test_a_shadows_stage_that_fails_is_the_reason(problem: Problem) -> None:
    settings = replace(problem.controller, estimator="shadow", shadow_fraction=0.2)
    world = running(replace(problem, controller=settings))
    world.worker("planning@E.shadow").stage = Raising("planning")
    world.run(2_000)
    health, headline = told(world)
    assert health == "degraded"
    assert "planning@E.shadow" in headline or "the last 4 shadows through SO" in headline
    assert "no light" in headline


def test_shadows_through_a_node_that_is_drained_may_fail(problem: Problem) -> None:
    settings = replace(problem.controller, estimator="shadow", shadow_fraction=0.2)
    world = running(replace(problem, controller=settings))
    world.cell.wishes.drained.add("E")
    for who in ("perception@E.shadow", "planning@E.shadow"):
        world.kill(who)
    world.run(2_000)
    assert told(world) == ("ok", "")


# --------------------------------------------------------- commands that come too seldom


class Camera:
    """A source that has frames at a rate of its own, in a cell of 15 cycles a second."""

    def __init__(self, problem: Problem, hz: float, max_age_ms: float) -> None:
        pipeline = replace(problem.pipeline, period_ms=1_000 / 15, deadline_ms=1_000 / 15)
        live = replace(problem.live, release="frames", max_age_ms=max_age_ms)
        self.world = World(replace(problem, pipeline=pipeline, live=live), policy="LOC")
        self.hz = hz
        self._frame()

    def _frame(self) -> None:
        network = self.world.network
        self.world.worker("sensing@R1").framed(network.now_ns)
        network.call_at(network.now_ns + round(1e9 / self.hz), self._frame)


@pytest.mark.parametrize(
    ("hz", "max_age_ms", "words"),
    [
        (4, 200, "4 cycles a second of 15: cycles come every 250 ms, max_age_ms is 200"),
        (10, 400, "10 cycles a second of 15"),
        (26, 400, "26 cycles a second of 15"),
    ],
)
def test_a_camera_at_another_rate_degrades_the_cell(
    problem: Problem, hz: float, max_age_ms: float, words: str
) -> None:
    camera = Camera(problem, 15, max_age_ms)
    camera.world.run(8_000)
    assert told(camera.world) == ("ok", "")
    camera.hz = hz
    camera.world.run(1_500)
    looks = []
    for _ in range(60):
        camera.world.run(250)
        looks.append(told(camera.world))
    assert {health for health, _ in looks} == {"degraded"}
    assert all(words in headline for _, headline in looks[12:]), looks
    camera.hz = 15
    camera.world.run(8_000)
    assert told(camera.world) == ("ok", "")


def test_each_silence_is_counted_in_its_window_and_in_all(problem: Problem) -> None:
    camera = Camera(problem, 4, 200)
    world = camera.world
    world.run(21_000)
    found = world.status
    assert found["recent"]["silences"] == [20, 20, 20]
    assert world.arm.silences - 1 <= found["silences"] <= world.arm.silences
    assert "hold() was called 60 times in the last 3 windows: cycles come" in found["headline"]
    assert found["release_ratio"] == pytest.approx(4 / 15)


@pytest.mark.parametrize("apart", [1, 2])
def test_silences_in_two_of_three_windows_degrade_the_cell(problem: Problem, apart: int) -> None:
    # No share of cycles that are lost degrades it.
    live = replace(problem.live, max_age_ms=100, degraded_at=1)
    world = running(replace(problem, live=live))
    window_ms = problem.window_cycles * problem.pipeline.period_ms
    for count in (1, 2):
        cut = world.network.cut("*", "sink.control@R2", key="**/sink/**")
        world.run(200)
        world.network.heal(cut)
        world.run(window_ms - 200)
        assert told(world)[0] == "ok"
        world.run((apart - 1) * window_ms if count == 1 else window_ms / 2)
    assert told(world)[0] == "degraded"
    assert "hold() was called 2 times in the last 3 windows" in told(world)[1]
    world.run(3 * window_ms)
    assert told(world) == ("ok", "")


def test_two_windows_of_three_with_few_commands_degrade_the_cell(problem: Problem) -> None:
    live = replace(problem.live, max_age_ms=200, degraded_at=0.08)
    world = running(replace(problem, live=live))
    window_ms = problem.window_cycles * problem.pipeline.period_ms
    # In each of two windows 2 of 20, and none in the third: less than the share of all.
    for _ in range(2):
        cut = world.network.cut("*", "sink.control@R2", key="**/sink/**")
        world.run(2 * problem.pipeline.period_ms)
        world.network.heal(cut)
        world.run(window_ms - 2 * problem.pipeline.period_ms)
    world.run(window_ms / 2)
    health, headline = told(world)
    assert health == "degraded"
    assert "93% of the commands are known to have been applied in the last 3 windows" in headline
    world.run(2 * window_ms)
    assert told(world) == ("ok", "")


def test_cycles_that_a_move_keeps_out_of_all_windows_count(problem: Problem) -> None:
    """The guard's moves begin a new window each time: most lost cycles are in none."""
    world = running(problem)
    for count in range(12):
        cut = world.network.cut("*", "sink.control@R2", key="**/sink/**")
        world.run(5 * problem.pipeline.period_ms)
        world.network.heal(cut)
        world.run(problem.window_cycles * problem.pipeline.period_ms + 250)
        assert told(world)[0] == ("degraded" if count else "ok")
    assert world.status["guard_moves"] > 5


def test_a_cell_whose_stamps_nobody_hears_is_watched_all_the_same(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    world.network.cut("stamper@R1", "controller@E", key="**/stamped")
    world.run(5_000)
    assert told(world) == ("ok", "")


def test_nothing_is_said_of_cycles_before_the_first_window_is_due(problem: Problem) -> None:
    world = World(problem, policy="LOC")
    world.sink.actuator = Refusing()
    window_ms = problem.window_cycles * problem.pipeline.period_ms
    world.run(window_ms)
    assert told(world) == ("ok", "")
    world.run(window_ms)
    assert told(world)[0] == "degraded"


def test_a_cell_that_starts_slowly_lacks_no_window_yet(problem: Problem) -> None:
    """Its last process comes late: there has been no cycle until then."""
    world = World(problem, policy="LOC")
    world.kill("perception@R1")
    world.run(window_late_ns(world.problem) / MS - 500)
    world.start("perception@R1")
    world.run(1_000)
    assert told(world) == ("ok", "")


# ---------------------------------------------------------------------------- slow stages


class Nothing(Passing):
    """A stage that forgets to return its output."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        return None  # type: ignore[return-value]


def with_input(problem: Problem, task: str, depth: int) -> Problem:
    tasks = dict(problem.pipeline.tasks)
    tasks[task] = replace(tasks[task], depth=depth)
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))


@pytest.mark.parametrize("max_age_ms", [None, 500.0], ids=["stale", "late"])
@pytest.mark.parametrize("placement", ["LOC", "SO"])
def test_a_stage_that_takes_longer_than_a_period_is_named(
    problem: Problem, placement: str, max_age_ms: float | None
) -> None:
    controller = replace(problem.controller, fallbacks=())
    live = replace(problem.live, max_age_ms=max_age_ms)
    cell = on(replace(problem, live=live, controller=controller), placement)
    world = World(cell, policy=placement, exec_ms={**EXEC_MS, "perception": 76.0})
    named = 0
    detector = f"perception@{cell.candidates[placement]['perception']}"
    world.run(750)  # the first cycles are on their way
    for _ in range(100):
        world.run(100)
        health, headline = told(world)
        assert "do not reach" not in headline
        assert "by the clocks" not in headline
        named += bool(
            re.search(rf"{detector} takes 76 ms of 33: \d+ of \d+ inputs were replaced", headline)
        )
    assert (health, named > 80) == ("degraded", True)
    assert world.status["slow"][0]["stage"] == detector
    # It is over.
    bench = world.roles[detector]
    assert isinstance(bench, Bench)
    bench.exec_ns = 10 * MS
    world.run(6_000)
    assert told(world) == ("ok", "")
    assert world.status["slow"] == []


def test_inputs_that_queue_at_a_slow_stage_are_no_lost_messages(problem: Problem) -> None:
    cell = with_input(on(replace(problem, window_cycles=20), "SO"), "perception", 0)
    cell = replace(cell, controller=replace(cell.controller, fallbacks=()))
    world = World(cell, policy="SO", exec_ms={**EXEC_MS, "perception": 76.0})
    world.run(3_000)
    for _ in range(50):
        world.run(100)
        _, headline = told(world)
        assert "perception@E takes 76 ms of 33" in headline
        assert "do not reach" not in headline
        assert "by the clocks" not in headline


def test_a_note_about_memory_hides_no_other(problem: Problem) -> None:
    world = World(problem, policy="LOC", stages={"control": Nothing})
    world.run(8_000)
    found = world.status
    grown = "control@R2: its memory has grown from 90 to 300 MB; does its stage leak?"
    found["processes"] = {
        "agent@R2": found["processes"]["agent@R2"] | {"note": grown},
        **{who: one for who, one in found["processes"].items() if who != "agent@R2"},
    }
    health, headline = diagnose(world.problem, found)
    assert health == "stalled"
    assert headline is not None
    first = headline.partition(";")[0]
    assert re.search(r"returned a NoneType, not a Message, \d+ calls in a row", first)
    assert grown not in headline


# ----------------------------------------------------------------------- certificates


class Issued:
    """A cell with keys; the certificates of some subjects end at other times than the rest."""

    def __init__(self, problem: Problem, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.problem, self._patch = problem, patch
        self.authority = Authority.create(folder, problem.name)
        for name in (*problem.fabric.nodes, "controller"):
            self.issue(name)

    def issue(self, name: str, **left: float) -> None:
        """Issue a certificate of a year, of which some time is left."""
        if left:
            begun = datetime.now(UTC) - timedelta(days=365) + timedelta(**left)
            self._patch.setattr("dwell.live.trust.authority.now", lambda: begun)
        role = "controller" if name == "controller" else "node"
        self.authority.issue(name, role)
        self._patch.undo()

    @property
    def seals(self) -> dict[str, Seals]:
        names = self.authority.roster.subjects
        return {name: Seals(Keyring.open(self.authority.folder / name)) for name in names}


@pytest.fixture
def issued(problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Issued:
    return Issued(problem, tmp_path / "keys", monkeypatch)


@pytest.mark.parametrize(
    ("left", "health", "headline"),
    [
        ({"days": 20}, "ok", None),
        ({"days": 3, "hours": 1}, "ok", "R2's certificate ends in 3 days"),
        ({"hours": 5, "minutes": 1}, "ok", "R2's certificate ends in 5 h"),
        ({"minutes": 30.2}, "degraded", "R2's certificate ends in 30 min"),
    ],
)
def test_the_end_of_a_certificate_is_announced(
    issued: Issued, left: dict[str, float], health: str, headline: str | None
) -> None:
    issued.issue("R2", **left)
    found = running(issued.problem, seals=issued.seals).status
    assert (found["health"], found["headline"]) == (health, headline)
    assert found["certificates"]["R2"]["days"] == pytest.approx(
        timedelta(**left).total_seconds() / 86_400, abs=0.01
    )


def test_a_certificate_that_has_ended_is_named_also_where_its_node_is_silent(
    issued: Issued,
) -> None:
    issued.issue("R2", seconds=3)
    world = running(issued.problem, seals=issued.seals)
    time.sleep(3.5)
    for role in roles(world.problem):
        if role.node == "R2":
            world.kill(role.who)
    world.run(silence_ms(world) + 1_000)
    found = world.status
    assert found["health"] in ("degraded", "stalled")
    assert "R2's certificate ended " in found["headline"]
    assert "nothing is heard of R2" in found["headline"]


def test_the_certificate_that_is_in_use_counts(issued: Issued) -> None:
    """A newer one of the same node, which it has not taken yet, changes nothing."""
    issued.issue("R2", days=2.1)
    before = issued.seals
    issued.issue("R2")
    new = issued.seals
    used = {**new, "R2": Seals(replace(before["R2"].keyring, roster=new["R2"].keyring.roster))}
    world = running(issued.problem, seals=used)
    assert world.status["headline"] == "R2's certificate ends in 2 days"
    world.seals = new
    for role in roles(world.problem):
        if role.node == "R2":
            world.kill(role.who)
            world.start(role.who)
    world.run(2_000)
    assert world.status["headline"] is None


def test_certificates_that_end_together_are_one_warning(issued: Issued) -> None:
    for name in ("R1", "E", "R2", "controller"):
        issued.issue(name, days=3.1)
    found = running(issued.problem, seals=issued.seals).status
    assert found["headline"] == "R1's, E's, R2's, controller's certificate ends in 3 days"
