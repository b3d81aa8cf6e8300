"""Whoever is out of reach keeps nobody waiting: closing a connection takes no time."""

from __future__ import annotations

import os
import socket
import stat
import struct
from pathlib import Path

from dwell.live.transport.no_linger import Connections
from dwell.live.transport.zenoh import ZenohTransport
from tests.live.transport.meshes import ZenohMesh

TEN_SECONDS = struct.pack("ii", 1, 10)


def lingering(number: int) -> bool:
    """Whether closing a connection of this process may have to wait."""
    try:
        if not stat.S_ISSOCK(os.fstat(number).st_mode):
            return False
        copy = os.dup(number)
    except OSError:
        return False
    with socket.socket(fileno=copy) as connection:
        asked = connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(TEN_SECONDS))
    return bool(struct.unpack("ii", asked)[0])


def test_a_connection_that_would_wait_does_not() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far:
            near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, TEN_SECONDS)
            assert lingering(near.fileno())
            Connections().wait_for_nobody()
            assert not lingering(near.fileno())
            near.sendall(b"it is open still")
            assert far.recv(100) == b"it is open still"


def test_a_connection_that_is_asked_to_wait_later_does_not_either() -> None:
    # Zenoh asks it of those that are there; being made, to a peer out of reach, takes long.
    connections = Connections()
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far:
            connections.wait_for_nobody()
            near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, TEN_SECONDS)
            connections.wait_for_nobody()
            assert not lingering(near.fileno())


def test_files_and_other_sockets_are_left_alone(tmp_path: Path) -> None:
    here, there = socket.socketpair()
    with (tmp_path / "a").open("wb") as file, here, there:
        here.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, TEN_SECONDS)
        Connections().wait_for_nobody()
        assert lingering(here.fileno())
        file.write(b"open")


def test_no_connection_to_another_process_waits() -> None:
    mesh = ZenohMesh(["me@R1", "far@E"])
    try:
        end = mesh.open("me@R1")
        assert isinstance(end, ZenohTransport)
        mesh.spawn("far@E")
        mesh.joined(lambda: all(end.peers.values()), lambda: None)
        assert end.peers
        mesh.joined(
            lambda: not [n for n in os.listdir("/dev/fd") if lingering(int(n))], lambda: None
        )
    finally:
        mesh.close()
