"""`dwell check --node`: checks whether a node can run its part of a live cell."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import typer

from dwell.cli.output import aligned, print_json
from dwell.errors import Fault, LiveError, TrustError, installing
from dwell.live.host.security import Security, environment, exposed
from dwell.live.host.stage_modules import actuator_of, ros_topics, stage_of
from dwell.live.stage import CellStage
from dwell.live.wire.lint import lint
from dwell.live.wire.wiring import PORTS_PER_ROLE, Role, Wiring, roles, wire
from dwell.model import Problem
from dwell.model.bounds import counted


@dataclass(slots=True)
class StateTimes:
    """Times in which the stages of a node write and read their states."""

    #: ``snapshot_ms``, ``restore_ms`` and ``bytes`` by task.
    tasks: dict[str, dict[str, float]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def measure(self, problem: Problem, name: str, stage: CellStage) -> None:
        """Time `snapshot` and `restore` of a stage that has not been started."""
        began_s = time.perf_counter()
        try:
            data = bytes(stage.snapshot())
            written_s = time.perf_counter()
            stage.restore(data)
        except Exception as error:  # the user's code
            raised = f"{type(error).__name__}: {error}"
            self.warnings.append(f"tasks.{name}.run: its state was not timed ({raised})")
            return
        snapshot_ms = round((written_s - began_s) * 1e3, 3)
        restore_ms = round((time.perf_counter() - written_s) * 1e3, 3)
        self.tasks[name] = {
            "snapshot_ms": snapshot_ms,
            "restore_ms": restore_ms,
            "bytes": len(data),
        }
        patience_ms = problem.guard_patience_ns / 1e6
        if snapshot_ms > patience_ms:
            self.warnings.append(
                f"tasks.{name}.run: snapshot() takes {snapshot_ms:.0f} ms, longer than "
                f"the guard's patience of {patience_ms:g} ms: no checkpoints are made, and a move "
                "loses the cycles of that time"
            )


PACKAGES = {"zenoh": "eclipse-zenoh", "msgspec": "msgspec", "psutil": "psutil"}


def check_node(
    problem: Problem,
    cell: Path,
    node: str,
    keys: Path | None = None,
    *,
    insecure: bool = False,
    as_json: bool,
) -> bool:
    """Import and make all stages and actuators of a node; print the faults, return if none."""
    problem.require_node(node)
    # Import the user's stages from the folder of the cell file, like a worker's process.
    sys.path.insert(0, str(cell.resolve().parent))
    wiring, faults = _wiring(problem)
    security, unsafe = _security(problem, node, environment(keys, insecure=insecure))
    states = StateTimes()
    stages = _stages(problem, node, states)
    faults += [*unsafe, *_packages(), *stages, *_actuators(problem, node)]
    warnings = [*(str(caution) for caution in lint(problem)), *states.warnings]
    if security is not None and security.keyring is not None:
        warnings += _open_topics(problem, node)
    if security is not None:
        warnings += [line.removeprefix("warning: ") for line in security.warnings()]
    if as_json:
        rows = [{"path": fault.path, "message": fault.message} for fault in faults]
        processes = [] if wiring is None else [role.who for role in wiring.on(node)]
        head = {"node": node, "ready": not faults, "faults": rows, "processes": processes}
        print_json({**head, "warnings": warnings, "states": states.tasks})
        return not faults
    for fault in faults:
        typer.echo(f"{cell}: node {node}: {fault}", err=True)
    for warning in warnings:
        typer.echo(f"{cell}: warning: {warning}", err=True)
    if wiring is not None and not faults:
        typer.echo(_summary(problem, wiring, node))
        for name, one in states.tasks.items():
            typer.echo(
                f"{name}: snapshot() takes {one['snapshot_ms']:g} ms for {one['bytes']} bytes, "
                f"restore() {one['restore_ms']:g} ms"
            )
    return not faults


def _open_topics(problem: Problem, node: str) -> Iterator[str]:
    """Yield a warning for each ROS topic of a node that is not encrypted, in a cell with keys."""
    for path, topic in ros_topics(problem, {node}).items():
        from dwell.live.ros2.ros_session import is_encrypted

        if not is_encrypted(topic):
            yield (
                f"{path}: the cell has keys, and this topic has none: who reaches its router can "
                "read it and publish on it; connect by tls/ (docs/howto/ros2.md)"
            )


def _packages() -> Iterator[Fault]:
    for module, package in PACKAGES.items():
        if importlib.util.find_spec(module) is None:
            yield Fault("", f"{package} is not installed; {installing('live')}")


def _security(
    problem: Problem, node: str, given: Mapping[str, str]
) -> tuple[Security | None, list[Fault]]:
    """Return the protection of the node's processes, or the faults that forbid their start."""
    try:
        return Security.of(problem, Role(f"agent@{node}", node, "agent"), given), []
    except TrustError as error:
        return None, [Fault("", str(error))]
    except LiveError:
        return None, list(exposed(problem))


def _wiring(problem: Problem) -> tuple[Wiring | None, list[Fault]]:
    """Return the wiring, or the faults of the hosts."""
    try:
        return wire(problem), []
    except LiveError as error:
        parts = (line.partition(": ") for line in str(error).splitlines())
        return None, [
            Fault(path, text) if text else Fault("live.hosts", path) for path, _, text in parts
        ]


def _stages(problem: Problem, node: str, states: StateTimes) -> Iterator[Fault]:
    """Yield the faults of the node's stages, and time the stages with a state."""
    pipeline = problem.pipeline
    first = next(name for name in pipeline.tasks if not pipeline.inputs(name))
    for name, task in pipeline.tasks.items():
        if node not in task.on:
            continue
        where = f"tasks.{name}.run"
        try:
            stage = stage_of(problem, name)
        except LiveError as error:
            yield Fault(where, str(error).removeprefix(f"{where}: "))
            continue
        yield from _inputs(problem, name, stage, where)
        frames = problem.live.release == "frames" and name == first
        if frames and not stage.has_frames:
            yield Fault(where, f"{task.run} has no method wait(), and live.release is frames")
        yield from _state(name, task.run or "ros2", stage, task.state_bytes)
        if stage.stateful and task.state_bytes:
            states.measure(problem, name, stage)


def _inputs(problem: Problem, name: str, stage: CellStage, where: str) -> Iterator[Fault]:
    sources = {flow.source for flow in problem.pipeline.inputs(name)}
    for source in stage.inputs:
        if source not in sources:
            known = ", ".join(sorted(sources)) or "nothing"
            yield Fault(where, f"its `inputs` name {source!r}, but it gets {known}")


def _state(name: str, run: str, stage: CellStage, state_bytes: int) -> Iterator[Fault]:
    """Yield a fault if only one of cell file and stage has a state to move."""
    where = f"tasks.{name}.state_bytes"
    if state_bytes and not stage.stateful:
        yield Fault(where, f"{state_bytes}, but {run} has no methods snapshot() and restore()")
    if not state_bytes and stage.stateful:
        yield Fault(where, f"0, but {run} has a state: say about how many bytes it takes")


def _actuators(problem: Problem, node: str) -> Iterator[Fault]:
    for name, task in problem.pipeline.tasks.items():
        if problem.pipeline.outputs(name) or node not in task.on:
            continue
        where = f"live.actuators.{name}"
        try:
            actuator_of(problem, name)
        except LiveError as error:
            yield Fault(where, str(error).removeprefix(f"{where}: "))


def _summary(problem: Problem, wiring: Wiring, node: str) -> str:
    """Return a table of the node's processes, their ports and their peers."""
    host = problem.live.hosts[node]
    here = [role.who for role in wiring.on(node)]
    last = host.port + PORTS_PER_ROLE * len(here) - 1
    node_of = {role.who: role.node for role in roles(problem)}
    rows = [["process", "listens on", "reached from", "connects to"]]
    for role in wiring.on(node):
        entry = wiring.entry(role.who)
        ports = ", ".join(sorted(str(end.port) for end in entry.listen.values())) or "-"
        sources = _others(wiring, role, node_of, incoming=True)
        targets = _others(wiring, role, node_of, incoming=False)
        rows.append([role.who, ports, sources, targets])
    return "\n".join(
        (
            f"{problem.name}: {node} has all that it needs",
            f"{counted(len(here), 'process')}; TCP ports {host.port} to {last} of {host.address}",
            "",
            aligned(rows[0], rows[1:]),
        )
    )


def _others(wiring: Wiring, role: Role, node_of: dict[str, str], *, incoming: bool) -> str:
    """Return the other nodes that connect to a process, or to which it connects."""
    nodes = {
        node_of[link.source if incoming else link.target]
        for link in wiring.wires
        if role.who == (link.target if incoming else link.source)
    }
    return ", ".join(sorted(nodes - {role.node})) or "-"
