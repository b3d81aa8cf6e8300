"""What all tests share: no test fails because the machine is slow.

`make test` runs most tests side by side, and one after another those that need the machine to
themselves: real processes whose faults and deadlines are counted, and ports that are looked for.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

# Under nohup, and in the background of a shell, these are ignored, and so they would be by all
# processes that tests start and signal.
signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)

# Chosen by `--hypothesis-profile`.
settings.register_profile("ci", deadline=None, max_examples=25)
settings.register_profile("night", deadline=None, max_examples=200)
settings.load_profile("ci")

HERE = Path(__file__).parent
ALONE = (
    "testbed/chaos",
    "cli/test_background.py",
    "cli/test_live.py",
    "cli/test_live_run.py",
    "cli/test_testbed.py",
    "live/test_real_faults.py",
    "live/test_security.py",
    "live/transport",
    "testbed/test_execution.py",
    "testbed/test_netns_testbed.py",
    "testbed/test_run.py",
    "test_two_computers.py",
)


#: Files that take longest: side by side, they begin first, so that none is left over at the end.
LONGEST = (
    "reference/test_against.py",
    "live/test_protocol_model.py",
    "reproduction/test_questions.py",
    "live/test_continuity.py",
    "test_package.py",
    "cli/test_doctor.py",
    "cli/test_new.py",
)


def pytest_xdist_auto_num_workers() -> int:
    """Return how many processes test side by side: tests wait for a third of their time."""
    cpus = len(os.sched_getaffinity(0))
    return cpus + (cpus + 1) // 2


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need the machine to themselves; the longest files come first."""
    first = {HERE / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path, len(first)))
    for item in items:
        if any(item.path.is_relative_to(HERE / name) for name in ALONE):
            item.add_marker(pytest.mark.alone)
