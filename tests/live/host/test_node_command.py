"""What a command line may say of an agent and of a controller."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from dwell.errors import LiveError
from dwell.live.host.node_command import OptionError, agent, controller

CELL = Path(__file__).parents[3] / "examples" / "live" / "cell.yaml"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"cpus": "x"}, "--cpus: 'x' is no list of CPUs"),
        ({"cpus": "100000"}, "--cpus: 100000 cannot be had"),
        ({"cpus_of": ["nobody@R1=0"]}, "--cpus-of: 'nobody@R1=0' is for no process of the node"),
        ({"realtime": ["camera@R1=0"]}, "--realtime: '0' is no priority from 1 to 99"),
    ],
)
def test_an_option_that_is_wrong_is_named(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=words):
        agent("R1", CELL, state=tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_a_node_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LiveError, match="no node 'X'"):
        agent("X", CELL, state=tmp_path)


def test_a_controller_uses_no_cpu_that_is_not_there(tmp_path: Path) -> None:
    there = os.sched_getaffinity(0)
    with pytest.raises(OptionError, match="--cpus: 100000 cannot be had"):
        controller([CELL], tmp_path / "runs", cpus="100000")
    assert os.sched_getaffinity(0) == there
    assert not (tmp_path / "runs").exists()
