"""What all tests share: no test fails because the machine is slow.

`make test` runs most tests side by side, and one after another those that need the machine to
themselves: real processes whose faults and deadlines are counted, and ports that are looked for.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import settings

# Under nohup, and in the background of a shell, SIGINT is ignored, and so it would be by all
# processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("dwell", deadline=None)
settings.load_profile("dwell")

HERE = Path(__file__).parent
ALONE = (
    "testbed/chaos",
    "cli/test_live.py",
    "cli/test_live_run.py",
    "cli/test_testbed.py",
    "live/test_real_faults.py",
    "live/test_security.py",
    "live/transport",
    "test_package.py",
    "testbed/test_execution.py",
    "testbed/test_netns_testbed.py",
    "testbed/test_run.py",
)


def pytest_collection_modifyitems(items: Iterable[pytest.Item]) -> None:
    """Mark the tests that need the machine to themselves."""
    for item in items:
        if any(item.path.is_relative_to(HERE / name) for name in ALONE):
            item.add_marker(pytest.mark.alone)
