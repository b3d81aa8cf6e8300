"""Types of ROS messages: their hashes, and CDR bytes to objects and back."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from dwell.errors import LiveError, installing
from dwell.model.ros_topics import RosTopic

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc
    from rosbags.typesys.store import Typestore

HEADER = "std_msgs/msg/Header"
# A constant has `=`; the default of a field is a number, a truth value, a text or a list.
_EXTRA_NAME = re.compile(r"\s*(?!w?string\b)\S+\s+\w+\s+(?!true\b|True\b|false\b|False\b)[A-Za-z_]")


def decode(data: bytes | memoryview, type: str, messages: str | Path | None = None) -> Any:
    """Read a message.

    Parameters
    ----------
    data : bytes
        CDR bytes.
    type : str
        As ``sensor_msgs/msg/JointState``.
    messages : str or Path, optional
        Folder with further types, as `.msg` and `.idl` files.

    Returns
    -------
    object
        The fields of the message as attributes; numbers in sequences are read-only arrays.

    Raises
    ------
    LiveError
        If the type is unknown, or the bytes are no message of it.
    """
    return message_types(messages).decode(data, type)


def encode(value: Any, type: str, messages: str | Path | None = None) -> bytes:
    """Return the CDR bytes of a message.

    Parameters
    ----------
    value : msgspec.Struct, mapping or object from `decode`
        Fields of the message; missing fields are zero.
    type, messages
        As in `decode`.

    Raises
    ------
    LiveError
        If the type is unknown or has no such field, or a value does not fit.
    """
    return message_types(messages).encode(value, type)


def types_of(topic: RosTopic, folder: str | None) -> MessageTypes:
    """Return the types of a topic; raise a LiveError if its type is unknown or cannot be read.

    `folder` is the folder of the cell file.
    """
    own = topic.messages
    found = message_types(None if own is None else Path(folder or ".", own))
    found.require(topic.type)
    return found


def message_types(folder: str | Path | None = None) -> MessageTypes:
    """Return the types of ROS 2 and of a folder; they are read once."""
    return _read_types(None if folder is None else str(Path(folder).resolve()))


@lru_cache(maxsize=8)
def _read_types(folder: str | None) -> MessageTypes:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise LiveError(f"rosbags is not installed; {installing('ros2')}") from None
    store = get_typestore(Stores.LATEST)
    if folder is not None:
        _add(store, Path(folder))
    return MessageTypes(store)


def _add(store: Typestore, folder: Path) -> None:
    """Add the types of a folder, which replace types of the same name."""
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    files = sorted(path for path in folder.rglob("*") if path.suffix in (".msg", ".idl"))
    if not files:
        raise LiveError(f"{folder}: no .msg or .idl file; `messages` names a folder with some")
    for path in files:
        try:
            text = path.read_text(encoding="utf-8")
            if path.suffix == ".idl":
                types = get_types_from_idl(text)
            else:
                _require_single_names(text)
                package = path.parents[1] if path.parent.name == "msg" else path.parent
                types = get_types_from_msg(text, f"{package.name}/msg/{path.stem}")
            for name in types:
                store.fielddefs.pop(name, None)
                store.types.pop(name, None)
            store.register(types)
        except (OSError, ValueError, TypesysError) as error:
            raise LiveError(f"{path}: {str(error).strip()[:500]}") from None


def _require_single_names(text: str) -> None:
    """Raise a ValueError if a line of a `.msg` file has two names, which rosbags accepts."""
    for number, line in enumerate(text.splitlines(), 1):
        code = line.partition("#")[0]
        if "=" not in code and _EXTRA_NAME.match(code):
            raise ValueError(f"line {number}: {code.strip()!r} has two names; write one per line")


class MessageTypes:
    """Types of messages by name; wraps the type store of rosbags, and names its faults."""

    def __init__(self, store: Typestore) -> None:
        self._store = store

    def hash(self, name: str) -> str:
        """Return the RIHS01 hash of a type."""
        self.require(name)
        return self._store.hash_rihs01(name)

    def require(self, name: str, within: str = "") -> None:
        """Raise a LiveError unless a type, and each type in it, is known and can be read."""
        path = within or name
        if name.endswith("/wstring"):
            raise LiveError(f"{path}: a wstring, which is not supported; use string")
        if name not in self._store.fielddefs:
            where = f"{within}: " if within else ""
            raise LiveError(
                f"{where}unknown type {name}; types of your own: name the folder of their .msg or "
                ".idl files as `messages`"
            )
        for field, kind, desc in self._fields(name):
            if kind == "wstring":
                raise LiveError(f"{path}.{field}: a wstring, which is not supported; use string")
            if desc == "NAME":
                self.require(kind, f"{path}.{field}")

    def _fields(self, name: str) -> Iterator[tuple[str, str, str]]:
        """Yield name, type and kind of the innermost part of each field."""
        for field, (node, rest) in self._store.fielddefs[name][1]:
            inner: Any = rest
            if node.name in ("ARRAY", "SEQUENCE"):
                node, inner = inner[0]  # noqa: PLW2901
            yield field, inner if node.name == "NAME" else inner[0], node.name

    def is_stamped(self, name: str) -> bool:
        """Whether messages of a type begin with a header."""
        fields = self._store.fielddefs[name][1]
        return bool(fields) and fields[0][1][1] == HEADER

    def decode(self, data: bytes | memoryview, name: str) -> Any:
        """As the function `decode`."""
        self.require(name)
        try:
            return self._store.deserialize_cdr(memoryview(data), name)
        except Exception as error:  # bytes of any kind, in code that rosbags has made
            raise LiveError(f"{len(data)} bytes are no {name}: {error}") from None

    def encode(self, value: Any, name: str) -> bytes:
        """As the function `encode`."""
        self.require(name)
        try:
            if getattr(value, "__msgtype__", None) != name:
                value = self._made(name, value, name)
            return bytes(self._store.serialize_cdr(value, name))
        except LiveError:
            raise
        except Exception as error:  # values of any kind, in code that rosbags has made
            raise LiveError(f"{name}: a value does not fit: {error}") from None

    def _made(self, name: str, value: object, path: str) -> Any:
        """Return a message of a type from fields; missing fields are zero."""
        if isinstance(value, msgspec.Struct):
            value = msgspec.structs.asdict(value)
        if not isinstance(value, Mapping):
            raise LiveError(f"{path}: a {type(value).__name__}, where fields are wanted")
        fields = dict(self._store.fielddefs[name][1])
        if unknown := value.keys() - fields.keys():
            known = ", ".join(fields)
            raise LiveError(f"{path} has no field {min(unknown)!r}; it has {known}")
        given = {
            field: self._field(desc, value.get(field), f"{path}.{field}")
            for field, desc in fields.items()
        }
        return self._store.types[name](**given)

    def _field(self, desc: FieldDesc, value: Any, path: str) -> Any:
        node, rest = desc[0].name, desc[1]
        inner: Any = rest
        if node == "NAME":
            return self._made(inner, {} if value is None else value, path)
        if node == "BASE":
            return _ZERO.get(inner[0], 0) if value is None else value
        (kind, what), length = inner
        count = length if node == "ARRAY" else 0
        items = [None] * count if value is None else value
        if node == "ARRAY" and len(items) != count:
            raise LiveError(f"{path}: {len(items)} values; {count} are needed")
        if kind.name == "BASE" and what[0] != "string":
            import numpy as np

            return np.array([0] * count if value is None else items, _DTYPES.get(what[0], what[0]))
        return [self._field((kind, what), item, f"{path}[{i}]") for i, item in enumerate(items)]


_ZERO: dict[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
_DTYPES = {"byte": "uint8", "char": "uint8"}
