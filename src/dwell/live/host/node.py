"""Main functions of the agent of a node and of the controller of cells."""

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
from dwell.live.host.hosting import Hosted, Platform, keep_collections_short, take_turns
from dwell.live.host.kept_cell import CellKeeper
from dwell.live.host.launcher import ForkServer
from dwell.live.host.security import Security
from dwell.live.host.service import Service
from dwell.live.host.state_files import BeatFiles, make_folder
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

#: Errors of making a folder that the user has to fix; Dwell tries again after other errors.
MISTAKEN = frozenset({errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP})


class Continued(msgspec.Struct, frozen=True):
    """Folder of a run that the next controller continues (or empty), with its pins and drains."""

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
    hurried: threading.Event,
    keeper: CellKeeper,
    renews: bool,
    cpus: Iterable[int] | None,
    accelerator: Callable[[], float] | None,
    environment: dict[str, str],
    platform: Platform,
    say: Callable[[str], None],
) -> None:
    """Keep a node's processes running until `stopped` is set; then end them.

    Parameters
    ----------
    program : sequence of str
        Command of the fork server (`ForkServer`).
    words : callable
        Returns the arguments of a process from its name.
    hurried : Event
        If set, the processes end at once instead of cleanly.
    keeper : CellKeeper
        Keeps the copy of the cell file for the processes.
    renews : bool
        Whether to restart the running processes of a previous agent.
    accelerator : callable, optional
        Returns the utilisation of the node's accelerators, from 0 to 1. Used only if the cell file
        gives the node exactly one kind of accelerator.
    environment : dict of str to str
        Environment of the node's processes, with the variables of `dwell.live.host.security`; the
        variables of systemd are removed, which the processes must not inherit.

    Raises
    ------
    LiveError
        If the node is unknown, its ports are taken, its folder cannot be made, or the cell needs
        keys and has none; or if an actuator could not be stopped at the end.
    TrustError
        If the keys belong to another node.
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
    place.slots = BeatFiles(folder, who)
    # Copy the cell only now: if the start has failed, the user can correct the file.
    keeper.begin(stopped)
    launcher = ForkServer(program, environment)
    supervisor = Supervisor(make_folder(folder), say, launcher)
    try:
        for role in wiring.on(node):
            if role.kind not in ("agent", "controller"):
                supervisor.keep(role.who, words(role.who))
        gauge = None if accelerator is None else Gauge(accelerator)
        stages = partial(read_books, problem, wiring.on(node), folder)
        busy_ns = _busy_clock(problem, node, say)
        agent = Agent(place, supervisor, busy_ns, gauge, stages, keeper.told)
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
        keeper.renew = supervisor.restart_in_turn
        if renews:
            supervisor.restart_in_turn()
        take_turns([hosted], each_turn)
        if not keeper.replaced:
            keeper.end()
    finally:
        service.stopping()
        if keeper.replaced:
            launcher.stop()  # the processes continue: the next agent supervises them
            failed = {}
        else:
            failed = supervisor.stop(hurried=hurried)
        place.transport.close()
        # Killed processes leave their shared memory behind.
        remove_orphans()
    moving = [f"{who} {why}" for who, why in failed.items() if who.startswith("sink.")]
    if moving:
        raise LiveError(f"{'; '.join(moving)}: its actuator may not have stopped")


def _unused_hook(problem: Problem, node: str) -> str:
    """Return why the utilisation from `--accelerator` is unused; empty if it is used."""
    kinds = problem.fabric.nodes[node].accelerators
    if len(kinds) == 1:
        return ""
    has = f"several kinds of accelerators ({', '.join(kinds)})" if kinds else "no accelerators"
    return f"node {node} has {has} in the cell: what --accelerator returns counts for nothing"


def _busy_clock(problem: Problem, node: str, say: Callable[[str], None]) -> Callable[[], int]:
    """Return a counter of the node's busy core-ns: of its control group if the node has a quota."""
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
    keepers: Mapping[str, CellKeeper],
    continues: Mapping[str, Continued],
    policy: str | None,
    name: str | None,
    jobs: bool,
    environment: dict[str, str],
    platform: Platform,
    say: Callable[[str], None],
) -> dict[str, Continued]:
    """Control cells until `stopped` is set; return their runs by cell name.

    Parameters
    ----------
    out : Path
        Folder for the runs' folders.
    keepers : mapping of str to CellKeeper
        Keepers of the cell files, by cell name.
    continues : mapping of str to Continued
        Runs to continue after edited cell files, by cell name.
    policy : str, optional
        Policy of all cells [default: the policy of each cell file].
    name : str, optional
        Name that distinguishes this controller from rivals.
    jobs : bool
        Whether to record the jobs and the CPU time of each process.
    environment : dict of str to str
        Contains the variables of `dwell.live.host.security`.

    Raises
    ------
    LiveError
        If two cells have one name, ports are taken, the runs' folder cannot be made, or a cell
        needs keys and has none.
    TrustError
        If the keys are not the controller's.
    KernelError
        If the kernel cannot be loaded, but a cell's estimator needs it and its policy is not fixed.
    """
    names = [problem.name for problem in problems]
    if len(set(names)) < len(names):
        raise LiveError(f"two cells have one name: {', '.join(sorted(names))}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        # Continue after other errors: a full disk may have space later.
        if error.errno in MISTAKEN:
            raise LiveError(f"{out}: cannot be made ({error.strerror})") from None
    name = name or f"controller-{os.getpid()}"
    # Switch threads often, so messages are read while the end of a window is processed.
    sys.setswitchinterval(0.0005)
    recorders: dict[str, tuple[RunRecorder, ControlledCell]] = {}
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
            before = continues.get(problem.name, Continued())
            folder = before.folder and Path(before.folder).name
            recorder = RunRecorder(out, problem, controller, say, jobs=jobs, continues=folder)
            clock = platform.clock(problem, node)
            keeper = keepers[problem.name]
            keeper.begin(stopped)
            cell = ControlledCell(place, controller, recorder, name, time.time_ns(), keeper.told)
            cell.wishes.pinned, cell.wishes.drained = before.pinned, {*before.drained}
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
    """Open the sessions of a process with newer keys; note their roster in the state folder."""
    renewed = replace(security, keyring=keyring)
    if state is not None:
        renewed.remember(state)
    return platform.transport(renewed, who, who.partition("@")[2])


def controller_of(problem: Problem, policy: str | None, say: Callable[[str], None]) -> Controller:
    """Make a cell's controller; without the compiled kernel, only a fixed placement is possible."""
    try:
        return Controller(problem, policy)
    except KernelError as error:
        name = problem.policy_and_estimator(policy or problem.controller.policy)[0]
        if name not in problem.candidates:
            raise
        say(f"{error}; placement {name} stays, and its record expects no other of any candidate")
        return Controller(problem, name, _AsSeen(problem))


class _AsSeen:
    """Estimator that predicts the observed window for every candidate."""

    def __init__(self, problem: Problem) -> None:
        self._names = tuple(problem.candidates)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Return the observed window for every candidate (see `Estimator`)."""
        return dict.fromkeys(self._names, observed)


def _finished(recorder: RunRecorder, cell: ControlledCell) -> Continued:
    cell.write()
    folder = recorder.finish(cell.finish())
    wishes = cell.wishes
    return Continued(str(folder) if folder else "", wishes.pinned, tuple(sorted(wishes.drained)))
