"""Read a cell: a YAML file, or the same as plain values, into a Problem.

One pass finds every fault. A part that is wrong is blanked, so that what remains of its element
can still be built; an element that cannot is kept as a bare name, so that references to it
resolve. Structure (keys and single values), construction (values against each other), traces and
meaning (names, links, the DAG) then each add their faults to one list.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING

from dwell.cellfile.document_faults import Faults
from dwell.model import Problem

if TYPE_CHECKING:
    from dwell.cellfile.traces import Tables


def load(path: str | PathLike[str], *, traces: str | PathLike[str] | None = None) -> Problem:
    """Read a cell file.

    Parameters
    ----------
    path : str or path
        A YAML 1.2 (or JSON) file.
    traces : str or path, optional
        Folder where the relative names of trace files start; the cell's own where None.

    Returns
    -------
    Problem

    Raises
    ------
    ProblemError
        With every fault found in the file and in its traces, each with its line and field path; a
        TraceError where the traces alone are at fault.
    """
    source = fspath(path)
    faults = Faults(source)
    text = _read_text(source, faults)
    folder = Path(source).parent if traces is None else Path(traces)
    return read_problem(text, faults, folder, Path(source).stem or "cell", home=_home(source))


def load_without_traces(path: str | PathLike[str]) -> Problem:
    """Read a cell file and none of the traces that it names: a live cell draws nothing from them.

    Parameters
    ----------
    path : str or path

    Returns
    -------
    Problem
        With an `UnreadTrace` for every trace.

    Raises
    ------
    ProblemError
        With every fault found in the file, each with its line and field path.
    """
    source = fspath(path)
    faults = Faults(source)
    text = _read_text(source, faults)
    return _without_traces(text, faults, Path(source).stem or "cell", home=_home(source))


def _home(source: str) -> str:
    """Return the folder in which a cell file's own modules lie."""
    return str(Path(source).resolve().parent)


def _read_text(source: str, faults: Faults) -> object:
    """Return what a cell file says.

    Raises
    ------
    ProblemError
        If it is no YAML, or no cell.
    """
    from dwell.cellfile.yaml_text import read_yaml

    text = read_yaml(source, faults)
    if faults.at(""):
        raise faults.error()  # the file as such; there is nothing to read on
    if isinstance(text, dict) and "dwell-study" in text and "dwell" not in text:
        faults.add("dwell-study", "this is a study, not a cell; run it by `dwell study FILE`")
        raise faults.error()
    return text


def from_document(
    document: Mapping[str, object],
    *,
    folder: str | PathLike[str] = ".",
    source: str | None = None,
) -> Problem:
    """Read a cell from plain values, as `dwell.model.document.to_document` makes them.

    A candidate may name anchored tasks, too, as the documents of earlier versions do; a cell file
    may not.

    Parameters
    ----------
    document : mapping
        What a YAML parser would make of a cell file.
    folder : str or path
        Where the traces that it names are.
    source : str, optional
        Name of the document in messages.

    Returns
    -------
    Problem

    Raises
    ------
    ProblemError
        With every fault found.
    """
    return read_problem(document, Faults(source), Path(folder), "cell", anchored=True)


def from_record(document: Mapping[str, object]) -> Problem:
    """Read the cell that a run's record has, as `dwell.model.document.to_document` made it.

    Its traces are named, and not read: the record has none of their data, and where their files
    are it does not say.

    Parameters
    ----------
    document : mapping
        Of this version of Dwell, or of an older one, whose candidates name anchored tasks, too.

    Returns
    -------
    Problem
        With an `UnreadTrace` for every trace.

    Raises
    ------
    ProblemError
        With every fault found.
    """
    return _without_traces(document, Faults(), "cell", anchored=True, judged=False)


def _without_traces(
    document: object,
    faults: Faults,
    name: str,
    *,
    anchored: bool = False,
    judged: bool = True,
    home: str | None = None,
) -> Problem:
    """Read a document into a Problem whose traces are named only; see `Assembly`."""
    from dwell.cellfile.assembly import Assembly
    from dwell.cellfile.structure import CELL, read_structure

    entry = read_structure(document, faults, CELL)
    return Assembly(entry, None, faults, anchored, judged, home).problem(name)


def read_problem(
    document: object,
    faults: Faults,
    folder: Path,
    name: str,
    known: dict[object, Tables] | None = None,
    *,
    anchored: bool = False,
    home: str | None = None,
) -> Problem:
    """Read a document into a Problem.

    Parameters
    ----------
    document : object
        Plain values.
    faults : Faults
        Those of the document so far, and the lines of its values.
    folder : Path
        Where the traces that it names are.
    name : str
        For a cell that does not name itself.
    known : dict, optional
        Traces that were read for documents like this one; takes those that are read now.
    anchored : bool
        Whether a candidate may name anchored tasks where they are.
    home : str, optional
        Folder of the modules that it names, for `Problem.folder`.

    Raises
    ------
    ProblemError
        With every fault found.
    """
    from dwell.cellfile.assembly import Assembly
    from dwell.cellfile.document_faults import dotted
    from dwell.cellfile.structure import CELL, read_structure
    from dwell.cellfile.traces import declared_traces, read_traces

    known = {} if known is None else known
    entry = read_structure(document, faults, CELL)
    declared = tuple((dotted(steps), trace) for steps, trace in declared_traces(entry, ()))
    if declared not in known:
        known[declared] = read_traces(entry, folder, faults)
    return Assembly(entry, known[declared], faults, anchored=anchored, home=home).problem(name)
