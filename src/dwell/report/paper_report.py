"""The report of the paper's studies: one page, and every figure and table as files beside it."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dwell.cellfile.work_folder import write_whole
from dwell.errors import SimulationError
from dwell.model import FrozenDict, Problem
from dwell.report import chapter_tables
from dwell.report.drawing import draw
from dwell.report.paper_page import Made, paper_html
from dwell.report.style import PageStyle
from dwell.report.svg import drawn, in_page, pdf_file, svg_file
from dwell.study.chapter import Chapter, Figure
from dwell.study.paper.running import Scale
from dwell.study.software import versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

__all__ = ["paper_report"]

# Bytes from which on a figure of the page is a picture, and not a drawing.
LARGEST = 400_000
DOTS_AN_INCH = 160

NOTHING: Mapping[str, object] = FrozenDict()


def paper_report(
    chapters: Sequence[Chapter],
    problem: Problem,
    folder: Path,
    *,
    scale: Scale | None = None,
    elapsed_s: float | None = None,
    failures: Mapping[str, object] = NOTHING,
    replayed: Sequence[Problem] = (),
) -> Path:
    """Write the report of chapters.

    Parameters
    ----------
    chapters : sequence of Chapter
    problem : Problem
        The cell they are about.
    folder : Path
        Gets ``report.html``, which needs nothing else; ``figures`` with every figure as SVG and
        PDF; and ``tables`` with every table as CSV (the whole frame) and for LaTeX. Files are
        called after their chapter and slug.
    scale : Scale, optional
        How much was simulated.
    elapsed_s : float, optional
        What that took, seconds.
    failures : mapping of str to error or str
        Chapters that are missing, and why.
    replayed : sequence of Problem
        Cells that replay measurements, where a chapter is about them.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    SimulationError
        If the folder cannot be written; what is there stays.
    """
    look = PageStyle.of(problem, chapters)
    files = _named(chapters)
    why = {name: str(error) for name, error in failures.items()}
    made = Made(scale, elapsed_s, versions(), why, replayed)
    drawings = {}
    for chapter in chapters:
        for figure in chapter.figures:
            name = files[id(figure)]
            drawings[name] = _write_figure(figure, look, folder / "figures", name)
        for table in chapter.tables:
            name = files[id(table)]
            _write(folder / "tables" / f"{name}.csv", chapter_tables.csv(table).encode())
            text = chapter_tables.latex(table, look, name)
            _write(folder / "tables" / f"{name}.tex", text.encode())
    page = folder / "report.html"
    html = paper_html(chapters, problem, look, made, drawings, files)
    _write(page, html.encode())
    return page


def _named(chapters: Sequence[Chapter]) -> dict[int, str]:
    """Return what the files of every figure and table are called, by its identity."""
    found: dict[int, str] = {}
    for kind in ("figures", "tables"):
        taken: set[str] = set()
        for chapter in chapters:
            for item in getattr(chapter, kind):
                name = _name(chapter.slug, item.slug)
                while name in taken:
                    name += "-again"
                taken.add(name)
                found[id(item)] = name
    return found


def _name(chapter: str, slug: str) -> str:
    """Join the two; a slug may begin with its chapter's."""
    inside = slug == chapter or slug.startswith(f"{chapter}-")
    return slug if inside else f"{chapter}-{slug}"


def _write_figure(figure: Figure, look: PageStyle, folder: Path, name: str) -> str:
    """Write a figure's files; return what stands in the page."""
    canvas = draw(figure, look)
    # Places are found once, and not again for every file.
    canvas.draw_without_rendering()
    canvas.set_layout_engine("none")
    svg = drawn(canvas, name)
    shown = in_page(svg, look.prose(figure.title))
    if len(shown) > LARGEST:
        shown = _picture(canvas, look.prose(figure.title))
    _write(folder / f"{name}.svg", svg_file(svg, look.prose(figure.title)))
    _write(folder / f"{name}.pdf", pdf_file(canvas, look.prose(figure.title)))
    return shown


def _picture(canvas: Canvas, description: str) -> str:
    """Return a figure of very many marks as dots, on white."""
    from html import escape

    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=DOTS_AN_INCH, facecolor="white")
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="{escape(description)}" src="data:image/png;base64,{data}">'


def _write(path: Path, data: bytes) -> None:
    """Write a file that appears complete or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data)
    except OSError as error:
        raise SimulationError(
            f"{path}: cannot be written ({error.strerror or error}); the finished runs stay: "
            "remove the cause, and ask for the report again"
        ) from None
