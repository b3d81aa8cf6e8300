"""Runs a node's agent, and the controller of some cells."""

from __future__ import annotations

import errno
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from dwell.control import Controller
from dwell.errors import KernelError, LiveError
from dwell.live.host.agent import Agent, Gauge, busy_ns_of
from dwell.live.host.hosting import PLAIN, Hosted, Platform, keep_collections_short, take_turns
from dwell.live.host.kept_cell import CellKeeper
from dwell.live.host.launcher import ForkServer
from dwell.live.host.security import Security
from dwell.live.host.service import Service
from dwell.live.host.state_files import make_folder
from dwell.live.host.supervision import Supervisor
from dwell.live.log import Log
from dwell.live.roles.control_group import own_group
from dwell.live.roles.controlled_cell import ControlledCell
from dwell.live.roles.recording import RunRecorder
from dwell.live.roles.role import RolePlace
from dwell.live.roles.stage_counts import read_books
from dwell.live.transport.orphans import remove_orphans
from dwell.live.trust import KEYS
from dwell.live.wire.transport import Transport
from dwell.live.wire.wiring import wire
from dwell.model import Problem, QoS

if TYPE_CHECKING:
    from dwell.live.trust.keyring import Keyring

#: Why a folder cannot be made that somebody has to put right; anything else is tried again.
MISTAKEN = frozenset({errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP})


class Continued(msgspec.Struct, frozen=True):
    """The run of a cell that its controller has ended, and what operators wanted then.

    Parameters
    ----------
    folder : str
        The run's; empty where there is none.
    """

    folder: str = ""
    pinned: str = ""
    drained: tuple[str, ...] = ()


def run_agent(
    problem: Problem,
    node: str,
    folder: Path,
    program: Sequence[str],
    words: Callable[[str], Sequence[str]],
    stopped: threading.Event,
    *,
    hurried: threading.Event | None = None,
    keeper: CellKeeper | None = None,
    renews: bool = False,
    cpus: Iterable[int] | None = None,
    accelerator: Callable[[], float] | None = None,
    environment: Mapping[str, str] | None = None,
    platform: Platform = PLAIN,
    say: Callable[[str], None] = print,
) -> None:
    """Keep a node's processes running until told to stop; then end them.

    Parameters
    ----------
    program : sequence of str
        Command of the process that the others are forked from (`ForkServer`).
    words : callable
        Returns the words that start a process, by the process's name.
    hurried : Event, optional
        Has its processes end at once, and not in order, once it is told to stop.
    keeper : CellKeeper, optional
        Keeps the cell file for the processes; without one they read the file itself.
    renews : bool
        Whether the processes that it takes over are to be restarted.
    accelerator : callable, optional
        Returns the utilisation of the node's accelerators, a share from 0 to 1. It counts where the
        cell says that the node has one kind of them.
    environment : mapping of str to str, optional
        Environment of the node's processes, with the variables of `dwell.live.host.security`; this
        process's own if left out.
    platform : Platform, optional
        Clock and transport of the agent; without faults if left out.

    Raises
    ------
    LiveError
        If there is no such node, or its ports or its folder cannot be had, or it leaves this
        computer without keys; or if an actuator could not be stopped at the end.
    TrustError
        If the keys are not the node's.
    """
    if node not in problem.fabric.nodes:
        known = ", ".join(problem.fabric.nodes)
        raise LiveError(f"no node {node!r} in cell {problem.name!r}; there are {known}")
    if cpus is not None:
        os.sched_setaffinity(0, cpus)
    if accelerator is not None and (unused := _unused_hook(problem, node)):
        say(unused)
    wiring = wire(problem)
    who = f"agent@{node}"
    # Without the variables of systemd, which the processes must not have.
    environment = dict(os.environ if environment is None else environment)
    service = Service(who, environment)
    security = Security.of(problem, wiring.entry(who).role, environment)
    security.remember(make_folder(folder))
    security.remind(say, stopped)
    source = security.keyring
    if source is not None:
        from dwell.live.host.key_renewal import installed

        environment[KEYS] = str(folder / "keys")
        security = replace(security, keyring=installed(source, folder / "keys"))
    transport = platform.transport(security, who, node)
    place = security.place(who, node, transport, Log(say))
    # Only what runs is kept: a file that could not be started can be corrected.
    if keeper is not None:
        keeper.begin(stopped)
    launcher = ForkServer(program, environment)
    supervisor = Supervisor(make_folder(folder), say, launcher)
    try:
        for role in wiring.on(node):
            if role.kind not in ("agent", "controller"):
                supervisor.keep(role.who, words(role.who))
        gauge = None if accelerator is None else Gauge(accelerator)
        stages = partial(read_books, problem, wiring.on(node), folder)
        changed = str if keeper is None else keeper.told
        busy_ns = _busy_clock(problem, node, say)
        agent = Agent(place, supervisor, busy_ns, gauge, stages, changed)
        clock, complain = platform.clock(problem, node), place.complain
        hosted = Hosted(agent, transport, clock, stopped=stopped, complain=complain)
        supervisor.ends.wake = hosted.wake_now
        each_turn = [service.step]
        if source is not None:
            from dwell.live.host.key_renewal import KeyRenewal

            connect = partial(_connected, platform, security, who, folder)
            renewal = KeyRenewal(
                *(source.folder, hosted, agent.pulse, connect),
                copy=folder / "keys",
                supervisor=supervisor,
            )
            each_turn.append(renewal.step)
        keep_collections_short()
        service.ready()
        if keeper is not None:
            keeper.renew = supervisor.restart_in_turn
            if renews:
                supervisor.restart_in_turn()
        take_turns([hosted], each_turn)
        if keeper is not None and not keeper.replaced:
            keeper.end()
    finally:
        service.stopping()
        if keeper is not None and keeper.replaced:
            launcher.stop()  # the agent that takes this one's place takes the processes over
            failed = {}
        else:
            failed = supervisor.stop(hurried=hurried)
        place.transport.close()
        # Those that have been killed could not remove theirs.
        remove_orphans()
    moving = [f"{who} {why}" for who, why in failed.items() if who.startswith("sink.")]
    if moving:
        raise LiveError(f"{'; '.join(moving)}: its actuator may not have stopped")


def _unused_hook(problem: Problem, node: str) -> str:
    """Say why the utilisation that a hook returns counts for nothing; empty where it counts."""
    kinds = problem.fabric.nodes[node].accelerators
    if len(kinds) == 1:
        return ""
    has = f"several kinds of accelerators ({', '.join(kinds)})" if kinds else "no accelerators"
    return f"node {node} has {has} in the cell: what --accelerator returns counts for nothing"


def _busy_clock(problem: Problem, node: str, say: Callable[[str], None]) -> Callable[[], int]:
    """Count the node's CPUs; of a node with a quota, what its own control group uses of them."""
    if problem.fabric.nodes[node].quota is not None:
        if (group := own_group()) is not None:
            return group.used_ns
        say(
            f"node {node} has a quota, but this agent is in no control group of its own: its "
            "utilisation counts all that its CPUs do"
        )
    return partial(busy_ns_of, sorted(os.sched_getaffinity(0)))


def run_controller(
    problems: Sequence[Problem],
    out: Path,
    stopped: threading.Event,
    *,
    keepers: Mapping[str, CellKeeper] | None = None,
    continues: Mapping[str, Continued] | None = None,
    policy: str | None = None,
    name: str | None = None,
    jobs: bool = False,
    environment: Mapping[str, str] | None = None,
    platform: Platform = PLAIN,
    say: Callable[[str], None] = print,
) -> dict[str, Continued]:
    """Control cells until told to stop.

    Parameters
    ----------
    out : Path
        Where the runs' folders go, one a cell and run.
    keepers : mapping of str to CellKeeper, optional
        Keep the cell files, by the names of the cells.
    continues : mapping of str to Continued, optional
        Last runs of a controller that took over edited files, by the names of the cells.
    policy : str, optional
        Instead of the cells' own.
    name : str, optional
        Name of this controller, by which others that would take charge tell it apart.
    jobs : bool
        Whether the runs keep their jobs, and what each process took of the CPUs.
    environment : mapping of str to str, optional
        With the variables of `dwell.live.host.security`; this process's own if left out.
    platform : Platform, optional
        Clock and transport of the controller; without faults if left out.

    Returns
    -------
    dict of str to Continued
        The runs, by the names of the cells.

    Raises
    ------
    LiveError
        If two cells have one name, ports are taken, the runs' folder cannot be made, or a cell
        leaves this computer without keys.
    TrustError
        If the keys are not the controller's.
    KernelError
        If a cell's estimator needs the compiled kernel, which cannot be loaded, and its policy may
        move it.
    """
    names = [problem.name for problem in problems]
    if len(set(names)) < len(names):
        raise LiveError(f"two cells have one name: {', '.join(sorted(names))}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        # A disk that is full may have room later.
        if error.errno in MISTAKEN:
            raise LiveError(f"{out}: cannot be made ({error.strerror})") from None
    name = name or f"controller-{os.getpid()}"
    # No message waits for long while a window closes.
    sys.setswitchinterval(0.0005)
    recorders: dict[str, tuple[RunRecorder, ControlledCell]] = {}
    environment = dict(os.environ if environment is None else environment)
    service = Service(f"controller@{problems[0].controller_node}", environment)
    with ExitStack() as stack:
        hosted, hurry, each_turn = [], threading.Event(), [service.step]
        for problem in problems:
            node = problem.controller_node
            role = wire(problem).entry(f"controller@{node}").role
            security = Security.of(problem, role, environment)
            security.remind(say, stopped)
            transport = platform.transport(security, f"controller@{node}", node)
            place = security.place(f"controller@{node}", node, transport, Log(say))
            stack.callback(_close, place)
            controller = controller_of(problem, policy, say)
            before = (continues or {}).get(problem.name, Continued())
            folder = before.folder and Path(before.folder).name
            recorder = RunRecorder(out, problem, controller, say, jobs=jobs, continues=folder)
            clock = platform.clock(problem, node)
            changed: Callable[[], str] = str
            if (keeper := (keepers or {}).get(problem.name)) is not None:
                keeper.begin(stopped)
                changed = keeper.told
            cell = ControlledCell(place, controller, recorder, name, time.time_ns(), changed)
            cell.pinned, cell.drained = before.pinned, {*before.drained}
            hosted.append(
                Hosted(
                    *(cell, transport, clock),
                    stopped=stopped,
                    hurry=hurry,
                    complain=place.complain,
                )
            )
            if security.keyring is not None:
                from dwell.live.host.key_renewal import KeyRenewal

                connect = partial(_connected, platform, security, place.who, None)
                keys = security.keyring.folder
                each_turn.append(KeyRenewal(keys, hosted[-1], cell.pulse, connect).step)
            recorders[problem.name] = recorder, cell
        keep_collections_short()
        service.ready()
        try:
            take_turns(hosted, each_turn)
        finally:
            service.stopping()
            ended = {name: _finished(*recorded) for name, recorded in recorders.items()}
        return ended


def _close(place: RolePlace) -> None:
    place.transport.close()


def _connected(
    platform: Platform, security: Security, who: str, state: Path | None, keyring: Keyring
) -> Transport:
    """Open the sessions of a process with newer keys, whose roster a state folder remembers."""
    renewed = replace(security, keyring=keyring)
    if state is not None:
        renewed.remember(state)
    return platform.transport(renewed, who, who.partition("@")[2])


def controller_of(problem: Problem, policy: str | None, say: Callable[[str], None]) -> Controller:
    """Make a cell's controller; without the compiled kernel only one that prices nothing."""
    try:
        return Controller(problem, policy)
    except KernelError as error:
        name = problem.policy_and_estimator(policy or problem.controller.policy)[0]
        if name not in problem.candidates:
            raise
        say(f"{error}; placement {name} stays, and its record expects no other of any candidate")
        return Controller(problem, name, _AsSeen(problem))


class _AsSeen:
    """An estimator that expects of every candidate what the window showed."""

    def __init__(self, problem: Problem) -> None:
        self._names = tuple(problem.candidates)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Expect the window of all (see `Estimator`)."""
        return dict.fromkeys(self._names, observed)


def _finished(recorder: RunRecorder, cell: ControlledCell) -> Continued:
    cell.write()
    folder = recorder.finish(cell.finish())
    return Continued(str(folder) if folder else "", cell.pinned, tuple(sorted(cell.drained)))
