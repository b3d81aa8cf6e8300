"""Pages that other distributions add, by the entry points `dwell.pages`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from dwell.report.page import Page


class WritesPage(Protocol):
    """Writes the page of a folder and prints the results."""

    def __call__(
        self, folder: Path, page: Path, *, figures: Path | None, static: bool, as_json: bool
    ) -> None:
        """Write the page; see `dwell.cli.output.write_report`."""
        ...


@dataclass(frozen=True, slots=True)
class FolderPages:
    """Pages of a kind of folder.

    Parameters
    ----------
    holds : callable
        Whether a folder is of this kind.
    """

    holds: Callable[[Path], bool]
    write: WritesPage


@dataclass(frozen=True, slots=True)
class ResultPages:
    """Pages of a kind of result.

    Parameters
    ----------
    kind : str
        Name of its class.
    page : callable
        Makes the page of a result; of a number of sections, the answer first.
    """

    kind: str
    page: Callable[[object, int | None], Page]
