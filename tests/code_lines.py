"""Lines of code of the three flats, and the most that each may have: `python -m tests.code_lines`.

Blank lines, comments, imports and docstrings do not count. A change that adds more than its purpose
needs raises a bound here, where a reviewer sees it.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: Folders of each flat, the deepest first; the rest of `src/dwell` is the simulator.
FLATS = {
    "lab": ("lab/src",),
    "live": ("src/dwell/live", "src/dwell/dash", "src/dwell/calibration"),
    "simulator": ("src/dwell",),
}
#: The most lines of code.
MOST = {"simulator": 28_258, "live": 16_504, "lab": 6_807}


def code_lines(text: str) -> int:
    """Return the number of lines that are code."""
    tree = ast.parse(text)
    other: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                other.update(_lines(first))
        if isinstance(node, ast.Import | ast.ImportFrom):
            other.update(_lines(node))
    lines = text.splitlines()
    other.update(number for number, line in enumerate(lines, 1) if not line.strip())
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        number = token.start[0]
        if token.type == tokenize.COMMENT and lines[number - 1].lstrip().startswith("#"):
            other.add(number)
    return len(lines) - len(other)


def _lines(node: ast.stmt) -> range:
    return range(node.lineno, (node.end_lineno or node.lineno) + 1)


def flat_of(path: Path) -> str:
    """Return the flat that a source belongs to."""
    return next(
        flat
        for flat, folders in FLATS.items()
        if any(path.is_relative_to(ROOT / folder) for folder in folders)
    )


def counted_lines() -> Counter[str]:
    """Return the lines of code of each flat."""
    found: Counter[str] = Counter()
    for folder in ("src/dwell", "lab/src"):
        for path in (ROOT / folder).rglob("*.py"):
            found[flat_of(path)] += code_lines(path.read_text(encoding="utf-8"))
    return found


def main() -> None:
    """Print the lines of each flat; exit with 1 if one has too many."""
    found = counted_lines()
    for flat, most in MOST.items():
        print(f"{flat}: {found[flat]:,} lines of code (at most {most:,})")
    sys.exit(any(found[flat] > most for flat, most in MOST.items()))


if __name__ == "__main__":
    main()
