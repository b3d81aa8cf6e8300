"""The page of the paper's studies: every question with its answer, and what it rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import NamedTuple

from dwell.model import Problem
from dwell.report import chapter_tables
from dwell.report.answers import answers, beginning
from dwell.report.contenders import describe_contenders
from dwell.report.formatting import listed, shown_scenario, write_number
from dwell.report.method import describe_cell, describe_scenario
from dwell.report.page import (
    definitions,
    document,
    items,
    marked,
    paragraph,
    section,
)
from dwell.report.style import PageStyle
from dwell.study.chapter import Chapter
from dwell.study.paper.running import HELD_OUT, Scale

__all__ = ["Made", "paper_html"]

TITLE = "Which placement, when, and at what cost"
STATISTICS = (
    "The unit is the seed. One run gives one number, runs of different seeds are independent, and "
    "the windows and cycles of a run are not: no interval is taken over them. Contenders play the "
    "same realisations of everything random, so that what is compared is the difference seed by "
    "seed.",
    "Intervals are 95 %, two-sided, each on its own: of means by the studentised bootstrap (4,999 "
    "resamples of the seeds), of numbers that can be infinite, such as the 95th percentile where "
    "cycles are lost, of their medians between order statistics. “Under 5 %” is said only where "
    "the one-sided 95 % limit of V_D is below 5 %; where no run shows a miss that limit is "
    "1 − 0.05^(1/n) for n seeds, whatever the number of cycles.",
    "Differences are tested by flipping signs: p is the share of all assignments of signs to the "
    "seeds whose mean is at least as far from 0. All comparisons that answer one question on one "
    "metric are a family, and their p values are adjusted together by Holm's procedure. Where a "
    "difference is “not shown”, none is excluded either: the interval says what is left open.",
    "Sobol indices part the variance of an output over a whole range of settings: S1 is the share "
    "that a setting makes alone, ST the share in which it takes part at all. They are taken of "
    "outputs that do not contain what is varied, at the same seeds in every point; their intervals "
    "say whether there were enough points, and small ones may come out below 0 by chance.",
)
LIMITS = (
    "Simulated, not measured on machines: every number follows from the cell file's assumptions "
    "about execution times, links and disturbances.",
    "The cell is the paper's as we had to fill it in: which of its numbers are the paper's, which "
    "are measured and which are assumed is written down in docs/canonical-cell.md.",
    "Regret is measured against the cheapest run of a few that know the future. That is no bound: "
    "it may be negative, and in steady scenarios it counts the noise of single windows, which "
    "nobody can foresee.",
)


ADDED = "a placement that is not among the cell's: the chapter that shows it says what it is."


class Made(NamedTuple):
    """How a study was made.

    Parameters
    ----------
    scale : Scale or None
        How much was simulated.
    elapsed_s : float or None
        What it took.
    versions : mapping of str to str
    failures : mapping of str to str
        Chapters that are missing, and why.
    replayed : sequence of Problem
        Cells that replay measurements.
    """

    scale: Scale | None
    elapsed_s: float | None
    versions: Mapping[str, str]
    failures: Mapping[str, str]
    replayed: Sequence[Problem] = ()


def paper_html(
    chapters: Sequence[Chapter],
    problem: Problem,
    look: PageStyle,
    made: Made,
    drawings: Mapping[str, str],
    files: Mapping[int, str],
) -> str:
    """Return the page.

    Parameters
    ----------
    chapters : sequence of Chapter
    problem : Problem
    look : PageStyle
        Of all chapters.
    made : Made
    drawings : mapping of str to str
        Every figure as HTML, by its file's name without an ending.
    files : mapping of int to str
        What the files of figures and tables are called, by their identities.

    Returns
    -------
    str
        HTML without scripts, and without anything that is loaded from elsewhere.
    """
    body = [f"<h1>{TITLE}</h1>", paragraph(_subtitle(problem, made), "subtitle")]
    body += answers(chapters, look)
    for name, why in made.failures.items():
        body.append(paragraph(f"The chapter “{name}” is missing: {why}", "bad"))
    names = [*look.placements, *look.palette.policies]
    told = describe_contenders(problem, names)
    told |= {name: ADDED for name in look.placements if name not in problem.candidates}
    if told:
        body.append(section("Who plays", definitions(told)))
    for chapter in chapters:
        body.append(_chapter(chapter, look, drawings, files))
    body.append(section("The cell and what happens to it", *_cell(problem, made)))
    body.append(section("How it was measured", *map(paragraph, STATISTICS)))
    body.append(section("What it does not say", items(LIMITS)))
    return document(TITLE, body)


def _subtitle(problem: Problem, made: Made) -> str:
    parts = [f"Cell “{problem.name}”, simulated"]
    if made.replayed:
        parts.append(f"{listed(f'“{one.name}”' for one in made.replayed)}, which replay traces")
    if made.scale is not None:
        scale = made.scale
        parts.append(
            f"{scale.seeds} seeds, runs of {scale.windows} windows (dynamic scenarios: "
            f"{scale.dynamic_windows}) of {problem.window_cycles} cycles"
        )
    parts.append(", ".join(f"{name} {text}" for name, text in made.versions.items()))
    if made.elapsed_s is not None:
        parts.append(f"made in {_lasted(made.elapsed_s)}")
    text = "; ".join(part for part in parts if part)
    if made.scale is not None and made.scale.name != "full":
        text += ". A look, with few seeds: hardly anything can be shown with so few"
    return f"{text}."


def _lasted(seconds: float) -> str:
    if seconds < 90:
        return f"{write_number(seconds, 0)} s"
    return f"{write_number(seconds / 60, 0)} minutes"


def _chapter(
    chapter: Chapter, look: PageStyle, drawings: Mapping[str, str], files: Mapping[int, str]
) -> str:
    parts = [
        beginning(chapter, look),
        paragraph(look.prose(chapter.verdict), "question"),
        *([items(map(look.prose, chapter.evidence), "evidence")] if chapter.evidence else []),
        paragraph(_begun(look.prose(chapter.design)), "note"),
    ]
    for figure in chapter.figures:
        name = files[id(figure)]
        note = chapter_tables.noted(figure, look)
        caption = f"<figcaption>{marked(note)}</figcaption>" if note else ""
        parts.append(
            f"<h3>{marked(look.prose(figure.title))}</h3>\n"
            f'<figure>\n<div class="drawing">{drawings[name]}</div>\n{caption}'
            f"{_files('figures', name, ('svg', 'pdf'))}\n</figure>"
        )
    for item in chapter.tables:
        name = files[id(item)]
        parts.append(chapter_tables.html(item, look, main=item.slug == chapter.slug))
        parts.append(_files("tables", name, ("csv", "tex")))
    if chapter.findings:
        found = (_begun(look.prose(text)) for text in chapter.findings)
        parts += ["<h3>What else came out</h3>", items(found)]
    return "\n".join([*parts, "</section>"])


def _begun(text: str) -> str:
    """Begin a sentence with a capital, if it begins with a word."""
    return text[:1].upper() + text[1:] if text[1:2].islower() else text


def _files(folder: str, name: str, endings: Sequence[str]) -> str:
    """Return where the same thing is as a file, beside the page."""
    path = escape(f"{folder}/{name}")
    links = ", ".join(
        f'<a href="{path}.{ending}">{"" if i else path}.{ending}</a>'
        for i, ending in enumerate(endings)
    )
    return f'<p class="note files">{links}</p>'


def _cell(problem: Problem, made: Made) -> Iterator[str]:
    yield definitions(describe_cell(problem) | _scale(made))
    if problem.scenarios:
        yield paragraph("What the scenarios add to the cell:")
        yield items(
            f"{shown_scenario(name)}: {describe_scenario(problem.scenario(name))}."
            for name in problem.scenarios
        )


def _scale(made: Made) -> dict[str, str]:
    if made.scale is None:
        return {}
    scale = made.scale
    return {
        "seeds": f"1 to {scale.seeds} of a comparison, 1 to {scale.grid_seeds} of a grid, 1 to "
        f"{scale.sobol_seeds} of a Sobol design; {HELD_OUT + 1} to {HELD_OUT + scale.tuning_seeds} "
        "are held out, for tuning alone",
        "windows": f"{scale.windows} of a run in a steady scenario, {scale.dynamic_windows} in a "
        "dynamic one",
    }
