"""The command `dwell` itself: its help, and unknown commands."""

from __future__ import annotations

import re

import pytest

from dwell.cli.commands import GROUPS
from tests.cli.small_cell import assert_refused, call


def test_a_wrong_command_is_named_with_its_nearest() -> None:
    assert_refused(call("chek"), "check")


def test_the_help_has_each_command_under_its_heading() -> None:
    text = call("--help").stdout
    headings = re.findall(r"^(\w+):\n((?:  .+\n)+)", text, re.MULTILINE)
    found = {heading: re.findall(r"^  (\S+)", rows, re.MULTILINE) for heading, rows in headings}
    for heading, names in GROUPS.items():
        assert found[heading] == list(names)
    assert found["Other"] == ["completion"]
    assert len(found["Examples"]) == 3


@pytest.mark.parametrize(
    "words", [(), ("fleet",), ("keys",), ("live",), ("profile",), ("testbed",)]
)
def test_no_summary_of_a_command_is_cut_off(words: tuple[str, ...]) -> None:
    lines = call(*words, "--help").stdout.splitlines()
    assert not [line for line in lines if line.endswith("...") and not line.startswith("Usage")]
