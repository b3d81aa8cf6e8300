"""The paper's table beside what was simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from dwell.study import Interval
from dwell.study.comparison import AIM
from dwell.study.intervals import Verdict, under
from dwell.study.paper import Chapter, Runner
from dwell.study.paper.contrasts import values
from dwell.study.paper.table import chapter, verdict
from dwell.study.predictions import Answer
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import told

STATIC, CORRECTED = "dtp+profile", "dtp+corrected"
SCENARIOS = ("baseline", "robot-cpu-stress")
AIMS: Mapping[str, Mapping[str, Verdict]] = {
    "LOC": {"baseline": "under", "robot-cpu-stress": "over"},
    STATIC: {"baseline": "not shown", "robot-cpu-stress": "under"},
    "atp": {"baseline": "under", "robot-cpu-stress": "under"},
}


def judged(static: Sequence[Answer], corrected: Sequence[Answer]) -> dict[str, dict[str, Answer]]:
    return {
        STATIC: dict(zip(SCENARIOS, static, strict=True)),
        CORRECTED: dict(zip(SCENARIOS, corrected, strict=True)),
    }


@pytest.mark.parametrize(
    ("static", "corrected", "expected"),
    [
        (("agrees", "agrees"), ("differs", "differs"), "yes"),
        (("agrees", "differs"), ("differs", "differs"), "in part"),
        (("differs", "agrees in part"), ("differs", "differs"), "in part"),
        (("differs", "differs"), ("agrees", "differs"), "in part"),
        (("differs", "differs"), ("differs", "differs"), "no"),
        (("open", "differs"), ("differs", "differs"), "not shown"),
        (("differs", "differs"), ("differs", "open"), "not shown"),
    ],
)
def test_the_answer_follows_from_the_judgements(
    static: Sequence[Answer], corrected: Sequence[Answer], expected: str
) -> None:
    answer = verdict(judged(static, corrected), AIMS).answer
    assert answer == expected


def test_the_sentence_names_the_scenarios_and_counts_the_aim() -> None:
    _, sentence = told(verdict(judged(("agrees", "open"), ("agrees in part", "differs")), AIMS))
    assert f"{STATIC}: as predicted in baseline; undecided in robot-cpu-stress." in sentence
    assert "in part in baseline; otherwise in robot-cpu-stress." in sentence
    assert "in 1 of 2 scenarios, and in part in 0; with the estimator corrected in 0" in sentence
    assert f"LOC in 1, {STATIC} in 1." in sentence


def test_without_predictions_nothing_was_asked() -> None:
    answer, sentence = told(verdict({}, AIMS))
    assert answer == "none asked"
    assert "predicts nothing" in sentence


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Chapter:
    folder = tmp_path_factory.mktemp("table")
    return chapter(make_cell("robot-cpu-stress"), SCALE, Runner(folder, processes=1))


def test_every_policy_stands_in_the_table_with_its_verdict(written: Chapter) -> None:
    tables = {table.slug: table for table in written.tables}
    main = tables["table"].frame
    assert main.height == 2 * 9
    assert set(tables["table"].units) <= set(main.columns)
    for row in main.to_dicts():
        assert row["aim"] in ("under", "over", "not shown")
        assert row["leader_share"] == max(row["leader_share"], 0.3)
    assert tables["table-predictions"].frame.height == 2 * 4


def test_it_is_the_same_again(written: Chapter, tmp_path: Path) -> None:
    again = chapter(make_cell("robot-cpu-stress"), SCALE, Runner(tmp_path, processes=1))
    assert (again.answer, again.verdict, again.findings) == (
        written.answer,
        written.verdict,
        written.findings,
    )
    for one, other in zip(written.tables, again.tables, strict=True):
        assert one.frame.equals(other.frame)


def test_figures_have_the_columns_that_they_name(written: Chapter) -> None:
    for figure in written.figures:
        named = {figure.x, figure.y, figure.series, figure.facet or figure.x}
        assert named <= set(figure.frame.columns)
        assert not figure.frame.is_empty()


def test_the_aim_is_that_of_the_one_sided_limits(tmp_path: Path) -> None:
    runner = Runner(tmp_path, processes=1)
    found = chapter(make_cell(), SCALE, runner)
    import polars as pl

    runs = pl.read_parquet(tmp_path / "table" / "runs.parquet")
    for row in found.tables[2].frame.to_dicts():
        labels = {"scenario": row["scenario"], "policy": row["policy"]}
        rates = values(runs, "violation_rate", labels)
        assert row["aim"] == under(rates, AIM)
        assert Interval(row["violation_rate"], 0, 0).value == pytest.approx(rates.mean())
