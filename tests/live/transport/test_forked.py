"""A child that a stage forks keeps nothing of its parent's sessions, and all of the stage's."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from dwell.live.transport.zenoh import ZenohTransport
from tests.live.transport.meshes import ROOT, ZenohMesh

#: A process with sessions, connected in all of them, whose stage has files and sockets and forks.
PARENT = """
import json, os, socket, sys, time
from dwell.live.transport.zenoh import ZenohTransport
from tests.live.transport.meshes import full_entry

names, who, first_port, stage_port = json.loads(sys.argv[1])
transport = ZenohTransport(full_entry(names, who, first_port))
transport.subscribe("dwell/t/**", lambda _: None)
server = socket.create_server(("127.0.0.1", stage_port))
# To a port of the same number as a peer's, on another address.
client = socket.create_connection(("127.0.0.2", first_port))
here, there = socket.socketpair()
while not all(transport.peers.values()):
    time.sleep(0.01)
kept = {number: os.readlink(f"/dev/fd/{number}") for number in (
    server.fileno(), client.fileno(), here.fileno(), there.fileno())}
child = os.fork()
if not child:
    left = {n: os.path.lexists(f"/dev/fd/{n}") and os.readlink(f"/dev/fd/{n}") for n in kept}
    print(json.dumps([os.getpid(), kept == left]), flush=True)
    time.sleep(60)
    os._exit(0)
time.sleep(60)
"""


@pytest.fixture
def mesh() -> Iterator[ZenohMesh]:
    made = ZenohMesh(["near@E", "forks@E"])
    yield made
    made.close()


def test_a_child_keeps_what_is_the_stages_and_no_port_or_connection(mesh: ZenohMesh) -> None:
    near = mesh.open("near@E")
    assert isinstance(near, ZenohTransport)
    first = mesh.first_port
    spare = first + 3 * len(mesh.names)
    with socket.create_server(("127.0.0.2", first)):
        asked = json.dumps([mesh.names, "forks@E", first, spare])
        command = [sys.executable, "-c", PARENT, asked]
        parent = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE)
        assert parent.stdout is not None
        child, kept = json.loads(parent.stdout.readline())
        try:
            assert kept
            assert shared_memory_of(parent.pid)
            assert not shared_memory_of(child)
            parent.kill()
            parent.wait()
            # Its peers notice at once, and whoever comes after it has its ports.
            mesh.joined(lambda: not any(near.peers.values()), lambda: None)
            again = mesh.open("forks@E")
            assert isinstance(again, ZenohTransport)
            mesh.joined(lambda: all(near.peers.values()), lambda: None)
        finally:
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            parent.kill()
            parent.stdout.close()


def shared_memory_of(pid: int) -> list[str]:
    """Files of Zenoh's shared memory that a process has open."""
    found = []
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            path = os.readlink(descriptor)
            if path.endswith(".zenoh"):
                found.append(path)
    return found
