"""Capacity: by hand, by its definition, and what limits a fleet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import dwell
from dwell.errors import ProblemError
from dwell.model import evolve
from dwell.model.fleet import Fleet, FleetEntry
from dwell.study import capacity
from dwell.study.capacity import Capacity, capacity_of
from dwell.study.played_sizes import KeptSizes, PlayedSize, Sizes
from dwell.study.twins import with_twins
from dwell.study.what_ifs import changes_of, served_by
from tests.cells.fleets import fleet_of, one_job, within

EXAMPLES = Path(__file__).parents[2] / "examples"
FEW: dict[str, Any] = {"seeds": (1, 2), "cycles": 100, "processes": 1}


@pytest.fixture(scope="module")
def quiet() -> Fleet:
    """Canonical cells on an edge server without other tenants."""
    canonical = dwell.load(EXAMPLES / "canonical.yaml")
    alone = evolve(canonical, {"nodes.E.bursts": None})
    return Fleet("quiet", (FleetEntry(alone, 1),), ("E",), coordination="none")


@pytest.mark.parametrize(
    ("deadline_ms", "phases", "robots"),
    [(9.9, "even", 5), (6.1, "sync", 3), (6.0, "sync", 2), (2.1, "even", 5), (2.0, "even", 0)],
)
def test_one_fifo_core_by_hand(deadline_ms: float, phases: str, robots: int) -> None:
    """P = 10 ms, jobs of 2 ms, 1 µs before and after."""
    fleet = fleet_of((within(one_job(), deadline_ms), 1))
    found = capacity_of(fleet, policy="OFF", phases=phases, most=12, **FEW)
    assert (found.robots, found.at_least) == (robots, False)
    assert found.interval[0] <= robots <= found.interval[1]
    assert (found.limit_on, found.phases) == ("violation_rate", phases)
    assert bool(found.reason) == (robots == 0)


def test_what_was_not_asked_for_is_at_least(quiet: Fleet) -> None:
    found = capacity_of(fleet_of((one_job(), 1)), policy="OFF", phases="even", most=4, **FEW)
    assert (found.robots, found.at_least, found.interval[1]) == (4, True, 4)
    assert found.limits is None


def test_where_one_alone_is_over_the_limit_the_excess_counts() -> None:
    """A tenant halves the core for 4 ms in 53, so that one cell alone misses more than it may."""
    bursts = {"every_ms": 53, "for_ms": 4, "threads": 1}
    cell = evolve(within(one_job(scheduler="fair"), 3.0), {"nodes.E.bursts": bursts})
    fleet = fleet_of((cell, 1))
    found = capacity_of(fleet, policy="OFF", phases="even", most=6, **{**FEW, "cycles": 400})
    alone = found.curve[0].violation_rate.value
    assert 0.05 < alone < 0.5
    assert found.limit_on == "excess"
    assert found.bound == pytest.approx(0.05 + alone)
    assert found.robots >= 1
    rates = [point.violation_rate.value for point in found.curve]
    assert all(rate <= found.bound for rate in rates[: found.robots])
    assert found.at_least or rates[found.robots] > found.bound


@pytest.mark.parametrize("phases", ["sync", "even", "random"])
def test_static_fleets_are_what_a_fleet_s_run_shows(quiet: Fleet, phases: Any) -> None:
    """V_D of the worst cell of every size, exactly."""
    seeds = (3, 4)
    found = capacity_of(
        quiet, policy="SO", phases=phases, most=3, limit=0.9, seeds=seeds, cycles=300, processes=1
    )
    for point in found.curve:
        worst = []
        for seed in seeds:
            run = dwell.simulate_fleet(
                quiet.with_count(point.robots), seed=seed, windows=8, policy="SO", phases=phases
            )
            missed = [one.arrays("cycles")["missed"][5 * 100 :] for one in run.cells.values()]
            worst.append(PlayedSize.of(missed, {}).rate)
        assert point.violation_rate.value == pytest.approx(sum(worst) / len(seeds), abs=1e-15)


def test_it_is_the_same_however_many_processes_there_are() -> None:
    fleet = fleet_of((within(one_job(), 6.1), 1))
    one, two = (
        capacity_of(fleet, policy="OFF", most=12, seeds=(1, 2), cycles=40, processes=count)
        for count in (1, 2)
    )
    assert one == two


class StopError(Exception):
    """Ends a study on the way."""


@pytest.mark.parametrize("policy", ["OFF", "latency-first"])
def test_an_interrupted_study_goes_on(tmp_path: Path, policy: str) -> None:
    fleet = fleet_of((within(one_job(), 6.1), 1))
    settings: dict[str, Any] = {"policy": policy, "phases": "even", "most": 24, **FEW}
    whole = capacity_of(fleet, **settings)
    file = tmp_path / "capacity" / "one.played"
    told: list[int] = []

    def stop(done: int, most: int) -> None:
        told.append(done)
        if len(told) == 2:
            raise StopError

    with pytest.raises(StopError):
        capacity_of(fleet, **settings, kept=KeptSizes(file), progress=stop)
    kept = KeptSizes(file)
    assert kept.count > 0
    before = file.read_text()
    assert capacity_of(fleet, **settings, kept=kept) == whole
    # Nothing was played twice.
    assert file.read_text().startswith(before)
    lines = file.read_text().splitlines()
    assert len(set(lines)) == len(lines)
    # A line that is cut does not count, nor do the results of another fleet.
    file.write_text(before + lines[-1][:-20])
    for _ in range(2):
        assert capacity_of(fleet, **settings, kept=KeptSizes(file)) == whole
    assert len(file.read_text().splitlines()) == len(lines) + 1
    other = fleet_of((within(one_job(), 4.0), 1))
    expected = capacity_of(other, **settings)
    assert capacity_of(other, **settings, kept=KeptSizes(file)) == expected
    KeptSizes(file).remove()
    assert not file.parent.exists()


def test_synchronous_cameras_cost_a_third(quiet: Fleet) -> None:
    """Of canonical cells on SO, without other tenants."""
    found = {
        phases: capacity_of(
            quiet, policy="SO", phases=phases, most=12, seeds=(1, 2, 3, 4), processes=1
        )
        for phases in ("sync", "random", "even")
    }
    assert found["sync"].robots == 6
    assert 9 <= found["random"].robots <= 10
    assert 9 <= found["even"].robots <= 10
    limits = found["sync"].limits
    assert limits is not None
    assert (limits.kind, limits.name) == ("resource", "E")
    assert limits.share > 0.9


def test_a_policy_that_moves_has_a_capacity_too(quiet: Fleet) -> None:
    found = capacity_of(
        quiet, policy="dtp", phases="even", most=2, seeds=(1,), cycles=200, processes=1
    )
    assert (found.robots, found.at_least, found.policy) == (2, True, "dtp")


def test_other_entries_stay(quiet: Fleet) -> None:
    """They count neither as robots nor as nothing."""
    cell = within(one_job(), 6.1)
    both = fleet_of((cell, 1), (replace(cell, name="other"), 1))
    found = capacity_of(both, policy="OFF", phases="sync", most=8, **FEW)
    assert found.robots == 2


class Rates:
    """A player whose V_D by size, the same under every seed, is known."""

    def __init__(self, *rates: float) -> None:
        self.rates = rates

    def __call__(self, unit: Sizes) -> list[PlayedSize]:
        sizes = range(unit.first, unit.last + 1)
        rates = [self.rates[min(size, len(self.rates)) - 1] for size in sizes]
        return [PlayedSize(rate, 0.0, {}) for rate in rates]

    def limiting(self, robots: int, seeds: object) -> None:
        return None


def by_rates(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Capacity]:
    def found(*rates: float, most: int = 16, on_excess: bool = False) -> Capacity:
        monkeypatch.setattr(capacity, "FleetPlayer", lambda *_: Rates(*rates))
        fleet = fleet_of((one_job(), 1))
        return capacity_of(
            fleet,
            policy="OFF",
            phases="even",
            most=most,
            seeds=(1, 2, 3),
            on_excess=on_excess,
            processes=1,
        )

    return found


def test_no_smaller_size_may_be_over_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    found = by_rates(monkeypatch)
    assert found(0.01, 0.02, 0.06, 0.01, 0.01, 0.9).robots == 2
    assert found(0.05, 0.05, 0.0501).robots == 2
    assert found(0.01, 0.02, 0.03, most=3).at_least
    assert found(0.06, 0.11, 0.12).limit_on == "excess"
    assert found(0.06, 0.11, 0.12).robots == 2
    assert found(0.04, 0.09, 0.12, on_excess=True).robots == 2
    useless = found(0.6, 0.6)
    assert (useless.robots, useless.reason) == (0, "one cell alone misses 60.00 % of its deadlines")


@pytest.mark.parametrize(
    ("period_ms", "phases", "cycles"), [(0.5, "even", 4_000_000), (0.05, "random", 4_000_000)]
)
def test_many_cycles_of_a_cell_next_to_a_slow_one_are_warned_of(
    period_ms: float, phases: str, cycles: int
) -> None:
    slow = one_job(name="slow", period_ms=1000.0)
    fast = one_job(0.01, name="fast", period_ms=period_ms, deadline_ms=period_ms)
    fleet = fleet_of((slow, 1), (fast, 1)).changed(policy="OFF", phases=phases)
    (told,) = capacity.long_runs(fleet)
    assert told.path == "cells[1].cell"
    assert f"counts {cycles:,} cycles of fast" in told.message
    assert "slow needs" in told.message
    assert not [*capacity.long_runs(fleet_of((slow, 1)))]


def test_what_cannot_be_answered_is_refused(quiet: Fleet) -> None:
    def told(fleet: Fleet, **more: object) -> list[str]:
        with pytest.raises(ProblemError) as error:
            capacity_of(fleet, **more)  # type: ignore[arg-type]
        return str(error.value).splitlines()

    assert told(replace(quiet, phases=(1.0,)), policy="LOC") == [
        "phases: a list is of one size; give one of sync, even, random",
        "policy: LOC never uses a shared node (E), so that there may be any number of canonical; "
        "name another one",
    ]
    assert told(replace(quiet, shared=())) == [
        "shared: no node is shared, so that there may be any number of cells"
    ]
    assert "must be a whole number from 1 to 1000" in told(quiet, policy="SO", most=2000)[0]


def test_changes_that_may_help(quiet: Fleet) -> None:
    found = {change.text: change.make(1) for change in changes_of(quiet.changed(policy="SO"))}
    assert list(found) == [
        "phases evenly spread",
        "a core more on E",
        "E 1.25 times as fast",
        "a second server like E",
        "HYB instead of SO",
    ]
    assert found["a core more on E"].entries[0].cell.fabric.nodes["E"].cores == 9
    assert found["phases evenly spread"].phases == "even"
    assert found["HYB instead of SO"].policy == "HYB"
    fast, slow = (
        one.entries[0].cell.pipeline.tasks["perception"].on["E"].exec_ms.expectation
        for one in (found["E 1.25 times as fast"], quiet)
    )
    assert fast == pytest.approx(slow / 1.25)
    assert [change.text for change in changes_of(quiet.changed(phases="even", policy="HYB"))] == [
        *("a core more on E", "E 1.25 times as fast", "a second server like E"),
        "SO instead of HYB",
    ]


@pytest.mark.parametrize("deadline_ms", [9.0, 30.0])
def test_a_later_deadline_where_the_period_allows_it(deadline_ms: float) -> None:
    cell = within(one_job(period_ms=20.0), deadline_ms)
    assert [change.text for change in changes_of(fleet_of((cell, 1), phases="even"))][:2] == [
        "deadlines 10 ms later",
        "a core more on E",
    ]


# ------------------------------------------------------------------------------- by accelerator


def with_gpu() -> Fleet:
    """Jobs of 2 ms on the one GPU of a node of 16 cores, P = 10 ms."""
    cell = one_job(cores=16, scheduler="fair")
    gpu = {"nodes.E.accelerators": {"gpu": 1}, "tasks.work.on.E.accelerator": "gpu"}
    return fleet_of((evolve(within(cell, 9.9), gpu), 1)).changed(policy="OFF", phases="even")


def test_an_accelerator_limits_and_not_its_node() -> None:
    found = capacity_of(with_gpu(), most=12, **FEW)
    assert found.robots == 5
    assert found.as_json()["limits"] == {"resource": "E.gpu", "share": 1.0}
    used = found.point(5).utilisation
    assert used == {"E": pytest.approx(0.0, abs=1e-3), "E.gpu": pytest.approx(1.0, abs=1e-2)}


@pytest.mark.parametrize(
    ("change", "robots"),
    [("one E.gpu more", 10), ("a second server like E", 10), ("E.gpu 1.25 times as fast", 6)],
)
def test_what_an_accelerator_more_carries(change: str, robots: int) -> None:
    (found,) = (one for one in changes_of(with_gpu()) if one.text == change)
    assert found.capacity(most=12, **FEW).robots == robots


def test_the_first_change_that_serves_what_is_asked() -> None:
    assert served_by(with_gpu(), 9, **FEW) == ("one E.gpu more", 1)
    assert served_by(with_gpu(), 14, **FEW) == ("one E.gpu more", 2)
    assert served_by(with_gpu(), 90, **FEW) is None


def test_twins_take_cells_in_turn() -> None:
    found = with_twins(with_gpu().with_count(5), "E", 2)
    assert found.shared == ("E", "E-2", "E-3")
    nodes = [entry.cell.candidates["OFF"]["work"] for entry in found.entries]
    assert nodes == ["E", "E-2", "E-3", "E", "E-2"]


# ---------------------------------------------------------------------------------- by phases


def test_where_phases_are_drawn_the_draw_is_the_unit() -> None:
    """Constant jobs of 1 ms, P = 10, D = 4: of 40,000 draws 1.75 % are missed at 7, 5.6 % at 8."""
    cell = within(one_job(1.0), 4.0)
    fleet = fleet_of((cell, 1)).changed(policy="OFF", phases="random")
    found = capacity_of(fleet, most=11, processes=1)
    low, high = found.interval
    assert low <= 7 <= high
    assert high - low <= 3
    point = found.point(8)
    assert point.phases_error > 10 * point.cycles_error
    assert found.searched == "every size"


def test_ten_draws_without_a_miss_are_no_certainty() -> None:
    cell = within(one_job(1.0), 9.0)
    fleet = fleet_of((cell, 1)).changed(policy="OFF", phases="random")
    found = capacity_of(fleet, most=2, seeds=range(1, 11), processes=1)
    rate = found.point(2).violation_rate
    assert (rate.value, rate.low) == (0.0, 0.0)
    assert rate.high > 0.25


def test_a_policy_is_searched_by_bisection(quiet: Fleet) -> None:
    found = capacity_of(
        quiet,
        policy="latency-first",
        phases="even",
        most=12,
        seeds=(1, 2),
        cycles=200,
        processes=1,
    )
    assert found.searched == "bisection"
    sizes = [point.robots for point in found.curve]
    assert sizes[:3] == [1, 2, 4]
    assert len(sizes) < 9
    over = [one.robots for one in found.curve if one.violation_rate.value > found.bound]
    assert found.at_least or found.robots < min(over)
