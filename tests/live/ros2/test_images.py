"""Images of ROS as arrays, written by another implementation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from dwell.errors import LiveError
from dwell.live.ros2.images import read_compressed, read_image, stamp_ns, with_stamp

STORE = get_typestore(Stores.LATEST)
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
STAMP_NS = 1_700_000_000_123_456_789


def header(frame: str = "camera") -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(STAMP_NS, 10**9))
    return STORE.types["std_msgs/msg/Header"](stamp, frame)


def image(
    data: bytes,
    height: int,
    width: int,
    encoding: str,
    step: int,
    *,
    big: bool = False,
    frame: str = "camera",
) -> bytes:
    pixels = np.frombuffer(data, np.uint8)
    fields = header(frame), height, width, encoding, int(big), step, pixels
    message = STORE.types[IMAGE](*fields)
    return bytes(STORE.serialize_cdr(message, IMAGE, little_endian=not big))


CHANNELS = {"mono8": 0, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
WIDE = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}


@pytest.mark.parametrize("frame", ["", "c", "camera", "base"])
@pytest.mark.parametrize(("encoding", "channels"), CHANNELS.items())
def test_images_of_bytes(encoding: str, channels: int, frame: str) -> None:
    shape = (2, 3, channels) if channels else (2, 3)
    pixels = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
    step = 3 * max(channels, 1)
    data = image(pixels.tobytes(), 2, 3, encoding, step, frame=frame)
    found = read_image(data)
    np.testing.assert_array_equal(found, pixels)
    assert found.shape == shape
    assert np.shares_memory(found, np.frombuffer(data, np.uint8))
    assert found.flags.c_contiguous


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("encoding", "dtype"), WIDE.items())
def test_images_of_wider_numbers(encoding: str, dtype: str, big: bool) -> None:
    pixels = np.arange(6).reshape(2, 3).astype((">" if big else "<") + dtype)
    step = 3 * pixels.itemsize
    found = read_image(image(pixels.tobytes(), 2, 3, encoding, step, big=big))
    np.testing.assert_array_equal(found, pixels)
    assert found.dtype.kind == pixels.dtype.kind


def test_rows_with_a_gap_are_a_view() -> None:
    data = image(bytes(range(20)), 2, 3, "rgb8", 10)
    found = read_image(data)
    assert found[1].ravel().tolist() == list(range(10, 19))
    assert np.shares_memory(found, np.frombuffer(data, np.uint8))


def test_empty_image() -> None:
    assert read_image(image(b"", 0, 0, "rgb8", 0)).shape == (0, 0, 3)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (image(bytes(12), 2, 3, "yuv422", 6), "an image of encoding 'yuv422'; it can be mono8"),
        (image(bytes(12), 2, 3, "rgb8", 6), "step 6 and 12 bytes; its rows take 9"),
        (image(bytes(12), 2, 3, "rgb8", 9), "step 9 and 12 bytes"),
        (image(bytes(18), 2, 3, "rgb8", 9)[:40], "40 bytes are no sensor_msgs/msg/Image"),
        (b"", "0 bytes are no sensor_msgs/msg/Image"),
        (b"\0\2\0\0" + bytes(80), "84 bytes are no sensor_msgs/msg/Image"),
    ],
)
def test_unusable_image(data: bytes, message: str) -> None:
    with pytest.raises(LiveError, match=message):
        read_image(data)


def test_compressed_image() -> None:
    content = np.frombuffer(b"\xff\xd8 a picture", np.uint8)
    message = STORE.types[COMPRESSED](header(), "jpeg", content)
    data = bytes(STORE.serialize_cdr(message, COMPRESSED))
    assert read_compressed(data) == content.tobytes()
    with pytest.raises(LiveError, match="20 bytes are no sensor_msgs/msg/CompressedImage"):
        read_compressed(data[:20])


@pytest.mark.parametrize("big", [False, True])
def test_stamp_is_read_and_replaced(big: bool) -> None:
    data = image(b"\1", 1, 1, "mono8", 1, big=big)
    assert stamp_ns(data) == STAMP_NS
    for wanted_ns in (0, 5, -7, 2**31 * 10**9 - 1):
        changed = with_stamp(data, wanted_ns)
        assert stamp_ns(changed) == wanted_ns
        assert changed[12:] == data[12:]
