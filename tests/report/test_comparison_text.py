"""A comparison on the terminal."""

from __future__ import annotations

from dwell.report import comparison_text
from tests.report.pages import small_comparison


def test_it_has_a_table_for_every_scenario_and_the_verdict() -> None:
    comparison = small_comparison()
    text = comparison_text(comparison)
    for name in ("Baseline", "Robot CPU stress"):
        assert text.count(f"\n{name} ") + text.startswith(name) == 1
    assert text.count("ATP *") == len(comparison.scenarios)
    assert "* our reconstruction" in text
    assert "V_D %" in text
    assert "LOC %" in text
    assert "\n- " in text


def test_it_is_plain_text_without_trailing_blanks() -> None:
    text = comparison_text(small_comparison())
    assert "\x1b" not in text
    assert all(line == line.rstrip() for line in text.splitlines())


def test_it_folds_into_a_narrow_terminal() -> None:
    assert max(map(len, comparison_text(small_comparison(), width=80).splitlines())) <= 80
