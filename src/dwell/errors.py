"""The exceptions of Dwell, one class per kind of error under one root.

Also the line that a command prints for an error, and its exit code.
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
]

#: Longest text of an error from foreign code, in characters.
LONGEST = 300
#: Folder of this package.
PACKAGE = os.path.join(os.path.dirname(__file__), "")
#: Name of the distribution; `dwell` on the package index is an unrelated project.
DISTRIBUTION = "dwell-placement"

#: How to install the laboratory from a checkout; no package index has it.
INSTALL_LAB = "in a checkout of Dwell: python -m pip install ./lab"

#: The package of each optional module, and the extra that installs the package.
OPTIONAL = {
    "cryptography": ("cryptography", "live"),
    "distributed": ("distributed", "dask"),
    "jinja2": ("Jinja2", "report"),
    "mcap": ("mcap", "mcap"),
    "msgspec": ("msgspec", "live"),
    "polars": ("Polars", "sim"),
    "prometheus_client": ("prometheus-client", "dash"),
    "psutil": ("psutil", "live"),
    "rosbags": ("rosbags", "ros2"),
    "scipy": ("SciPy", "sim"),
    "starlette": ("Starlette", "dash"),
    "uvicorn": ("uvicorn", "dash"),
    "vl_convert": ("vl-convert", "report"),
    "xxhash": ("xxhash", "ros2"),
    "zenoh": ("Zenoh", "live"),
}
#: Packages of modules that no extra installs.
FURTHER = {"SALib": "salib", "cv2": "opencv-python-headless", "osqp": "osqp"}


class ExitCode(IntEnum):
    """Exit codes, the same for every command."""

    #: The command succeeded.
    DONE = 0
    #: The work failed, or a check found a fault.
    FAILED = 1
    #: The input is wrong: arguments, files, names.
    WRONG = 2
    #: The user pressed Ctrl-C.
    INTERRUPTED = 130


class DwellError(Exception):
    """Root of every error that Dwell raises on purpose; its text is for the user."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a problem: the field, the description and the remedy."""

    #: The field, as ``tasks.perception.on.E.exec_ms``; empty for the whole problem.
    path: str
    #: The value, the bound it breaks, and the remedy.
    message: str
    #: Line in the file, from 1.
    line: int | None = None

    def __str__(self) -> str:
        """Return ``path: message``."""
        return f"{self.path}: {self.message}" if self.path else self.message


class ProblemError(DwellError, ValueError):
    """A cell, or a part of it, is not valid; the error lists every fault found.

    A string in place of faults is one fault without a path. `source` is the file of the problem.
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
    """A trace of measurements is missing, empty, too short, or has a value out of range."""


class PlacementError(DwellError, ValueError):
    """A placement lacks a task, or puts a task on a node where it may not run."""


class MetricError(DwellError, ValueError):
    """A window's metrics, or an estimate of them, are missing, not finite or negative."""


class PolicyError(DwellError, ValueError):
    """A policy is unknown, or its decision cannot be executed."""


class MissingPartError(DwellError, ValueError):
    """A name or a command belongs to a distribution of Dwell that is not installed."""


class SimulationError(DwellError, RuntimeError):
    """A simulation does not support a requested feature."""


class KernelError(DwellError, RuntimeError):
    """The compiled kernel is missing, damaged, of other sources or for another processor.

    `flaw` names the file and the fault, and `remedy` the command that repairs it.
    """

    def __init__(self, flaw: str, remedy: str) -> None:
        super().__init__(flaw, remedy)
        self.flaw = flaw
        self.remedy = remedy

    def __str__(self) -> str:
        """Return ``flaw; remedy``."""
        return f"{self.flaw}; {self.remedy}"


class RunError(DwellError, ValueError):
    """A folder is not the record of a run, or another version wrote it."""


class UnwritableError(RunError):
    """A run cannot be written because its disk is full or fails; a later attempt may succeed."""


class ProfileError(DwellError, ValueError):
    """A subject of measurement is missing, or a file is not a profile of measurements."""


class MeasurementError(DwellError, RuntimeError):
    """A measurement is incomplete because its subject failed or a peer disconnected."""


class LiveError(DwellError, RuntimeError):
    """The live runtime cannot do its work."""


class TrustError(DwellError, ValueError):
    """A key, a certificate or a list of them is missing, invalid, or of another identity."""


class UserNote(str):
    """Note on an exception from a user's code: class, call, error and line."""

    __slots__ = ()


def user_note(error: BaseException) -> UserNote | None:
    """Return the note of an error that a user's code raised."""
    notes = vars(error).get("__notes__", ())
    return next((note for note in notes if isinstance(note, UserNote)), None)


def describe_raised(error: BaseException, *, users: bool = False) -> str:
    """Describe an error from foreign code, as ``ValueError: no frame (stages.py:12)``.

    With `users`, name the last line in the file that Dwell called, or no line if the call itself
    failed; otherwise name the last line of the traceback.
    """
    lines = str(error).strip().splitlines()
    raised = f"{type(error).__name__}: {lines[0][:LONGEST]}" if lines else type(error).__name__
    frames = list(traceback.extract_tb(error.__traceback__))
    if users:
        outside = [one for one in frames if not one.filename.startswith(PACKAGE)]
        frames = [one for one in outside if one.filename == outside[0].filename]
    # The text of a SyntaxError already includes its position.
    if isinstance(error, SyntaxError) or not frames:
        return raised
    file, line = frames[-1].filename, frames[-1].lineno
    return raised if "importlib" in file else f"{raised} ({file.rpartition('/')[2]}:{line})"


def installing(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def not_installed(*extras: str) -> list[str]:
    """Return the packages of some extras that are not installed."""
    return [
        package
        for module, (package, extra) in OPTIONAL.items()
        if extra in extras and find_spec(module) is None
    ]


def lacking(*extras: str) -> str:
    """Return which packages of some extras are not installed, and the command that installs them.

    The last extra contains the others. Returns an empty string if all are installed.
    """
    packages = not_installed(*extras)
    verb = "is" if len(packages) == 1 else "are"
    what = f"{' and '.join(packages)} {verb} not installed"
    return f"{what}; {installing(extras[-1])}" if packages else ""


def missing_package(error: ModuleNotFoundError) -> DwellError | None:
    """Return the error that names an optional package and the command that installs it.

    Returns None if the module belongs to no optional package.
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

    Returns None for an error of another kind.
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
    # Errors in the input are ValueErrors.
    code = ExitCode.WRONG if isinstance(error, ValueError) else ExitCode.FAILED
    return str(error) if located else f"error: {error}", code
