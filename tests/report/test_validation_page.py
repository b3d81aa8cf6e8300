"""The page and the text of a validation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from dwell import Run, simulate
from dwell.report.validation_page import validation_html
from dwell.report.validation_text import validation_text
from dwell.study.validation import Validation, validate
from tests.report.pages import Page
from tests.study.cell import make_problem
from tests.study.test_validation import slower


@cache
def validation() -> Validation:
    """Return predictions by a cell that is too fast, of runs some of which lose cycles."""
    problem = make_problem()
    runs: dict[str, Run] = {}
    for scenario, policies in (
        ("baseline", ("LOC", "work-function")),
        ("network-impairment", ("SO", "dtp")),
    ):
        for policy in policies:
            runs[f"{scenario}-{policy}"] = simulate(
                problem, scenario=scenario, policy=policy, seed=101, windows=40, jobs=True
            )
    runs["baseline-LOC"].meta["excluded_windows"] = [5]
    return validate(runs, slower(problem, 0.7), seeds=2)


@cache
def page() -> Page:
    return Page(validation_html(validation()))


def test_page_is_whole_and_needs_nothing_else() -> None:
    assert page().outside == []
    assert "script" not in page().tags
    assert len(page().ids) == len(set(page().ids))
    assert page().tags.count("svg") == 3


def test_page_shows_every_part() -> None:
    assert [name for name in page().headings if not name.isdigit()] == [
        "Predicted beside measured: small",
        "Verdicts",
        "Predicted over measured",
        "Latencies",
        "Where the time goes",
        "Jobs",
        "More figures",
        "Windows and migrations",
        "Utilisation",
        "Placements",
        "How it was judged",
        "What it does not say",
        "What this is",
    ]


def test_page_tells_what_is_missed_and_why() -> None:
    assert "LOC in baseline: L95 is predicted as" in page().text
    assert "of the parts computing is farthest off" in page().text
    assert "1 of 152 windows are left out" in page().text
    assert "Less than 5 minutes were measured" in page().text


def test_text_fits_the_terminal() -> None:
    text = validation_text(validation())
    assert max(map(len, text.splitlines())) <= 100
    assert text.count("DTP (profile)") >= 1
    assert "  (profile)" in text
    for word in ("Baseline", "Network impairment", "missed", "better than the sum of means"):
        assert word in text


def test_group_without_a_finished_cycle() -> None:
    problem = make_problem()
    scenarios = {"network-impairment": problem.scenario("network-impairment")}
    lossy = {name: replace(link, loss=0.99) for name, link in problem.fabric.links.items()}
    problem = replace(problem, scenarios=scenarios, fabric=replace(problem.fabric, links=lossy))
    run = simulate(problem, policy="SO", seed=1, windows=12)
    found = validate([run], problem, seeds=2)
    assert found.verdict("l95_ms") in ("met", "open")
    assert Page(validation_html(found)).outside == []
    assert "∞" in validation_text(found)
