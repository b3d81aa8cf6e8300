"""Round trips to a peer over one TCP connection.

A message is a header of sixteen bytes (`HEADER`: magic, number, length of the payload) and its
payload; the answer is the header alone, with the message's number and length 0. Nagle's algorithm
is off on both sides, and the connection is made before anything is timed. Each round sends a
message without payload and then one with it.

From these two round trips, r0 and r1::

    delay_ms  = r0 / 2                                  one sample per round
    rate_mbps = 8 bytes / (1e3 median(r1 - r0))

This assumes equal delays in both directions. The delay includes the processing of a message at both
ends. The rate is the rate of a TCP connection at this pace, not the capacity of the medium.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.calibration.machine_conditions import MachineCounters
from dwell.calibration.measure import Pace, Settings
from dwell.calibration.profile_file import Measurement, link_name, stamp
from dwell.errors import MeasurementError, ProfileError
from dwell.model.bounds import RATE_MBPS, Bound

HEADER = struct.Struct("!4sIQ")
MAGIC = b"DWL1"
MAX_BYTES = 64_000_000
CHUNK_BYTES = 2**16
#: Name of the first exchange, before the rounds, in error messages.
FIRST = "the first message"

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

    Two measurements at once would disturb each other, so the next peer waits. The listener closes a
    connection that sends another protocol, announces more than `MAX_BYTES`, or is silent for
    `idle_s`. It keeps at most `CHUNK_BYTES` of a payload in memory.

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
    try:
        connection.settimeout(idle_s)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection.makefile("rb") as messages:
            while header := messages.read(HEADER.size):
                magic, number, length = _unpacked(header)
                if magic != MAGIC:
                    return answered, "refused: this is no message of `dwell profile link`"
                if length > MAX_BYTES:
                    return answered, f"refused: {length} bytes announced, over {MAX_BYTES}"
                while length > 0:
                    chunk = messages.read(min(length, CHUNK_BYTES))
                    if not chunk:
                        raise EOFError
                    length -= len(chunk)
                connection.sendall(HEADER.pack(MAGIC, number, 0))
                answered += 1
        return answered, "it has ended"
    except TimeoutError:
        return answered, f"refused: nothing came for {idle_s:g} s"
    except EOFError:
        return answered, "it ended within a message"
    except OSError as error:
        return answered, f"it broke off ({_reason(error)})"


def _reason(error: OSError) -> str:
    # Python adds its operation to strerror; errors of name resolution have no system errno.
    if error.errno is None or error.errno < 0:
        return str(error.strerror or error)
    return os.strerror(error.errno)


def _unpacked(header: bytes) -> tuple[bytes, int, int]:
    """Return magic, number and length of a message.

    Raises
    ------
    EOFError
        If the connection has ended before.
    """
    if len(header) < HEADER.size:
        raise EOFError
    magic, number, length = HEADER.unpack(header)
    return magic, number, length


# -------------------------------------------------------------------------------- the measurer


class RoundTrips(NamedTuple):
    """Round trips of the two messages of each round.

    Parameters
    ----------
    minimal_ns, payload_ns : int64 array, shape (rounds,)
        Without payload, and with it.
    late : int
        Rounds that began after their release.
    """

    minimal_ns: NDArray[np.int64]
    payload_ns: NDArray[np.int64]
    late: int


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``, or of ``[HOST]:PORT`` for IPv6.

    Raises
    ------
    ProfileError
        If the text has another form.
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
        Payload of the larger message; its bytes are random, against compression on the way.
    settings : Settings
        Rounds, rounds of warm-up, and the time between two.
    connect_s, answer_s : float
        How long to wait for the connection and the first answer, and for any other.

    Raises
    ------
    ProblemError
        If a number is out of its range.
    MeasurementError
        If the peer is missing, is not a `listen`, answers too late, or closes the connection.
    """
    PAYLOAD_BYTES.check("bytes", payload_bytes)
    if settings.period_ms is not None:
        PERIOD_MS.check("period_ms", settings.period_ms)
    peer = f"{host}:{port}"
    connection = _connect(host, port, connect_s)
    minimal, large = bytearray(HEADER.size), bytearray(HEADER.size) + os.urandom(payload_bytes)
    numbers = count(1)
    when = FIRST
    with closing(connection), connection.makefile("rb") as answers:

        def round_trip(message: bytearray) -> int:
            number = next(numbers) % 2**32
            HEADER.pack_into(message, 0, MAGIC, number, len(message) - HEADER.size)
            start = time.perf_counter_ns()
            connection.sendall(message)
            answer = answers.read(HEADER.size)
            end = time.perf_counter_ns()
            if _unpacked(answer) != (MAGIC, number, 0):
                raise MeasurementError(
                    f"{peer}: answered, but it is no `dwell profile listen` of this version"
                )
            return end - start

        try:
            round_trip(minimal)  # checks that the peer speaks this protocol
            connection.settimeout(answer_s)
            pace = Pace(settings.period_ms)
            for phase, rounds in (
                ("round {} of the warm-up", settings.warmup),
                ("round {}", settings.runs),
            ):
                pace.late = 0
                trips_ns = np.zeros((rounds, 2), np.int64)
                for done in range(rounds):
                    when = phase.format(done)
                    pace.wait()
                    trips_ns[done] = round_trip(minimal), round_trip(large)
        except TimeoutError:
            if when == FIRST:
                raise MeasurementError(
                    f"{peer}: took the connection but has not answered within {connect_s:g} s; "
                    "it is no `dwell profile listen`, or busy with another peer"
                ) from None
            raise MeasurementError(f"{peer}: no answer within {answer_s:g} s in {when}") from None
        except (EOFError, OSError) as error:
            why = _reason(error) if isinstance(error, OSError) else "it closed it"
            raise MeasurementError(f"{peer}: connection lost in {when} ({why})") from None
    return RoundTrips(trips_ns[:, 0], trips_ns[:, 1], pace.late)


def _connect(host: str, port: int, connect_s: float) -> socket.socket:
    try:
        connection = socket.create_connection((host, port), timeout=connect_s)
    except TimeoutError:
        raise MeasurementError(f"{host}:{port}: no connection within {connect_s:g} s") from None
    except OSError as error:
        raise MeasurementError(
            f"{host}:{port}: no connection ({_reason(error)}); run "
            f"`dwell profile listen --host ADDRESS --port {port}` there first"
        ) from None
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def measure_link(
    source: str,
    target: str,
    host: str,
    port: int,
    *,
    payload_bytes: int,
    settings: Settings,
) -> Measurement:
    """Measure the link from this node to another node that runs `listen`.

    Parameters
    ----------
    source, target : str
        Names of this node and the other in the cell.
    host, port, payload_bytes, settings
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
    trips = time_round_trips(host, port, payload_bytes=payload_bytes, settings=settings)
    minimal_ms, payload_ms = trips.minimal_ns / 1e6, trips.payload_ns / 1e6
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
    """Return the rate of a link in Mbit/s, from the extra round-trip time of a payload.

    Returns
    -------
    float or None
        None if the extra time is 0 or less, or the rate is out of the range of a cell.
    """
    if longer_ms <= 0:
        return None
    rate = 8 * payload_bytes / (1e3 * longer_ms)
    return rate if RATE_MBPS.holds(rate) else None
