"""Check the structure of a document and return what of it can be used.

pydantic finds every fault of structure in one pass. What is at fault is then blanked (set to None,
which every optional part may be, or to a harmless stand-in), again and again until the document
validates, so that the checks of meaning see all the rest of it.
"""

from __future__ import annotations

import copy
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Generic, Literal, TypeVar, Union, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from dwell.cellfile.document_faults import Faults, Step, dotted
from dwell.cellfile.entries import CellEntry, Entry
from dwell.cellfile.rendering import as_read
from dwell.model import bounds
from dwell.model.document import VERSION
from dwell.model.semantics import closest, nearest

MAX_DEPTH = 40
# How like a required key an unknown one has to be to stand for it: `teir` for `tier`.
MISSPELT = 0.7

E = TypeVar("E", bound=Entry)


@dataclass(frozen=True, slots=True)
class Form(Generic[E]):
    """The form of a kind of file.

    Parameters
    ----------
    entry : type of Entry
        Its structure.
    what : str
        Kind of document, for messages: ``cell``.
    key : str
        The key that holds the version of the format.
    version : int
        The version that is read.
    sections, parts : mapping
        Stand-ins for what an entry cannot be without: by path for sections, by key for parts of
        elements.
    may_be_empty : callable
        Whether nothing may be given at a place of the file.
    """

    entry: type[E]
    what: str
    key: str
    version: int
    sections: Mapping[str, object]
    parts: Mapping[str, object] = field(default_factory=dict)
    may_be_empty: Callable[[tuple[Step, ...]], bool] = lambda _: False

    @property
    def begin(self) -> str:
        """First line of such a file."""
        return f"{self.key}: {self.version}"


CELL: Form[CellEntry] = Form(
    CellEntry,
    "cell",
    "dwell",
    VERSION,
    sections={
        "dwell": VERSION,
        "period_ms": bounds.LARGEST,
        "nodes": {},
        "tasks": {},
        "candidates": {},
    },
    parts={"tier": "robot", "exec_ms": 1, "delay_ms": 1},
)


def read_structure(document: object, faults: Faults, form: Form[E]) -> E:
    """Return the document as an entry, less what is at fault in it.

    Parameters
    ----------
    document : object
        Plain values; not changed.
    faults : Faults
        Takes every fault of structure.
    form : Form
        `CELL`, or that of another kind of file.

    Returns
    -------
    Entry
        A valid entry of the form. None stands for elements that could not be read.

    Raises
    ------
    ProblemError
        At once where the document is no file of this form and version at all.
    """
    if not isinstance(document, Mapping):
        has, begin = as_read(document), form.begin
        faults.refuse(
            "", f"a {form.what} file is a mapping that begins with `{begin}`; this is {has}"
        )
    values = _plain_mapping(document, (), faults, form)
    _check_version(values, faults, form)
    known = faults.at
    while True:
        try:
            return form.entry.model_validate(values)
        except ValidationError as error:
            details = error.errors(include_url=False, include_context=False)
        # Reported first, all of them: blanking one may take others away.
        for missing in _misspelt(details, form):
            faults.excuse(dotted(missing))
        for detail in details:
            path = dotted(detail["loc"])
            if not known(path):
                faults.add(path, _message(detail, form))
        for detail in details:
            _blank(values, detail["loc"], detail["type"], form)
        # From now on, what surfaces beside a known fault may be an effect of blanking it.
        known = faults.touches


def _check_version(values: dict[str, object], faults: Faults, form: Form[E]) -> None:
    version = values.get(form.key)
    if version is None or (type(version) is int and version == form.version):
        return
    values[form.key] = form.version  # true and 1.0 equal 1, and pydantic would take them
    if type(version) is int and version > form.version:
        # Whatever else looks wrong may be right in that version.
        faults.refuse(
            form.key,
            f"schema version {bounds.shown(version)} is newer than this Dwell, which reads "
            f"{form.version}; upgrade dwell",
        )
    faults.add(form.key, f"{as_read(version)} is not allowed; write `{form.begin}`")


def _plain_mapping(
    document: Mapping[Any, object], steps: tuple[Step, ...], faults: Faults, form: Form[E]
) -> dict[str, object]:
    """Return a deep copy in dicts and lists, which can be blanked; what is no document is None."""
    values: dict[str, object] = {}
    for key, item in document.items():
        path, name = (*steps, str(key)), key
        if isinstance(key, bool | int | float | None):
            name = faults.take_as_text(dotted(path), key, str(key))
        if isinstance(name, str) and not _is_torn(name):
            values[name] = _plain(item, path, faults, form)
        else:
            faults.add(dotted(path), f"the key {as_read(key)} is not a text")
    return values


def _plain(value: object, steps: tuple[Step, ...], faults: Faults, form: Form[E]) -> object:
    path = dotted(steps)
    if len(steps) > MAX_DEPTH:
        faults.add(path, f"nested deeper than {MAX_DEPTH} levels")
        return None
    if isinstance(value, Mapping):
        return _plain_mapping(value, steps, faults, form)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(item, (*steps, i), faults, form) for i, item in enumerate(value)]
    if isinstance(value, str) and _is_torn(value):
        faults.add(path, f"{as_read(value)} holds half of a character; remove it")
        return None
    name = faults.unquoted(value)
    if name is not None and _declaration(steps, form)[0] is str:
        return name
    if value is None and not form.may_be_empty(steps) and not faults.at(path):
        faults.add(path, f"nothing is given; {_filling(steps, form)}")
    return value


def _filling(steps: tuple[Step, ...], form: Form[E]) -> str:
    """Return a remedy for a key or an item without a value."""
    declared = _declaration(steps, form)[1]
    if declared is not None and declared.is_required():
        return f"give a value: {_lower(declared.description)}"
    what = f"the key {steps[-1]!r}" if isinstance(steps[-1], str) else "the item"
    return f"give a value, or remove {what}"


def _is_torn(text: str) -> bool:
    """Whether a text holds a lone surrogate, which no file can."""
    return any("\ud800" <= sign <= "\udfff" for sign in text)


def _blank(values: dict[str, Any], loc: Sequence[Step], kind: str, form: Form[E]) -> None:
    """Take what is at fault out of the document, so that the rest of it validates."""
    if loc[0] == "candidates" and len(loc) > 2:
        loc = loc[:2]  # half a placement would look as if tasks were missing
    if loc[0] == "nodes" and "accelerators" in loc[2:3]:
        loc = loc[:2]  # a node without its accelerators, as if tasks named unknown ones
    parent: Any = values
    for step in loc[:-1]:
        parent = parent[step] if _has(parent, step) else None
    last = loc[-1]
    stand_ins: Mapping[Any, object] = (
        form.sections if len(loc) == 1 else form.parts if len(loc) > 2 else {}
    )
    if parent is None:
        return  # went with another fault's part
    if kind == "extra_forbidden":
        parent.pop(last, None)
    elif last in stand_ins and not (_has(parent, last) and parent[last] == stand_ins[last]):
        parent[last] = copy.copy(stand_ins[last])
    elif _has(parent, last) and parent[last] is not None:
        parent[last] = None
    else:
        _blank(values, loc[:-1], "", form)


def _has(container: object, step: Step) -> bool:
    if isinstance(container, dict):
        return step in container
    return isinstance(container, list) and isinstance(step, int) and step < len(container)


def _misspelt(details: Sequence[ErrorDetails], form: Form[E]) -> Iterator[tuple[Step, ...]]:
    """Yield the places of keys that are missing because an unknown one stands for them."""
    missing = {detail["loc"] for detail in details if detail["type"] == "missing"}
    for detail in details:
        *parent, key = detail["loc"]
        if detail["type"] == "extra_forbidden":
            meant = closest(str(key), _keys(_declaration(parent, form)[0]), MISSPELT)
            if (*parent, meant) in missing:
                yield (*parent, meant)


def _message(detail: ErrorDetails, form: Form[E]) -> str:
    """Return what is wrong, and what to do, in the words of the file."""
    kind, value, loc = detail["type"], detail["input"], detail["loc"]
    if kind == "wrong":
        return detail["msg"]
    owner, declared = _declaration(loc[:-1], form)[0], _declaration(loc, form)[1]
    if kind == "extra_forbidden":
        return f"unknown key {loc[-1]!r}; {nearest(str(loc[-1]), _keys(owner))}"
    if kind == "missing":
        what = _lower(declared.description) if declared else "it is required"
        return f"missing; add it: {what}"
    if kind == "literal_error":
        choices = [str(choice) for choice in _choices(_declaration(loc, form)[0])]
        hint = nearest(value, choices) if isinstance(value, str) else ""
        only = f"{as_read(value)} is not allowed; it must be one of {', '.join(choices)}"
        return f"{only}; {hint}" if hint.startswith("did you mean") else only
    remedies = {
        "model_type": f"a mapping of {', '.join(_keys(_declaration(loc, form)[0]))}",
        "dict_type": "a mapping",
        "list_type": "a list; for none, write []",
        "string_type": "a text; put it in quotes",
        "string_too_short": "a text that is not empty",
        "bool_type": "true or false",
        "string_pattern_mismatch": "64 hexadecimal digits, as they were recorded",
    }
    if kind in remedies:
        remedy = remedies[kind]
        if kind == "string_type" and isinstance(value, dict | list):
            remedy = "a text"
        return f"{as_read(value)} is not allowed; it must be {remedy}"
    return detail["msg"]


def _lower(text: str | None) -> str:
    return text[:1].lower() + text[1:].rstrip(".") if text else "it is required"


def _declaration(loc: Sequence[Step], form: Form[E]) -> tuple[object, FieldInfo | None]:
    """Return the type declared at a place of the file, and the field it is declared by."""
    here: object = form.entry
    declared = None
    for step in loc:
        here, declared = _bare(here), None
        if isinstance(here, type) and issubclass(here, Entry):
            declared = here.model_fields.get(_field_names(here).get(str(step), ""))
            here = declared.annotation if declared is not None else None
        elif get_origin(here) in (dict, list):
            here = get_args(here)[-1]
    return _bare(here), declared


def _bare(annotation: object) -> object:
    """Return a type without ``| None`` and its annotations."""
    while get_origin(annotation) in (Annotated, Union, types.UnionType):
        annotation = get_args(annotation)[0]
    return annotation


def _field_names(entry: type[Entry]) -> dict[str, str]:
    return {field.alias or name: name for name, field in entry.model_fields.items()}


def _keys(owner: object) -> list[str]:
    if isinstance(owner, type) and issubclass(owner, Entry):
        return list(_field_names(owner))
    return []


def _choices(annotation: object) -> tuple[object, ...]:
    return get_args(annotation) if get_origin(annotation) is Literal else ()
