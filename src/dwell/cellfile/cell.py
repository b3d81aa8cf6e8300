"""Read a cell: a YAML file, or the same as plain values, into a Problem.

One pass finds every fault. A wrong part is blanked, and the rest of its element is built. An
element that cannot be built stays as a bare name, to which references resolve. Structure (keys and
single values), construction (values against each other), traces and meaning (names, links, the DAG)
each add their faults to one list.
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

    Raises
    ------
    ProblemError
        With every fault found in the file and in its traces, each with its line and field path; a
        TraceError where the traces alone are at fault.
    """
    source = fspath(path)
    return read_cell(source, Path(source).parent if traces is None else Path(traces))[1]


def load_without_traces(path: str | PathLike[str]) -> Problem:
    """Read a cell file and none of the traces that it names: a live cell draws nothing from them.

    Returns
    -------
    Problem
        With an `UnreadTrace` for every trace.

    Raises
    ------
    ProblemError
        With every fault found in the file, each with its line and field path.
    """
    return read_cell(fspath(path), None)[1]


def read_cell(
    source: str, folder: Path | None, known: dict[object, Tables] | None = None
) -> tuple[object, Problem]:
    """Return the plain values of a cell file and its problem (see `read_problem`).

    Raises
    ------
    ProblemError
        With every fault found.
    """
    from dwell.cellfile.yaml_text import read_yaml

    faults, file = Faults(source), Path(source)
    document = read_yaml(source, faults)
    home = str(file.resolve().parent)
    return document, read_problem(document, faults, folder, file.stem or "cell", known, home=home)


def from_document(
    document: Mapping[str, object],
    *,
    folder: str | PathLike[str] = ".",
    source: str | None = None,
    is_record: bool = False,
) -> Problem:
    """Read a cell from plain values, as `dwell.model.document.to_document` makes them.

    Parameters
    ----------
    document : mapping
        Content of a cell file, as a YAML parser gives it.
    folder : str or path
        Folder of the traces that it names.
    source : str, optional
        Name of the document in messages.
    is_record : bool
        Whether a machine with other policies and estimators may have written it.

    Raises
    ------
    ProblemError
        With every fault found.
    """
    faults = Faults(source, is_record=is_record)
    return read_problem(document, faults, Path(folder), "cell")


def from_record(document: Mapping[str, object]) -> Problem:
    """Read the cell that a run's record has, as `dwell.model.document.to_document` made it.

    Its traces are named, and not read: the record has none of their data, and where their files
    are it does not say.

    Parameters
    ----------
    document : mapping
        Plain values.

    Returns
    -------
    Problem
        With an `UnreadTrace` for every trace.

    Raises
    ------
    ProblemError
        With every fault found.
    """
    return read_problem(document, Faults(is_record=True), None, "cell")


def read_problem(
    document: object,
    faults: Faults,
    folder: Path | None,
    name: str,
    known: dict[object, Tables] | None = None,
    *,
    home: str | None = None,
) -> Problem:
    """Read a document into a Problem.

    Parameters
    ----------
    document : object
        Plain values.
    faults : Faults
        Faults of the document so far, and the lines of its values.
    folder : Path, optional
        Folder of the traces that it names; with None they are not read.
    name : str
        Name of a cell without a name.
    known : dict, optional
        Traces already read for similar documents; takes the traces that are read now.
    home : str, optional
        Folder of the modules that it names, for `Problem.folder`.

    Raises
    ------
    ProblemError
        With every fault found.
    """
    from dwell.cellfile.assembly import Assembly
    from dwell.cellfile.cell_form import CELL
    from dwell.cellfile.structure import read_structure
    from dwell.cellfile.traces import declared_traces

    entry = read_structure(document, faults, CELL)
    tables: Tables | None = None
    if folder is not None:
        known = {} if known is None else known
        # Without traces nothing is imported.
        known.setdefault((), {})
        declared = tuple((path, *trace.values.items()) for path, trace in declared_traces(entry))
        if declared not in known:
            from dwell.cellfile.trace_files import read_traces

            known[declared] = read_traces(entry, folder, faults)
        tables = known[declared]
    return Assembly(entry, tables, faults, home).problem(name)
