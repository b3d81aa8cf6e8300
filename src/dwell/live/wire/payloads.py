"""Payloads of stages: encoding, and decoding of untrusted bytes.

A payload is sent as raw bytes next to its header, which has its kind: ``none``, ``bytes``,
``array:<dtype>:<shape>`` or ``struct:<name>``. An array is read in the received buffer, without a
copy. A struct is MessagePack; it becomes the type that the stage declares, or plain values.
NumPy's scalars in its fields are sent as plain numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any, TypeAlias, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from dwell.errors import LiveError

Payload: TypeAlias = "bytes | NDArray[Any] | msgspec.Struct | dict[str, Any] | list[Any] | None"

#: NumPy kinds of arrays that can be sent: numbers only, no objects or records.
NUMBERS = "biufc"
MAX_DIMENSIONS = 8
#: Depth in a struct to which an error names the part that cannot be sent.
MAX_DEPTH = 16
#: Description of an array from `write_payload`. NumPy accepts more strings as a dtype, and
#: evaluates some as Python.
ARRAY = re.compile(r"([<>|=]?[biufc][0-9]{1,2}|\?):((?:[0-9]{1,18}(?:x[0-9]{1,18})*)?)")


def write_payload(payload: object) -> tuple[str, bytes | memoryview]:
    """Return the kind of a payload, and its bytes; raise a LiveError if it cannot be sent.

    The bytes of a contiguous array are a view of its memory.
    """
    if payload is None:
        return "none", b""
    if isinstance(payload, bytes):
        return "bytes", payload
    if isinstance(payload, bytearray | memoryview):
        return "bytes", _flat(memoryview(payload))
    if isinstance(payload, np.ndarray):
        # A plain array does not load numpy.ma, which takes a tenth of a second.
        if type(payload) is not np.ndarray and isinstance(payload, np.ma.MaskedArray):
            raise LiveError(
                "a masked array cannot be sent; send payload.filled(), and the mask beside it"
            )
        if payload.dtype.kind not in NUMBERS:
            raise LiveError(f"an array of {payload.dtype} cannot be sent; send numbers")
        if payload.ndim > MAX_DIMENSIONS:
            raise LiveError(f"an array of {payload.ndim} dimensions; at most {MAX_DIMENSIONS}")
        shape = "x".join(str(length) for length in payload.shape)
        data = np.ascontiguousarray(payload).reshape(-1).view(np.uint8)
        return f"array:{payload.dtype.str}:{shape}", data.data
    if isinstance(payload, msgspec.Struct):
        try:
            text = msgspec.msgpack.encode(payload, enc_hook=_number)
        except Exception as error:  # the user's objects
            raise LiveError(_unsendable(payload, error)) from None
        return f"struct:{type(payload).__name__}", text
    what = type(payload).__name__
    raise LiveError(f"a {what} cannot be sent; send bytes, an array, or a msgspec.Struct")


def _flat(view: memoryview) -> bytes | memoryview:
    """Return a view's bytes; only a view that is not contiguous is copied."""
    try:
        return view.cast("B")
    except (TypeError, ValueError):  # with gaps, empty, or of another byte order
        return view.tobytes()


def _number(value: object) -> bool | int | float:
    """Return a NumPy scalar as a plain number."""
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.integer) and not isinstance(value, np.timedelta64):
        return int(value)
    if isinstance(value, np.floating):
        return float(value)
    raise TypeError


def _unsendable(payload: msgspec.Struct, error: Exception) -> str:
    """Return an error that names the part of a struct that cannot be sent."""
    place, value = type(payload).__name__, cast("object", payload)
    for _ in range(MAX_DEPTH):
        for name, part in _parts(value):
            try:
                msgspec.msgpack.encode(part, enc_hook=_number)
            except Exception as deeper:  # the user's objects
                place, value, error = place + name, part, deeper
                break
        else:
            break
    why = f" ({error})" if str(error) else ""
    return f"{place}: a {type(value).__name__} cannot be sent in a struct{why}; send plain values"


def _parts(value: object) -> Iterator[tuple[str, object]]:
    """Yield the fields or items of a value, with their places in it."""
    if isinstance(value, msgspec.Struct):
        for name in type(value).__struct_fields__:
            yield f".{name}", getattr(value, name, None)
    elif isinstance(value, dict):
        for key, part in value.items():
            yield f"[{key!r:.40}]", part
    elif isinstance(value, list | tuple):
        for number, part in enumerate(value):
            yield f"[{number}]", part


def read_payload(kind: str, data: bytes, expected: type | None = None) -> Payload:
    """Read a payload of the kind in its header.

    `expected` is the struct that the stage declares for this input. Raises a LiveError if the bytes
    do not fit the kind or the struct.
    """
    word, _, rest = kind.partition(":")
    if word == "none":
        return None
    if word == "bytes":
        return data
    if word == "array":
        return _read_array(rest, data)
    if word != "struct":
        raise LiveError(f"unknown kind of payload {kind[:60]!r}")
    try:
        if expected is not None:
            return msgspec.msgpack.decode(data, type=expected)
        plain: dict[str, Any] | list[Any] = msgspec.msgpack.decode(data)
        return plain
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        wanted = "" if expected is None else f" where {_name(expected)} is wanted"
        raise LiveError(f"a {rest or 'struct'}{wanted} cannot be read: {error}") from None


def _name(kind: type) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)


def _read_array(description: str, data: bytes) -> NDArray[Any]:
    found = ARRAY.fullmatch(description)
    try:
        if found is None:
            raise TypeError
        dtype = np.dtype(found[1])
    except TypeError:
        raise LiveError(f"no description of an array: {description[:60]!r}") from None
    shape = tuple(int(length) for length in found[2].split("x")) if found[2] else ()
    try:
        if len(shape) > MAX_DIMENSIONS or math.prod(shape) * dtype.itemsize != len(data):
            raise ValueError
        return np.frombuffer(data, dtype).reshape(shape)
    except ValueError:
        raise LiveError(f"{len(data)} bytes are no array {description[:60]!r}") from None
