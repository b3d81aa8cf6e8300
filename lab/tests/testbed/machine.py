"""What tests need of the machine, and why they are skipped where it is not to be had."""

from __future__ import annotations

import os
from functools import cache
from itertools import count

from dwell.errors import LiveError
from dwell.model import Quota
from dwell_lab.testbed.groups import Groups, Share
from dwell_lab.testbed.hosts import Hosts

CPU = max(os.sched_getaffinity(0))
_numbers = count()


def own_name() -> str:
    """A testbed's name that no other test, nor any other run of the tests, has."""
    return f"test-{os.getpid()}-{next(_numbers)}"


@cache
def no_hosts() -> str:
    """Why there can be no hosts; empty if there can."""
    try:
        with Hosts(own_name(), ["A", "B"], [("A", "B")]):
            return ""
    except LiveError as error:
        return str(error)


@cache
def no_groups() -> str:
    """Why there can be no groups with quotas; empty if there can."""
    try:
        with Groups(own_name(), {"A": Share((CPU,), Quota(0.5, 10.0))}):
            return ""
    except LiveError as error:
        return str(error)
