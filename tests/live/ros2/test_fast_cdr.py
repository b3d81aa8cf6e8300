"""Bytes of messages, held against Fast CDR, the C++ library of ROS 2."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from dwell import ros2

SOURCE = Path(__file__).with_name("fast_cdr.cpp")
HEADER = {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "base"}
#: Most bytes of a message that only align others.
MOST_PADDING = 12
#: The messages of the program, in its order.
MESSAGES: list[tuple[str, dict[str, Any]]] = [
    ("geometry_msgs/msg/Twist", {"linear": {"x": 0.5}, "angular": {"z": -1.25}}),
    ("std_msgs/msg/String", {"data": "hello"}),
    (
        "sensor_msgs/msg/JointState",
        {"header": HEADER, "name": ["a", "elbow"], "position": [1.0, 2.5], "effort": [3.0]},
    ),
    (
        "sensor_msgs/msg/Image",
        {
            "header": HEADER,
            "height": 2,
            "width": 1,
            "encoding": "rgb8",
            "step": 3,
            "data": [1, 2, 3, 4, 5, 6],
        },
    ),
    (
        "trajectory_msgs/msg/JointTrajectory",
        {
            "header": HEADER,
            "joint_names": ["a"],
            "points": [{"positions": [1.5], "time_from_start": {"sec": 3, "nanosec": 9}}],
        },
    ),
]


def test_bytes_are_those_of_fast_cdr(tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    program = tmp_path / "fast_cdr"
    made = subprocess.run(
        [compiler, "-std=c++17", str(SOURCE), "-lfastcdr", "-o", str(program)],
        capture_output=True,
        text=True,
        check=False,
    )
    if "Fast CDR is not installed" in made.stderr:
        pytest.skip("Fast CDR is not installed (Debian: libfastcdr-dev)")
    assert made.returncode == 0, made.stderr
    lines = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    for (name, fields), line in zip(MESSAGES, lines, strict=True):
        theirs, ours = bytes.fromhex(line), ros2.encode(fields, name)
        # Fast CDR leaves the bytes between aligned numbers as they are in memory.
        assert len(ours) == len(theirs), name
        assert ros2.encode(ros2.decode(theirs, name), name) == ours
        assert sum(one != other for one, other in zip(ours, theirs, strict=True)) <= MOST_PADDING
