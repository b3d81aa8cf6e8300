"""LaTeX: text and numbers escaped, tables with the rules of the package booktabs."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence

from dwell.report.formatting import SYMBOL

__all__ = ["escaped", "tabular"]

SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
}
#: Rows that a page has room for.
ONE_PAGE = 60
#: Letters of a line, the room between columns included, up to which a size fits a page of A4:
#: upright, and turned.
SIZES = ((92, "footnotesize"), (106, "scriptsize"))
TURNED = ((138, "footnotesize"), (160, "scriptsize"))
#: What is no letter of the engines that read the file as it is, and is written in its place.
SIGNS = {
    "−": "$-$",
    "±": r"$\pm$",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "∞": r"$\infty$",
    "→": r"$\rightarrow$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "⌊": r"$\lfloor$",
    "⌋": r"$\rfloor$",
    "⌈": r"$\lceil$",
    "⌉": r"$\rceil$",
    "–": "--",
    "—": "---",
    "“": "``",
    "”": "''",
    "’": "'",
    "…": r"\dots{}",
    "\u00a0": "~",
    "\u2009": r"\,",
    **{
        letter: f"$\\{name}$"
        for letter, name in {
            "α": "alpha",
            "β": "beta",
            "Δ": "Delta",
            "λ": "lambda",
            "μ": "mu",
            "ρ": "rho",
            "σ": "sigma",
            "ω": "omega",
            "Π": "Pi",
            "π": "pi",
        }.items()
    },
}
#: Unicode has two of these.
SIGNS["µ"] = SIGNS["μ"]


def escaped(text: str) -> str:
    """Return plain text as LaTeX; symbols with an index, such as V_D, become mathematics."""
    first, *rest = SYMBOL.split(text)
    parts = [_plain(first)]
    for letter, index, after in zip(rest[::3], rest[1::3], rest[2::3], strict=True):
        base = SIGNS[letter].strip("$") if letter in SIGNS else letter
        parts += [rf"${base}_{{\mathrm{{{index}}}}}$", _plain(after)]
    return "".join(parts)


def _plain(text: str) -> str:
    """Escape every letter; those that nobody has heard of lose what makes them so."""
    return "".join(map(_letter, text.replace("`", "")))


def _letter(letter: str) -> str:
    if letter in SPECIAL:
        return SPECIAL[letter]
    if letter in SIGNS:
        return SIGNS[letter]
    if letter.isascii() or (letter.isalpha() and ord(letter) < 0x180):
        return letter if letter.isprintable() else " "
    bare = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return "".join(SPECIAL.get(one, one) for one in bare) or "?"


def tabular(
    head: Sequence[str],
    columns: str,
    rows: Iterable[tuple[str, Sequence[str]]],
    *,
    caption: str,
    label: str,
) -> str:
    """Return a table: a float as wide as the text at most, or one of several pages.

    Parameters
    ----------
    head : sequence of str
        Plain texts.
    columns : str
        A letter for each: ``l`` or ``r``.
    rows : iterable of (group, cells)
        Plain texts. A row with a group is its name, across the table, and has no cells.
    caption : str
        Plain text.
    label : str
        For references.
    """
    rows = list(rows)
    body: list[str] = []
    for group, cells in rows:
        if group:
            name = rf"\textit{{{escaped(group)}}}"
            body += [r"\addlinespace"] if body else []
            body.append(rf"\multicolumn{{{len(columns)}}}{{@{{}}l@{{}}}}{{{name}}} \\")
        else:
            body.append(_row(cells))
    titled = rf"\caption{{{escaped(caption)}}}\label{{{label}}}"
    top = [r"\toprule", _row(head), r"\midrule"]
    shape = f"{{@{{}}{columns}@{{}}}}"
    if len(body) > ONE_PAGE:
        size, turned = _size([head, *(row for _, row in rows if row)])
        return "\n".join(
            [
                rf"% needs \usepackage{{booktabs,longtable{',lscape' * turned}}}",
                *([r"\begin{landscape}"] * turned),
                rf"\begingroup\{size}\setlength{{\tabcolsep}}{{3pt}}",
                rf"\begin{{longtable}}{shape}",
                rf"{titled} \\",
                *(*top, r"\endfirsthead"),
                *(*top, r"\endhead"),
                *(r"\bottomrule", r"\endfoot"),
                *body,
                *(r"\end{longtable}", r"\endgroup"),
                *([r"\end{landscape}"] * turned),
                "",
            ]
        )
    return "\n".join(
        [
            r"% needs \usepackage{booktabs,graphicx}",
            *(r"\begin{table}", r"\centering", titled),
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{shape}",
            *top,
            *body,
            *(r"\bottomrule", r"\end{tabular}%", "}", r"\end{table}", ""),
        ]
    )


def _size(rows: Sequence[Sequence[str]]) -> tuple[str, bool]:
    """Return the size of letters at which a table is no wider than the text, and if on its side."""
    widest = [max(map(len, column)) for column in zip(*rows, strict=True)]
    letters = sum(widest) + 1.4 * len(widest)
    upright = [(name, False) for most, name in SIZES if letters <= most]
    turned = [(name, True) for most, name in TURNED if letters <= most]
    return next(iter(upright + turned), ("tiny", True))


def _row(cells: Sequence[str]) -> str:
    return " & ".join(map(_cell, cells)) + r" \\"


def _cell(text: str) -> str:
    shown = escaped(text)
    # After \\, a bracket would be taken for a length.
    return f"{{{shown}}}" if shown.startswith("[") else shown
