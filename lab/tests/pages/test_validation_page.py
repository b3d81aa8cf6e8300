"""The page and the text of a validation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from dwell import Run, simulate
from dwell_lab.pages.validation_page import validation_html, validation_page, validation_text
from dwell_lab.validation.validation import Validation, validate
from lab.tests.validation.test_validation import slower
from tests.cells.small import make_problem
from tests.report.pages import Page, figure_of, table_of


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
    return Page(validation_html(validation(), static=True))


def test_page_is_whole_and_needs_nothing_else() -> None:
    assert page().outside == []
    assert "script" not in page().tags
    assert len(page().ids) == len(set(page().ids))
    assert page().tags.count("svg") == 4


def test_goals_stand_first_with_their_counts() -> None:
    shown = validation_page(validation())
    goals = shown.sections[0].blocks[0]
    assert goals is table_of(shown, "goals")
    rows = {row["goal"]: row for row in table_of(shown, "goals").rows}
    row = rows["L95 within 10 %"]
    found = [group.verdict("l95_ms") for group in validation().groups]
    assert row["word"] == validation().verdict("l95_ms") == "missed"
    assert row["missed"] == found.count("missed")


def test_page_tells_what_is_missed_and_what_was_left_out() -> None:
    rows = {
        (row["scenario"], row["policy"]): row
        for row in table_of(validation_page(validation()), "verdicts").rows
    }
    row = rows["baseline", "LOC"]
    assert row["l95_word"] == "missed"
    assert row["l95_off"] < 0
    assert row["excluded"] == 1
    assert row["enough"] == "no"
    parts = table_of(validation_page(validation()), "parts").rows
    slower_by = next(one for one in parts if one["policy"] == "LOC")["compute_off"]
    assert slower_by < -1


def test_the_deadline_is_on_both_axes_of_latency() -> None:
    figure = next(one for one in validation_page(validation()).figures if one.slug == "over")
    deadline = {"datum": validation().problem.pipeline.deadline_ms}
    latencies, *others = figure.spec()["hconcat"]
    assert [axis for part in latencies["layer"] for axis in ("x", "y")
            if part["encoding"][axis] == deadline] == ["x", "y"]  # fmt: skip
    assert str(deadline) not in str(others)


def test_text_fits_a_terminal() -> None:
    text = validation_text(validation(), width=100)
    assert max(map(len, text.splitlines())) <= 100
    text = validation_text(validation())
    for word in ("DTP (profile)", "Network impairment", "missed", "better than the sum of means"):
        assert word in text


def test_group_without_a_finished_cycle() -> None:
    problem = make_problem()
    scenarios = {"network-impairment": problem.scenario("network-impairment")}
    lossy = {name: replace(link, loss=0.99) for name, link in problem.fabric.links.items()}
    problem = replace(problem, scenarios=scenarios, fabric=replace(problem.fabric, links=lossy))
    run = simulate(problem, policy="SO", seed=1, windows=12)
    found = validate([run], problem, seeds=2)
    assert found.verdict("l95_ms") in ("met", "open")
    assert Page(validation_html(found, static=True)).outside == []
    assert "∞" in validation_text(found)


def test_moves_of_the_measured_runs_stand_under_their_scenarios() -> None:
    shown, moves = validation_page(validation()), validation().moves
    table = table_of(shown, "predicted-moves")
    told = [(row["run"], row["window"]) for row in table.rows]
    assert told == moves.select("run", "window").rows()
    assert set(moves["run"]) == {"baseline-work-function", "network-impairment-dtp"}
    assert [heading for heading, _ in table.groups()] == ["Baseline", "Network impairment"]
    assert figure_of(shown, "predicted").frames["rows"].height == moves.height
    still = replace(validation(), moves=moves.clear())
    assert "predicted" not in [one.slug for one in validation_page(still).figures]
