"""The paper's questions: every one is asked and answered, at the least that its designs take."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from dwell.study import UNTOLD
from reproduction.__main__ import main
from reproduction.questions import QUESTIONS
from reproduction.questions.jitter import turning_point
from reproduction.questions.reversion import CONDITIONS, PLACES, SLOW
from reproduction.questions.weights import luck
from reproduction.verdicts import WITHIN

WORDS = {"lower", "higher", "no difference shown", "under", "over", "not shown", "met", "missed"}
WORDS |= {"not asked", "turns", "never", "always", "cannot tell", "cannot tell with 2 seeds"}
WORDS |= {"same run", "same cycles", WITHIN}

#: Designs with hundreds of runs, by question: the first values of an axis, or those that differ in
#: kind. All values of an axis go through the same lines.
FEWER: Mapping[str, Mapping[str, Any]] = {
    "chatter": {"SCENARIOS": ("baseline", "bursts")},
    "concurrent": {
        "STRESSED": {"R1": ("R1",), "R1+R2": ("R1", "R2")},
        "GRID": ((0.8, 1.2), (0.7, np.inf), (np.inf,), (0,)),
    },
    "deciding": {"STEADY": ("baseline", "robot-cpu-stress"), "RANDOM": ("bursts",)},
    "dynamic": {
        "DYNAMIC": ("step", "bursts"),
        "STEADY": ("baseline", "robot-cpu-stress"),
        "FRACTIONS": (0.01, 0.1),
    },
    "hysteresis": {
        "SCENARIOS": ("baseline", "bursts", "step"),
        "ESCAPES": ("edge-cpu-stress", "step"),
        "COLD": ("mixture", "step"),
    },
    "reversion": {
        "PLACES": {name: PLACES[name] for name in ("both links", "R1 to E", "E to R2")},
        "JOINED": ("no fault", "both links", SLOW),
        "CONDITIONS": {name: CONDITIONS[name] for name in ("", "R1 stressed")},
    },
}


@pytest.mark.parametrize("name", [name for name in QUESTIONS if name not in ("weights", "real")])
def test_a_question_is_answered(
    name: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    question = importlib.import_module(f"reproduction.questions.{name}")
    for constant, values in FEWER.get(name, {}).items():
        monkeypatch.setattr(question, constant, values)
    words = ["--scale", "tiny", "--only", name, "--out", str(tmp_path), "--processes", "1"]
    assert main(words) == 0
    assert capsys.readouterr().out == f"report: {tmp_path / 'report.html'}\n"
    verdicts = pl.read_csv(tmp_path / "tables" / name / "verdicts.csv")
    assert verdicts.height > 0
    assert set(verdicts["word"]) <= WORDS
    # Two seeds can show nothing by a test, whatever was simulated.
    assert not set(verdicts.filter(pl.col("p").is_not_null())["word"]) & {"lower", "higher"}
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f'<h2 id="{name}">' in page
    # Once, and not in every row.
    assert page.count("cannot tell with 2 seeds") == 1
    assert page.count(f">{UNTOLD}</td>") >= (verdicts["word"] == "cannot tell with 2 seeds").sum()


def test_studies_have_pictures_that_the_page_leads_to(tmp_path: Path) -> None:
    words = ["--scale", "tiny", "--only", "table", "--out", str(tmp_path), "--processes", "1"]
    assert main([*words, "--pictures"]) == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    links = re.findall(r'href="(runs/[^"]*)"', page)
    assert links
    for link in links:
        assert "<svg" in (tmp_path / link).read_text(encoding="utf-8")


def test_traces_that_are_missing_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--scale", "tiny", "--only", "real", "--real", str(tmp_path / "none")]
    assert main([*words, "--out", str(tmp_path)]) == 1
    assert str(tmp_path / "none") in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--only", "real"], "--real FOLDER"),
        (["--only", "tables"], "invalid choice: 'tables'"),
        (["--seeds", "0"], "'0' is not allowed; it must be a number from 1 on"),
        (["--scale", "huge"], "invalid choice: 'huge'"),
    ],
)
def test_mistakes_are_told_before_anything_is_simulated(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert told in capsys.readouterr().err


def test_a_folder_that_is_a_file_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.touch()
    assert main(["--scale", "tiny", "--only", "table", "--out", str(file)]) == 1
    assert str(file) in capsys.readouterr().err


# --------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize(
    ("excess", "turn"),
    [([1.0, 1.0, 1.0], 0.0), ([-1.0, -1.0, -1.0], np.inf), ([-1.0, -1.0, 1.0], 10**1.5)],
)
def test_where_offloading_ceases_to_pay(excess: list[float], turn: float) -> None:
    assert turning_point((1.0, 10.0, 100.0), np.array(excess)) == pytest.approx(turn)


def test_points_that_differ_alike_under_every_seed_are_no_luck() -> None:
    points = np.array([1.0, 2.0, 4.0])
    assert luck(np.stack([points, points + 10.0])) == pytest.approx(0.0, abs=1e-12)


def test_points_that_differ_otherwise_under_every_seed_are_luck() -> None:
    draws = np.random.default_rng(1).normal(size=(4, 500))
    assert luck(draws) == pytest.approx(1.0, abs=0.15)
    assert np.isnan(luck(draws[:1]))
    assert luck(np.ones((3, 5))) == 0.0
