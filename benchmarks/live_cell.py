"""A cell of real processes whose stages do next to nothing, and what its actuator saw.

Its stages take no CPU, so that what is left is what the runtime itself takes.
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

import dwell
from benchmarks.timing import ROOT
from dwell.errors import LiveError
from dwell.live.local.loopback import Loopback, on_this_machine
from dwell.live.roles.worker import Worker
from dwell.live.stage import Message
from dwell.live.wire.messages import Header, decode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem

#: Where the actuator writes, and what: cycle, release, and the instant of the call.
OBSERVED = "DWELL_BENCH_OBSERVED"
RECORD = struct.Struct("<qqq")
#: Where `Counting` writes the numbers of cycles.
ARRIVED = "arrived"
NUMBER = struct.Struct("<q")
NODES = ("R1", "E", "R2")
CANDIDATES = {
    "LOC": {"perception": "R1", "planning": "R2"},
    "SO": {"perception": "E", "planning": "E"},
    "HYB": {"perception": "E", "planning": "R2"},
}
FLOWS = (("sensing", "perception"), ("perception", "planning"), ("planning", "control"))
START_S = 60.0


class Passing:
    """A stage that passes on a few bytes."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return eight bytes."""
        return Message(bytes(8))


class Counting(Passing):
    """The same in a worker that writes down what arrives, before it takes the newest of it."""

    def __init__(self) -> None:
        path = Path(os.environ[OBSERVED]).with_name(ARRIVED)
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        take = Worker._input

        def write(worker: Worker, sample: Arrival, kind: str, now_ns: int) -> None:
            os.write(file, NUMBER.pack(decode(sample.header, Header).stamp.cycle))
            take(worker, sample, kind, now_ns)

        Worker._input = write  # type: ignore[method-assign, assignment]


class Actuator:
    """Writes down every call, in order."""

    def __init__(self) -> None:
        path = os.environ[OBSERVED]
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def apply(self, command: Message) -> None:
        """Write cycle, release and instant."""
        now_ns = time.monotonic_ns()
        os.write(self._file, RECORD.pack(command.cycle, command.released_ns, now_ns))

    def hold(self) -> None:
        """Nothing to do."""

    def zero(self) -> None:
        """Nothing to do."""


def document(
    name: str,
    *,
    period_ms: float = 40,
    tasks: Mapping[str, Sequence[str]] | None = None,
    candidates: Mapping[str, Mapping[str, str]] | None = None,
    flows: Sequence[tuple[str, str]] = FLOWS,
    delay_ms: object = 1,
    fallbacks: Sequence[str] = ("LOC", "HYB", "SO"),
    **more: Any,
) -> dict[str, Any]:
    """Return a cell file; the policy stays where it is, so that only people move stages."""
    placed = tasks or {
        "sensing": ["R1"],
        "perception": ["R1", "E"],
        "planning": ["R2", "E"],
        "control": ["R2"],
    }
    sinks = set(placed) - {source for source, _ in flows}
    found: dict[str, Any] = {
        "dwell": 1,
        "name": name,
        "period_ms": period_ms,
        "deadline_ms": period_ms,
        "window_cycles": 25,
        "warmup_windows": 0,
        "nodes": {n: {"tier": "edge" if n == "E" else "robot", "cores": 2} for n in NODES},
        "links": [
            {"from": a, "to": b, "both_ways": True, "delay_ms": delay_ms, "rate_mbps": 1000}
            for a, b in (("R1", "E"), ("E", "R2"), ("R1", "R2"))
        ],
        "tasks": {
            task: {
                "run": "benchmarks.live_cell:Passing",
                "on": {node: {"exec_ms": 0.1} for node in nodes},
            }
            for task, nodes in placed.items()
        },
        "flows": [{"from": a, "to": b, "bytes": 8} for a, b in flows],
        "candidates": candidates or CANDIDATES,
        "objective": {
            "weights": {
                "latency": 1.0,
                "violations": 1.0,
                "robot": 0.0,
                "edge": 0.0,
                "switching": 0.0,
            },
            "targets": {"latency_ms": period_ms, "robot": 0.9, "edge": 0.9},
            "caps": {"latency_ms": 3 * period_ms},
        },
        "controller": {
            "on": "E",
            "policy": "dtp",
            "initial": next(iter(candidates or CANDIDATES)),
            "min_improvement": 10.0,
            "estimator": "profile",
            "guard_cycles": 10,
            "fallbacks": list(fallbacks),
            "close_grace_ms": period_ms,
        },
        "live": {
            "max_age_ms": 1_000,
            "actuators": dict.fromkeys(sorted(sinks), "benchmarks.live_cell:Actuator"),
        },
    }
    return {**found, **more}


def problem_of(found: dict[str, Any], folder: Path, *, links: bool) -> Problem:
    """Return the cell on ports of this machine, with links between its nodes or without."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "written.yaml"
    path.write_text(yaml.safe_dump(found, sort_keys=False))
    problem = on_this_machine(dwell.load(path))
    if links:
        return problem
    hosts = {node: {"port": host.port} for node, host in problem.live.hosts.items()}
    path.write_text(yaml.safe_dump({**found, "live": {**found["live"], "hosts": hosts}}))
    return dwell.load(path)


@dataclass(frozen=True, slots=True)
class Applied:
    """A call of the actuator."""

    cycle: int
    released_ns: int
    at_ns: int


def records(path: Path, record: struct.Struct) -> Iterator[tuple[Any, ...]]:
    """Yield the whole records of a file that may not exist yet."""
    data = path.read_bytes() if path.exists() else b""
    return record.iter_unpack(data[: len(data) - len(data) % record.size])


class LightCell(Loopback):
    """A cell of `document` on this machine; a context manager that waits until it runs.

    Its processes find stages in the folders of `paths`; `observed` is what its actuator writes.
    """

    def __init__(
        self,
        found: dict[str, Any],
        folder: Path,
        *,
        links: bool = False,
        paths: Sequence[Path] = (),
    ) -> None:
        problem = problem_of(found, folder, links=links)
        self.observed = folder / "observed"
        given = filter(None, [os.environ.get("PYTHONPATH")])
        folders = [str(ROOT), *map(str, paths), *given]
        environment = {OBSERVED: str(self.observed), "PYTHONPATH": os.pathsep.join(folders)}
        super().__init__(problem, folder, {}, environment=environment)

    def start(self) -> None:
        """Start it; returns when its commands are applied."""
        super().start()
        try:
            self.wait_for("commands", lambda: len(self.applied()) > 10)
            self.wait_for("the controller", lambda: self.said().get("placement") is not None)
        except BaseException:
            self.stop()
            raise

    def applied(self) -> Sequence[Applied]:
        """Return the actuator's calls so far."""
        return [Applied(*one) for one in records(self.observed, RECORD)]

    def pids(self) -> dict[str, int]:
        """Return the processes that the agents have started, by name."""
        found = {}
        for mark in self.folder.glob("*/*.pid"):
            with suppress(OSError, ValueError):
                found[mark.stem] = int(json.loads(mark.read_text())["pid"])
        return found

    def said(self) -> Mapping[str, Any]:
        """Return what the controller says; nothing where it does not answer."""
        try:
            return self.sample(0.5)
        except LiveError:
            return {}

    def wait_until_at(self, placement: str) -> None:
        """Wait until the controller says that the cell is there."""
        self.wait_for(placement, lambda: self.said().get("placement") == placement)

    def wait_for(self, what: str, event: Callable[[], bool], patience_s: float = START_S) -> None:
        """Wait until something holds.

        Raises
        ------
        LiveError
            If it does not.
        """
        until = time.monotonic() + patience_s
        while not event():
            if time.monotonic() > until:
                raise LiveError(f"{self.problem.name}: waited {patience_s:g} s for {what}")
            time.sleep(0.01)
