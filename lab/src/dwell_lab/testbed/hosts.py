"""Network namespaces that emulate hosts: one address each, and one TUN device per neighbour.

The process that holds both descriptors of a pair of TUN devices is the link: it reads packets from
one host's device and writes them to the other's. Nothing is created outside the namespaces, and
they have no other connection.
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

#: Bytes of the largest packet: IPv4 permits 65 535, and a message of 64 kB is one packet.
MTU = 65_520
#: Queue length of a device, in packets; a message of megabytes is some tens of packets.
QUEUE = 10_000
#: TCP's initial window, in packets: a message needs no extra round trip.
FIRST_WINDOW = 256
FIRST_ADDRESS = IPv4Address("10.77.0.0")
NAMESPACES = Path("/run/netns")
# TCP's windows start at the middle value and grow to the last, without slow starts after a pause
# and without metrics saved from earlier connections. Reno is in every kernel and sends a message at
# once; BBR would pace it at the rate measured for earlier messages.
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
    """Return the name of the network namespace of a testbed's node."""
    return f"dwell-{name}-{node}"


def namespace_path(namespace: str) -> Path:
    """Return the file of a network namespace (ip-netns(8))."""
    return NAMESPACES / namespace


class Hosts(Started):
    """Namespaces, addresses and TUN devices of nodes; a context manager.

    `pairs` are nodes with a link between them, each pair in either order.

    Raises `LiveError` if a pair names an unknown node.
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
            # Register the removal first: a failed attempt may leave the file.
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
            raise LiveError(f"unknown host {node!r}; hosts: {', '.join(self._nodes)}")
        return self._nodes.index(node)

    def address(self, node: str) -> str:
        """Return a node's IPv4 address, on the loopback device of its namespace."""
        return str(FIRST_ADDRESS + 1 + self._index(node))

    def namespace(self, node: str) -> str:
        """Return the name of a node's network namespace."""
        self._index(node)
        return namespace_name(self._name, node)

    def device(self, other: str) -> str:
        """Return the name of the devices that lead to a node, the same in all namespaces."""
        return f"to{self._index(other)}"

    def tun(self, one: str, other: str) -> int:
        """Return the descriptor of the device in `one` that leads to `other`.

        Packets have no extra header. The hosts close the descriptor when they stop.

        Raises `LiveError` if the two have no link, or the hosts have not been created.
        """
        if (one, other) not in self._tuns:
            raise LiveError(f"no device leads from {one!r} to {other!r}")
        return self._tuns[one, other]

    def inside(self, node: str, words: Sequence[str]) -> list[str]:
        """Return a command that runs another command in a node's namespace, in the same process.

        The process still sees this machine's files, including the control groups, which
        ``ip netns exec`` would hide.
        """
        return ["nsenter", f"--net={namespace_path(self.namespace(node))}", "--", *words]


def within(namespace: str, act: Callable[[], T]) -> T:
    """Call a function in a thread inside a network namespace, and return its result.

    Sockets and devices that it opens stay in the namespace.

    Raises `LiveError` if the namespace cannot be entered.
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
    """Kill all processes in a network namespace, and remove it; a missing namespace is fine.

    Raises `LiveError` if a process does not end.
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
        if file.exists() or name.startswith("ipv4"):  # a kernel can be built without IPv6
            file.write_text(value)


def _open_tun(device: str) -> int:
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_CLOEXEC)
    try:
        fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", device.encode(), IFF_TUN | IFF_NO_PI))
    except BaseException:
        os.close(tun)
        raise
    return tun
