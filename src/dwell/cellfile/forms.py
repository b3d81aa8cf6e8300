"""Forms: allowed values at a place in a file, how to read them, and their JSON Schema.

A form converts a value, or records a fault and returns `FAULTY`. Reading continues after a fault:
a faulty optional key counts as absent; a faulty or missing required key gets its stand-in; if the
key has no stand-in, the mapping around it is faulty, too.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field
from typing import Any, Final, TypeAlias, get_args, get_origin

from dwell.cellfile.document_faults import Faults
from dwell.model.bounds import Bound, Pattern, as_read
from dwell.model.declaration import DeclaredField, KeyTier, declared_fields
from dwell.model.dotted_paths import Step, beneath
from dwell.model.semantics import closest, nearest

JsonSchema: TypeAlias = dict[str, Any]
#: JSON Schemas of the named forms, by name.
Definitions: TypeAlias = dict[str, JsonSchema]

#: Result of a form for a faulty value.
FAULTY: Final = object()
# Least similarity at which an unknown key counts as a misspelt required key: `teir` for `tier`.
MISSPELT = 0.7


def removing(step: Step) -> str:
    """Return a remedy for a key or an item without a value."""
    what = f"the key {step!r}" if isinstance(step, str) else "the item"
    return f"give a value, or remove {what}"


class Form(ABC):
    """Allowed values at a place in a file."""

    @abstractmethod
    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the converted value; record a fault and return `FAULTY` if it is not allowed."""

    @abstractmethod
    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the JSON Schema; add the schemas of named forms to the definitions."""


def not_allowed(value: object, bound: str) -> str:
    """Return the message for a value outside its bound."""
    return f"{as_read(value)} is not allowed; it must be {bound}"


def refused(value: object, bound: str, path: str, faults: Faults) -> Any:
    """Record that a value is not allowed."""
    faults.add(path, not_allowed(value, bound))
    return FAULTY


def _read_by(reader: Callable[[Any], Any], value: Any, path: str, faults: Faults) -> Any:
    """Return the reader's result; record the message of its ValueError as a fault."""
    try:
        return reader(value)
    except ValueError as error:
        faults.add(path, str(error))
        return FAULTY


# ------------------------------------------------------------------------------ single values


@dataclass(frozen=True, slots=True)
class NumberForm(Form):
    """A finite number within a bound, or the bound's word."""

    bound: Bound

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return an int if the bound is for integers, else a float; or return the bound's word."""
        return _read_by(self.number, value, path, faults)

    def number(self, value: Any) -> Any:
        """Return the number or the bound's word; raise a ValueError if it is not allowed."""
        if isinstance(value, str) and self.bound.holds(value):
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            remedy = unquoted(value) if isinstance(value, str) else ""
            raise ValueError(not_allowed(value, f"{self.bound}{remedy}"))
        if abs(value) > sys.float_info.max and self.bound.high == math.inf:
            raise ValueError(f"{as_read(value)} is not allowed; leave the key out for no limit")
        # Accept 6e4 as an integer, as JSON Schema does.
        if self.bound.whole and isinstance(value, float) and value.is_integer():
            value = int(value)
        if not self.bound.holds(value):
            raise ValueError(not_allowed(value, str(self.bound)))
        return value if self.bound.whole else float(value)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return its type and its bounds."""
        bound = self.bound
        result: JsonSchema = {"type": "integer" if bound.whole else "number"}
        plain = int if bound.whole else float
        result["exclusiveMinimum" if bound.above else "minimum"] = plain(bound.low)
        if bound.high != math.inf:
            result["exclusiveMaximum" if bound.below else "maximum"] = plain(bound.high)
        return {"anyOf": [{"const": bound.word}, result]} if bound.word else result


def unquoted(text: str) -> str:
    """Return a remedy for a quoted number; empty for other texts."""
    try:
        number = float(text)
    except ValueError:
        return ""
    return f"; write {text.replace('_', '')} without quotes" if math.isfinite(number) else ""


@dataclass(frozen=True, slots=True)
class TextForm(Form):
    """A text; editors may complete the `known` texts, other texts are allowed, too."""

    bound: Pattern | None = None
    known: tuple[str, ...] = ()

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the text if it matches the bound."""
        if not isinstance(value, str):
            what = "a text" if isinstance(value, dict | list) else "a text; put it in quotes"
            return refused(value, what, path, faults)
        if self.bound is not None and not self.bound.holds(value):
            return refused(value, str(self.bound), path, faults)
        return value

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return its type."""
        result: JsonSchema = {"type": "string"}
        if self.bound is not None:
            result["pattern"] = f"^{self.bound.expression}$"
        return {"anyOf": [{"enum": list(self.known)}, result]} if self.known else result


@dataclass(frozen=True, slots=True)
class FlagForm(Form):
    """A truth value."""

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the truth value."""
        return value if isinstance(value, bool) else refused(value, "true or false", path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return its type."""
        return {"type": "boolean"}


@dataclass(frozen=True, slots=True)
class ChoiceForm(Form):
    """One of some values."""

    choices: tuple[Any, ...]

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the value."""
        if type(value) in (str, int) and value in self.choices:
            return value
        names = [str(choice) for choice in self.choices]
        hint = nearest(value, names) if isinstance(value, str) else ""
        bound = f"one of {', '.join(names)}"
        return refused(value, f"{bound}; {hint}" if hint.startswith("did") else bound, path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the values."""
        if len(self.choices) == 1:
            return {"const": self.choices[0]}
        return {"enum": list(self.choices), "type": "string"}


@dataclass(frozen=True, slots=True)
class WrittenForm(Form):
    """A value with several notations.

    Parameters
    ----------
    ways : str
        The notations, in words.
    reader : callable
        Converts the value; raises a ValueError if it is not allowed.
    may_be_empty : bool
        Whether keys directly inside the value may be empty.
    shown : mapping
        JSON Schema.
    """

    ways: str
    reader: Callable[[Any], Any]
    may_be_empty: bool = False
    shown: Mapping[str, Any] = field(default_factory=dict)

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return the reader's result; record a fault for each empty place that is not allowed."""
        for place, step in _empty_places(value, path):
            within = place.removeprefix(path)
            if not (self.may_be_empty and within == f".{step}") and not faults.at(place):
                faults.add(place, f"nothing is given; {removing(step)}")
        return _read_by(self.reader, value, path, faults)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the schema as given."""
        return dict(self.shown)


def _empty_places(value: Any, path: str) -> Iterator[tuple[str, Step]]:
    """Yield the path and last step of each empty place within a value."""
    steps: Any = ()
    if isinstance(value, dict | list):
        steps = value.items() if isinstance(value, dict) else enumerate(value)
    for step, item in steps:
        place = beneath(path, step)
        if item is None:
            yield place, step
        yield from _empty_places(item, place)


# ------------------------------------------------------------------------------- containers


def take(form: Form, value: Any, path: str, faults: Faults, remedy: str) -> Any:
    """Return the converted value, or `FAULTY`; an empty value is a fault with this remedy."""
    if isinstance(form, TextForm) and (text := faults.unquoted(value)) is not None:
        value = text
    if value is None:
        if not faults.at(path):
            faults.add(path, f"nothing is given; {remedy}")
        return FAULTY
    return form.read(value, path, faults)


@dataclass(frozen=True, slots=True)
class MappingForm(Form):
    """Values of one form by name.

    Parameters
    ----------
    keeps : bool
        Whether a faulty value becomes None; if false, it makes the mapping faulty.
    least : int
        Smallest number of values; only in the JSON Schema.
    """

    form: Form
    keeps: bool = False
    least: int = 0

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return a dict of the converted values."""
        if not isinstance(value, dict):
            return refused(value, "a mapping", path, faults)
        found = {
            name: take(self.form, item, beneath(path, name), faults, removing(name))
            for name, item in value.items()
        }
        if self.keeps:
            return {name: None if item is FAULTY else item for name, item in found.items()}
        return FAULTY if FAULTY in found.values() else found

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the schema of a mapping."""
        result: JsonSchema = {
            "type": "object",
            "additionalProperties": self.form.schema(definitions),
        }
        return {**result, "minProperties": self.least} if self.least else result


@dataclass(frozen=True, slots=True)
class ListForm(Form):
    """A list of values of one form; see `MappingForm`."""

    form: Form
    keeps: bool = False

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return a list of the converted values."""
        if not isinstance(value, list):
            return refused(value, "a list; for none, write []", path, faults)
        found = [
            take(self.form, item, beneath(path, index), faults, removing(index))
            for index, item in enumerate(value)
        ]
        if self.keeps:
            return [None if item is FAULTY else item for item in found]
        return FAULTY if FAULTY in found else found

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return the schema of a list."""
        return {"type": "array", "items": self.form.schema(definitions)}


@dataclass(frozen=True, slots=True)
class FormKey:
    """A key of a mapping.

    Parameters
    ----------
    name : str
        Field or argument that receives the value.
    named : str
        The key in the file.
    says : str
        Description, one sentence.
    usual : str
        Default, in words.
    stand_in : object
        Replaces a missing or faulty value of a required key; `FAULTY` makes the mapping faulty.
    breaks : bool
        Whether a faulty value of an optional key makes the mapping faulty.
    tier : str
        See `Declaration`.
    """

    name: str
    named: str
    form: Form
    says: str
    is_required: bool = False
    usual: str = ""
    stand_in: Any = FAULTY
    breaks: bool = False
    tier: KeyTier = "tuning"

    @property
    def described(self) -> str:
        """The description with the default."""
        return f"{self.says[:-1]}; default: {self.usual}." if self.usual else self.says


def optional(
    name: str,
    form: Form,
    says: str,
    usual: str = "",
    *,
    named: str = "",
    tier: KeyTier = "tuning",
) -> FormKey:
    """Return an optional key; `named` is its name in the file if that differs from `name`."""
    return FormKey(name, named or name, form, says, usual=usual, tier=tier)


def required(
    name: str,
    form: Form,
    says: str,
    stand_in: Any = FAULTY,
    *,
    named: str = "",
    tier: KeyTier = "first",
) -> FormKey:
    """Return a required key; see `optional`."""
    return FormKey(name, named or name, form, says, True, "", stand_in, tier=tier)


class Entry:
    """Converted values of a mapping, as attributes by field name; None for absent keys.

    Parameters
    ----------
    shape : Shape
        Form of the mapping.
    path : str
        Place of the mapping in the file.
    values : mapping of str to object
        The given values by field name.
    """

    __slots__ = ("path", "shape", "values")

    def __init__(self, shape: Shape, path: str, values: Mapping[str, Any]) -> None:
        self.shape, self.path, self.values = shape, path, values

    def __repr__(self) -> str:
        return (
            f"<Entry of {self.shape.title} at {self.path or 'the top'}: {', '.join(self.values)}>"
        )

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self.values.get(name)


@dataclass(frozen=True, eq=False)
class Shape(Form):
    """A mapping of known keys.

    Parameters
    ----------
    title : str
        Name in the JSON Schema.
    says : str
        Description, one sentence.
    kind : type, optional
        Class of the model; the values are its arguments.
    extra : mapping
        Further entries of the JSON Schema.
    """

    title: str
    says: str
    keys: tuple[FormKey, ...]
    kind: Any = None
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """The keys as the file names them."""
        return [key.named for key in self.keys]

    @property
    def by_tier(self) -> list[FormKey]:
        """The keys by tier, starting with the keys for a first cell."""
        tiers = get_args(KeyTier)
        return sorted(self.keys, key=lambda key: tiers.index(key.tier))

    def read(self, value: Any, path: str, faults: Faults) -> Any:
        """Return an `Entry` with the given values."""
        if not isinstance(value, dict):
            return refused(value, f"a mapping of {', '.join(self.names)}", path, faults)
        names = self.names
        missing = [key.named for key in self.keys if key.is_required and key.named not in value]
        for name in value:
            here = beneath(path, name)
            if name not in names:
                if not faults.at(here):
                    faults.add(here, f"unknown key {name!r}; {nearest(name, names)}")
                meant = closest(name, names, MISSPELT)
                if meant in missing:
                    faults.excuse(beneath(path, meant))
        values = {}
        is_broken = False
        for key in self.keys:
            read = self._read_key(key, value, beneath(path, key.named), faults)
            if read is not FAULTY:
                values[key.name] = read
            elif key.is_required and key.stand_in is not FAULTY:
                values[key.name] = key.stand_in
            else:
                is_broken |= key.is_required or (key.breaks and key.named in value)
        return FAULTY if is_broken else Entry(self, path, values)

    def _read_key(self, key: FormKey, value: Mapping[str, Any], path: str, faults: Faults) -> Any:
        says = key.says[:1].lower() + key.says[1:].rstrip(".")
        if key.named not in value:
            if key.is_required and not faults.at(path):
                faults.add(path, f"missing; add it: {says}")
            return FAULTY
        remedy = f"give a value: {says}" if key.is_required else removing(key.named)
        return take(key.form, value[key.named], path, faults, remedy)

    def schema(self, definitions: Definitions) -> JsonSchema:
        """Return a reference to the shape's definition; add the definition if it is missing."""
        if self.title not in definitions:
            definitions[self.title] = {}
            definitions[self.title] = self.definition(definitions)
        return {"$ref": f"#/$defs/{self.title}"}

    def definition(self, definitions: Definitions) -> JsonSchema:
        """Return the complete schema."""
        properties = {
            key.named: {**key.form.schema(definitions), "description": key.described}
            for key in self.by_tier
        }
        result: JsonSchema = {
            "type": "object",
            "description": self.says,
            "additionalProperties": False,
            "properties": properties,
        }
        required = [key.named for key in self.keys if key.is_required]
        return {**result, **({"required": required} if required else {}), **self.extra}


# ------------------------------------------------------------------------ of declared classes


def key_of(
    one: DeclaredField, form: Form, *, stand_in: Any = FAULTY, breaks: bool = False
) -> FormKey:
    """Return the key of a field that the model declares."""
    required = one.default is MISSING and one.key.usual is None
    usual = one.key.usual or ("" if required else _shown(one.default))
    about = one.key
    return FormKey(
        one.name, one.named, form, about.says, required, usual, stand_in, breaks, about.tier
    )


def _shown(default: Any) -> str:
    """Return a default in words."""
    if isinstance(default, bool):
        return "true" if default else "false"
    if default in (None, (), {}):
        return "none"
    value = getattr(default, "value", default)
    if isinstance(value, int | float):
        return f"{value:g}"
    return value if isinstance(value, str) else ""


def form_of(one: DeclaredField, forms: Mapping[Any, Form]) -> Form:
    """Return the form of a field: the entry of its type in `forms`, or a form for the type."""
    if one.kind in forms:
        return forms[one.kind]
    origin, inner = get_origin(one.kind), get_args(one.kind)
    if one.is_mapping:
        form = forms.get(inner[1])
        return MappingForm(form or _single(inner[1], one), keeps=False)
    if origin is tuple:
        return ListForm(forms.get(inner[0]) or _single(inner[0], one))
    return _single(one.kind, one)


def _single(kind: Any, one: DeclaredField) -> Form:
    if one.choices:
        return ChoiceForm(one.choices)
    if isinstance(one.key.bound, Pattern):
        return TextForm(one.key.bound)
    if one.key.bound is not None:
        return NumberForm(one.key.bound)
    return FlagForm() if kind is bool else TextForm()


def shape_of(
    kind: type,
    forms: Mapping[Any, Form],
    *,
    title: str = "",
    without: tuple[str, ...] = (),
    instead: Mapping[str, Form | FormKey] | None = None,
    further: tuple[FormKey, ...] = (),
    says: str = "",
) -> Shape:
    """Return the shape of a class of the model.

    Parameters
    ----------
    forms : mapping
        Forms by type, for types with several values.
    without : tuple of str
        Fields without a key.
    instead : mapping of str to Form or FormKey
        Forms or keys of single fields; they replace the form of the field's type.
    further : tuple of FormKey
        Last keys, without a field.
    says : str
        Description; if empty, the first line of the class's docstring.
    """
    keys = []
    for one in declared_fields(kind):
        if one.name in without:
            continue
        given = (instead or {}).get(one.name)
        if isinstance(given, FormKey):
            keys.append(given)
        else:
            keys.append(key_of(one, given or form_of(one, forms)))
    first = (kind.__doc__ or "").partition("\n")[0]
    return Shape(title or kind.__name__, says or first, (*keys, *further), kind)


def entries_of(value: Any) -> Iterator[Entry]:
    """Yield every entry within a converted value, outer entries first."""
    if isinstance(value, Entry):
        yield value
        for inner in value.values.values():
            yield from entries_of(inner)
    elif isinstance(value, dict):
        for inner in value.values():
            yield from entries_of(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from entries_of(inner)
