"""A ROS network of processes: a router, and nodes of zenoh-ros2-sdk."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.ports import free_ports

ROOT = Path(__file__).parents[3]


@dataclass
class RosNetwork:
    """Processes that end with the test; `port` is the router's."""

    port: int
    processes: list[subprocess.Popen[str]] = field(default_factory=list)
    readers: list[threading.Thread] = field(default_factory=list)

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

    def listen(self, topic: str, kind: str) -> list[dict[str, Any]]:
        """Start a node that listens; its messages are added to the list."""
        process = self.start("sdk_node", "listen", str(self.port), topic, kind)
        heard: list[dict[str, Any]] = []

        def read() -> None:
            for line in process.stdout or ():
                heard.append(json.loads(line))  # noqa: PERF401 - as they come

        self.readers.append(threading.Thread(target=read, daemon=True))
        self.readers[-1].start()
        return heard


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
        for reader in network.readers:
            reader.join()
        for process in network.processes:
            if process.stdout is not None:
                process.stdout.close()


def kill(process: subprocess.Popen[str]) -> None:
    """Kill a process."""
    process.kill()
    process.wait()
