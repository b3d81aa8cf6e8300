"""Process of a stamper, worker or sink; an agent starts it."""

from __future__ import annotations

import sys
import threading
import time
from functools import partial
from pathlib import Path

import msgspec

from dwell.errors import LiveError
from dwell.live.failures import start_repeating
from dwell.live.host.hosting import (
    LONGEST_SLEEP_S,
    PLAIN,
    Clock,
    Hosted,
    Platform,
    keep_collections_short,
    work,
)
from dwell.live.host.lowest_class import take_lowest_class
from dwell.live.host.security import Security
from dwell.live.host.stage_modules import actuator_of, stage_of
from dwell.live.host.state_files import (
    BeatFiles,
    BookFile,
    HighestFile,
    InFlight,
    boot_id,
    kept_memory,
    make_folder,
)
from dwell.live.log import Log
from dwell.live.roles.control_group import ControlGroup, own_group
from dwell.live.roles.joins import Job
from dwell.live.roles.role import Pulse, RoleLogic, RolePlace
from dwell.live.roles.sink import Rest, Sink
from dwell.live.roles.stage_counts import StageBook, book_path
from dwell.live.roles.stamper import Stamper
from dwell.live.roles.worker import Worker
from dwell.live.wire.messages import Header
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role as Named
from dwell.live.wire.wiring import wire
from dwell.model import Problem

#: Calls of an actuator at a clean end of its process, and the longest time for repeating them.
ENDING: tuple[Rest, ...] = ("zero", "stop")
ENDING_S = 2.0


def run_process(
    problem: Problem,
    who: str,
    folder: Path,
    stopped: threading.Event,
    platform: Platform = PLAIN,
) -> bool:
    """Run a process of `wiring.roles` until `stopped` is set; return whether it ended cleanly.

    A sink ends cleanly if it could stop its actuator. Raises a LiveError if the
    process is unknown, its port is taken, or the cell needs keys and has none; and a TrustError if
    the keys belong to another process.
    """
    entry = wire(problem).entry(who)
    node = entry.role.node
    security = Security.of(problem, entry.role)
    clock = platform.clock(problem, node)
    transport = platform.transport(security, who, node)
    place = security.place(who, node, transport, Log(_print))
    try:
        return _run(entry.role, place, make_folder(folder), stopped, clock)
    finally:
        transport.close()


def _run(
    role: Named, place: RolePlace, folder: Path, stopped: threading.Event, clock: Clock
) -> bool:
    problem, place.slots = place.problem, BeatFiles(folder, role.who)
    # Switch threads often: a beat must not wait for a computing stage.
    sys.setswitchinterval(0.0005)
    # The control group counts the CPU time of a node with a quota.
    group = own_group() if problem.fabric.nodes[role.node].quota is not None else None
    if role.kind not in ("stamper", "sink"):
        _work(role, place, folder, stopped, clock, group)
        return True
    (folder / f"{role.who}.ready").touch()
    if role.kind == "stamper":
        book = BookFile(folder / f"{role.who}.book")
        stamper = Stamper(place, book, time.time_ns(), clock(), boot_id())
        if group is not None:
            stamper.group_clock = group.taken_ns
        _host(stamper, place, stopped, clock)
        return True
    actuator = actuator_of(problem, role.task)
    actuator.start()
    highest = HighestFile(folder / f"{role.who}.highest")
    sink = Sink(place, role.task, actuator, highest)
    if group is not None:
        sink.group_clock = group.taken_ns
    start_repeating("actuator", LONGEST_SLEEP_S, stopped, lambda: sink.watch(clock()))
    hosted = _host(sink, place, stopped, clock)
    # Wait for a command that is being applied; the role accepts no further commands.
    with hosted.lock:
        return bring_to_rest(sink)


def _host(role: RoleLogic, place: RolePlace, stopped: threading.Event, clock: Clock) -> Hosted:
    """Run a role in this thread until `stopped` is set."""
    hosted = Hosted(role, place.transport, clock, stopped=stopped, complain=place.complain)
    keep_collections_short()
    hosted.run()
    return hosted


def bring_to_rest(sink: Sink, patience_s: float = ENDING_S) -> bool:
    """Stop an actuator for good with `zero` and `stop`; return whether both succeeded.

    A call that raises is repeated every `max_age_ms`, for up to `patience_s` in total.
    """
    until_s = time.monotonic() + patience_s
    rests = True
    for how in ENDING:
        while not (told := sink.rest(how)):
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                break
            time.sleep(min(sink.max_age_ns / 1e9, left_s))
        rests &= told
    return rests


def _work(
    role: Named,
    place: RolePlace,
    folder: Path,
    stopped: threading.Event,
    clock: Clock,
    group: ControlGroup | None,
) -> None:
    problem = place.problem
    try:
        stage = stage_of(problem, role.task, role.index)
    except LiveError as error:
        # The process keeps running and reports the error in its beats, as restarts would hide it.
        print(error, file=sys.stderr, flush=True)
        broken = False, f"{role.who}: {error}"
        _host(_Broken(place, lambda: broken), place, stopped, clock)
        return
    memory = partial(kept_memory, book_path(folder, role.who))
    worker = Worker(
        place,
        role.task,
        stage,
        shadow=role.kind == "shadow",
        stands_by=f"{role.task}@{role.node}" if role.kind == "standby" else "",
        book=StageBook(problem, role.task, role.node, memory),
    )
    if group is not None:
        worker.group_clock = group.counts
    inflight = InFlight(folder / f"{role.who}.inflight")
    _retry_suspect(worker, folder / f"{role.who}.again", clock)

    def note(job: Job | None) -> None:
        if job is None:
            inflight.end()
        else:
            # If this process dies, the next process tries the job's inputs again.
            inputs = [(header, bytes(payload)) for header, payload, _ in job.inputs.values()]
            inflight.begin(msgspec.msgpack.encode([job.shadow, inputs]))

    work(
        *(worker, place.transport),
        stopped=stopped,
        note=note,
        clock=clock,
        begin=partial(take_lowest_class, role.who, _print) if worker.shadow else lambda: None,
        ready=(folder / f"{role.who}.ready").touch,
    )


def _print(line: str) -> None:
    print(f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {line}", file=sys.stderr, flush=True)


class _Broken(Pulse):
    """Replaces a worker whose stage cannot be loaded, and reports the error."""

    def receive(self, sample: Arrival, now_ns: int) -> None:  # type: ignore[override]
        super().receive(sample, now_ns)


def _retry_suspect(worker: Worker, path: Path, clock: Clock) -> None:
    """Run the job at which the previous process died first, to test whether its inputs kill."""
    try:
        shadow, inputs = msgspec.msgpack.decode(
            path.read_bytes(), type=tuple[bool, list[tuple[Header, bytes]]]
        )
        path.unlink()
    except (OSError, msgspec.MsgspecError):
        return
    worker.retry(shadow, inputs, clock())
