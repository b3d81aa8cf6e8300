"""Cores: which ones a list names, and who runs on them."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.calibration.pinning import choose_cores, pinned
from dwell.errors import ProfileError

ALLOWED = frozenset(os.sched_getaffinity(0))
CORE = min(ALLOWED)


def everyone() -> dict[int, set[int]]:
    """Return the cores of every thread of this process."""
    found = {}
    for item in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            found[int(item.name)] = os.sched_getaffinity(int(item.name))
    return found


def test_the_highest_core_unless_told_otherwise() -> None:
    assert choose_cores(None) == {max(ALLOWED)}


@given(st.sets(st.sampled_from(sorted(ALLOWED)), min_size=1))
def test_lists_of_cores(cores: set[int]) -> None:
    assert choose_cores(",".join(map(str, cores))) == cores
    first, last = min(cores), max(cores)
    if ALLOWED.issuperset(range(first, last + 1)):
        assert choose_cores(f"{first}-{last}") == set(range(first, last + 1))


@pytest.mark.parametrize("text", ["", "a", "-1", "1.5", "0,,1", "0-", "2-1", "9" * 20])
def test_no_list_of_cores(text: str) -> None:
    with pytest.raises(ProfileError, match=r"^core: "):
        choose_cores(text)


def test_a_core_that_is_not_there_is_named_with_those_that_are() -> None:
    missing = max(ALLOWED) + 1
    with pytest.raises(ProfileError, match=f"no core {missing}; it may use .*{max(ALLOWED)}"):
        choose_cores(f"{CORE},{missing}")


def test_every_thread_is_pinned_and_given_back() -> None:
    go_on, started, seen = threading.Event(), threading.Event(), []

    def look() -> None:
        seen.append(os.sched_getaffinity(0))
        started.set()
        go_on.wait()

    older = threading.Thread(target=go_on.wait)
    older.start()
    before = everyone()
    with pinned({CORE}):
        assert set(map(frozenset, everyone().values())) == {frozenset({CORE})}
        newer = threading.Thread(target=look)
        newer.start()
        started.wait()
    after = everyone()
    # Threads of others may have ended meanwhile.
    assert {thread: cores for thread, cores in after.items() if thread in before}.items() <= (
        before.items()
    )
    assert newer.native_id is not None
    assert after[newer.native_id] == ALLOWED
    go_on.set()
    older.join()
    newer.join()
    assert seen == [{CORE}]


def test_given_back_after_an_error() -> None:
    with pytest.raises(ValueError, match="within"), pinned({CORE}):
        raise ValueError("within")
    assert set(map(frozenset, everyone().values())) == {ALLOWED}
