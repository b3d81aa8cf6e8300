"""Payloads of stages: written, and read again without trusting them.

A payload travels raw, beside its header, and the header says its kind: ``none``, ``bytes``,
``array:<dtype>:<shape>`` or ``struct:<name>``. An array is read where it arrived, without a copy.
A struct is MessagePack; it becomes the type that the stage declares, and plain values otherwise.
"""

from __future__ import annotations

import math
import re
from typing import Any, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from dwell.errors import LiveError

Payload: TypeAlias = "bytes | NDArray[Any] | msgspec.Struct | dict[str, Any] | list[Any] | None"

#: Kinds of numbers that arrays may hold: no objects, no records.
NUMBERS = "biufc"
MAX_DIMENSIONS = 8
#: A description of an array as `write_payload` makes it. NumPy reads much more as a dtype, some of
#: it as Python.
ARRAY = re.compile(r"([<>|=]?[biufc][0-9]{1,2}|\?):((?:[0-9]{1,18}(?:x[0-9]{1,18})*)?)")


def write_payload(payload: object) -> tuple[str, bytes | memoryview]:
    """Return the kind of a payload, and its bytes.

    Returns
    -------
    kind : str
    data : bytes or memoryview
        A view of an array's own memory where it is contiguous.

    Raises
    ------
    LiveError
        If it is anything else.
    """
    if payload is None:
        return "none", b""
    if isinstance(payload, bytes):
        return "bytes", payload
    if isinstance(payload, bytearray | memoryview):
        return "bytes", memoryview(payload).cast("B")
    if isinstance(payload, np.ndarray):
        if payload.dtype.kind not in NUMBERS:
            raise LiveError(f"an array of {payload.dtype} cannot be sent; send numbers")
        if payload.ndim > MAX_DIMENSIONS:
            raise LiveError(f"an array of {payload.ndim} dimensions; at most {MAX_DIMENSIONS}")
        shape = "x".join(str(length) for length in payload.shape)
        data = np.ascontiguousarray(payload).reshape(-1).view(np.uint8)
        return f"array:{payload.dtype.str}:{shape}", data.data
    if isinstance(payload, msgspec.Struct):
        return f"struct:{type(payload).__name__}", msgspec.msgpack.encode(payload)
    what = type(payload).__name__
    raise LiveError(f"a {what} cannot be sent; send bytes, an array, or a msgspec.Struct")


def read_payload(kind: str, data: bytes, expected: type | None = None) -> Payload:
    """Read a payload.

    Parameters
    ----------
    kind : str
        As its header says.
    expected : type, optional
        Struct that the stage declares for this input.

    Raises
    ------
    LiveError
        If the bytes are not what the header says, or not what the stage expects.
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
        raise LiveError(f"no {rest or 'struct'}: {error}") from None


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
