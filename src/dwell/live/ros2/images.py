"""Images of ROS as arrays."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.errors import LiveError
from dwell.live.ros2.message_types import decode

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


class PixelFormat(NamedTuple):
    """Type of the numbers of a pixel, and how many it has; 0: no axis for them."""

    dtype: str
    channels: int = 0


FORMATS = {
    "mono8": PixelFormat("u1"),
    "mono16": PixelFormat("u2"),
    "rgb8": PixelFormat("u1", 3),
    "bgr8": PixelFormat("u1", 3),
    "rgba8": PixelFormat("u1", 4),
    "bgra8": PixelFormat("u1", 4),
    "16UC1": PixelFormat("u2"),
    "32FC1": PixelFormat("f4"),
}
# Seconds and nanoseconds of a header, behind the four bytes that name the order of bytes.
_STAMP = "iI"
_STAMP_AT = 4


def stamp_ns(data: bytes) -> int:
    """Return the stamp of a message that begins with a header, ns."""
    seconds, rest_ns = struct.unpack_from(_order(data) + _STAMP, data, _STAMP_AT)
    return int(seconds) * 1_000_000_000 + int(rest_ns)


def with_stamp(data: bytes, at_ns: int) -> bytes:
    """Return a message that begins with a header, with another stamp."""
    stamped = bytearray(data)
    struct.pack_into(_order(data) + _STAMP, stamped, _STAMP_AT, *divmod(at_ns, 1_000_000_000))
    return bytes(stamped)


def _order(data: bytes) -> str:
    return "<" if data[1:2] == b"\1" else ">"


def read_image(data: bytes) -> NDArray[Any]:
    """Return the pixels of a `sensor_msgs/msg/Image`: (height, width[, channels]), read-only.

    It is a view of the bytes. Raises a LiveError if the bytes are no image, or of an encoding that
    is not in `FORMATS`.
    """
    image = decode(data, IMAGE)
    found = FORMATS.get(image.encoding)
    if found is None:
        raise LiveError(
            f"an image of encoding {image.encoding[:60]!r}; it can be {', '.join(FORMATS)}; set "
            "the camera's encoding, or convert it in a ROS node"
        )
    dtype = np.dtype(found.dtype).newbyteorder(">" if image.is_bigendian else "<")
    inner = (found.channels,) if found.channels else ()
    shape = (image.height, image.width, *inner)
    strides = (image.step, *(size * dtype.itemsize for size in inner), dtype.itemsize)
    row = image.width * (found.channels or 1) * dtype.itemsize
    if image.step < row or image.data.size < image.step * image.height:
        raise LiveError(
            f"an image of {image.width} × {image.height} {image.encoding} with step {image.step} "
            f"and {image.data.size} bytes; its rows take {row}"
        )
    return np.ndarray(shape, dtype, image.data, strides=strides)


def read_compressed(data: bytes) -> bytes:
    """Return the bytes of a `sensor_msgs/msg/CompressedImage`, as its format codes them."""
    return bytes(decode(data, COMPRESSED).data.data)
