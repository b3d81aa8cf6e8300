"""The page of a comparison: whole, self-contained, and saying what its numbers say."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import polars as pl
import pytest

from dwell.report import comparison_html
from dwell.report.findings import explain, judge_all, question, standing, verdict
from dwell.study import compare, tenants_demo
from dwell.study.predictions import PAPER, judge_placement
from tests.report.pages import Page, small_comparison
from tests.study.cell import SEEDS, make_comparison, make_problem

Shown: TypeAlias = dict[tuple[str, str], Mapping[str, float | Sequence[float]]]

NOISE = np.linspace(-0.01, 0.01, len(SEEDS))


@pytest.fixture(scope="module")
def html() -> str:
    return comparison_html(small_comparison())


def test_nothing_is_loaded_from_elsewhere(html: str) -> None:
    page = Page(html)
    assert page.outside == []
    assert not re.search(r"https?:|@import|url\((?!#)|javascript", html)
    assert "script" not in page.tags


def test_it_is_well_formed_and_no_name_stands_twice(html: str) -> None:
    page = Page(html)
    assert len(set(page.ids)) == len(page.ids)
    assert page.tags.count("svg") == page.tags.count("figure") == len(page.labels)


def test_what_figures_refer_to_is_there(html: str) -> None:
    page = Page(html)
    wanted = set(re.findall(r'url\(#([^)]*)\)|href="#([^"]*)"', html))
    assert {a or b for a, b in wanted} <= set(page.ids)


def test_text_of_figures_is_text_in_the_colours_of_the_page(html: str) -> None:
    assert "<text" in html
    assert "currentColor" in html
    assert "DejaVu" not in html


def test_it_has_every_part(html: str) -> None:
    headings = " | ".join(Page(html).headings)
    for part in (
        "Results",
        "Prediction and result",
        "DTP through time",
        "estimated",
        "How it was measured",
        "What it does not say",
    ):
        assert part in headings


def test_every_policy_stands_in_every_scenario(html: str) -> None:
    text = Page(html).text
    for name in ("Baseline", "Robot CPU stress"):
        assert name in text
    assert "our reconstruction" in text
    assert "seeds 1 to 3" in text


def test_what_the_actuator_got_is_told(html: str) -> None:
    page = Page(html)
    assert "What the actuator got" in page.headings
    for words in ("misses in a row", "most misses in 20", "mean age (ms)"):
        assert words in page.text


def test_the_same_comparison_makes_the_same_page() -> None:
    one = replace(small_comparison(), scenarios=("baseline",))
    assert comparison_html(one) == comparison_html(one)


def test_a_cell_without_dtp_or_predictions_has_a_page() -> None:
    found = compare(
        make_problem(),
        scenarios=("baseline",),
        policies=("SO",),
        seeds=(1,),
        windows=4,
        processes=1,
    )
    page = Page(comparison_html(found))
    assert page.outside == []
    assert not any("Prediction" in heading for heading in page.headings)


def test_the_shares_of_the_tenants_are_columns() -> None:
    tenants = tenants_demo("examples", seeds=2, windows=7, processes=1)
    page = Page(comparison_html(small_comparison(), tenants=tenants))
    assert page.outside == []
    assert all(share in page.text for share in ("0.00 %", "3.00 %", "6.25 %", "10.0 %"))


def test_several_comparisons_stand_in_one_page() -> None:
    first = replace(small_comparison(), scenarios=("baseline",))
    second = replace(first, problem=replace(first.problem, name="other"))
    page = Page(comparison_html(first, second))
    assert len(set(page.ids)) == len(page.ids)
    assert {"Cell small", "Cell other"} <= set(page.headings)


# ------------------------------------------------------------------------------ what is said


def rates(mean: float) -> dict[str, list[float]]:
    return {"violation_rate": [mean + x for x in NOISE]}


def test_a_rate_is_under_the_aim_only_where_its_limit_is() -> None:
    shown: Shown = {
        ("baseline", "LOC"): rates(0.02),
        ("baseline", "SO"): rates(0.047),
        ("baseline", "HYB"): rates(0.08),
        ("baseline", "dtp"): {"violation_rate": 0.0},
    }
    comparison = make_comparison(shown)
    found = [standing(comparison, "baseline", name) for name in comparison.policies]
    assert found == ["under", "open", "above", "no miss"]


def test_no_miss_is_shown_as_open() -> None:
    found = small_comparison()
    runs = found.runs.with_columns(pl.lit(0.0).alias("violation_rate"))
    html = comparison_html(replace(found, scenarios=("baseline",), runs=runs))
    assert html.count('<span class="open nowrap">no miss</span>') == len(found.policies)
    assert "“No miss” is open too" in html


def test_a_difference_that_rounds_to_nothing_is_not_said_to_be_none() -> None:
    shown: Shown = {
        ("baseline", "dtp"): {"cost": 1.0},
        ("baseline", "dtp+corrected"): {"cost": [1.001 + x / 1000 for x in NOISE]},
    }
    policies = ("LOC", "SO", "HYB", "dtp", "dtp+corrected")
    text = verdict(make_comparison(shown, policies=policies))[-1]
    assert text.endswith("is higher by less than 0.01 in Baseline.")


def test_the_verdict_names_who_keeps_the_aim() -> None:
    shown = {
        ("baseline", "LOC"): rates(0.02),
        ("baseline", "SO"): rates(0.3),
        ("baseline", "HYB"): rates(0.3),
        ("baseline", "dtp"): rates(0.3),
    }
    assert verdict(make_comparison(shown))[0] == "LOC keeps V_D under 5 % in the scenario."


def test_the_verdict_says_when_nobody_does() -> None:
    shown = {("baseline", name): rates(0.3) for name in ("LOC", "SO", "HYB")}
    shown["baseline", "dtp"] = rates(0.2)
    text = verdict(make_comparison(shown))[0]
    assert text.startswith("No policy keeps V_D under 5 %")
    assert "Baseline (DTP, 20.0 ± 0.6 %)" in text


def test_no_miss_at_all_is_said_to_be_no_proof() -> None:
    shown = {("baseline", name): {"violation_rate": 0.0} for name in ("LOC", "SO", "HYB", "dtp")}
    text = verdict(make_comparison(shown))[0]
    assert "8 independent runs limit it at 31.2 % only" in text
    assert text.startswith("No policy is shown to keep V_D under 5 % in the scenario.")


def test_the_verdict_holds_dtp_against_the_cheapest_placement() -> None:
    shown: Shown = {
        ("baseline", "LOC"): {"cost": 1.5},
        ("baseline", "SO"): {"cost": 1.0},
        ("baseline", "HYB"): {"cost": 1.5},
        ("baseline", "dtp"): {"cost": [1.25 + x for x in NOISE]},
    }
    assert "J of DTP is higher by 0.25 in Baseline." in verdict(make_comparison(shown))[1]
    shown["baseline", "dtp"] = {"cost": [1.0 + x for x in NOISE]}
    assert "J of DTP is not told apart in Baseline." in verdict(make_comparison(shown))[1]
    shown["baseline", "dtp"] = {"cost": 1.0}
    assert "J of DTP is the same in Baseline." in verdict(make_comparison(shown))[1]


def test_leaving_and_returning_is_put_down_to_the_estimator() -> None:
    shown = {
        ("baseline", "SO"): {"cost": 9.84},
        ("baseline", "dtp"): {
            "migrations": 36.0,
            "returns": 35.0,
            "share_SO": 0.5,
            "share_HYB": 0.5,
            "cost": 9.6,
        },
    }
    text = verdict(make_comparison(shown, estimated={"LOC": 1.1, "SO": 0.91, "HYB": 0.99}))[-1]
    assert "migrated 36 times in a run of 98 windows, and 97 % of these" in text
    assert "SO at J = 0.91, and run alone SO measures 9.84" in text


def test_other_estimators_are_held_against_dtp() -> None:
    shown: Shown = {
        ("baseline", "dtp"): {"cost": [1.5 + x for x in NOISE]},
        ("baseline", "dtp+corrected"): {"cost": 1.25},
    }
    policies = ("LOC", "SO", "HYB", "dtp", "dtp+corrected")
    text = verdict(make_comparison(shown, policies=policies))[-1]
    assert text == "Against DTP, the cost J of DTP (corrected) is lower by 0.25 in Baseline."


def test_without_a_migration_nothing_is_put_down_to_anything() -> None:
    assert verdict(make_comparison({}))[-1] == "DTP never migrated after the warm-up."


def test_a_prediction_that_fits_the_cell_but_not_the_policy() -> None:
    shown = {
        ("baseline", "LOC"): {"cost": 1.0},
        ("baseline", "SO"): {"cost": 2.0},
        ("baseline", "HYB"): {"cost": 3.0},
        ("baseline", "dtp"): {"share_SO": 1.0, "migrations": 1.0, "cost": 2.0},
    }
    comparison = make_comparison(shown, estimated={"SO": 0.5})
    judgement = judge_placement(comparison, PAPER[0])
    text = " ".join(explain(comparison, judgement))
    assert judgement.answer == "differs"
    assert "LOC costs least (J = 1.00; SO 2.00, HYB 3.00)" in text
    assert "it is the policy that departs" in text


def test_a_prediction_that_does_not_fit_the_cell() -> None:
    shown = {
        ("baseline", "LOC"): {"cost": 2.0},
        ("baseline", "SO"): {"cost": 1.0},
        ("baseline", "HYB"): {"cost": 3.0},
        ("baseline", "dtp"): {"share_SO": 1.0},
    }
    comparison = make_comparison(shown)
    text = " ".join(explain(comparison, judge_placement(comparison, PAPER[0])))
    assert "the predicted placement is not the cheapest to begin with" in text


def test_predictions_are_judged_where_they_were_run() -> None:
    comparison = make_comparison({}, scenarios=("baseline", "radio-outage"))
    judged = judge_all(comparison)
    assert [item.prediction.scenario for item in judged] == ["baseline"]
    assert "in each of 2 scenarios" in question(comparison)
