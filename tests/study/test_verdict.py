"""The verdict on a run: kept, missed or open."""

from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell.model import Problem
from dwell.study.summary import summarise
from dwell.study.verdict import RunVerdict, verdict_of


def judged(problem: Problem, scenario: str, windows: int, policy: str = "LOC") -> RunVerdict:
    run = dwell.simulate(problem, scenario=scenario, policy=policy, seed=1, windows=windows)
    rate = summarise(run, problem, {}).row["violation_rate"]
    return verdict_of(run, problem, float(rate))


@pytest.fixture(name="canonical", scope="module")
def _canonical() -> Problem:
    return dwell.load("examples/canonical.yaml")


def test_a_long_run_far_from_the_aim_has_a_clear_verdict(canonical: Problem) -> None:
    verdict = judged(canonical, "baseline", 300)
    assert verdict.word == "kept"
    assert verdict.low is not None
    assert verdict.high is not None
    assert verdict.low <= verdict.rate <= verdict.high < 0.05
    assert judged(canonical, "robot-cpu-stress", 60).word == "missed"


def test_a_short_run_near_the_aim_is_open(canonical: Problem) -> None:
    verdict = judged(canonical, "baseline", 20)
    assert verdict.word == "open"
    assert str(verdict).endswith("of deadlines missed (aim: under 5 %): open")


def test_a_run_shorter_than_its_episodes_is_open_whatever_it_showed(tmp_path: Path) -> None:
    """Episodes of 1,000 s come every 3,000 s: a run of 40 s shows one side alone."""
    text = Path("examples/canonical.yaml").read_text(encoding="utf-8")
    times = "every_s: {constant: 3000}, for_s: {constant: 1000}"
    rare = f"{{node: R1, stress_threads: 4, episodes: {{name: rare, {times}}}}}"
    cell = tmp_path / "cell.yaml"
    begun, _, rest = text.partition("  robot-cpu-stress:")
    cell.write_text(f"{begun}  rare:\n    - {rare}\n  robot-cpu-stress:{rest}", encoding="utf-8")
    verdict = judged(dwell.load(cell), "rare", 12)
    assert (verdict.word, verdict.low, verdict.high) == ("open", None, None)
    assert "[" not in str(verdict)
