"""Pages of figures and tables, each one HTML file that loads nothing from elsewhere.

A page contains its figures as SVG. Unless the page is static, a script draws them again with
Vega-Lite: with tooltips, and a choice of policies and seeds.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from dwell.report.figure import Figure, javascript, svg
from dwell.report.formatting import SYMBOL
from dwell.report.table import WORDS, Table

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).with_name("templates")


class Fact(NamedTuple):
    """A number that answers the question of the page.

    `value` includes the unit. `error` is the interval or another remark; `word` is the verdict.
    """

    name: str
    value: str
    error: str = ""
    word: str = ""


class Definitions(NamedTuple):
    """Terms and their meanings, plain text."""

    entries: Mapping[str, str]


Block: TypeAlias = "Figure | Table | Definitions"


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page.

    `note` is a text under the heading and `anchor` a name for links within the page. A click opens
    a `folded` section.
    """

    title: str
    blocks: Sequence[Block]
    note: str = ""
    anchor: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Page:
    """A report, the answer first.

    A reader can choose among `policies`, a mapping of names to colours, and among `seeds`.
    """

    title: str
    subtitle: str
    sections: Sequence[Section]
    facts: Sequence[Fact] = ()
    policies: Mapping[str, str] | None = None
    seeds: Sequence[int] = ()

    @property
    def figures(self) -> Iterator[Figure]:
        """All figures, in the order of the page."""
        for part in self.sections:
            yield from (block for block in part.blocks if isinstance(block, Figure))

    @property
    def tables(self) -> Iterator[Table]:
        """All tables, in the order of the page."""
        for part in self.sections:
            yield from (block for block in part.blocks if isinstance(block, Table))


def page_html(page: Page, *, static: bool = False) -> str:
    """Return a page as HTML; a static page has no scripts and no data for them.

    The content security policy of the page forbids loading anything and evaluating text as code.
    """
    scripts: list[str] = []
    specs: dict[str, str] = {}
    if not static:
        scripts = [javascript(), (TEMPLATES / "page.js").read_text(encoding="utf-8")]
        # The first end tag ends a script, even inside a string.
        specs = {
            figure.slug: json.dumps(figure.spec(), separators=(",", ":")).replace("</", "<\\/")
            for figure in page.figures
            if not figure.widths
        }
    kinds = {Figure: "figure", Table: "table", Definitions: "definitions"}
    return (
        environment()
        .get_template("page.html")
        .render(
            page=page,
            scripts=[script.replace("</script", "<\\/script") for script in scripts],
            specs=specs,
            static=static,
            style=(TEMPLATES / "page.css").read_text(encoding="utf-8"),
            words=WORDS,
            symbol=SYMBOL.pattern,
            drawn=svg,
            kind_of=lambda block: kinds[type(block)],
        )
    )


@cache
def environment() -> Environment:
    """Return the environment of the templates, with the filters ``marked`` and ``digest``."""
    import jinja2

    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters["marked"] = _marked
    found.filters["digest"] = _digest
    return found


def _digest(script: str) -> str:
    """Return the SHA-256 digest of an inline script for a content security policy, in base 64."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _marked(text: str) -> str:
    """Return a text as HTML: escaped, with `code` and indexed symbols marked up."""
    from jinja2.filters import do_mark_safe

    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text, quote=False))
    html = SYMBOL.sub(r"\1<sub>\2</sub>", html)
    # A no-break space keeps a number and its unit on one line.
    return do_mark_safe(re.sub(r"(?<=\d) (?=(?:%|ms|s)(?!\w))", "\u00a0", html))
