"""Contenders in words and in figures."""

from __future__ import annotations

from dwell.report.contenders import describe_contenders, palette_of
from dwell.report.palette import Palette
from tests.cells.small import make_problem

NAMES = ("LOC", "SO", "HYB", "atp", "dtp", "latency-first", "dtp+corrected", "cusum+corrected")


def test_each_policy_and_estimator_is_told_once() -> None:
    told = describe_contenders(make_problem(), NAMES)
    assert set(told) == {
        "LOC, SO, HYB", "DTP", "ATP", "Latency-first", "CUSUM", "… (corrected)"
    }  # fmt: skip
    assert told["ATP"].count("our reconstruction") == 1


def test_no_two_contenders_are_drawn_alike() -> None:
    styles = palette_of(make_problem(), NAMES).policies
    assert list(styles) == list(NAMES)
    moving = [styles[name] for name in NAMES[3:]]
    assert len({style.marker for style in moving}) == len(moving)
    assert len({str(style.dashes) for style in moving}) == len(moving)


def test_where_nobody_says_what_it_believes_nothing_changes() -> None:
    problem = make_problem()
    assert palette_of(problem, NAMES[:6]) == Palette.of(problem.candidates, NAMES[:6])
