"""Zenoh's batches written by hand, and a connection of them through a link."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from dwell.demo.link import Forward, LinkProcess
from dwell.demo.link_rate import Sharing

# Longer than a machine under load ever takes: what does not come until then does not come.
PATIENCE_S = 20.0

INIT = bytes([0x01, 0x09, 0x00])
KEEP_ALIVE = bytes([0x04])
DECLARE = bytes.fromhex("9e210820010001749e2108620101032f2a2abe0021081a")


def number(value: int) -> bytes:
    """Seven bits a byte, lowest first."""
    written = bytearray()
    while value > 0x7F:
        written.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*written, value])


def push(payload: bytes, name: bytes = b"key") -> bytes:
    """A put, without a batch or frame around it."""
    return b"\x3d\x00" + number(len(name)) + name + b"\x01" + number(len(payload)) + payload


def frame(messages: Sequence[bytes], sn: int = 1, priority: int | None = None) -> bytes:
    """A reliable frame."""
    if priority is None:
        return b"\x25" + number(sn) + b"".join(messages)
    return b"\xa5" + number(sn) + bytes([0x31, priority]) + b"".join(messages)


def fragments(message: bytes, size: int, sn: int = 1, priority: int | None = None) -> list[bytes]:
    """A message in reliable fragments, one a batch."""
    pieces = [message[at : at + size] for at in range(0, len(message), size)]
    batches = []
    for index, piece in enumerate(pieces):
        extensions = [] if priority is None else [bytes([0x31, priority])]
        extensions += [b"\x02"] if index == 0 else []
        header = 0x26 | (0x80 if extensions else 0) | (0x40 if index < len(pieces) - 1 else 0)
        for at in range(len(extensions) - 1):
            extensions[at] = bytes([extensions[at][0] | 0x80]) + extensions[at][1:]
        batches.append(bytes([header]) + number(sn + index) + b"".join(extensions) + piece)
    return batches


def framed(batches: Sequence[bytes]) -> bytes:
    """Batches with their lengths, as they are sent."""
    return b"".join(len(batch).to_bytes(2, "little") + batch for batch in batches)


class End:
    """One end of a connection."""

    def __init__(self, sock: socket.socket) -> None:
        sock.settimeout(PATIENCE_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = sock
        self._buffer = b""

    def send(self, *batches: bytes) -> None:
        """Send batches."""
        self.socket.sendall(framed(batches))

    def receive(self, count: int) -> list[bytes]:
        """Wait for so many batches."""
        return [self._batch() for _ in range(count)]

    def until(self, last: bytes) -> list[bytes]:
        """Wait for a certain batch and return what came before it."""
        batches: list[bytes] = []
        while (batch := self._batch()) != last:
            batches.append(batch)
        return batches

    def _batch(self) -> bytes:
        length = int.from_bytes(self._exactly(2), "little")
        return self._exactly(length)

    def _exactly(self, size: int) -> bytes:
        while len(self._buffer) < size:
            received = self.socket.recv(1 << 20)
            if not received:
                raise EOFError
            self._buffer += received
        taken, self._buffer = self._buffer[:size], self._buffer[size:]
        return taken

    @property
    def silent(self) -> bool:
        """Whether there is nothing to read; looks again for a moment."""
        return not select.select([self.socket], [], [], 0.1)[0]


class Wire:
    """A link from A, which dials, to B, which listens here."""

    def __init__(self, seed: int = 5, *, sharing: Sharing = "fifo") -> None:
        self._stack = ExitStack()
        self._sockets: list[socket.socket] = []
        self._server = self._stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        self._server.settimeout(PATIENCE_S)
        forward = Forward("A", "127.0.0.1", self._server.getsockname()[1])
        self.link = LinkProcess(("A", "B"), [forward], seed=seed, sharing=sharing)

    def __enter__(self) -> Self:
        self._stack.enter_context(self.link)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.hang_up()
        self._stack.close()

    def hang_up(self) -> None:
        """Close all connections."""
        while self._sockets:
            self._sockets.pop().close()

    def dial(self) -> End:
        """Connect to the link only."""
        address = ("127.0.0.1", self.link.ports[0])
        sock = socket.create_connection(address, timeout=PATIENCE_S)
        self._sockets.append(sock)
        return End(sock)

    def accept(self) -> End:
        """Take the connection that the link has made."""
        sock, _ = self._server.accept()
        self._sockets.append(sock)
        return End(sock)

    def connect(self, *, session: bool = True) -> tuple[End, End]:
        """Return both ends of a new connection, after the first message of a session."""
        dialled = self.dial()
        accepted = self.accept()
        if session:
            for one, other in ((dialled, accepted), (accepted, dialled)):
                one.send(INIT)
                assert other.receive(1) == [INIT]
        return dialled, accepted


def wait_until(holds: Callable[[], bool]) -> None:
    """Look until something holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline, "it has not come true"
        time.sleep(0.002)
