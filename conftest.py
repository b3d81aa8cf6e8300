"""What all tests share: no test fails because the machine is slow.

`make test` runs most tests side by side at a low priority, next to real processes that keep a
period. Tests that need the machine to themselves follow. `make test-all` does the same with what
takes longest.
"""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import chain, permutations
from pathlib import Path
from typing import TypeAlias

import pytest
import typer.main
from hypothesis import settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

# Under nohup, and in the background of a shell, these are ignored, and so they would be by all
# processes that tests start and signal.
signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)

# Chosen by `--hypothesis-profile`.
settings.register_profile("ci", deadline=None, max_examples=25)
settings.register_profile("night", deadline=None, max_examples=200)
settings.load_profile("ci")

# Commands are made of their functions once, and not whenever one is called in the tests' process.
typer.main.get_command = cache(typer.main.get_command)

ROOT = Path(__file__).parent

#: Tests by file or folder: those whose names have one of these parts, or all.
Chosen: TypeAlias = Mapping[str, tuple[str, ...]]

#: Real processes that have to keep to a period. They need less than a CPU, and get it where all
#: other tests have a lower priority.
WITH_PRIORITY: Chosen = {
    "tests/live/test_real_faults.py": (),
    "lab/tests/chaos/test_fault_campaign.py": ("loopback", "test_every", "test_a_campaign"),
    "lab/tests/chaos/test_strike.py": (),
    "tests/test_two_computers.py": (),
}

#: Real processes that have to keep to shares of the machine.
ALONE: Chosen = {
    "lab/tests/chaos/test_fault_campaign.py": ("hosts",),
    "lab/tests/testbed/test_execution.py": (),
}

#: Files and folders whose tests one process runs in turn: cells of twenty processes, of which two
#: at once are too much for two CPUs; what looks for free CPUs; and what is built once.
TOGETHER = {
    "cells": (
        "tests/live/commands/test_background.py",
        "tests/live/commands/test_live.py",
        "tests/live/commands/test_live_run.py",
        "tests/live/commands/test_live_secure.py",
        "tests/cli/test_new.py",
        "tests/dash/test_live_page.py",
    ),
    "testbeds": (
        "lab/tests/commands/test_testbed.py",
        "lab/tests/testbed/test_netns_testbed.py",
        "lab/tests/testbed/test_run.py",
    ),
    "packages": ("tests/test_package.py",),
}

#: What only `make test-all` runs.
EXHAUSTIVE: Chosen = {
    "tests/live/commands/test_live_run.py": ("test_it_needs_no_more_than_the_extra_live",),
    "lab/tests/commands/test_testbed.py": ("test_interrupted_it_takes_everything_down[15]",),
    "tests/live/test_protocol_model.py": (
        *(
            f"test_nothing_goes_wrong_and_there_is_always_a_way_back[{case}]"
            for case in ("orders 2", "states 1", "states 3", "states 4")
        ),
        *(f"test_the_stamper_does_what_the_model_does[{seed}]" for seed in (3, 4, 5)),
        "test_every_rule_is_needed[orders-charge]",
    ),
    "tests/live/test_real_faults.py": (
        "test_cell_survives[freeze",
        *(f"test_cell_survives[cut {a}->{b}]" for a, b in permutations(("R1", "E", "R2"), 2)),
    ),
    "tests/live/test_seeded_faults.py": tuple(
        f"test_no_fault_breaks_a_promise[{block}]" for block in (1, 2)
    ),
    "tests/reference/test_against.py": ("the others",),
    "tests/reference/test_guarded.py": ("the others",),
    "tests/reproduction/test_questions.py": tuple(
        f"test_a_question_is_answered[{name}]"
        for name in ("chatter", "concurrent", "dominance", "dynamic", "jitter", "reversion")
    ),
    "tests/test_compilers.py": (),
    "tests/test_package.py": (),
    "tests/test_readme.py": ("test_commands_print_what_the_page_on_capacity_says",),
    "tests/test_sanitizers.py": (),
    "lab/tests/chaos/test_fault_campaign.py": (),
    "lab/tests/chaos/test_strike.py": ("actuator", "clock", "process", "terminal"),
    "lab/tests/testbed/test_execution.py": (),
}

#: Marks of these.
LISTED = {"alone": ALONE, "exhaustive": EXHAUSTIVE, "with_priority": WITH_PRIORITY}

#: Files whose tests share nothing, and take longest: any process has any of them.
APART = (
    "tests/test_readme.py",
    "tests/test_sanitizers.py",
    "tests/test_compilers.py",
    "tests/reference/test_against.py",
    "tests/reference/test_guarded.py",
    "tests/live/test_protocol_model.py",
    "tests/live/test_seeded_faults.py",
    "tests/reproduction/test_questions.py",
    "tests/test_docs.py",
    "tests/live/roles/test_controlled_cell.py",
    "tests/live/test_faults.py",
    "tests/live/wire/test_continuity.py",
    "tests/regression/test_runs.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Put real processes that keep a period into a session of their own.

    Their shadow jobs run in the lowest scheduling class, and need what the cell leaves: next to
    busy processes of the same session they starve, at any niceness, and a cell that has left its
    placement never proves that it may return. A kernel that shares the CPU by session (autogroup)
    gives each session its share: by its niceness, which root may lower.
    """
    if "with_priority" in config.option.markexpr.split(" and "):
        with suppress(OSError):
            os.setsid()
            Path("/proc/self/autogroup").write_text("-5")


def pytest_xdist_auto_num_workers() -> int:
    """Return how many processes test side by side: tests wait for a third of their time."""
    cpus = len(os.sched_getaffinity(0))
    return cpus + (cpus + 1) // 2


@cache
def below(file: Path, names: tuple[str, ...]) -> str:
    """Return the name that a file is below, or nothing."""
    return next((name for name in names if file.is_relative_to(ROOT / name)), "")


def among(item: pytest.Item, chosen: Chosen) -> bool:
    """Whether a test is one of those."""
    name = below(item.path, tuple(chosen))
    return bool(name) and any(part in item.name for part in chosen[name] or ("",))


class InGroups(LoadScopeScheduling):  # type: ignore[misc]
    """Gives each process a group of tests after another: a file, or files that stay together."""

    def _split_scope(self, nodeid: str) -> str:
        file = ROOT / nodeid.partition("::")[0]
        if below(file, APART):
            return nodeid
        return next((name for name, files in TOGETHER.items() if below(file, files)), str(file))


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> InGroups:
    """Return who deals tests out where they run side by side."""
    return InGroups(config, log)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Pass over files that have no test with a mark that is asked for."""
    asked = config.option.markexpr.split(" and ")
    lists = [tuple(chosen) for mark, chosen in LISTED.items() if mark in asked]
    without = any(not below(collection_path, names) for names in lists)
    return True if without and collection_path.suffix == ".py" else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keep the garbage collector from looking at thousands of tests, while they come and later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that are listed here; what takes longest begins first."""
    longest = (*chain(*TOGETHER.values()), *APART)
    items.sort(key=lambda item: [*longest, ""].index(below(item.path, longest)))
    for item in items:
        for mark, chosen in LISTED.items():
            if among(item, chosen):
                item.add_marker(mark)
