"""The exceptions of Dwell: one root, one class for each kind of thing that can be wrong.

With what a command says of them, and the code that it exits with.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib.util import find_spec

__all__ = [
    "DwellError",
    "ExitCode",
    "Fault",
    "KernelError",
    "LiveError",
    "MeasurementError",
    "MetricError",
    "MissingPartError",
    "PlacementError",
    "PolicyError",
    "ProblemError",
    "ProfileError",
    "RunError",
    "SimulationError",
    "TraceError",
    "TrustError",
    "UnwritableError",
    "UserNote",
    "describe_raised",
    "installing",
    "line_and_code",
    "missing_package",
    "not_installed",
    "user_note",
]

#: Characters of what foreign code has raised.
LONGEST = 300
#: Folder of this package.
PACKAGE = os.path.join(os.path.dirname(__file__), "")
#: Name of the distribution: `dwell` on the package index is somebody else's.
DISTRIBUTION = "dwell-placement"

#: The line that installs the laboratory, which no index has, from a checkout.
INSTALL_LAB = "in a checkout of Dwell: python -m pip install ./lab"

#: By module: the package that brings it, and the extra that brings the package.
OPTIONAL = {
    "cryptography": ("cryptography", "live"),
    "distributed": ("distributed", "dask"),
    "jinja2": ("Jinja2", "report"),
    "mcap": ("mcap", "mcap"),
    "msgspec": ("msgspec", "live"),
    "polars": ("Polars", "sim"),
    "prometheus_client": ("prometheus-client", "dash"),
    "psutil": ("psutil", "live"),
    "scipy": ("SciPy", "sim"),
    "starlette": ("Starlette", "dash"),
    "uvicorn": ("uvicorn", "dash"),
    "vl_convert": ("vl-convert", "report"),
    "zenoh": ("Zenoh", "live"),
}
#: By module: a package that no extra brings.
FURTHER = {"SALib": "salib", "cv2": "opencv-python-headless", "osqp": "osqp"}


class ExitCode(IntEnum):
    """Exit codes, the same for every command."""

    #: All that was asked for is there.
    DONE = 0
    #: The work failed, or what was examined is not as it has to be.
    FAILED = 1
    #: The input is wrong: arguments, files, names.
    WRONG = 2
    #: By Ctrl-C.
    INTERRUPTED = 130


class DwellError(Exception):
    """Root of every error that Dwell raises on purpose; its text is meant for the user."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong with a problem: where it is, what it is, and what to do about it.

    Parameters
    ----------
    path : str
        The field, as ``tasks.perception.on.E.exec_ms``; empty for the whole.
    message : str
        The value found, the bound it breaks, and the remedy.
    line : int, optional
        Where it stands in the file, from 1.
    """

    path: str
    message: str
    line: int | None = None

    def __str__(self) -> str:
        """Return ``path: message``."""
        return f"{self.path}: {self.message}" if self.path else self.message


class ProblemError(DwellError, ValueError):
    """A cell, or a part of one, is not valid; it carries every fault that was found.

    Parameters
    ----------
    faults : sequence of Fault, or str
        Faults; a string is one fault without a path.
    source : str, optional
        The file the problem was read from.
    """

    def __init__(self, faults: Sequence[Fault] | str, source: str | None = None) -> None:
        if isinstance(faults, str):
            faults = (Fault("", faults),)
        self.faults: tuple[Fault, ...] = tuple(faults)
        self.source = source
        super().__init__("\n".join(self._located(fault) for fault in self.faults))

    def _located(self, fault: Fault) -> str:
        """Return ``cell.yaml:12: path: message``, as compilers and editors write it."""
        line = "" if fault.line is None else f"{fault.line}:"
        if self.source:
            return f"{self.source}:{line} {fault}"
        return f"line {line} {fault}" if line else str(fault)

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        """Pickle by the constructor's arguments (errors cross process borders)."""
        return type(self), (self.faults, self.source)


class TraceError(ProblemError):
    """A trace of measurements is missing, empty, too short, or holds values it may not."""


class PlacementError(DwellError, ValueError):
    """A placement does not cover the tasks it should, or puts one where it may not run."""


class MetricError(DwellError, ValueError):
    """A window's metrics, or an estimate of them, are missing, not finite or negative."""


class PolicyError(DwellError, ValueError):
    """A policy is unknown, or decided something that cannot be done."""


class MissingPartError(DwellError, ValueError):
    """A name or a command is of a distribution of Dwell that is not installed."""


class SimulationError(DwellError, RuntimeError):
    """A simulation was asked for something it cannot do."""


class KernelError(DwellError, RuntimeError):
    """The compiled kernel is missing, damaged, of other sources or for another processor.

    Parameters
    ----------
    flaw : str
        The file, and what is wrong with it.
    remedy : str
        The line that mends it.
    """

    def __init__(self, flaw: str, remedy: str) -> None:
        super().__init__(flaw, remedy)
        self.flaw = flaw
        self.remedy = remedy

    def __str__(self) -> str:
        """Return ``flaw; remedy``."""
        return f"{self.flaw}; {self.remedy}"


class RunError(DwellError, ValueError):
    """A folder is not the record of a run, or not one that this version can read."""


class UnwritableError(RunError):
    """A run cannot be written at the moment: its disk is full, or fails; later it may be."""


class ProfileError(DwellError, ValueError):
    """A subject of measurement is not there, or a file is not a profile of measurements."""


class MeasurementError(DwellError, RuntimeError):
    """A measurement could not be finished: what was measured failed, or a peer went away."""


class LiveError(DwellError, RuntimeError):
    """The live runtime cannot do what it was asked to."""


class TrustError(DwellError, ValueError):
    """A key, a certificate or a list of them is missing, not valid, or not who it should be."""


class UserNote(str):
    """Note on an exception that a user's code raised: the class, the call, the error, its line."""

    __slots__ = ()


def user_note(error: BaseException) -> UserNote | None:
    """Return the note of an error that a user's code raised."""
    notes = vars(error).get("__notes__", ())
    return next((note for note in notes if isinstance(note, UserNote)), None)


def describe_raised(error: BaseException, *, users: bool = False) -> str:
    """Return ``ValueError: no frame (stages.py:12)``, of an error that foreign code has raised.

    Parameters
    ----------
    users : bool
        Whether to name the last line in the file that Dwell called, not the last line of all; no
        line if the call itself failed.
    """
    lines = str(error).strip().splitlines()
    raised = f"{type(error).__name__}: {lines[0][:LONGEST]}" if lines else type(error).__name__
    frames = list(traceback.extract_tb(error.__traceback__))
    if users:
        outside = [one for one in frames if not one.filename.startswith(PACKAGE)]
        frames = [one for one in outside if one.filename == outside[0].filename]
    # A SyntaxError says by itself where it is.
    if isinstance(error, SyntaxError) or not frames:
        return raised
    file, line = frames[-1].filename, frames[-1].lineno
    return raised if "importlib" in file else f"{raised} ({file.rpartition('/')[2]}:{line})"


def installing(extra: str) -> str:
    """Return the command that installs what an extra brings, for a message that misses it."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def not_installed(*extras: str) -> list[str]:
    """Return the packages of some extras that are not installed."""
    return [
        package
        for module, (package, extra) in OPTIONAL.items()
        if extra in extras and find_spec(module) is None
    ]


def missing_package(error: ModuleNotFoundError) -> DwellError | None:
    """Return the error that names an optional package and the command that installs it.

    Returns
    -------
    DwellError or None
        None where the module is none of an optional package of Dwell's.
    """
    module = (error.name or "").partition(".")[0]
    if module in OPTIONAL:
        package, extra = OPTIONAL[module]
        return DwellError(f"{package} is not installed; {installing(extra)}")
    if module in FURTHER:
        return DwellError(f"{module} is not installed; pip install {FURTHER[module]}")
    return None


def line_and_code(error: Exception) -> tuple[str, ExitCode] | None:
    """Return the line that a command prints for an error, and its exit code.

    Returns
    -------
    tuple of str and ExitCode, or None
        None for errors of other kinds.
    """
    if note := user_note(error):
        return f"error: {note}", ExitCode.WRONG
    if isinstance(error, ModuleNotFoundError):
        missing = missing_package(error)
        return None if missing is None else (f"error: {missing}", ExitCode.FAILED)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"error: {where}{error.strerror or error}", ExitCode.FAILED
    if not isinstance(error, DwellError):
        return None
    located = isinstance(error, ProblemError) and error.source is not None
    # Of the errors, those of what was given are ValueErrors.
    code = ExitCode.WRONG if isinstance(error, ValueError) else ExitCode.FAILED
    return str(error) if located else f"error: {error}", code
