"""A ROS network of processes: a router, and nodes of zenoh-ros2-sdk."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from tests.ports import free_ports

ROOT = Path(__file__).parents[3]
#: Longest time for anything to happen on a busy machine.
PATIENCE_S = 60.0


def until(condition: Callable[[], object], what: str) -> None:
    """Wait until a condition holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, f"not within {PATIENCE_S:g} s: {what}"
        time.sleep(0.01)


@dataclass
class RosNetwork:
    """Processes that end with the test; `port` is the router's."""

    port: int
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    @property
    def router(self) -> str:
        """Endpoint of the router."""
        return f"tcp/127.0.0.1:{self.port}"

    def start(self, module: str, *words: str) -> subprocess.Popen[str]:
        """Start a module and wait until it prints that it is open."""
        command = [sys.executable, "-m", f"tests.live.ros2.{module}", *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        self.processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "open"
        return process

    def start_router(self) -> subprocess.Popen[str]:
        """Start the router."""
        return self.start("ros_router", str(self.port))

    def talk(self, topic: str, kind: str, rate_hz: float = 50.0) -> subprocess.Popen[str]:
        """Start a node that publishes."""
        return self.start("sdk_node", "talk", str(self.port), topic, kind, str(rate_hz))

    def listen(self, topic: str, kind: str) -> subprocess.Popen[str]:
        """Start a node that prints each message as JSON."""
        return self.start("sdk_node", "listen", str(self.port), topic, kind)


@contextmanager
def ros_network() -> Iterator[RosNetwork]:
    """Open a network without processes; end its processes."""
    network = RosNetwork(free_ports(1))
    try:
        yield network
    finally:
        for process in network.processes:
            with suppress(OSError):
                process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def kill(process: subprocess.Popen[str]) -> None:
    """Kill a process."""
    process.kill()
    process.wait()
