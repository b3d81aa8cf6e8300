"""Network namespaces that stand for hosts: an address each, a TUN device to each neighbour.

Whoever holds the two descriptors of a pair of TUN devices is the link between the two: what one
host sends is read from its device, and written to the other's. Nothing is made outside of the
namespaces, and there is no other way out of them.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import struct
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from ipaddress import IPv4Address
from pathlib import Path
from typing import TypeVar

from dwell.errors import LiveError
from dwell.live.local.child import Started, run_command
from dwell_lab.testbed.groups import kill_all

#: Bytes of the largest packet: IPv4 takes 65 535, and a message of 64 kB is one packet.
MTU = 65_520
#: Packets that wait in a device for whoever reads it; a message of megabytes is some tens.
QUEUE = 10_000
#: Packets that TCP sends without having heard of the first: a message takes no round trip.
FIRST_WINDOW = 256
FIRST_ADDRESS = IPv4Address("10.77.0.0")
NAMESPACES = Path("/run/netns")
# TCP's windows start at the middle value and grow to the last; without new slow starts after a
# pause, and without memory of connections that were. Reno is in every kernel, and sends a message
# at once: BBR would spread it over the time that it takes at the rate of the messages before.
SETTINGS = {
    "ipv4/tcp_congestion_control": "reno",
    "ipv4/tcp_rmem": "4096 16777216 33554432",
    "ipv4/tcp_wmem": "4096 16777216 33554432",
    "ipv4/tcp_slow_start_after_idle": "0",
    "ipv4/tcp_no_metrics_save": "1",
    "ipv6/conf/all/disable_ipv6": "1",
    "ipv6/conf/default/disable_ipv6": "1",
}
CLONE_NEWNET = 0x40000000  # linux/sched.h
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # linux/if_tun.h

T = TypeVar("T")


def namespace_name(name: str, node: str) -> str:
    """Return the network namespace of a testbed's node."""
    return f"dwell-{name}-{node}"


def namespace_path(namespace: str) -> Path:
    """Return the file that stands for a network namespace (ip-netns(8))."""
    return NAMESPACES / namespace


class Hosts(Started):
    """Namespaces, addresses and TUN devices of nodes; a context manager.

    Parameters
    ----------
    name : str
        Name of the testbed.
    nodes : sequence of str
    pairs : iterable of (str, str)
        Nodes with a link between them, each pair in either order.

    Raises
    ------
    LiveError
        If a pair names a node that there is not.
    """

    def __init__(self, name: str, nodes: Sequence[str], pairs: Iterable[tuple[str, str]]) -> None:
        super().__init__()
        self._name = name
        self._nodes = tuple(nodes)
        self._neighbours: dict[str, list[str]] = {node: [] for node in nodes}
        for one, other in pairs:
            self._index(one)
            self._index(other)
            for node, neighbour in ((one, other), (other, one)):
                if neighbour not in self._neighbours[node]:
                    self._neighbours[node].append(neighbour)
        self._tuns: dict[tuple[str, str], int] = {}

    def _start(self) -> None:
        for node in self._nodes:
            if namespace_path(self.namespace(node)).exists():
                raise LiveError(
                    f"the network namespace {self.namespace(node)} exists already; use another "
                    f"name, or remove it: ip netns delete {self.namespace(node)}"
                )
        for node in self._nodes:
            # Before it is made: a failed attempt may leave its file.
            self._stack.callback(remove_namespace, self.namespace(node))
            _ip("netns", "add", self.namespace(node))
            self._furnish(node)

    def _furnish(self, node: str) -> None:
        namespace = self.namespace(node)
        within(namespace, _set)
        words = ["link set lo up", f"address add {self.address(node)}/32 dev lo"]
        for other in self._neighbours[node]:
            device = self.device(other)
            self._tuns[node, other] = tun = within(namespace, partial(_open_tun, device))
            self._stack.callback(os.close, tun)
            words += [
                f"link set {device} mtu {MTU} txqueuelen {QUEUE} up",
                f"route add {self.address(other)}/32 dev {device} src {self.address(node)} "
                f"initcwnd {FIRST_WINDOW} initrwnd {FIRST_WINDOW}",
            ]
        _ip("-n", namespace, "-batch", "-", given="\n".join(words) + "\n")

    def _index(self, node: str) -> int:
        if node not in self._nodes:
            raise LiveError(f"there is no host {node!r}; there are {', '.join(self._nodes)}")
        return self._nodes.index(node)

    def address(self, node: str) -> str:
        """Return a node's IPv4 address, on the loopback device of its namespace."""
        return str(FIRST_ADDRESS + 1 + self._index(node))

    def namespace(self, node: str) -> str:
        """Return the name of a node's network namespace."""
        self._index(node)
        return namespace_name(self._name, node)

    def device(self, other: str) -> str:
        """Return the name, in any of the namespaces, of the device that leads to a node."""
        return f"to{self._index(other)}"

    def tun(self, one: str, other: str) -> int:
        """Return the descriptor of the device in `one` that leads to `other`.

        Packets without a header in front; closed with the hosts.

        Raises
        ------
        LiveError
            If there is no link between the two, or the hosts have not been made.
        """
        if (one, other) not in self._tuns:
            raise LiveError(f"there is no device from {one!r} to {other!r}")
        return self._tuns[one, other]

    def inside(self, node: str, words: Sequence[str]) -> list[str]:
        """Return a command that runs another in a node's namespace, in the same process.

        It has this machine's files still, those of its groups of processes among them, which
        ``ip netns exec`` would hide.
        """
        return ["nsenter", f"--net={namespace_path(self.namespace(node))}", "--", *words]


def within(namespace: str, act: Callable[[], T]) -> T:
    """Call a function in a thread that is in a network namespace, and return its result.

    Sockets and devices that it opens stay there.

    Raises
    ------
    LiveError
        If the namespace cannot be entered.
    """

    def enter() -> T:
        with namespace_path(namespace).open() as file:
            libc = ctypes.CDLL(None, use_errno=True)
            if libc.setns(file.fileno(), CLONE_NEWNET):
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number), file.name)
        return act()

    with ThreadPoolExecutor(1) as thread:
        try:
            return thread.submit(enter).result()
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            raise LiveError(f"network namespace {namespace}: {where}{error.strerror}") from None


def remove_namespace(namespace: str) -> None:
    """End all processes in a network namespace, and remove it; nothing if there is none.

    Raises
    ------
    LiveError
        If something does not end.
    """
    if not namespace_path(namespace).exists():
        return
    kill_all(
        lambda: [int(pid) for pid in _ip("netns", "pids", namespace).split()], f"in {namespace}"
    )
    _ip("netns", "delete", namespace)


def _ip(*words: str, given: str = "") -> str:
    if shutil.which("ip") is None:
        raise LiveError("network namespaces need the command ip: apt-get install iproute2")
    return run_command("ip", *words, given=given)


def _set() -> None:
    for name, value in SETTINGS.items():
        file = Path("/proc/sys/net", name)
        if file.exists() or name.startswith("ipv4"):  # IPv6 may be left out of a kernel
            file.write_text(value)


def _open_tun(device: str) -> int:
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", device.encode(), IFF_TUN | IFF_NO_PI))
    except BaseException:
        os.close(tun)
        raise
    return tun
