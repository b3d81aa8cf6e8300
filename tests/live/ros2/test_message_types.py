"""CDR bytes and hashes of messages, and types that cannot be used."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from zenoh_ros2_sdk.utils import get_type_hash

import dwell
from dwell.errors import LiveError
from dwell.live.ros2.message_types import decode, encode, message_types
from examples.live.ros_stages import Twist, Vector

TWIST = "geometry_msgs/msg/Twist"


#: Hashes that `ros2 topic info -v` prints in ROS 2 Jazzy.
HASHES = {
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
}


@pytest.mark.parametrize(("name", "digest"), HASHES.items())
def test_hashes_are_those_of_ros(name: str, digest: str) -> None:
    assert message_types().hash(name) == f"RIHS01_{digest}"


def test_hash_of_own_type_is_that_of_the_sdk(tmp_path: Path) -> None:
    text = "float64[4] speeds\nuint32 number\n"
    own_type(tmp_path, text)
    theirs = get_type_hash("own_msgs/msg/Wheels", msg_definition=text, dependencies={})
    assert message_types(tmp_path).hash("own_msgs/msg/Wheels") == theirs


def own_type(folder: Path, text: str, name: str = "own_msgs/msg/Wheels.msg") -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def test_twist_by_hand() -> None:
    numbers = 0.5, 0.0, 0.0, 0.0, 0.0, -1.25
    data = b"\x00\x01\x00\x00" + struct.pack("<6d", *numbers)
    assert encode(Twist(Vector(0.5), Vector(z=-1.25)), TWIST) == data
    assert encode({"linear": {"x": 0.5}, "angular": {"z": -1.25}}, TWIST) == data
    found = decode(data, TWIST)
    assert (found.linear.x, found.angular.z) == (0.5, -1.25)
    assert encode(found, TWIST) == data


def test_big_endian_bytes() -> None:
    data = b"\x00\x00\x00\x00" + struct.pack(">6d", 0.5, 0, 0, 0, 0, 2)
    assert decode(data, TWIST).angular.z == 2.0


def test_sequences_and_nested_messages() -> None:
    points = [{"positions": [1, 2.5], "time_from_start": {"sec": 3}}, {}]
    data = encode(
        {"joint_names": ["a", "b"], "points": points}, "trajectory_msgs/msg/JointTrajectory"
    )
    found = decode(data, "trajectory_msgs/msg/JointTrajectory")
    assert found.joint_names == ["a", "b"]
    assert found.points[0].positions.tolist() == [1.0, 2.5]
    assert found.points[0].time_from_start.sec == 3
    assert found.points[1].positions.size == 0


def test_the_facade_has_them() -> None:
    assert dwell.ros2.encode({"data": "x"}, "std_msgs/msg/String") == b"\0\1\0\0\2\0\0\0x\0"
    assert dwell.ros2.decode(b"\0\1\0\0\2\0\0\0x\0", "std_msgs/msg/String").data == "x"


def test_own_types_in_a_flat_folder_and_as_idl(tmp_path: Path) -> None:
    own_type(tmp_path, "uint8 a 5\nstring name left\nbool on true\nint32 MOST=3\n", "own/Flat.msg")
    idl = "module own { module msg { struct Fast { double speed; }; }; };"
    own_type(tmp_path, idl, "own/msg/Fast.idl")
    assert len(encode({"a": 1}, "own/msg/Flat", tmp_path)) > 4
    assert (
        decode(encode({"speed": 2.0}, "own/msg/Fast", tmp_path), "own/msg/Fast", tmp_path).speed
        == 2
    )


def test_own_definition_replaces_that_of_ros(tmp_path: Path) -> None:
    own_type(tmp_path, "string data\nuint8 more\n", "std_msgs/msg/String.msg")
    assert decode(b"\0\1\0\0\1\0\0\0\0\5", "std_msgs/msg/String", tmp_path).more == 5


FAULTY: dict[str, tuple[Any, str, str]] = {
    "unknown type": ({}, "foo/msg/Bar", "unknown type foo/msg/Bar"),
    "unknown field": ({"speed": 1}, TWIST, "geometry_msgs/msg/Twist has no field 'speed'"),
    "field of a field": ({"linear": {"w": 1}}, TWIST, "Twist.linear has no field 'w'"),
    "text for a number": ({"linear": {"x": "fast"}}, TWIST, "a value does not fit"),
    "number for a message": ({"linear": 1.0}, TWIST, "Twist.linear: a float"),
    "no fields": (np.zeros(3), TWIST, "a ndarray, where fields are wanted"),
    "too large": ({"data": -1}, "std_msgs/msg/UInt8", "a value does not fit"),
    "length of an array": ({"k": [1, 2]}, "sensor_msgs/msg/CameraInfo", "CameraInfo.k: 2 values"),
}


@pytest.mark.parametrize(("value", "name", "message"), FAULTY.values(), ids=FAULTY.keys())
def test_what_cannot_be_encoded(value: object, name: str, message: str) -> None:
    with pytest.raises(LiveError, match=message):
        encode(value, name)


@pytest.mark.parametrize(
    "data", [b"", b"\0\1\0\0", b"\0\1\0\0" + bytes(9), b"\7\7\0\0" + bytes(48)]
)
def test_what_cannot_be_decoded(data: bytes) -> None:
    with pytest.raises(LiveError, match=f"{len(data)} bytes are no {TWIST}"):
        decode(data, TWIST)


FAULTY_FILES = {
    "wstring a\n": r"own_msgs/msg/Wheels.a: a wstring",
    "uint8 a\nfloat64 b c\n": r"Wheels.msg: line 2: 'float64 b c' has two names",
    "float64\n": r"Wheels.msg: Could not parse",
    "Missing a\n": r"own_msgs/msg/Wheels.a: unknown type own_msgs/msg/Missing",
}


@pytest.mark.parametrize(("text", "message"), FAULTY_FILES.items())
def test_faulty_files_of_types(tmp_path: Path, text: str, message: str) -> None:
    own_type(tmp_path, text)
    with pytest.raises(LiveError, match=message):
        message_types(tmp_path).hash("own_msgs/msg/Wheels")


def test_folder_without_types(tmp_path: Path) -> None:
    with pytest.raises(LiveError, match=r"no \.msg or \.idl file"):
        message_types(tmp_path)
