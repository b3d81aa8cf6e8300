"""Check the structure of a document and return what of it can be used.

Every fault of structure is found in one pass; the checks of meaning then see all the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import ChoiceForm, Entry, FormKey, Shape, required
from dwell.model.bounds import as_read, shown
from dwell.model.dotted_paths import Step, dotted

MAX_DEPTH = 40
#: By the key of its version: a kind of file, and the command that takes it.
KINDS = {
    "dwell": ("cell", "dwell run"),
    "dwell-study": ("study", "dwell study"),
    "dwell-fleet": ("fleet", "dwell fleet run"),
}


@dataclass(frozen=True, slots=True)
class FileKind:
    """A kind of file.

    Parameters
    ----------
    shape : Shape
        Allowed contents; its required keys have stand-ins.
    what : str
        Name of the kind in messages: ``cell``.
    key : str
        The key that holds the version of the format.
    version : int
        The version that is read.
    """

    shape: Shape
    what: str
    key: str
    version: int

    @classmethod
    def of(
        cls, what: str, key: str, version: int, title: str, says: str, *keys: FormKey
    ) -> FileKind:
        """Return a kind of file with these keys after the key of its version."""
        first = required(
            "version", ChoiceForm((version,)), "Version of this format.", version, named=key
        )
        return cls(Shape(title, says, (first, *keys)), what, key, version)

    @property
    def begin(self) -> str:
        """First line of a file of this kind."""
        return f"{self.key}: {self.version}"


def read_structure(document: object, faults: Faults, kind: FileKind) -> Entry:
    """Return the document as an entry without its faulty values.

    Parameters
    ----------
    document : object
        Plain values; not changed.
    faults : Faults
        Takes every fault of structure.

    Returns
    -------
    Entry
        None stands for elements that could not be read.

    Raises
    ------
    ProblemError
        At once where the document is no file of this kind and version at all.
    """
    if not isinstance(document, Mapping):
        has, begin = as_read(document), kind.begin
        faults.refuse(
            "", f"a {kind.what} file is a mapping that begins with `{begin}`; this is {has}"
        )
    for key, (what, command) in KINDS.items():
        if key in document and kind.key not in document:
            faults.refuse(
                key,
                f"this is a {what}, not a {kind.what}, which begins with `{kind.begin}`; run it by "
                f"`{command} FILE`",
            )
    values = _plain_mapping(document, (), faults)
    _check_version(values, faults, kind)
    # Required keys have stand-ins, so the entry itself is never faulty.
    entry: Entry = kind.shape.read(values, "", faults)
    return entry


def _check_version(values: dict[str, Any], faults: Faults, kind: FileKind) -> None:
    version = values.get(kind.key)
    if version is None or (type(version) is int and version == kind.version):
        return
    values[kind.key] = kind.version
    if type(version) is int and version > kind.version:
        # Other apparent faults may be right in that version.
        faults.refuse(
            kind.key,
            f"schema version {shown(version)} is newer than this Dwell, which reads "
            f"{kind.version}; upgrade dwell",
        )
    faults.add(kind.key, f"{as_read(version)} is not allowed; write `{kind.begin}`")


def _plain_mapping(
    document: Mapping[Any, object], steps: tuple[Step, ...], faults: Faults
) -> dict[str, Any]:
    """Return a copy in dicts and lists, with None for other objects."""
    values: dict[str, Any] = {}
    for key, item in document.items():
        path, name = (*steps, str(key)), key
        if isinstance(key, bool | int | float | None):
            name = faults.take_as_text(dotted(path), key, str(key))
        if isinstance(name, str) and not _is_torn(name):
            values[name] = _plain(item, path, faults)
        else:
            faults.add(dotted(path), f"the key {as_read(key)} is not a text")
    return values


def _plain(value: object, steps: tuple[Step, ...], faults: Faults) -> object:
    path = dotted(steps)
    if len(steps) > MAX_DEPTH:
        faults.add(path, f"nested deeper than {MAX_DEPTH} levels")
        return None
    if isinstance(value, Mapping):
        return _plain_mapping(value, steps, faults)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(item, (*steps, i), faults) for i, item in enumerate(value)]
    if isinstance(value, str) and _is_torn(value):
        faults.add(path, f"{as_read(value)} holds half of a character; remove it")
        return None
    return value


def _is_torn(text: str) -> bool:
    """Whether a text holds a lone surrogate, which no file can."""
    return any("\ud800" <= sign <= "\udfff" for sign in text)
