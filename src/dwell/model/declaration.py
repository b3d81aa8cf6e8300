"""Declarations of keys: type, bound, default and one sentence per field of the model.

Constructors check the bounds, `dwell.cellfile` reads files and writes the JSON Schema, and the
tables of the docs are generated, all from these declarations.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass
from typing import (
    Any,
    Literal,
    NamedTuple,
    TypeAlias,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from dwell.errors import Fault, ProblemError
from dwell.model.bounds import Bound, Pattern, require
from dwell.model.frozen import FrozenDict

T = TypeVar("T")

#: Key of a `Declaration` in the metadata of a field.
KEY = "dwell"
#: Who reads a key in a live cell: all processes alike (`wiring`), the controller alone
#: (`decision`), or each node for itself: the code that it runs, and how it is reached.
Digested: TypeAlias = Literal["wiring", "decision", "code", "hosts"]
#: Who sets a key: a first cell, who tunes decisions, or a measurement of computers and links.
KeyTier: TypeAlias = Literal["first", "tuning", "measured"]


@dataclass(frozen=True, slots=True)
class Declaration:
    """The declaration of a field, in addition to its type and default.

    Parameters
    ----------
    says : str
        One sentence, its unit in it.
    bound : Bound or Pattern, optional
        Bound of a number or a text, or of every value of a mapping.
    named : str, optional
        Its name in a cell file and in messages, if it differs from the field's.
    usual : str, optional
        The default in words, if it depends on other keys.
    is_rare : bool
        Whether a document leaves it out where it is as usual.
    digested : str
        Digest that it is part of, and all below it (`dwell.model.document.digests`).
    tier : str
        Where docs, schema and `dwell new` list it.
    """

    says: str
    bound: Bound | Pattern | None = None
    named: str | None = None
    usual: str | None = None
    is_rare: bool = False
    digested: Digested = "wiring"
    tier: KeyTier = "tuning"


def key(
    says: str,
    bound: Bound | Pattern | None = None,
    *,
    default: Any = MISSING,
    default_factory: Any = MISSING,
    named: str | None = None,
    usual: str | None = None,
    is_rare: bool = False,
    digested: Digested = "wiring",
    tier: KeyTier = "tuning",
) -> Any:
    """Declare a field of a class that is `declared` (see `Declaration`)."""
    about = {KEY: Declaration(says, bound, named, usual, is_rare, digested, tier)}
    if default_factory is not MISSING:
        return dataclasses.field(default_factory=default_factory, metadata=about)
    return dataclasses.field(default=default, metadata=about)


@dataclass_transform(frozen_default=True, field_specifiers=(key, dataclasses.field))
def declared(section: str = "") -> Callable[[type[T]], type[T]]:
    """Make a frozen dataclass with slots that checks each field by its declaration.

    Mappings become immutable, and sequences become tuples. The class's own `__post_init__` runs
    afterwards and checks values against each other.

    Parameters
    ----------
    section : str
        Key of a cell file that contains the keys of the class, if messages name it.
    """

    def make(cls: type[T]) -> type[T]:
        further = getattr(cls, "__post_init__", None)

        def check(self: Any) -> None:
            _check(self, section)
            if further is not None:
                further(self)

        cls.__post_init__ = check  # type: ignore[attr-defined]
        made = dataclass(frozen=True, slots=True)(cls)
        _sections[made] = section
        made.__doc__ = f"{cls.__doc__}\n\n{_described(made)}"
        return made

    return make


_sections: dict[type, str] = {}


def within_path(path: str, kind: type, fault: str) -> str:
    """Return the path of a fault of an object of a declared class that is at a path."""
    around = path.rpartition(".")[0] if _sections.get(kind) else path
    return f"{around}.{fault}" if around and fault else around or fault


def made_at(path: str, kind: Any, make: Callable[..., T], *args: object, **values: object) -> T:
    """Make an object of a declared class; the paths of its faults begin with `path`.

    Raises
    ------
    ProblemError
        With the faults of `make`, each at its path (`within_path`).
    """
    try:
        return make(*args, **values)
    except ProblemError as error:
        faults = [Fault(within_path(path, kind, one.path), one.message) for one in error.faults]
        raise ProblemError(faults) from None


def is_declared(kind: Any) -> bool:
    """Return whether `declared` made a class, or the class of an object."""
    return (kind if isinstance(kind, type) else type(kind)) in _sections


class DeclaredField(NamedTuple):
    """A field of a declared class.

    Parameters
    ----------
    name : str
        The field's.
    kind : object
        Its type, without None.
    choices : tuple of str
        Allowed texts, or texts of a mapping; empty if any text is allowed.
    default : object
        `dataclasses.MISSING` where it is required.
    key : Declaration
        Its declaration.
    """

    name: str
    kind: Any
    choices: tuple[str, ...]
    default: Any
    key: Declaration

    @property
    def named(self) -> str:
        """Its name in a cell file."""
        return self.key.named or self.name

    @property
    def is_mapping(self) -> bool:
        """Whether the field is a mapping from names to values."""
        return get_origin(self.kind) is Mapping


_fields: dict[type, tuple[DeclaredField, ...]] = {}


def declared_fields(kind: type) -> tuple[DeclaredField, ...]:
    """Return the fields of a declared class that are keys, in their order."""
    if kind not in _fields:
        # When all names of their types are known.
        _fields[kind] = _read_fields(kind)
    return _fields[kind]


def _read_fields(kind: Any) -> tuple[DeclaredField, ...]:
    hints = get_type_hints(kind)
    return tuple(
        DeclaredField(
            one.name,
            _bare(hints[one.name]),
            _choices(_bare(hints[one.name])),
            one.default if one.default_factory is MISSING else one.default_factory(),
            one.metadata[KEY],
        )
        for one in dataclasses.fields(kind)
        if KEY in one.metadata
    )


def _bare(annotation: Any) -> Any:
    """Return a type without ``| None``."""
    if get_origin(annotation) in (Union, types.UnionType):
        kinds = [one for one in get_args(annotation) if one is not type(None)]
        return kinds[0] if len(kinds) == 1 else annotation
    return annotation


def _choices(kind: Any) -> tuple[str, ...]:
    if get_origin(kind) is Mapping:
        return _choices(get_args(kind)[1])
    return get_args(kind) if get_origin(kind) is Literal else ()


def _check(made: Any, section: str) -> None:
    for one in declared_fields(type(made)):
        value = getattr(made, one.name)
        if value is None and one.default is None:
            continue
        path = f"{section}.{one.named}" if section else one.named
        for place, single in _values(path, value):
            if one.key.bound is not None:
                one.key.bound.check(place, single)
            if one.kind is bool:
                require(isinstance(single, bool), place, single, "true or false")
            if one.kind is str and one.key.bound is None:
                require(isinstance(single, str), place, single, "a text")
            if one.choices:
                require(single in one.choices, place, single, f"one of {', '.join(one.choices)}")
        if one.is_mapping:
            object.__setattr__(made, one.name, FrozenDict(value))
        elif get_origin(one.kind) is tuple:
            object.__setattr__(made, one.name, tuple(value))


def _values(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield f"{path}.{name}", item
    else:
        yield path, value


def _described(kind: Any) -> str:
    """Return the parameters of a class for its docstring."""
    lines = ["Parameters", "----------"]
    for one in dataclasses.fields(kind):
        about = one.metadata.get(KEY)
        optional = "" if one.default is MISSING and one.default_factory is MISSING else ", optional"
        lines.append(f"{one.name} : {one.type}{optional}")
        if about is not None:
            bound = f" ({about.bound})" if about.bound is not None else ""
            lines.append(f"    {about.says}{bound}")
    return "\n".join(lines)
