"""Output of commands: tables, JSON, whole files, and progress on a terminal."""

from __future__ import annotations

import hashlib
import json
import re
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from dwell.errors import ExitCode, RunError
from dwell.files import Content, write_whole
from dwell.record.json_documents import json_ready

if TYPE_CHECKING:
    from dwell.errors import Fault
    from dwell.model.progress import Progress
    from dwell.record import Run
    from dwell.report.page import Page

#: Seconds between two lines of progress where stderr is no terminal.
EVERY_S = 10.0
BLOCKS = "▁▂▃▄▅▆▇█"


def interrupted(message: str) -> NoReturn:
    """Say what is finished after Ctrl-C, and exit."""
    typer.echo(f"interrupted: {message}", err=True)
    raise typer.Exit(ExitCode.INTERRUPTED)


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as text: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for row in (head, *rows):
        first, *rest = zip(row, widths, strict=True)
        cells = [first[0].ljust(first[1]), *(text.rjust(width) for text, width in rest)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def with_error(mean: str, error: float) -> str:
    """Return a mean, with a nonzero standard error to the mean's last digit."""
    return f"{mean} ± {error:.{len(mean.partition('.')[2])}f}" if error else mean


def block(share: float) -> str:
    """Return a block that is so high, from 0 to 1, for a line of them."""
    return BLOCKS[min(max(int(share * len(BLOCKS)), 0), len(BLOCKS) - 1)]


def warn(file: Path, warnings: Iterable[Fault]) -> None:
    """Print what is seldom meant in a file on stderr, one a line."""
    for warning in warnings:
        typer.echo(f"{file}: warning: {warning}", err=True)


def print_json(value: Mapping[str, Any]) -> None:
    """Print JSON on stdout (see `json_text`)."""
    typer.echo(json_text(value))


def json_text(value: Mapping[str, Any], indent: int | None = 2) -> str:
    """Return JSON, on one line where `indent` is None; NaN and infinities become null."""
    return json.dumps(json_ready(value), indent=indent, allow_nan=False)


def file_name(name: str, *, more: str = "") -> str:
    """Return a name as part of a file's name: other signs than letters, digits, _ . - become _.

    Parameters
    ----------
    more : str
        Signs that stay, too.
    """
    return re.sub(rf"[^\w.{more}-]", "_", name)


def write_file(path: Path, content: Content) -> None:
    """Write a file that appears complete or not at all; an older one survives until then.

    Raises
    ------
    OSError
        If that fails; it names the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(None, "is a folder; name a file", str(path))
    try:
        write_whole(path, content, durable=False)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def mark_of(*source: object) -> str:
    """Return the last line of a page made from a source, given as values for JSON."""
    text = json.dumps(source, sort_keys=True, default=str)
    return f"<!-- made from {hashlib.sha256(text.encode()).hexdigest()} -->\n"


def mark_of_run(run: Run) -> str:
    """Return the last line of the page of a run; the same run made again has the same."""
    return mark_of(run.run_id or {**run.meta, "versions": None})


def require_own(page: Path, mark: str) -> None:
    """Refuse to replace a file, except a page with the same mark (see `mark_of`).

    Raises
    ------
    RunError
        If it is anything else.
    """
    if page.is_file() and not page.read_bytes().endswith(mark.encode()):
        raise RunError(
            f"{page} was made from something else; name another place with --out, or remove it"
        )


def write_report(
    page: Page, path: Path | None, *, figures: Path | None, static: bool, mark: str
) -> None:
    """Write a page; with a folder `figures`, write its figures and tables as files, too.

    Parameters
    ----------
    path : Path, optional
        File of the page; None writes no page.
    figures : Path, optional
        Folder, made if missing; files of the same names are replaced.
    static : bool
        Whether the page is without scripts.
    mark : str
        Last line of the page (see `mark_of`).
    """
    from dwell.report.figure_files import figure_files
    from dwell.report.page import page_html

    if path is not None:
        write_file(path, page_html(page, static=static) + mark)
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        for name, data in figure_files(page):
            write_whole(figures / name, data, durable=False)


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show an activity indicator on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(what):
        yield


@contextmanager
def progress(what: str, *, cycles: float | None = None) -> Iterator[Progress]:
    """Show on stderr how much is done: a bar on a terminal, elsewhere a line every `EVERY_S`.

    Parameters
    ----------
    what : str
        Text before the bar.
    cycles : float, optional
        Cycles of each item that is counted; the rate is shown where it is given.
    """
    if not sys.stderr.isatty():
        with _lines(what) as show:
            yield show
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        row = bar.add_task(what, total=None, rate="")

        def shown(done: int, total: int) -> None:
            bar.update(row, completed=done, total=total)
            speed = bar.tasks[0].speed
            if cycles is not None and speed is not None:
                bar.update(row, rate=f"{speed * cycles / 1e6:.2f} M cycles/s")

        yield shown


@contextmanager
def _lines(what: str) -> Iterator[Progress]:
    """Print a line on stderr every `EVERY_S` seconds."""
    over, told = threading.Event(), what

    def show(done: int, total: int) -> None:
        nonlocal told
        told = f"{what}: {done} of {total}"

    def tell() -> None:
        while not over.wait(EVERY_S):
            typer.echo(told, err=True)

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield show
    finally:
        over.set()
        teller.join()


def proof(proving: Mapping[str, Any]) -> str:
    """Return in words how far a proof is."""
    return "proving {candidate}: {done} of {needed} cycles".format_map(proving)
