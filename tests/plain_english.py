"""Habits of contorted English per 1,000 words of each package: `python -m tests.plain_english`.

Reads docstrings, comments and strings of four words or more in Python, comments in C++, comments
and strings in JavaScript, the text of HTML, and the pages of each folder of docs. `--worst N`
shows the worst sentences. Fails if a package or folder is above `MOST`.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ("src/dwell", "lab/src/dwell_lab")
PAGES = ("docs", "lab/docs")
#: The most habits per 1,000 words of a package or folder.
MOST = 5.0

_THINGS = "run line agent lane file folder row column page terminal window cycle value key block"
_THINGS += " module process name table mark frame worker figure thread job kind move burst node"
_PER = "run cell node candidate task window cycle fault robot process close change command figure"
_PER += (
    " algorithm concept policy scenario seed kind hardware pixel core second placement flow link"
)
_PER += " row group place claim thing"
_NAMERS = (
    "file line page log table message entry key record row column name command run cell status"
)
_NAMERS += " it"
_VERBS = "is are was were it they one comes? came goes runs? happens? the a an no was has had can"
_VERBS += " does did others that"
_NOUN_VERBS = (
    "is are was were it they the a an no has had can does comes came others runs happens one"
)
_NOUNS = "it they the a an no one there that nothing nobody not all its this more both each other"
_ADVERBS = "already never always just only also not been then now ever yet since once"
_DONE = "run play done made tell look keep compile simulated verify begin taken found be"


def _any(words: str) -> str:
    return "(?:" + "|".join(words.split()) + ")"


#: Patterns by the advice that replaces them.
HABITS = {
    "one X per Y": rf"\b(?:an?|one) {_any(_THINGS)}s? an? {_any(_PER)}\b",
    "name who prints, records, reports or receives": r"\b(?:is|are|was|were|be|been|gets?) "
    r"(?:told|said|asked|heard|spoken|let|had)\b",
    "a file states, sets or shows": rf"\b{_any(_NAMERS)} (?:says|said|tells|told|speaks?)\b",
    "name the role": r"\b(?:(?:no|some|any|every)body(?:'s| else)?|whoever|nothing but)\b",
    "repeat the noun": r"\b(?:(?:of )?(?:those|that) of|of those|those (?:that|which|whose)"
    r"|of (?:that )?which|of what)\b",
    "name the thing, not *what*": rf"(?:^|[.:;,(] ?)(?:What|Whatever) {_any(_VERBS)}\b"
    rf"|\b{_any('of by for with from to than as in on and at')} what {_any(_NOUN_VERBS)}\b",
    "put the subject first": r"(?:^|[.;:] )(?-i:Of|By which|To which|Where|Whose|Beside|Nor"
    r"|Neither) (?:an?|the|its?|no|what|all|these|those|single|nothing|one|two|more|not|each|every"
    r"|[a-z]+ing)\b",
    "if or when": rf"\b{_any('and but or also only except')} where {_any(_NOUNS)}\b",
    "with, next to, compared with": r"\bbeside\b",
    "a plain word": r"\b(?:befalls?|befell|mend(?:s|ed)?|dwelt|likewise|there(?:of|in)"
    r"|hence(?:forth)?|anew|thrice|forth|apart from that"
    r"|as a rule|meanwhile|yonder|lest)\b",
    "on average; that many; own X": r"\b(?:in the mean|so many|so much|in a row a"
    r"|at the earliest of|in the end,|of one's own)\b",
    "a verb for the idiom": r"\b(?:comes? (?:to|of(?: it)?|from nothing|round|by)|came (?:to|of)"
    r"|goes? (?:on|by|round|back|forth|through)|went on|going on|lies within|holds? of"
    r"|stands? (?:in|on|under|beside|twice|out)|makes? (?:of|up)|keeps? to|has to do)\b",
    "except": r"\b(?:all|none|nothing|any|no [a-z]+|every|each|within [0-9.]+ ?%?) ?,? but\b",
    "an active verb": rf"\b(?:has|have|had|having) (?!{_any(_ADVERBS)} )[a-z]+ "
    rf"{_any(_DONE)}\b",
    "so": r"\bso that\b",
    "the positive form": r"\b(?:not|nobody|nothing|none)\b[^.;:,|?]{0,40}"
    r"\b(?:not|nobody|nothing|none|without|unless)\b",
    "exists, is available": r"\b(?:is|are) there(?: is)?\b|\bin its place\b"
    r"|\bthere (?:is|are|was|were) (?:no|none|nothing|one|what|such)\b",
    "the noun for *one*": r"\b(?:(?:the|that|this|another|the other|a|which) one|such an?"
    r"|(?<!and )ones)\b",
}
PATTERNS = {advice: re.compile(pattern, re.IGNORECASE) for advice, pattern in HABITS.items()}

_JAVASCRIPT = re.compile(
    r"//(?P<line>[^\n]*)|/\*(?P<block>.*?)\*/"
    r"""|"(?P<double>(?:\\.|[^"\\\n])*)"|'(?P<single>(?:\\.|[^'\\\n])*)'|`(?P<template>(?:\\.|[^`\\])*)`""",
    re.DOTALL,
)
_MARKUP = re.compile(r"\{%.*?%\}|<(script|style)\b.*?</\1>|<!--|-->|\{\{.*?\}\}", re.DOTALL)
_FENCE = re.compile(r"^```.*?^```|<!--.*?-->", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_TAG = re.compile(r"<[^>]*>")
_ATTRIBUTE = re.compile(r'(?:title|alt|aria-label|placeholder)="([^"]*)"')


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of four words or more, without questions."""
    text = re.sub(r"`[^`]*`", "CODE", text)
    for part in re.split(r"(?<=[.!?:]) +(?=[A-Z*\[(_])|\n\n|\n(?=[*\-|] )|\n(?=\d+\. )", text):
        sentence = " ".join(part.split())
        if len(sentence.split()) >= 4 and not sentence.rstrip("*_) ").endswith("?"):
            yield sentence


def habits(sentence: str) -> dict[str, int]:
    """Count the habits of a sentence by the advice that replaces them."""
    counts = {advice: len(pattern.findall(sentence)) for advice, pattern in PATTERNS.items()}
    return {advice: count for advice, count in counts.items() if count}


def _python(source: str) -> Iterator[tuple[int, str]]:
    tree, documented = ast.parse(source), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                documented.add(id(node.body[0].value))  # type: ignore[attr-defined]
                text = re.sub(r"\n-{3,}", "", text)
                headings = r"(?m)^([\w*, ]+ : [^\n]*|[A-Z][a-z ]+)$"
                yield node.body[0].lineno, re.sub(headings, "\n\n", text)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or id(node) in documented:
            continue
        if isinstance(node.value, str) and len(node.value.split()) >= 4:
            yield node.lineno, node.value
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    yield from _blocks(
        (token.start[0], token.string.lstrip("# "))
        for token in tokens
        if token.type == tokenize.COMMENT and not token.string.startswith("# noqa")
    )


def _blocks(comments: Iterator[tuple[int, str]]) -> Iterator[tuple[int, str]]:
    """Join comments on consecutive lines."""
    texts: list[str] = []
    last = -1
    for line, text in comments:
        if texts and line != last + 1:
            yield last, " ".join(texts)
            texts = []
        texts.append(text)
        last = line
    yield last, " ".join(texts)


def _c_like(source: str) -> Iterator[tuple[int, str]]:
    comments = []
    for match in _JAVASCRIPT.finditer(source):
        line = source.count("\n", 0, match.start()) + 1
        if match.lastgroup in {"line", "block"}:
            comments.append((line, re.sub(r"(?m)^[/* ]+", "", match[match.lastgroup])))
        elif match.lastgroup and len(match[match.lastgroup].split()) >= 4:
            yield line, re.sub(r"\$\{[^}]*\}", "CODE", match[match.lastgroup])
    yield from _blocks(iter(comments))


def _markup(source: str) -> Iterator[tuple[int, str]]:
    for match in _ATTRIBUTE.finditer(source):
        yield source.count("\n", 0, match.start()) + 1, match[1]
    # Line breaks stay, so the line numbers do too.
    text = _MARKUP.sub(
        lambda match: "CODE" * (match[0][:2] == "{{") + "\n" * match[0].count("\n"), source
    )
    yield from enumerate(_TAG.sub("", text).splitlines(), 1)


def _markdown(source: str) -> Iterator[tuple[int, str]]:
    """Yield paragraphs, items of lists and cells of tables, without blocks of code."""
    # Line breaks stay, so the line numbers do too.
    text = _FENCE.sub(lambda match: "\n" * match[0].count("\n"), source)
    text = _LINK.sub(r"\1", re.sub(r"\*\*(.*?)\*\*", r"\1", text, flags=re.DOTALL))
    block: list[str] = []
    for number, line in enumerate(f"{text}\n".splitlines(), 1):
        begins = re.match(r" *(?:[*-]|\d+\.) ", line)
        if block and (begins or not line.strip() or line.startswith(("#", "|"))):
            yield number - len(block), "\n".join(block)
            block = []
        if line.startswith("|"):
            for cell in line.strip("|").split("|"):
                yield number, cell
        elif line.strip() and not line.startswith("#"):
            block.append(line[begins.end() :] if begins else line)
    yield number - len(block), "\n".join(block)


READERS = {
    **dict.fromkeys((".py", ".pyi"), _python),
    **dict.fromkeys((".js", ".h", ".cpp"), _c_like),
    ".html": _markup,
    ".md": _markdown,
}


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield each sentence of a file with its line."""
    for line, text in READERS[path.suffix](path.read_text(encoding="utf-8")):
        for sentence in sentences(text):
            yield line, sentence


def files() -> Iterator[tuple[str, Path]]:
    """Yield each source file with its package."""
    for folder in SOURCES:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in READERS and "uplot" not in path.parts:
                inside = path.relative_to(ROOT / folder).parts
                name = Path(folder).name
                yield f"{name}.{inside[0]}" if len(inside) > 1 else name, path
    for folder in PAGES:
        for path in sorted((ROOT / folder).rglob("*.md")):
            yield ".".join(path.relative_to(ROOT).parts[:-1]), path


def main() -> int:
    """Print the table; return 1 if a package is above its figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("only", nargs="?", default="", help="packages whose name contains this")
    parser.add_argument("--worst", type=int, default=0, help="sentences to show")
    arguments = parser.parse_args()
    words: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    worst = []
    for package, path in files():
        if arguments.only not in package:
            continue
        for line, sentence in texts(path):
            found = habits(sentence)
            words[package] += len(sentence.split())
            counts[package] += sum(found.values())
            worst.append((sum(found.values()), f"{path.relative_to(ROOT)}:{line}", sentence, found))
    worst.sort(key=lambda item: -item[0])
    for number, place, sentence, found in worst[: arguments.worst]:
        if number:
            print(f"{place}: {', '.join(found)}\n    {sentence}")
    print(f"{'package':22}{'words':>8}{'habits':>8}{'per 1,000':>11}")
    above = []
    for package in sorted(words):
        rate = 1000 * counts[package] / max(1, words[package])
        print(f"{package:22}{words[package]:8,}{counts[package]:8}{rate:11.1f}")
        if rate > MOST:
            above.append(package)
    if above:
        print(f"above {MOST:g}: {', '.join(above)} (--worst 40 shows sentences)", file=sys.stderr)
    return bool(above)


if __name__ == "__main__":
    sys.exit(main())
