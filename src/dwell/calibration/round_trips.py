"""Link: round trips to a peer over one TCP connection.

A message is a header of sixteen bytes (`HEADER`: magic, number, length of the payload) and its
payload; the answer is the header alone, with the message's number and length 0. Nagle's algorithm
is off on both sides, and the connection is made before anything is timed. Each round sends a
message without payload and then one with it.

From these two round trips, r0 and r1::

    delay_ms  = r0 / 2                                  one sample a round
    rate_mbps = 8 bytes / (1e3 median(r1 - r0))

Half of a round trip is the way there only if both ways take equally long: that is an assumption.
Nothing is subtracted, so that the delay includes what both ends need to pass a message on, and the
rate is what a TCP connection has got at this pace, not what the medium could carry.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from array import array
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import NoReturn

import numpy as np

from dwell.calibration.machine_conditions import MachineCounters
from dwell.calibration.measure import Pace, Settings
from dwell.calibration.profile_file import Measurement, link_name, stamp
from dwell.errors import MeasurementError, ProfileError
from dwell.model.bounds import RATE_MBPS, Bound

HEADER = struct.Struct("!4sIQ")
MAGIC = b"DWL1"
MAX_BYTES = 64_000_000
CHUNK_BYTES = 2**16
WARMUP = 10

PAYLOAD_BYTES = Bound(1, MAX_BYTES, whole=True)
PERIOD_MS = Bound(1e-3, 10_000)
PORT = Bound(0, 65535, whole=True)

CONNECT_S = 5.0
ANSWER_S = 30.0
# Longer than the longest period.
IDLE_S = 60.0


# ------------------------------------------------------------------------------- the listener


def listen(
    host: str,
    port: int,
    *,
    announce: Callable[[str, int], None],
    log: Callable[[str], None],
    once: bool = False,
    idle_s: float = IDLE_S,
) -> None:
    """Answer the messages of peers, one connection at a time, until interrupted.

    One at a time because two measurements would disturb each other; the next peer waits. A
    connection that sends something else, announces more than `MAX_BYTES` or says nothing for
    `idle_s` is closed. Whatever is sent, no more than `CHUNK_BYTES` of it are kept.

    Parameters
    ----------
    host : str
        Address to listen on; only this machine reaches 127.0.0.1.
    port : int
        0 takes a free one.
    announce : callable
        Called with address and port once peers may connect.
    log : callable
        Takes a line about every connection that has ended.
    once : bool
        Return after the first connection.

    Raises
    ------
    MeasurementError
        If it cannot listen there.
    """
    PORT.check("port", port)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        server = socket.create_server((host, port), family=family, backlog=8)
    except OSError as error:
        raise MeasurementError(f"{host}:{port}: cannot listen there ({_reason(error)})") from None
    with closing(server):
        announce(host, server.getsockname()[1])
        while True:
            connection, peer = server.accept()
            with closing(connection):
                answered, reason = _answer(connection, idle_s)
            log(f"{peer[0]}:{peer[1]}: {answered} messages answered; {reason}")
            if once:
                return


def _answer(connection: socket.socket, idle_s: float) -> tuple[int, str]:
    """Answer every message of a connection; return how many, and why it ended."""
    answered = 0
    buffer = memoryview(bytearray(CHUNK_BYTES))
    try:
        connection.settimeout(idle_s)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while True:
            first = connection.recv_into(buffer[: HEADER.size])
            if first == 0:
                return answered, "it has ended"
            _receive(connection, buffer[first : HEADER.size])
            magic, number, length = HEADER.unpack(buffer[: HEADER.size])
            if magic != MAGIC:
                return answered, "refused: this is no message of `dwell profile link`"
            if length > MAX_BYTES:
                return answered, f"refused: {length} bytes announced, over {MAX_BYTES}"
            while length > 0:
                count = connection.recv_into(buffer[: min(length, CHUNK_BYTES)])
                if count == 0:
                    raise EOFError
                length -= count
            connection.sendall(HEADER.pack(MAGIC, number, 0))
            answered += 1
    except TimeoutError:
        return answered, f"refused: nothing came for {idle_s:g} s"
    except EOFError:
        return answered, "it ended within a message"
    except OSError as error:
        return answered, f"it broke off ({_reason(error)})"


def _reason(error: OSError) -> str:
    # Python adds to strerror what it was about to do; those of name resolution have no errno.
    if error.errno is None or error.errno < 0:
        return str(error.strerror or error)
    return os.strerror(error.errno)


def _receive(connection: socket.socket, buffer: memoryview) -> None:
    """Fill a buffer.

    Raises
    ------
    EOFError
        If the connection ends before.
    """
    while len(buffer) > 0:
        count = connection.recv_into(buffer)
        if count == 0:
            raise EOFError
        buffer = buffer[count:]


# -------------------------------------------------------------------------------- the measurer


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Round trips of the two messages of each round.

    Parameters
    ----------
    minimal_ns, payload_ns : array of int
        One value a round: without payload, and with it.
    late : int
        Rounds that began after their release.
    """

    minimal_ns: array[int]
    payload_ns: array[int]
    late: int


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``; an IPv6 address stands in brackets.

    Raises
    ------
    ProfileError
        If it is something else.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if host.startswith("[") else host
    bracketed = text.startswith("[") or ":" not in host
    if not host or not bracketed or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise ProfileError(
            f"{text!r} is not of the form HOST:PORT, port 1 to 65535 ([HOST]:PORT for IPv6)"
        )
    return host, int(port)


def time_round_trips(
    host: str,
    port: int,
    *,
    payload_bytes: int,
    settings: Settings,
    connect_s: float = CONNECT_S,
    answer_s: float = ANSWER_S,
) -> RoundTrips:
    """Send messages to a `listen` and time their answers.

    Parameters
    ----------
    payload_bytes : int
        Of the larger message; random bytes, so that nothing on the way compresses them.
    settings : Settings
        Rounds, rounds of warm-up, and the time between two.
    connect_s, answer_s : float
        How long to wait for the connection and the first answer, and for any other.

    Raises
    ------
    ProblemError
        If a number is out of its range.
    MeasurementError
        If there is no such peer, it is something else, does not answer in time, or goes away.
    """
    PAYLOAD_BYTES.check("bytes", payload_bytes)
    if settings.period_ms is not None:
        PERIOD_MS.check("period_ms", settings.period_ms)
    try:
        connection = socket.create_connection((host, port), timeout=connect_s)
    except TimeoutError:
        raise MeasurementError(f"{host}:{port}: no connection within {connect_s:g} s") from None
    except OSError as error:
        raise MeasurementError(
            f"{host}:{port}: no connection ({_reason(error)}); run "
            f"`dwell profile listen --host ADDRESS --port {port}` there first"
        ) from None
    with closing(connection):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer = _Peer(connection, f"{host}:{port}", payload_bytes)
        peer.greet(connect_s)
        connection.settimeout(answer_s)
        pace = Pace(settings.period_ms)
        peer.rounds(settings.warmup, pace, "round {} of the warm-up")
        pace.late = 0
        minimal_ns, payload_ns = peer.rounds(settings.runs, pace, "round {}")
    return RoundTrips(minimal_ns, payload_ns, pace.late)


class _Peer:
    """The other end of a connection."""

    def __init__(self, connection: socket.socket, name: str, payload_bytes: int) -> None:
        self._connection = connection
        self._name = name
        self._number = 0
        self._minimal = bytearray(HEADER.size)
        self._large = bytearray(HEADER.size) + os.urandom(payload_bytes)
        self._answer = memoryview(bytearray(HEADER.size))

    def greet(self, timeout_s: float) -> None:
        """Send a first message, to see whether the peer speaks the same."""
        self._connection.settimeout(timeout_s)
        try:
            self._round_trip(self._minimal)
        except TimeoutError:
            raise MeasurementError(
                f"{self._name}: took the connection but has not answered within {timeout_s:g} s; "
                "it is no `dwell profile listen`, or busy with another peer"
            ) from None
        except (EOFError, OSError) as error:
            self._lost("the first message", error)

    def rounds(self, count: int, pace: Pace, what: str) -> tuple[array[int], array[int]]:
        """Return the round trips of both messages in `count` rounds, nanoseconds."""
        minimal_ns, payload_ns = array("q", bytes(8 * count)), array("q", bytes(8 * count))
        done = 0
        try:
            for done in range(count):
                pace.wait()
                minimal_ns[done] = self._round_trip(self._minimal)
                payload_ns[done] = self._round_trip(self._large)
        except TimeoutError:
            limit = self._connection.gettimeout()
            raise MeasurementError(
                f"{self._name}: no answer within {limit:g} s in {what.format(done)}"
            ) from None
        except (EOFError, OSError) as error:
            self._lost(what.format(done), error)
        return minimal_ns, payload_ns

    def _round_trip(self, message: bytearray) -> int:
        self._number = (self._number + 1) % 2**32
        HEADER.pack_into(message, 0, MAGIC, self._number, len(message) - HEADER.size)
        start = time.perf_counter_ns()
        self._connection.sendall(message)
        _receive(self._connection, self._answer)
        end = time.perf_counter_ns()
        if HEADER.unpack(self._answer) != (MAGIC, self._number, 0):
            raise MeasurementError(
                f"{self._name}: answered, but it is no `dwell profile listen` of this version"
            )
        return end - start

    def _lost(self, when: str, error: Exception) -> NoReturn:
        why = _reason(error) if isinstance(error, OSError) else "it closed it"
        raise MeasurementError(f"{self._name}: connection lost in {when} ({why})") from None


def measure_link(
    source: str,
    target: str,
    host: str,
    port: int,
    *,
    payload_bytes: int,
    settings: Settings,
    connect_s: float = CONNECT_S,
    answer_s: float = ANSWER_S,
) -> Measurement:
    """Measure the link from this node to another one, where a `listen` runs.

    Parameters
    ----------
    source, target : str
        Names of this node and the other in the cell.
    host, port, payload_bytes, settings, connect_s, answer_s
        See `time_round_trips`.

    Returns
    -------
    Measurement
        Column ``source->target``: half of the round trip without payload, ms. Columns
        ``…/round_trip_ms`` and ``…/payload_round_trip_ms``: the round trips as measured.

    Raises
    ------
    ProfileError, ProblemError
        If a name or number is not allowed.
    MeasurementError
        See `time_round_trips`.
    """
    name = link_name(source, target)
    watch = MachineCounters(os.sched_getaffinity(0))
    trips = time_round_trips(
        host,
        port,
        payload_bytes=payload_bytes,
        settings=settings,
        connect_s=connect_s,
        answer_s=answer_s,
    )
    minimal_ms = np.array(trips.minimal_ns, np.float64) / 1e6
    payload_ms = np.array(trips.payload_ns, np.float64) / 1e6
    columns = {
        name: minimal_ms / 2,
        f"{name}/round_trip_ms": minimal_ms,
        f"{name}/payload_round_trip_ms": payload_ms,
    }
    about = {
        **stamp(),
        "kind": "link",
        "from": source,
        "to": target,
        "peer": f"{host}:{port}",
        "bytes": payload_bytes,
        "warmup": settings.warmup,
        "period_ms": settings.period_ms,
        "late": trips.late,
        "rate_mbps": rate_mbps(payload_bytes, float(np.median(payload_ms - minimal_ms))),
        "conditions": asdict(watch.conditions()),
    }
    return Measurement(name, columns, about)


def rate_mbps(payload_bytes: int, longer_ms: float) -> float | None:
    """Rate at which a payload makes a round trip so much longer, Mbit/s.

    Returns
    -------
    float or None
        None where the payload makes it no longer, or there is no such rate in a cell.
    """
    if longer_ms <= 0:
        return None
    rate = 8 * payload_bytes / (1e3 * longer_ms)
    return rate if RATE_MBPS.holds(rate) else None
