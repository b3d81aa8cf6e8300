"""Regret, its parts, and the aim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from dwell.model import Problem
from dwell.sim import draw, simulate_realisation
from dwell.study import Contender, Interval
from dwell.study.paper import Runner, shadow_cost
from dwell.study.paper import dynamic as module
from dwell.study.paper.aims import Aim, Parts, Said, best_static_regret, judge, parts_of
from dwell.study.paper.dynamic import CUSUM, DTP, TOLD, chapter, closest, contenders, verdict
from dwell.study.paper.shadow_cost import shadow_bytes_per_s
from dwell.study.paper.timeline import timeline_figure
from dwell.study.paper.tuning import best, scores, thinned
from dwell.study.reference import CLAIRVOYANT, CLAIRVOYANT_DWELL
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import check_written, told

Numbers: TypeAlias = "NDArray[np.float64] | float"

SEEDS = 8
NONE: Mapping[str, Interval] = {}
PARTS = Parts(Interval(0.15, 0.14, 0.16), Interval(0.05, 0.04, 0.06))


def make_aim(cost: Said, rate: Said = "not asked", moves: Said = "met", at: float = 0.2) -> Aim:
    known = Interval(at, at - 0.01, at + 0.01)
    more = {"dtp+profile": Interval(3.0, 2.0, 4.0)} if moves == "missed" else NONE
    return Aim(known, Interval(0.08, 0.07, 0.09), known, more, cost, rate, moves)


REACHED, MISSED, OPEN = make_aim("met", at=0.05), make_aim("missed"), make_aim("not shown", at=0.1)


@pytest.mark.parametrize(
    ("aims", "expected"),
    [
        ([REACHED, REACHED], "yes"),
        ([REACHED, MISSED], "in part"),
        ([REACHED, OPEN], "in part"),
        ([MISSED, MISSED], "no"),
        ([MISSED, OPEN], "not shown"),
        ([OPEN, OPEN], "not shown"),
    ],
)
def test_the_answer_follows_from_the_aims(aims: Sequence[Aim], expected: str) -> None:
    mine = {f"scenario-{i}": aim for i, aim in enumerate(aims)}
    answer, sentence = told(verdict({DTP: mine}, {DTP: dict.fromkeys(mine, PARTS)}))
    assert answer == expected
    assert f"in {sum(aim is REACHED for aim in aims)} of 2 dynamic scenarios" in sentence


def test_it_says_by_how_much_what_is_missed_and_which_part_costs_it() -> None:
    mine = {"bursts": make_aim("missed", "missed", "missed"), "step": REACHED}
    _, sentence = told(verdict({CUSUM: mine}, {CUSUM: dict.fromkeys(mine, PARTS)}))
    assert sentence.startswith("cusum+corrected comes closest")
    assert "fall short by cost in bursts, and by V_D in bursts, and by migrations" in sentence
    assert "it is beyond that in bursts 20.0 [19.0, 21.0] % (rule and lag 15.0 %" in sentence
    assert "the estimate +5.0 points)" in sentence
    assert "in bursts; it is not shown in bursts (8.0 [7.0, 9.0] %, missed)" in sentence
    assert "migrates more than DTP in bursts (+3.0 [2.0, 4.0] against dtp+profile)" in sentence
    _, sentence = told(
        verdict(
            {CUSUM: {"step": make_aim("not shown", "not shown", "not shown", at=0.1)}},
            {CUSUM: {"step": PARTS}},
        )
    )
    assert "1 is open (step 10.0 [9.0, 11.0] %)" in sentence
    assert "it is not shown in step (8.0 [7.0, 9.0] %, open)" in sentence
    assert "nowhere shown to migrate more than DTP; open in step" in sentence
    _, sentence = told(
        verdict({CUSUM: {"step": make_aim("met", "met", at=0.0)}}, {CUSUM: {"step": PARTS}})
    )
    assert "in step; it is kept in all 1" in sentence


def test_the_closest_reaches_most_then_misses_least_then_costs_least() -> None:
    aims = {
        "far": {"a": MISSED, "b": MISSED},
        "near": {"a": REACHED, "b": MISSED},
        "nearest": {"a": REACHED, "b": OPEN},
        "dear": {"a": REACHED, "b": make_aim("not shown", at=0.12)},
    }
    assert closest(aims) == "nearest"
    del aims["nearest"]
    assert closest(aims) == "dear"


# ------------------------------------------------------------------------ runs made by hand


def made(shown: Mapping[str, Mapping[str, Numbers]]) -> pl.DataFrame:
    """Return runs of one scenario that show given numbers, one a seed."""
    columns = ("cost", "regret", "violation_rate", "migrations")
    frames = [
        pl.DataFrame(
            {
                "scenario": ["step"] * SEEDS,
                "policy": [policy] * SEEDS,
                "seed": range(1, SEEDS + 1),
                **{
                    column: np.broadcast_to(
                        np.asarray(given.get(column, 0.0), np.float64), SEEDS
                    ).copy()
                    for column in columns
                },
            }
        )
        for policy, given in shown.items()
    ]
    return pl.concat(frames)


WAVE = 0.002 * np.cos(np.arange(SEEDS))
REFERENCES: Mapping[str, Mapping[str, Numbers]] = {
    "LOC": {"cost": 1.0, "violation_rate": 0.02 + WAVE, "regret": 0.0},
    CLAIRVOYANT: {"cost": 1.1, "violation_rate": 0.5},
    CLAIRVOYANT_DWELL: {"cost": 1.2, "violation_rate": 0.5},
    "dtp+profile": {"cost": 1.5, "migrations": 10.0 + WAVE},
}


def judged(**given: Numbers) -> Aim:
    runs = made({**REFERENCES, "mine": given})
    return judge(runs, "step", "mine", candidates=("LOC",), dtp=("dtp+profile",))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"regret": 0.05 + WAVE, "violation_rate": 0.03 + WAVE}, ("met", "met", "met")),
        (
            {"regret": 0.2 + WAVE, "violation_rate": 0.08 + WAVE, "migrations": 12.0 + WAVE},
            ("missed", "missed", "missed"),
        ),
        (
            {
                "regret": 0.1 + 20 * WAVE,
                "violation_rate": 0.05 + 10 * WAVE,
                "migrations": 10.0 - 20 * WAVE,
            },
            ("not shown", "not shown", "not shown"),
        ),
    ],
)
def test_a_criterion_is_met_or_missed_where_its_interval_says_so(
    given: dict[str, Numbers], expected: tuple[str, ...]
) -> None:
    assert judged(**given).said == expected


def test_the_rate_of_the_reference_is_that_of_the_cheapest_run() -> None:
    aim = judged(regret=0.05 + WAVE)
    assert aim.reference_rate.value == pytest.approx(float((0.02 + WAVE).mean()))
    # Where the reference itself misses more, nobody is asked to do better.
    dearer: dict[str, Mapping[str, Numbers]] = {
        **REFERENCES,
        "LOC": {"cost": 2.0, "violation_rate": 0.0},
    }
    runs = made({**dearer, "mine": {"violation_rate": 0.3 + WAVE}})
    aim = judge(runs, "step", "mine", candidates=("LOC",), dtp=())
    assert aim.reference_rate.value == pytest.approx(0.5)
    assert aim.rate_said == "not asked"
    assert aim.moves_said == "not asked"


def test_parts_add_up_to_the_regret() -> None:
    runs = made({"mine": {"regret": 0.2 + WAVE}, "told": {"regret": 0.12 - WAVE}})
    parts = parts_of(runs, "step", "mine", "told")
    assert parts.rule.value + parts.estimate.value == pytest.approx(float((0.2 + WAVE).mean()))
    assert parts.estimate.low < 0.08 < parts.estimate.high
    assert parts.larger == "rule and lag"
    assert replace(parts, rule=Interval(0.0, 0.0, 0.0)).larger == "estimate"


def test_the_best_static_placement_may_be_another_one_for_each_seed() -> None:
    up = np.linspace(0.0, 0.7, SEEDS)
    runs = made({"LOC": {"regret": up}, "SO": {"regret": up[::-1]}})
    found = best_static_regret(runs, "step", ("LOC", "SO"))
    assert found.tolist() == np.minimum(up, up[::-1]).tolist()


# -------------------------------------------------------------------------- tuning, shadows


def test_the_best_is_the_one_with_the_least_mean_over_scenarios() -> None:
    runs = pl.DataFrame(
        {
            # The second scenario has more runs, and counts no more for that.
            "scenario": ["a", "b", "b", "a", "b", "b"],
            "policy": ["one", "one", "one", "two", "two", "two"],
            "regret": [0.0, 1.0, 1.0, 0.8, 0.4, 0.4],
        }
    )
    score = scores(runs, "regret")
    assert score == pytest.approx({"one": 0.5, "two": 0.6})
    those = (Contender("two", "dtp"), Contender("one", "dtp"))
    assert best(those, score).name == "one"
    assert best(those, score, lambda one: one.name == "two").name == "two"


def test_a_thinned_grid_keeps_its_ends() -> None:
    assert thinned((1, 2, 3, 4, 5), 3) == (1, 3, 5)
    assert thinned((1, 2, 3), 9) == (1, 2, 3)
    assert thinned((1, 2, 3), 2) == (1, 3)


def test_bytes_of_shadows_are_those_of_a_simulated_run() -> None:
    problem = make_cell()
    fraction, windows = 0.2, 40
    settings = replace(problem.controller, shadow_fraction=fraction)
    problem = replace(problem, controller=settings)
    realisation = draw(problem, scenario="baseline", seed=1, windows=windows)
    for name in problem.candidates:
        run = simulate_realisation(problem, realisation, policy=name, estimator="shadow")
        seconds = windows * problem.window_cycles * problem.pipeline.period_ms / 1e3
        sent = float(run.windows["shadow_bytes"].sum()) / seconds
        expected = sum(shadow_bytes_per_s(problem, name, fraction).values())
        assert sent == pytest.approx(expected, rel=0.05)
    assert shadow_bytes_per_s(problem, "LOC", 0.0) == dict.fromkeys(problem.fabric.links, 0.0)


# ------------------------------------------------------------------------- figure, chapter


def test_the_timeline_shows_what_was_believed_and_what_was_true() -> None:
    problem = make_cell("step")
    figure = timeline_figure(
        problem,
        Contender("dtp+corrected", "dtp", "corrected"),
        scenario="step",
        seed=1,
        windows=20,
        slug="dynamic-timeline",
    )
    frame = figure.frame
    assert set(frame["panel"]) == {"V_D", "L95", "J"} == set(figure.panels)
    names = tuple(problem.candidates)
    assert set(frame["series"]) == {"V_D", "L95", *names, *(f"{name} alone" for name in names)}
    realisation = draw(problem, scenario="step", seed=1, windows=20)
    alone = simulate_realisation(problem, realisation, policy="SO", estimator="profile")
    true = frame.filter(pl.col("series") == "SO alone")["y"].to_list()
    # No window has shifted before the first migration, which takes a cycle.
    assert true[:2] == pytest.approx(alone.windows["cost"].to_list()[:2])
    assert figure.spans is not None
    begin, end, label = figure.spans.row(0)
    # From 1 s to 3 s, in windows of 0.33 s that are centred at their numbers.
    assert begin == pytest.approx(1 / 0.33 - 0.5)
    assert end == pytest.approx(3 / 0.33 - 0.5, abs=0.3)
    assert label == "R1: 4 threads"


def test_everybody_who_is_told_plays_by_the_same_rule() -> None:
    problem = make_cell("step")
    chosen = {
        name: Contender("best", "dtp", "corrected", {"controller.min_dwell": 0})
        for name in (module.TUNED_DTP, module.TUNED_CUSUM)
    }
    by_name = {one.name: one for one in contenders(problem, chosen)}
    for name, knowing in TOLD.items():
        assert by_name[knowing].policy == by_name[name].policy
        assert by_name[knowing].settings == by_name[name].settings
        assert repr(by_name[knowing].estimator) == "Hindsight()"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Problem:
    for name, values in (
        ("THRESHOLDS", (0.2,)),
        ("SLACKS", (0.05, 0.3)),
        ("MEMORIES", (0.7,)),
        ("DWELLS", (1,)),
        ("IMPROVEMENTS", (0.05, 0.4)),
    ):
        monkeypatch.setattr(module, name, values)
    for one in (module, shadow_cost):
        monkeypatch.setattr(one, "FRACTIONS", (0.05,))
    return make_cell("robot-cpu-stress", "step")


def test_the_chapter(small: Problem, tmp_path: Path) -> None:
    written = chapter(small, SCALE, Runner(tmp_path, processes=1))
    check_written(written)
    tables = {table.slug: table.frame for table in written.tables}
    aim = tables["dynamic-aim"]
    assert set(aim["scenario"]) == {"step", "baseline", "robot-cpu-stress"}
    whole = aim["rule"] + aim["estimate"]
    assert np.allclose(whole.to_numpy(), aim["regret"].to_numpy())
    assert tables["dynamic-tuning"].height == 4
    assert {figure.kind for figure in written.figures} == {"intervals", "bars", "timeline"}
