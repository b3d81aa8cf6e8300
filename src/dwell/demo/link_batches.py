"""Which bytes of a Zenoh TCP connection are messages of data, as far as losing one needs it.

A connection is a sequence of batches, each behind its length (two bytes, little-endian). A batch
holds transport messages: frames of whole network messages, one fragment of a larger one, or what
keeps the session going. Of the network messages only a push (a put or a delete) may be lost;
declarations, queries and everything of the session may not. Sequence numbers may have gaps: a
receiver takes any later one for the next, so nothing of what follows has to be rewritten.

Source: Zenoh's protocol 0x09, github.com/eclipse-zenoh/zenoh, commons/zenoh-protocol (transport,
network, zenoh) and commons/zenoh-codec. Without TLS, compression and low latency, which change
the framing; such a connection is not recognised, or has no message that may be lost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

__all__ = ["LENGTH_BYTES", "MAX_BATCH_BYTES", "Chain", "Sifted", "Sifter", "is_session"]

LENGTH_BYTES = 2
MAX_BATCH_BYTES = 65_535
VERSION = 0x09

# Headers: five bits of identity, three flags.
IDENTITY = 0x1F
EXTENDED = 0x80
# Transport messages
INIT, KEEP_ALIVE, FRAME, FRAGMENT = 0x01, 0x04, 0x05, 0x06
RELIABLE, MORE = 0x20, 0x40
# Network messages have identities of their own, from here on.
FIRST_NETWORK = 0x18
PUSH, NAMED = 0x1D, 0x20
PUSHES = frozenset(bytes([flags | PUSH]) for flags in range(0, 0x100, 0x20))
# What a push carries
PUT, DELETE = 0x01, 0x02
STAMPED, ENCODED = 0x20, 0x40
# Extensions: four bits of identity, two of kind.
QOS, FIRST, DROPPED, SHARED_MEMORY = 0x1, 0x2, 0x3, 0x2
NUMBER, BUFFER = 1, 2


class _UnknownError(Exception):
    """Something that this module does not know; nothing behind it in the batch is touched."""


def is_session(beginning: bytes | bytearray) -> bool | None:
    """Whether a connection that begins so is one of Zenoh's; None if that is too little to say."""
    if len(beginning) < LENGTH_BYTES + 2:
        return None
    return beginning[2] & IDENTITY == INIT and beginning[3] == VERSION


@dataclass(slots=True)
class Chain:
    """A message in fragments, while they pass.

    Parameters
    ----------
    data : bool
        Whether it is one that may be lost.
    lost : bool
        Whether this one is.
    since_ns, delay_ns : int or None
        For the link: when its first fragment came, and the delay of all of them.
    """

    data: bool
    lost: bool = False
    since_ns: int | None = None
    delay_ns: int | None = None


@dataclass(slots=True)
class Sifted:
    """What became of a batch.

    Parameters
    ----------
    batch : bytes
        What is left of it to send on; empty if that is nothing.
    data : int
        Messages that end in it, the lost ones not counted.
    lost : int
        Messages lost that would end in it.
    chain : Chain, optional
        The message that it holds a fragment of.
    """

    batch: bytes
    data: int = 0
    lost: int = 0
    chain: Chain | None = None


@dataclass(slots=True)
class _Frame:
    begin: int
    head: int
    pushes: list[tuple[int, int]] = field(default_factory=list)
    end: int = 0


class Sifter:
    """Takes lost messages out of the batches of one direction of a connection."""

    def __init__(self) -> None:
        # Messages of different priority or reliability pass in fragments at the same time.
        self._chains: dict[tuple[int, int], Chain] = {}

    def sift(self, batch: bytes, lose: Callable[[], bool]) -> Sifted:
        """Decide for every message of data that begins in a batch whether it is lost.

        Parameters
        ----------
        batch : bytes
            Without its length.
        lose : callable
            Called once for each such message.
        """
        frames: list[_Frame] = []
        position = 0
        try:
            while position < len(batch):
                header = batch[position]
                identity = header & IDENTITY
                if identity == FRAGMENT and position == 0:
                    return self._fragment(batch, header, lose)
                if identity == KEEP_ALIVE:
                    position, _ = _extensions(batch, position + 1, header)
                elif identity == FRAME:
                    frame = _Frame(position, _number(batch, position + 1)[0])
                    frame.head, _ = _extensions(batch, frame.head, header)
                    frames.append(frame)
                    position = _pushes(batch, frame)
                else:
                    break
        except (_UnknownError, IndexError):
            pass
        return _without_lost(batch, frames, lose)

    def _fragment(self, batch: bytes, header: int, lose: Callable[[], bool]) -> Sifted:
        position, _ = _number(batch, 1)
        position, marks = _extensions(batch, position, header)
        conduit = (header & RELIABLE, marks.get(QOS, 5))
        chain = self._chains.get(conduit)
        if chain is None or FIRST in marks:
            # A fragment that no first one came before has an unknown header: it is left alone.
            data = FIRST in marks and batch[position : position + 1] in PUSHES
            chain = self._chains[conduit] = Chain(data, data and lose())
        rest = b"" if chain.lost else batch
        if DROPPED in marks:  # its sender has given it up
            del self._chains[conduit]
            return Sifted(rest, chain=chain)
        if header & MORE:
            return Sifted(rest, chain=chain)
        del self._chains[conduit]
        return Sifted(rest, chain.data and not chain.lost, chain.lost, chain)


def _pushes(batch: bytes, frame: _Frame) -> int:
    """Find the pushes at the beginning of a frame; return where the frame ends.

    Raises
    ------
    _UnknownError
        If something else is in the frame; the pushes before it have been found.
    """
    position = frame.head
    frame.end = len(batch)
    while position < len(batch):
        identity = batch[position] & IDENTITY
        if identity == PUSH:
            end = _push_end(batch, position)
            frame.pushes.append((position, end))
            position = end
        elif identity >= FIRST_NETWORK:
            raise _UnknownError
        else:
            break
    frame.end = position
    return position


def _push_end(batch: bytes, begin: int) -> int:
    header = batch[begin]
    position, _ = _number(batch, begin + 1)
    if header & NAMED:
        position = _skip_buffer(batch, position)
    position, _ = _extensions(batch, position, header)
    body = batch[position]
    position += 1
    if body & IDENTITY not in {PUT, DELETE}:
        raise _UnknownError
    if body & STAMPED:
        position, _ = _number(batch, position)
        position = _skip_buffer(batch, position)
    if body & IDENTITY == DELETE:
        position, _ = _extensions(batch, position, body)
    else:
        if body & ENCODED:
            position, encoding = _number(batch, position)
            if encoding & 1:
                position = _skip_buffer(batch, position)
        position, marks = _extensions(batch, position, body)
        if SHARED_MEMORY in marks:
            raise _UnknownError
        position = _skip_buffer(batch, position)
    if position > len(batch):
        raise _UnknownError
    return position


def _without_lost(batch: bytes, frames: list[_Frame], lose: Callable[[], bool]) -> Sifted:
    data, lost = 0, 0
    pieces: list[bytes] = []
    copied = 0
    for frame in frames:
        gone = [push for push in frame.pushes if lose()]
        data += len(frame.pushes) - len(gone)
        lost += len(gone)
        if gone and len(gone) == len(frame.pushes) and gone[-1][1] == frame.end:
            # A frame of nothing is not sent; its number is missing then.
            gone = [(frame.begin, frame.end)]
        for begin, end in gone:
            pieces.append(batch[copied:begin])
            copied = end
    if lost == 0:
        return Sifted(batch, data)
    pieces.append(batch[copied:])
    return Sifted(b"".join(pieces), data, lost)


def _number(batch: bytes, position: int) -> tuple[int, int]:
    """Return where a number of variable length ends, and the number: 7 bits a byte, lowest first.

    The ninth byte has eight.
    """
    value = shift = 0
    byte = batch[position]
    while byte & 0x80 and shift < 56:
        value |= (byte & 0x7F) << shift
        shift += 7
        position += 1
        byte = batch[position]
    return position + 1, value | byte << shift


def _skip_buffer(batch: bytes, position: int) -> int:
    position, length = _number(batch, position)
    return position + length


def _extensions(batch: bytes, position: int, header: int) -> tuple[int, dict[int, int]]:
    """Return where the extensions end, and the value (0 if it is no number) of each by identity."""
    marks: dict[int, int] = {}
    while header & EXTENDED:
        header = batch[position]
        position += 1
        value = 0
        kind = header >> 5 & 3
        if kind == NUMBER:
            position, value = _number(batch, position)
        elif kind == BUFFER:
            position = _skip_buffer(batch, position)
        elif kind:
            raise _UnknownError
        marks[header & 0x0F] = value
    return position, marks
