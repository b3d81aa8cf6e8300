"""The example's live cell on this machine: its commands, in processes of their own."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

import dwell
from dwell.errors import LiveError
from dwell.live.host.operator_client import OperatorClient
from dwell.live.wire.wiring import PORTS_PER_ROLE, roles
from dwell.model.document import to_document
from tests.cli.small_cell import ROOT, call
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, pause

EXAMPLE = ROOT / "examples" / "live"

#: Stages that do what the file `mood` beside them says, and an accelerator's utilisation.
MOODY = """
from pathlib import Path
import stages
from dwell.live.stage import Message

MOOD = Path(__file__).with_name("mood")

def perceive(inputs):
    mood = MOOD.read_text() if MOOD.exists() else ""
    if mood == "raise":
        raise ValueError("no light")
    if mood == "draw":
        print("\\x1b[2Jnone\\r\\ntold", flush=True)
        raise ValueError("\\x1b[2Jno\\r\\nlight")
    if mood == "text":
        return "left"
    return stages.perceive(inputs)

class Perception:
    def start(self):
        print("the old code", flush=True)
    def process(self, inputs):
        return perceive(inputs)

def busy():
    return 0.875
"""


def invoke(*arguments: str | Path) -> tuple[int, str, str]:
    """Run a command in this process."""
    result = call(*arguments)
    return result.exit_code, result.stdout, result.stderr


def in_window(placement: str) -> Callable[[dict[str, Any]], bool]:
    """Return whether a cell is at a placement, and the last window that has closed was, too."""

    def holds(status: dict[str, Any]) -> bool:
        here = status["placement"], status["window"].get("placement")
        return here == (placement, placement)

    return holds


class RealCell:
    """The example's cell with other ports, in a folder of its own.

    Parameters
    ----------
    folder : Path
    python : path-like
        What runs its commands; with this checkout's sources, if it is this one.
    """

    def __init__(self, folder: Path, python: str | Path = sys.executable) -> None:
        self.python = str(python)
        shutil.copytree(EXAMPLE, folder / "cell", ignore=shutil.ignore_patterns("__pycache__"))
        self.folder, self.file = folder, folder / "cell" / "cell.yaml"
        self.mood = folder / "cell" / "mood"
        self.module = folder / "cell" / "moody.py"
        self.module.write_text(MOODY)
        document = to_document(dwell.load(self.file))
        document["tasks"]["perception"]["run"] = "moody:Perception"
        document["nodes"]["E"]["accelerators"] = {"gpu": 1}
        # Other work on this machine may not look like a fault. Where it does, the guard moves the
        # cell, which soon proves that it can return.
        document["live"] |= {"release": "frames", "max_age_ms": 1_000, "degraded_at": 1}
        document["controller"] |= {"guard_cycles": 40, "probe_cycles": 5, "policy": "LOC"}
        # Tests count windows, and act between two decisions.
        document["controller"]["decide_cycles"] = document["window_cycles"]
        nodes = list(document["nodes"])
        first = free_ports(3 * 40)
        for i, node in enumerate(nodes):
            document["live"]["hosts"][node]["port"] = first + 40 * i
        self.document = document
        self.file.write_text(yaml.safe_dump(document, sort_keys=False))
        self.problem = dwell.load(self.file)
        assert PORTS_PER_ROLE * len(roles(self.problem)) < 3 * 40
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.environment: dict[str, str] = dict(os.environ)

    def start(self, name: str, *arguments: str | Path) -> subprocess.Popen[bytes]:
        """Start an agent or a controller; what it prints goes to a file."""
        with (self.folder / f"{name}.log").open("ab") as log:
            made = subprocess.Popen(
                [self.python, "-m", "dwell", *map(str, arguments), "--owner", str(os.getpid())],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **self._sources()},
            )
        self.processes[name] = made
        return made

    def _sources(self) -> dict[str, str]:
        return {"PYTHONPATH": str(ROOT / "src")} if self.python == sys.executable else {}

    def agent(self, node: str, *more: str, cell: Path | None = None) -> None:
        """Start a node."""
        words = ("--node", node, "--cell", cell or self.file, "--state", self.state(node))
        self.start(f"agent-{node}", "agent", *words, *more)

    def controller(self, *more: str) -> None:
        """Start the controller."""
        words = (
            "--cell",
            self.file,
            "--out",
            self.folder / "runs",
            "--state",
            self.folder / "kept",
        )
        self.start("controller", "controller", *words, *more)

    def begin(self) -> None:
        """Start the controller and all agents, and wait for a window where the policy stays."""
        self.controller()
        for node in ("R2", "E", "R1"):
            self.agent(node)
        self.until(lambda status: in_window("LOC")(status) and not status["silent"])

    def end(self, name: str) -> int:
        """End a command as systemd would."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGTERM)
        return process.wait(timeout=PATIENCE_S)

    def state(self, node: str) -> Path:
        return self.folder / "state" / node

    def log(self, node: str, who: str) -> str:
        return (self.state(node) / f"{who}.log").read_text()

    def until(self, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Ask for the status until something holds."""
        begin_s = time.monotonic()
        found: dict[str, Any] = {}
        with OperatorClient(self.problem, self.environment) as visitor:
            while (waited_s := time.monotonic() - begin_s) < PATIENCE_S:
                try:
                    found = visitor.ask("status", patience_s=1.0)
                except LiveError:
                    continue
                if holds(found):
                    return found
                pause(waited_s)
        logs = "\n".join(f"{p.name}: {p.read_text()}" for p in self.folder.glob("*.log"))
        raise AssertionError(f"it has not come about: {json.dumps(found, indent=1)}\n{logs}")

    def show(self, holds: Callable[[str], object], *options: str | Path, code: int = 0) -> str:
        """Print the status, by the command, until its output is as wanted, with its exit code."""
        begin_s = time.monotonic()
        stdout = ""
        while (waited_s := time.monotonic() - begin_s) < PATIENCE_S:
            found, stdout, _ = invoke("live", "status", *options, "--cell", self.file)
            if stdout and holds(stdout):
                assert found == code
                return stdout
            pause(waited_s)
        raise AssertionError(f"the status never read so; the last one: {stdout}")

    def note(self, who: str) -> Callable[[dict[str, Any]], str]:
        return lambda status: str(status["processes"].get(who, {}).get("note", ""))

    def close(self) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGTERM)
        for process in self.processes.values():
            process.wait(timeout=PATIENCE_S)
