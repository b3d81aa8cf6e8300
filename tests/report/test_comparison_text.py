"""A comparison on the terminal."""

from __future__ import annotations

import numpy as np

from dwell.report import comparison_text
from tests.report.pages import small_comparison
from tests.study.cell import SEEDS, make_comparison


def test_it_has_a_table_for_every_scenario_and_the_verdict() -> None:
    comparison = small_comparison()
    text = comparison_text(comparison)
    for name in ("Baseline", "Robot CPU stress"):
        assert text.splitlines().count(name) == 1
    assert text.count("\nATP ") == len(comparison.scenarios)
    assert "ATP is our reconstruction" in " ".join(text.split())
    assert "V_D %" in text
    assert "LOC, SO and HYB: % of the windows" in text
    assert "\n- " in text


def test_it_is_plain_text_without_trailing_blanks() -> None:
    text = comparison_text(small_comparison())
    assert "\x1b" not in text
    assert all(line == line.rstrip() for line in text.splitlines())


def test_it_folds_into_a_narrow_terminal() -> None:
    assert max(map(len, comparison_text(small_comparison(), width=80).splitlines())) <= 80


def test_contenders_are_called_as_in_the_page() -> None:
    policies = ("LOC", "SO", "HYB", "dtp", "dtp+corrected", "cusum+corrected")
    text = comparison_text(make_comparison({}, policies=policies))
    assert "+corrected" not in text
    for name in ("DTP (corrected)", "CUSUM (corrected)"):
        assert text.count(f"\n{name} ") == 1
        assert f"J of {name} is the same" in " ".join(text.split())


def test_tables_with_uneven_intervals_fit_into_100_columns() -> None:
    skewed = np.geomspace(1, 3, len(SEEDS))
    wide = {"violation_rate": 0.2 * skewed, "l95_ms": 30 * skewed, "cost": 3 * skewed}
    uneven = {name: [float(x) for x in values] for name, values in wide.items()}
    uneven["migrations"] = [float(x) for x in 10 * skewed]
    policies = ("LOC", "SO", "HYB", "atp", "dtp", "cusum+corrected")
    shown = {("baseline", policy): uneven for policy in policies}
    text = comparison_text(make_comparison(shown, policies=policies))
    tables = text[: text.index("Means over")]
    assert tables.count("±") == 4 * len(policies)
    assert "[" not in tables
    assert max(map(len, text.splitlines())) <= 100
