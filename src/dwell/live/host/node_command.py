"""Start of an agent or a controller from the options of a command line."""

from __future__ import annotations

import fnmatch
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from dwell.errors import ExitCode
from dwell.live.host.ending import end_when_told
from dwell.live.host.hosting import PLAIN, Platform
from dwell.live.host.kept_cell import CellKeeper, KeptCell
from dwell.live.host.node import Continued, controller_of, run_agent, run_controller
from dwell.live.host.parent_death import end_with_owner
from dwell.live.host.role_command import server, words
from dwell.live.host.security import environment
from dwell.live.host.state_folder import state_root
from dwell.live.log import say
from dwell.live.stage import load_function
from dwell.live.wire.lint import lint
from dwell.live.wire.wiring import roles
from dwell.model import Problem

T = TypeVar("T")


class OptionError(ValueError):
    """An option of a command is invalid; the message names the option and its value."""


def agent(
    node: str,
    cell: Path,
    *,
    state: Path | None = None,
    cpus: str | None = None,
    cpus_of: Sequence[str] = (),
    realtime: Sequence[str] = (),
    accelerator: str | None = None,
    keys: Path | None = None,
    insecure: bool = False,
    owner: int | None = None,
    renews: bool = False,
    platform: Platform = PLAIN,
) -> None:
    """Run a node of a live cell until a signal ends it (see `run_agent`).

    Parameters
    ----------
    state : Path, optional
        State folder of the node [default: a folder in `state_root`].
    cpus : str, optional
        CPUs to use, such as ``0,2-3`` [default: the CPUs of this process].
    cpus_of, realtime : sequence of str
        CPUs and real-time priorities of processes, such as ``perception@*=2-3``; the last match
        applies.
    accelerator : str, optional
        Function that returns the utilisation of the node's accelerator, as ``module:function``.
    keys : Path, optional
        Keyring [default: the keyring of the environment].
    owner : int, optional
        Id of the process with which this process ends.
    renews : bool
        See `run_agent`.

    Raises
    ------
    OptionError
        If an option is invalid.
    DwellError
        If the cell cannot be read, or the agent cannot run.
    """
    kept = KeptCell.of(cell, state_root().glob(f"*/{node}") if state is None else [state])
    problem = kept.problem()
    for caution in lint(problem):
        say(f"warning: {caution}")
    folder = state or kept.folder or state_root() / problem.name / node
    kept.install()
    read = None if accelerator is None else load_function(accelerator, "--accelerator")
    wanted = _cpus(cpus)
    there = sorted(role.who for role in roles(problem) if role.node == node)
    of = _by_process("--cpus-of", cpus_of, there, lambda text: _cpus(text, "--cpus-of", wanted))
    priorities = _by_process("--realtime", realtime, there, _priority)
    hurried, keeper = threading.Event(), CellKeeper(kept, folder, node, say)

    def take_over() -> None:
        keeper.take_over()
        if keeper.replaced:
            stopped.set()

    stopped = _until_told(owner, hurried.set, take_over)
    run_agent(
        problem,
        node,
        folder,
        server(cell.resolve(), platform.program, owner, folder),
        lambda who: words(cell.resolve(), who, folder, of.get(who), priorities.get(who)),
        stopped,
        hurried=hurried,
        keeper=keeper,
        renews=renews,
        cpus=wanted,
        accelerator=read,
        environment=environment(keys, insecure=insecure),
        platform=platform,
        say=say,
    )
    if keeper.replaced:
        _replace_process("--renews")


def controller(
    cells: Sequence[Path],
    out: Path,
    *,
    state: Path | None = None,
    policy: str | None = None,
    name: str | None = None,
    jobs: bool = False,
    cpus: str | None = None,
    keys: Path | None = None,
    insecure: bool = False,
    owner: int | None = None,
    continues: str = "{}",
    platform: Platform = PLAIN,
) -> None:
    """Control live cells until a signal ends this process (see `run_controller`).

    Parameters
    ----------
    out : Path
        Folder for the runs' folders.
    state : Path, optional
        Folder for the state folders, one per cell [default: `state_root`].
    cpus, keys, owner, platform : optional
        See `agent`.
    continues : str
        JSON of the same argument of `run_controller`.

    Raises
    ------
    OptionError
        If a CPU is not available.
    DwellError
        If a cell cannot be read, or the controller cannot run.
    """
    wanted = _cpus(cpus)
    if wanted is not None:
        os.sched_setaffinity(0, wanted)
    root = state_root(state)
    problems: list[Problem] = []
    keepers: dict[str, CellKeeper] = {}
    for file in cells:
        kept = KeptCell.of(file, root.glob("*/controller@*"))
        kept.install()
        problem = kept.problem(traces=True)
        node = problem.controller_node
        folder = kept.folder or root / problem.name / f"controller@{node}"
        problems.append(problem)
        keepers[problem.name] = CellKeeper(kept, folder, node, say)
    renewed = threading.Event()

    def take_over() -> None:
        found = [
            keeper.take_over(lambda new: controller_of(new.problem(traces=True), policy, say))
            for keeper in keepers.values()
        ]
        if {"decision", "code"} & {*found}:
            renewed.set()
            stopped.set()

    stopped = _until_told(owner, lambda: os._exit(ExitCode.FAILED), take_over)
    ended = run_controller(
        *(problems, out, stopped),
        keepers=keepers,
        continues=msgspec.json.decode(continues, type=dict[str, Continued]),
        policy=policy,
        name=name,
        jobs=jobs,
        environment=environment(keys, insecure=insecure),
        platform=platform,
        say=say,
    )
    for one in ended.values():
        if one.folder:
            say(f"run: {one.folder}")
    if renewed.is_set():
        _replace_process("--continues", msgspec.json.encode(ended).decode())
    for keeper in keepers.values():
        keeper.end()


def _replace_process(*more: str) -> None:
    """Execute the same command again, with the same process id, to import the modules again."""
    # A further SIGHUP must not end the process before it has its handlers.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    words = sys.orig_argv[1:]
    if more[0] in words:
        words = words[: words.index(more[0])]
    os.execv(sys.executable, [sys.executable, *words, *more])  # noqa: S606 - our own command


def _by_process(
    option: str, given: Sequence[str], there: Sequence[str], read: Callable[[str], T]
) -> dict[str, T]:
    """Read options PROCESS=VALUE; PROCESS may contain ``*``, and the last match applies."""
    values: dict[str, T] = {}
    for text in given:
        pattern, equals, value = text.partition("=")
        names = fnmatch.filter(there, pattern)
        if not equals or not names:
            known = ", ".join(there)
            raise OptionError(f"{option}: {text!r} is for no process of the node: {known}")
        values.update(dict.fromkeys(names, read(value)))
    return values


def _priority(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 99:
        raise OptionError(f"--realtime: {text!r} is no priority from 1 to 99")
    return int(text)


def _cpus(
    text: str | None, option: str = "--cpus", among: set[int] | None = None
) -> set[int] | None:
    """Read a list of available CPUs."""
    if text is None:
        return None
    cpus: set[int] = set()
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            cpus.update(range(int(first), int(last or first) + 1))
    except ValueError:
        raise OptionError(f"{option}: {text!r} is no list of CPUs, as 0,2-3") from None
    available = among or os.sched_getaffinity(0)
    if not cpus or not cpus <= available:
        raise OptionError(f"{option}: {text} cannot be had; there are {sorted(available)}")
    return cpus


def _until_told(
    owner: int | None, at_once: Callable[[], None], again: Callable[[], object]
) -> threading.Event:
    """Return an event that is set by a signal to end, or when the owner has ended."""
    stopped = threading.Event()
    end_with_owner(stopped, owner)
    end_when_told(stopped, at_once, again)
    return stopped
