"""Hosts: their addresses, what leads from one to the other, and that nothing stays."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from dwell.errors import LiveError
from dwell_lab.testbed.hosts import MTU, Hosts, namespace_path, within
from lab.tests.testbed.machine import no_hosts, own_name
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.skipif(bool(no_hosts()), reason=no_hosts())

NODES = ("A", "B", "C")
PAIRS = (("A", "B"), ("C", "B"))
MESSAGE = bytes(400_000)


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    with Hosts(own_name(), NODES, PAIRS) as made:
        yield made


@contextmanager
def copied(
    hosts: Hosts, one: str, other: str, *, passes: Callable[[str], bool] = lambda _: True
) -> Iterator[None]:
    """Copy packets from either host to the other; those of a host that may not are lost."""
    ends = {one: hosts.tun(one, other), other: hosts.tun(other, one)}
    reader, writer = os.pipe()

    def copy() -> None:
        while True:
            ready, _, _ = select.select([*ends.values(), reader], [], [])
            if reader in ready:
                return
            for source, target in ((one, other), (other, one)):
                if ends[source] in ready:
                    packet = os.read(ends[source], 2**16)
                    if passes(source):
                        os.write(ends[target], packet)

    thread = threading.Thread(target=copy)
    thread.start()
    try:
        yield
    finally:
        os.close(writer)
        thread.join()
        os.close(reader)


def socket_in(hosts: Hosts, node: str, kind: socket.SocketKind) -> socket.socket:
    def make() -> socket.socket:
        made = socket.socket(socket.AF_INET, kind)
        made.settimeout(PATIENCE_S)
        made.bind((hosts.address(node), 0))
        return made

    return within(hosts.namespace(node), make)


def receive(there: socket.socket, size: int) -> None:
    while size:
        received = there.recv(size)
        assert received
        size -= len(received)


def test_two_hosts_hear_each_other_over_what_copies_their_packets(hosts: Hosts) -> None:
    with (
        socket_in(hosts, "A", socket.SOCK_DGRAM) as here,
        socket_in(hosts, "B", socket.SOCK_DGRAM) as there,
        copied(hosts, "A", "B"),
    ):
        here.sendto(b"ping", there.getsockname())
        heard, source = there.recvfrom(100)
        assert (heard, source) == (b"ping", here.getsockname())
        there.sendto(b"pong", source)
        assert here.recv(100) == b"pong"


def test_a_message_of_sixty_kilobytes_is_one_packet(hosts: Hosts) -> None:
    with (
        socket_in(hosts, "A", socket.SOCK_DGRAM) as here,
        socket_in(hosts, "B", socket.SOCK_DGRAM) as there,
    ):
        here.sendto(bytes(60_000), there.getsockname())
        assert len(os.read(hosts.tun("A", "B"), 2**16)) == 60_000 + 28 <= MTU


def test_a_message_needs_no_round_trip(hosts: Hosts) -> None:
    """Nothing is heard of the receiver any more, and all of the message arrives.

    But for the first of a connection: its first window has 16 bits, whatever the hosts have.
    """
    deaf = threading.Event()
    with (
        socket_in(hosts, "B", socket.SOCK_STREAM) as server,
        socket_in(hosts, "A", socket.SOCK_STREAM) as here,
        copied(hosts, "A", "B", passes=lambda source: source == "A" or not deaf.is_set()),
    ):
        server.listen()
        here.connect(server.getsockname())
        there, _ = server.accept()
        with there:
            there.settimeout(PATIENCE_S)
            here.sendall(bytes(100_000))
            receive(there, 100_000)
            there.sendall(b"all there")
            receive(here, 9)
            deaf.set()
            here.sendall(MESSAGE)
            receive(there, len(MESSAGE))


def test_hosts_without_a_link_do_not_reach_each_other(hosts: Hosts) -> None:
    with socket_in(hosts, "A", socket.SOCK_DGRAM) as here:
        with pytest.raises(OSError, match="unreachable"):
            here.sendto(b"ping", (hosts.address("C"), 9))
        with pytest.raises(OSError, match="unreachable"):
            here.sendto(b"ping", ("192.0.2.1", 9))
    with pytest.raises(LiveError, match="no device leads from 'A' to 'C'"):
        hosts.tun("A", "C")


def test_a_command_runs_in_a_host_and_is_the_process_that_was_started(hosts: Hosts) -> None:
    words = hosts.inside("B", ["sh", "-c", "echo $$; ip -o -4 address; ls /sys/fs/cgroup"])
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        said, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert said.split()[0] == str(process.pid)
    assert hosts.address("B") in said
    assert hosts.address("A") not in said


def test_nothing_is_left_of_hosts_and_of_what_runs_in_them() -> None:
    before = subprocess.run(["ip", "-o", "link"], capture_output=True, check=True).stdout
    with Hosts(own_name(), NODES, PAIRS) as hosts:
        paths = [namespace_path(hosts.namespace(node)) for node in NODES]
        assert all(path.exists() for path in paths)
        sleeper = subprocess.Popen(hosts.inside("A", ["sleep", "600"]))
    assert sleeper.wait(PATIENCE_S) < 0
    assert not any(path.exists() for path in paths)
    assert subprocess.run(["ip", "-o", "link"], capture_output=True, check=True).stdout == before
    hosts.stop()


def test_a_name_that_is_taken_is_an_error_and_what_is_there_stays(hosts: Hosts) -> None:
    taken = hosts.namespace("A").removeprefix("dwell-").removesuffix("-A")
    with pytest.raises(LiveError, match="exists already"), Hosts(taken, ["Z", "A"], []):
        pass
    assert namespace_path(hosts.namespace("A")).exists()
    assert not namespace_path(f"dwell-{taken}-Z").exists()


def test_a_pair_with_an_unknown_node_is_an_error() -> None:
    with pytest.raises(LiveError, match="unknown host 'X'; hosts: A, B, C"):
        Hosts(own_name(), NODES, [("A", "X")])
