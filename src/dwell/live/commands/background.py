"""`dwell live up`, `down` and `log`: a cell's agents and controller in the background.

Each process has its own session, so it outlives the terminal. It has two files in the cell's folder
in the state folder: ``agent@R1.pid`` with its process id, and ``agent@R1.log`` with its output.
"""

from __future__ import annotations

import codecs
import fcntl
import os
import shlex
import shutil
import signal
import statistics
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import typer

from dwell.errors import LiveError, ProblemError
from dwell.live.host.kept_cell import Change, KeptCell, cell_here, change, forget
from dwell.live.host.node_processes import NodeProcesses
from dwell.live.host.operator_client import OperatorClient
from dwell.live.host.process_group import ProcessGroup, end_processes
from dwell.live.host.security import Security
from dwell.live.host.stage_modules import require_stages
from dwell.live.host.state_files import make_folder
from dwell.live.host.state_folder import logs
from dwell.live.host.supervision import LOG_BYTES, shorten_log, survivor, write_mark
from dwell.live.log import printable
from dwell.live.transport.orphans import remove_orphans
from dwell.live.wire.local_addresses import is_here, listening_ports, taken_ports, why_not_listen
from dwell.live.wire.wiring import Role, Wiring, roles, wire
from dwell.model import Problem

#: Longest times until a process listens, and until it ends after SIGTERM: an actuator may take two
#: seconds to stop, and a controller completes its run's folder.
START_S, END_S = 30.0, 30.0
LOOK_S = 0.1
#: Longest time for a step of `--again`, as the processes of a node restart one by one.
TAKEN_S = 120.0
#: Typical time for a clean end of a cell's processes.
STOPPED_S = 2.0
#: Number of log lines in the message about a process that does not start.
LAST_LINES = 5


@dataclass(frozen=True, slots=True)
class Background:
    """Part of a cell on this computer; `folder` has one folder per node."""

    problem: Problem
    folder: Path

    def running(self) -> dict[str, psutil.Process]:
        """Return the running agents and controller by name."""
        return _survivors(self.folder.glob("*.pid"))

    def leftovers(self, wiring: Wiring) -> dict[str, psutil.Process]:
        """Return the running processes of dead agents by name."""
        listening = listening_ports()
        marks: list[Path] = []
        for node in self.folder.iterdir() if self.folder.is_dir() else ():
            entry = wiring.entries.get(f"agent@{node.name}")
            if entry is None or entry.listen["control"].port not in listening:
                marks += node.glob("*.pid")
        return _survivors(marks)


def _survivors(marks: Iterable[Path]) -> dict[str, psutil.Process]:
    found = {mark.stem: survivor(mark) for mark in sorted(marks)}
    return {who: process for who, process in found.items() if process is not None}


def _named(processes: Mapping[str, psutil.Process]) -> str:
    return ", ".join(f"{who} (process {process.pid})" for who, process in processes.items())


# ------------------------------------------------------------------------- up


def nodes_here(problem: Problem, named: Sequence[str]) -> list[str]:
    """Return the nodes to run here: the named nodes, or else the nodes with a local address.

    Raises a ProblemError if a node is unknown, or no node belongs to this computer.
    """
    for node in named:
        problem.require_node(node)
    here = [
        node
        for node, host in problem.live.hosts.items()
        if (node in named if named else is_here(host.address))
    ]
    if not here:
        places = ", ".join(f"{node} at {host.address}" for node, host in problem.live.hosts.items())
        raise ProblemError(
            f"no node of cell {problem.name!r} is this computer ({places}); correct live.hosts"
        )
    return here


def up(
    file: Path,
    problem: Problem,
    folder: Path,
    out: Path,
    *,
    nodes: Sequence[str],
    environment: Mapping[str, str],
    policy: str | None = None,
) -> list[str]:
    """Start the agents of some nodes, and the controller if it belongs to them; return the names.

    If a process does not start, ends the others and removes their files. Raises a ProblemError if
    the cell cannot run; a LiveError if a process runs already, a port is taken, or a process does
    not start; and a TrustError if the keys belong to other nodes.
    """
    wiring, background = wire(problem), Background(problem, folder)
    here = [
        role for node in nodes for role in wiring.on(node) if role.kind in ("agent", "controller")
    ]
    for role in here:
        Security.of(problem, role, environment)
    require_stages(problem, file, nodes)
    _require_down(background, wiring, file)
    _require_ports(problem, wiring, nodes)
    processes = NodeProcesses(
        *(file.resolve(), folder),
        root=folder.parent,
        environment=environment,
        start_new_session=True,
    )
    with _Start(processes, out) as start:
        # Check again under the lock: another `dwell live up` may have been faster.
        _require_down(background, wiring, file)
        for role in here:
            start.run(role, policy)
        start.wait({role.who: wiring.entry(role.who).listen["control"].port for role in here})
    return [role.who for role in here]


def _require_down(background: Background, wiring: Wiring, file: Path) -> None:
    """Raise a LiveError if an agent, the controller or a process of a dead agent runs."""
    name, remedy = background.problem.name, f"dwell live down {shlex.quote(str(file))}"
    if running := background.running():
        raise LiveError(f"{name} is up already: {_named(running)}; this ends it: {remedy}")
    if left := background.leftovers(wiring):
        raise LiveError(
            f"an agent of {name} has died, and its processes still run: {_named(left)}; this ends "
            f"them: {remedy}"
        )


def _require_ports(problem: Problem, wiring: Wiring, nodes: Sequence[str]) -> None:
    """Raise a LiveError if an address of the nodes is not local, or a port is taken."""
    hosts = problem.live.hosts
    away = [
        f"live.hosts.{node}: {why_not_listen(hosts[node].address, 0)}"
        for node in nodes
        if not is_here(hosts[node].address)
    ]
    if away:
        raise LiveError("\n".join(away))
    whose = [role.who for node in nodes for role in wiring.on(node)]
    ends = [end for who in whose for end in wiring.entry(who).listen.values()]
    taken = {end.port for end in ends if why_not_listen(end.address, end.port)}
    if taken:
        whom = taken_ports(taken) or ", ".join(map(str, sorted(taken)))
        raise LiveError(
            f"of the ports of {problem.name} are taken: {whom}; end it, or give the nodes in "
            "live.hosts other ports"
        )


class _Start:
    """Start of several processes, which is undone after an error."""

    def __init__(self, processes: NodeProcesses, out: Path) -> None:
        self.processes, self.folder, self._out = processes, processes.folder, out
        self._was = {path: path.exists() for path in (*self.folder.parents, self.folder, out)}
        #: Size of each log before the start; None for a new log.
        self._logs: dict[str, int | None] = {}
        self._lock = -1

    def __enter__(self) -> _Start:
        self._lock = os.open(make_folder(self.folder), os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise LiveError(f"{self.folder}: another `dwell live up` is at work there") from None
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is not None:
                self._undo()
        finally:
            os.close(self._lock)

    def run(self, role: Role, policy: str | None) -> None:
        """Start an agent or the controller in a new session."""
        log = self.processes.log(role.who)
        length = log.stat().st_size if log.exists() else None
        self._logs[role.who] = 0 if shorten_log(log, LOG_BYTES) else length
        if role.kind == "agent":
            self.processes.start_agent(role.node)
        else:
            more = () if policy is None else ("--policy", policy)
            self.processes.start_controller_on(role.node, self._out, more)
        process = self.processes.running[role.who]
        write_mark(self.folder / f"{role.who}.pid", ProcessGroup.of(process.pid))

    def wait(self, ports: Mapping[str, int]) -> None:
        """Wait until all processes listen; raises a LiveError if one ends, or after `START_S`."""
        until_s = time.monotonic() + START_S
        while True:
            for who, process in self.processes.running.items():
                if (code := process.poll()) is not None:
                    raise LiveError(f"{who} has ended with exit code {code}: {self._last(who)}")
            listening = listening_ports()
            silent = [who for who, port in ports.items() if port not in listening]
            if not silent:
                return
            if time.monotonic() > until_s:
                who = silent[0]
                raise LiveError(f"{who} does not listen after {START_S:.0f} s: {self._last(who)}")
            time.sleep(LOOK_S)

    def _last(self, who: str) -> str:
        """Return the last lines that a process has printed since its start."""
        data = self.processes.log(who).read_bytes()[self._logs[who] or 0 :]
        lines = data.decode(errors="replace").strip().splitlines()[-LAST_LINES:]
        told = "\n".join(map(printable, lines)).removeprefix("error: ")
        return told or "it has printed nothing"

    def _undo(self) -> None:
        """End the started processes, and remove the new files and folders."""
        self.processes.end("", END_S)
        for who, length in self._logs.items():
            # The processes of a killed agent still run.
            _end(_survivors((self.folder / who.partition("@")[2]).glob("*.pid")))
            (self.folder / f"{who}.pid").unlink(missing_ok=True)
            if length is None:
                self.processes.log(who).unlink(missing_ok=True)
        if not self._was[self.folder]:
            shutil.rmtree(self.folder, ignore_errors=True)
        for path in (self._out, *self.folder.parents):
            if not self._was[path]:
                with suppress(OSError):
                    path.rmdir()


# ------------------------------------------------------------------------- again


def again(
    file: Path,
    root: Path,
    environment: Mapping[str, str],
    say: Callable[[str], None],
    *,
    yes: bool = False,
) -> list[str]:
    """Apply an edited cell file, edited modules, or another version of Dwell to a running cell.

    If the wiring has changed and `yes` is set, ends all processes and returns the nodes that the
    caller has to start again. Raises a ProblemError if the new cell cannot run; a LiveError if the
    cell is not running here, an agent does not apply the files, or the wiring has changed without
    `yes`; and a TrustError if new code needs an operator's keys.
    """
    kept, new = cell_here(file, root), KeptCell.of(file)
    problem = new.problem()
    here = Background(problem, root / problem.name)
    running, remedy = here.running(), shlex.quote(str(file))
    if kept.folder is None or not running:
        raise LiveError(f"{file}: does not run here; this starts it: dwell live up {remedy}")
    found = change(kept, new)
    agents = [who for who in running if who.startswith("agent@")]
    nodes = [who.partition("@")[2] for who in agents]
    wiring = wire(problem)
    require_stages(problem, file, [node for node in nodes if node in problem.fabric.nodes])
    if found == "wiring":
        old = kept.problem()
        pause = (
            f"{file}: its wiring is another: all processes end and start together, which takes "
            f"about {_pause_s(old, root, running):.0f} s without commands"
        )
        if not yes:
            raise LiveError(f"{pause}; with --yes it is done")
        say(pause)
        down(old, root / old.name)
        forget(file, root)
        _say_left(file, problem, found, running, say)
        return nodes
    fixed = {role.node for role in roles(problem) if role.kind in ("stamper", "sink")}
    if found == "code":
        # Nodes without stamper and sinks are first, to keep the stop of the robot short.
        agents.sort(key=lambda who: who.partition("@")[2] in fixed)
        with OperatorClient(problem, environment) as visitor:
            for who in agents:
                node = wiring.entry(who).role.node
                with _moved_off(visitor, node):
                    before = _survivors((here.folder / node).glob("*.pid"))
                    _hand_over(here, who, running[who], new)
                    _await_restarts(visitor, here, node, before)
                say(f"{node} runs the new code")
    else:
        for who in agents:
            _hand_over(here, who, running[who], new)
    for who in running.keys() - {*agents}:
        port = wiring.entry(who).listen["control"].port
        _hand_over(here, who, running[who], new, None if found == "text" else port)
    say(f"{file.name}: {found} is taken over by {', '.join(running)}")
    _say_left(file, problem, found, running, say)
    return []


def _pause_s(problem: Problem, root: Path, running: Mapping[str, psutil.Process]) -> float:
    """Return the expected time for a restart of the cell, from the duration of its last start."""
    began_s = min(process.create_time() for process in running.values())
    there = _survivors((root / problem.name).glob("*/*.pid")).values()
    # Use the median, as some processes may have been restarted since.
    started_s = statistics.median([began_s, *(process.create_time() for process in there)])
    longest_ms = max(task.start_ms for task in problem.pipeline.tasks.values())
    return STOPPED_S + started_s - began_s + longest_ms / 1e3


def _hand_over(
    here: Background, who: str, process: psutil.Process, new: KeptCell, port: int | None = None
) -> None:
    """Make an agent or a controller copy the new files; with a port, await its restart."""
    place, before = here.folder / who.removeprefix("agent@"), process.cmdline()

    def done() -> bool:
        if KeptCell.of(new.file, [place]).contents != new.contents:
            return False
        return port is None or (process.cmdline() != before and port in listening_ports())

    process.send_signal(signal.SIGHUP)
    _until(f"{who} has not taken {new.file.name} over", done)


@contextmanager
def _moved_off(visitor: OperatorClient, node: str) -> Iterator[None]:
    """Pin the candidate with the fewest stages on a node; restore the previous pin at the end."""
    status = visitor.ask("status")
    clear = {
        name: [there for _, there in placement.sites].count(node)
        for name, placement in visitor.problem.candidates.items()
        if placement.nodes.isdisjoint(status["drained"])
    }
    target = min(clear, key=lambda name: (clear[name], name != status["placement"]))
    visitor.ask("pin", target)
    try:
        _until(
            f"{node} cannot be left for {target}",
            lambda: visitor.ask("status")["placement"] == target,
        )
        yield
    finally:
        pinned = status["pinned"]
        visitor.ask("pin" if pinned else "unpin", pinned or "")


def _await_restarts(
    visitor: OperatorClient, here: Background, node: str, before: Mapping[str, psutil.Process]
) -> None:
    """Wait until all processes of a node have been restarted and are ready."""

    def ready() -> bool:
        running = _survivors((here.folder / node).glob("*.pid"))
        if any(running.get(who) in (None, process) for who, process in before.items()):
            return False
        known, now_s = visitor.ask("status")["processes"], time.time()
        # Ignore beats of the previous process, which are older than the new process.
        return all(
            known[who]["ready"] and known[who]["age_ms"] / 1e3 < now_s - process.create_time()
            for who, process in running.items()
        )

    _until(f"not all processes of {node} are ready", ready)


def _until(what: str, holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + TAKEN_S
    while not holds():
        if time.monotonic() > end_s:
            raise LiveError(f"{what} after {TAKEN_S:.0f} s; see the logs")
        time.sleep(LOOK_S)


def _say_left(
    file: Path,
    problem: Problem,
    found: Change,
    running: Collection[str],
    say: Callable[[str], None],
) -> None:
    """Print the nodes on other computers that also have to apply the change."""
    whom = {f"controller@{problem.controller_node}": problem.controller_node}
    if found in ("code", "wiring"):
        whom |= {f"agent@{node}": node for node in problem.fabric.nodes}
    left = dict.fromkeys(node for who, node in whom.items() if who not in running)
    if left and found != "text":
        yes = " --yes" if found == "wiring" else ""
        say(
            f"left to do: copy the files to {', '.join(left)}; there: dwell live up --again{yes} "
            f"{shlex.quote(str(file))}"
        )


# ------------------------------------------------------------------------- down


def down(problem: Problem, folder: Path) -> list[str]:
    """End a cell's processes on this computer, even of dead agents; return their names.

    The controller is the first, because its run would otherwise end with an outage. Raises a
    LiveError if a process did not end by itself, and was killed.
    """
    background = Background(problem, folder)
    running = background.running()
    controllers = {who: one for who, one in running.items() if who.startswith("controller@")}
    killed = _end(controllers)
    killed += _end({who: one for who, one in running.items() if who not in controllers})
    left = background.leftovers(wire(problem))
    killed += _end(left)
    if left or killed:
        remove_orphans()
    for mark in folder.glob("*.pid"):
        mark.unlink(missing_ok=True)
    if killed:
        raise LiveError(
            f"{', '.join(killed)} did not end within {END_S:.0f} s, and was killed; see its log"
        )
    return [*running, *left]


def _end(processes: Mapping[str, psutil.Process]) -> list[str]:
    """End processes, and kill them after `END_S`; return the names of the killed."""
    killed = end_processes(processes.values(), END_S)
    return [who for who, process in processes.items() if process in killed]


# ------------------------------------------------------------------------- log


def logs_of(root: Path, cell: str) -> dict[str, Path]:
    """Return the logs of a cell's processes on this computer, by process."""
    return {name: paths[cell] for name, paths in logs(root).items() if cell in paths}


def log_of(root: Path, who: str, cell: str) -> Path:
    """Return the log of a process of a cell; raises a ProblemError if it does not exist."""
    known = logs_of(root, cell)
    if who not in known:
        listed = f"processes with a log: {', '.join(known)}" if known else f"no log in {root}"
        raise ProblemError(f"no process {who!r} of {cell}; {listed}")
    return known[who]


def print_log(path: Path, *, follow: bool) -> None:
    """Print a log; with `follow`, also print new lines until interrupted."""
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    with path.open("rb") as file:
        while True:
            if text := decoder.decode(file.read()):
                typer.echo(printable(text, keep="\n\t"), nl=False)
            if not follow:
                return
            time.sleep(LOOK_S)
            # The log was shortened: read it from the beginning.
            if path.stat().st_size < file.tell():
                file.seek(0)
