"""Text for LaTeX: nothing that it takes for a command, nothing that it does not know."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dwell.report.latex import escaped, tabular


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("5 % & more", r"5 \% \& more"),
        ("a_b #1 {x} $3", r"a\_b \#1 \{x\} \$3"),
        ("V_D under α_L", r"$V_{\mathrm{D}}$ under $\alpha_{\mathrm{L}}$"),
        ("−0.5 ± 0.1 ms → ∞", r"$-$0.5 $\pm$ 0.1 ms $\rightarrow$ $\infty$"),
        ("“as `code`”", "``as code''"),
        ("1\u2009234", r"1\,234"),
        ("Müller ☃", "Müller ?"),
        (
            "a\\b ~ ^ <x>",
            r"a\textbackslash{}b \textasciitilde{} \textasciicircum{} "
            r"\textless{}x\textgreater{}",
        ),
    ],
)
def test_escaping(text: str, latex: str) -> None:
    assert escaped(text) == latex


@settings(max_examples=40)
@given(st.text(max_size=20))
def test_whatever_is_escaped_is_balanced_and_known(text: str) -> None:
    latex = escaped(text)
    bare = re.sub(r"\\[\\&%$#_{}]|\\[a-z]+\{\}", "", latex)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    assert not re.search(r"[&%#~](?<!\\.)", bare.replace("~", "", latex.count("~")))
    outside = re.sub(r"\$[^$]*\$", "", bare)
    assert "_" not in outside
    assert "^" not in outside
    assert all(letter.isascii() or ord(letter) < 0x180 for letter in latex)
    assert "\n" not in latex


def test_a_bracket_at_the_begin_of_a_row_is_no_argument() -> None:
    text = tabular(["a"], "l", [("", ["[1, 2]"]), ("", ["[3, 4]"])], caption="c", label="tab:x")
    assert "{[1, 2]} \\\\\n{[3, 4]} \\\\" in text


def test_groups_stand_across_the_table() -> None:
    rows = [("A_1 & co", ()), ("", ["x", "1"]), ("B", ()), ("", ["y", "2"])]
    text = tabular(["a", "b"], "lr", rows, caption="c", label="tab:x")
    assert r"\multicolumn{2}{@{}l@{}}{\textit{A\_1 \& co}} \\" in text
    assert text.count(r"\addlinespace") == 1
    assert text.startswith("% needs")


def test_a_table_of_more_than_a_page_goes_on_on_the_next() -> None:
    rows = [("", [str(i), "1"]) for i in range(80)]
    text = tabular(["a", "b"], "lr", rows, caption="c", label="tab:x")
    assert text.count(r"a & b \\") == 2
    for word in ("longtable", r"\endfirsthead", r"\endhead", r"\endfoot"):
        assert word in text
    assert r"\begin{table}" not in text


@pytest.mark.parametrize(
    ("width", "size", "turned"),
    [
        (30, "footnotesize", False),
        (50, "scriptsize", False),
        (60, "footnotesize", True),
        (75, "scriptsize", True),
        (200, "tiny", True),
    ],
)
def test_a_wide_table_of_several_pages_has_small_letters_or_lies_on_its_side(
    width: int, size: str, turned: bool
) -> None:
    rows = [("", ["x" * width, "1" * width])] * 70
    text = tabular(["a", "b"], "lr", rows, caption="c", label="l")
    assert rf"\begingroup\{size}\setlength" in text
    assert (r"\begin{landscape}" in text) == turned
    assert text.count(r"\begin{") == text.count(r"\end{")
    assert ("lscape" in text.splitlines()[0]) == turned
