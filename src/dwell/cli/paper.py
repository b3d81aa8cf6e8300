"""`dwell study paper`: every chapter, a line for each, and the report."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

import dwell
from dwell.cli.demo import find_examples
from dwell.cli.output import Progress, print_json, progress, working
from dwell.model import Problem
from dwell.report import paper_report
from dwell.report.style import PageStyle
from dwell.study.demo import REAL
from dwell.study.paper import CHAPTERS, Chapter, Paper, Scale, paper_problem, paper_study
from dwell.study.paper.paper import REAL as REPLAY

__all__ = ["PAPER", "Request", "run_paper"]

#: Stands in the place of a study file.
PAPER = "paper"

INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for; None is the default."""

    quick: bool
    out: Path | None
    processes: int | None
    dask: str | None
    seeds: int | None
    windows: int | None
    chapters: tuple[str, ...]
    real: Path | None
    examples: Path | None

    @property
    def scale(self) -> Scale:
        """How much is to be simulated."""
        scale = Scale.quick() if self.quick else Scale.full()
        if self.seeds is not None:
            scale = replace(scale, seeds=self.seeds)
        if self.windows is not None:
            scale = replace(scale, windows=self.windows, dynamic_windows=self.windows)
        return scale

    @property
    def folder(self) -> Path:
        """Where everything goes: a look is another study, and gets a folder of its own."""
        return self.out or Path("studies", f"{PAPER}-quick" if self.quick else PAPER)


def run_paper(request: Request, *, as_json: bool) -> bool:
    """Write every chapter, print its verdict, write the report.

    Returns
    -------
    bool
        Whether every chapter was finished; what the others failed with is printed.

    Raises
    ------
    DwellError
        If the cell is missing or wrong.
    typer.BadParameter
        If a chapter is named that there is not, or not without its measurements.
    typer.Exit
        If it was interrupted.
    """
    unknown = [name for name in request.chapters if name not in (*CHAPTERS, REPLAY)]
    if unknown:
        known = ", ".join((*CHAPTERS, REPLAY))
        raise typer.BadParameter(f"there is no chapter {unknown[0]!r}; the chapters are {known}")
    if REPLAY in request.chapters and request.real is None:
        raise typer.BadParameter(f"chapter {REPLAY!r} needs the measurements: give --real FOLDER")
    examples = find_examples(request.examples)
    problem = paper_problem(examples)
    real = _real_problems(examples, request.real)

    def done(chapter: Chapter) -> None:
        if not as_json:
            typer.echo(f"{look.prose(chapter_line(chapter))}\n")

    look = PageStyle.of(problem)
    resumed = (request.folder / "runs").exists()
    begun_s = time.monotonic()
    with _resumable(request.folder):
        paper = paper_study(
            problem,
            folder=request.folder,
            scale=request.scale,
            processes=request.processes,
            dask=request.dask,
            show=_shown,
            done=done,
            only=request.chapters or None,
            real=real,
        )
    page = None
    if paper.chapters:
        with working("writing the report"):
            page = paper_report(
                paper.chapters,
                problem,
                request.folder,
                scale=request.scale,
                # What went on from finished runs does not say how long they took.
                elapsed_s=None if resumed else time.monotonic() - begun_s,
                failures=paper.failures,
                replayed=real,
            )
    for name, error in paper.failures.items():
        typer.echo(f"error: chapter {name}: {error}", err=True)
    if as_json:
        print_json(_as_json(paper, page, request.folder))
    elif page is not None:
        typer.echo(f"report: {page}")
    return not paper.failures


def chapter_line(chapter: Chapter) -> str:
    """Return what the terminal shows of a chapter."""
    answer = "" if chapter.answer == "none asked" else f" {chapter.answer.capitalize()}."
    return f"{chapter.title}{answer} {chapter.verdict}"


def _real_problems(examples: Path, traces: Path | None) -> Sequence[Problem]:
    """Return the cells that replay the measurements in a folder."""
    if traces is None:
        return ()
    return [dwell.load(examples / name, traces=traces) for name in REAL]


@contextmanager
def _shown(study: str) -> Iterator[Progress | None]:
    with progress(f"simulating {study}") as shown:
        yield shown


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Say after Ctrl-C how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(
            f"interrupted: the runs that are finished stay in {folder}; the same command goes on "
            "from there",
            err=True,
        )
        raise typer.Exit(INTERRUPTED) from None


def _as_json(paper: Paper, page: Path | None, folder: Path) -> dict[str, Any]:
    chapters = [
        {
            "chapter": chapter.slug,
            "title": chapter.title,
            "answer": chapter.answer,
            "verdict": chapter.verdict,
            "evidence": list(chapter.evidence),
            "findings": list(chapter.findings),
        }
        for chapter in paper.chapters
    ]
    failures = {name: str(error) for name, error in paper.failures.items()}
    return {"report": page, "folder": folder, "chapters": chapters, "failures": failures}
