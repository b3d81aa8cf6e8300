"""A page: sections of figures and tables, as one file without anything from outside.

Figures stand in the page as static SVG, and, unless the page is static, as Vega-Lite that a script
of the page draws again: with numbers under the pointer, and a choice of policies and seeds.
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
    """A number that answers the page's question.

    Parameters
    ----------
    value : str
        With its unit.
    error : str
        Its interval, or what else belongs to it.
    word : str
        Word of a verdict, where there is one.
    """

    name: str
    value: str
    error: str = ""
    word: str = ""


class Definitions(NamedTuple):
    """Terms, and what stands for them; plain text."""

    entries: Mapping[str, str]


Block: TypeAlias = "Figure | Table | Definitions"


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page.

    Parameters
    ----------
    note : str
        Fixed text under the heading.
    anchor : str
        Name for links within the page.
    folded : bool
        Whether it is opened by a click.
    """

    title: str
    blocks: Sequence[Block]
    note: str = ""
    anchor: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Page:
    """A report, the answer first.

    Parameters
    ----------
    subtitle : str
        Subject of the report.
    policies : mapping of str to str
        Colours of the policies that can be chosen, by how they are written.
    seeds : sequence of int
        Seeds that can be chosen.
    """

    title: str
    subtitle: str
    sections: Sequence[Section]
    facts: Sequence[Fact] = ()
    policies: Mapping[str, str] | None = None
    seeds: Sequence[int] = ()

    @property
    def figures(self) -> Iterator[Figure]:
        """All figures, in their order."""
        for part in self.sections:
            yield from (block for block in part.blocks if isinstance(block, Figure))

    @property
    def tables(self) -> Iterator[Table]:
        """All tables, in their order."""
        for part in self.sections:
            yield from (block for block in part.blocks if isinstance(block, Table))


def page_html(page: Page, *, static: bool = False) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    static : bool
        Whether scripts, and the data that they draw, are left out.

    Returns
    -------
    str
        One file: nothing is loaded from elsewhere, and nothing is evaluated as code (its content
        security policy forbids both).
    """
    scripts: list[str] = []
    specs: dict[str, str] = {}
    if not static:
        scripts = [javascript(), (TEMPLATES / "page.js").read_text(encoding="utf-8")]
        # A script ends at the first end tag, whatever it stands in.
        specs = {
            figure.slug: json.dumps(figure.spec(), separators=(",", ":")).replace("</", "<\\/")
            for figure in page.figures
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
            drawn=svg,
            kind_of=lambda block: kinds[type(block)],
        )
    )


@cache
def environment() -> Environment:
    """Return the templates, with how texts are marked up."""
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
    """Return how a content security policy names a script that stands in the page."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _marked(text: str) -> str:
    """Escape a text; set `code` and symbols with an index."""
    from jinja2.filters import do_mark_safe

    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text, quote=False))
    html = SYMBOL.sub(r"\1<sub>\2</sub>", html)
    # A number stays on one line with its unit.
    return do_mark_safe(re.sub(r"(?<=\d) (?=(?:%|ms|s)(?!\w))", "\u00a0", html))
