"""Round trips over real sockets: to a listener, and to peers that are something else."""

from __future__ import annotations

import contextlib
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.calibration.measure import Settings
from dwell.calibration.round_trips import (
    CHUNK_BYTES,
    HEADER,
    MAGIC,
    MAX_BYTES,
    RoundTrips,
    listen,
    measure_link,
    parse_address,
    rate_mbps,
    time_round_trips,
)
from dwell.errors import MeasurementError, ProblemError, ProfileError
from tests.waiting import PATIENCE_S

LOCAL = "127.0.0.1"


@contextmanager
def listening(*, idle_s: float = 60) -> Iterator[tuple[int, list[str]]]:
    """Run a listener for one connection; yield its port, and what it said (when it has ended)."""
    ports: queue.Queue[int] = queue.Queue()
    said: list[str] = []
    thread = threading.Thread(
        target=listen,
        args=(LOCAL, 0),
        kwargs={
            "announce": lambda _, port: ports.put(port),
            "log": said.append,
            "once": True,
            "idle_s": idle_s,
        },
        daemon=True,
    )
    thread.start()
    yield ports.get(timeout=PATIENCE_S), said
    thread.join(timeout=PATIENCE_S)
    assert not thread.is_alive()


@contextmanager
def peer(serve: Callable[[socket.socket], object]) -> Iterator[int]:
    """Run a peer that treats one connection as `serve` says; yield its port."""
    with closing(socket.create_server((LOCAL, 0))) as server:

        def accept() -> None:
            with closing(server.accept()[0]) as connection:
                serve(connection)

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        thread.join(timeout=PATIENCE_S)


def call(
    port: int,
    *,
    rounds: int = 5,
    payload_bytes: int = 10,
    connect_s: float = 10,
    answer_s: float = 10,
) -> RoundTrips:
    return time_round_trips(
        LOCAL,
        port,
        payload_bytes=payload_bytes,
        settings=Settings(rounds, 2),
        connect_s=connect_s,
        answer_s=answer_s,
    )


def read(connection: socket.socket, count: int) -> bytes:
    """Return so many bytes, or what came before the connection ended."""
    data = b""
    while len(data) < count:
        try:
            more = connection.recv(count - len(data))
        except ConnectionResetError:
            break
        if not more:
            break
        data += more
    return data


# ------------------------------------------------------------------------------- both together


@pytest.mark.parametrize("payload_bytes", [1, CHUNK_BYTES - 1, CHUNK_BYTES, 3 * CHUNK_BYTES + 1])
def test_every_message_is_answered(payload_bytes: int) -> None:
    with listening() as (port, said):
        trips = call(port, rounds=4, payload_bytes=payload_bytes)
    assert len(trips.minimal_ns) == len(trips.payload_ns) == 4
    assert min(trips.minimal_ns) > 0
    assert min(trips.payload_ns) > 0
    # A first message to see who is there, two rounds of warm-up, four rounds.
    assert said[0].endswith(f": {1 + 2 * (2 + 4)} messages answered; it has ended")


def test_a_measured_link_has_half_of_the_round_trip() -> None:
    with listening() as (port, _):
        measured = measure_link(
            "R1",
            "E",
            LOCAL,
            port,
            payload_bytes=2_000_000,
            settings=Settings(20, 2, period_ms=0.5),
        )
    assert measured.name == "R1->E"
    trips = measured.columns["R1->E/round_trip_ms"]
    assert np.array_equal(measured.samples, trips / 2)
    assert {len(values) for values in measured.columns.values()} == {20}
    longer = np.median(measured.columns["R1->E/payload_round_trip_ms"] - trips)
    rate = measured.about["rate_mbps"]
    assert rate is None if longer <= 0 else rate == pytest.approx(16_000 / longer)
    assert (measured.about["from"], measured.about["bytes"]) == ("R1", 2_000_000)


def test_a_listener_in_another_process() -> None:
    """It says where it listens, serves peers one after another, and survives bad ones."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dwell", "profile", "listen", "--port", "0"],
        env={"PYTHONPATH": str(Path(__file__).parents[2] / "src"), "PATH": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        line = process.stdout.readline()
        assert line.startswith(f"listening on {LOCAL}:")
        port = int(line.rpartition(":")[2])
        assert len(call(port).minimal_ns) == 5
        with closing(socket.create_connection((LOCAL, port))) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert read(connection, 1) == b""
        assert len(call(port).minimal_ns) == 5
        lines = [process.stderr.readline().rstrip("\n") for _ in range(3)]
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)
    assert [line.partition(": ")[2].partition(";")[0] for line in lines] == [
        "15 messages answered",
        "0 messages answered",
        "15 messages answered",
    ]
    assert "refused" in lines[1]


# ------------------------------------------------------------------------ a listener's bad peers


def talk(data: bytes, *, idle_s: float = 60, end: bool = True) -> tuple[bytes, str]:
    """Send data to a listener; return its answers, and what it said."""
    with (
        listening(idle_s=idle_s) as (port, said),
        closing(socket.create_connection((LOCAL, port))) as connection,
    ):
        connection.sendall(data)
        if end:
            with contextlib.suppress(OSError):  # it has been refused already
                connection.shutdown(socket.SHUT_WR)
        answers = read(connection, 1000)
    return answers, said[0].partition(": ")[2]


def test_answers_repeat_the_number() -> None:
    messages = [HEADER.pack(MAGIC, 7, 3) + b"abc", HEADER.pack(MAGIC, 9, 0)]
    answers, said = talk(b"".join(messages))
    assert answers == HEADER.pack(MAGIC, 7, 0) + HEADER.pack(MAGIC, 9, 0)
    assert said == "2 messages answered; it has ended"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "0 messages answered; it has ended"),
        (HEADER.pack(MAGIC, 1, MAX_BYTES + 1), f"refused: {MAX_BYTES + 1} bytes announced"),
        (HEADER.pack(MAGIC, 1, 2**64 - 1), f"refused: {2**64 - 1} bytes announced"),
        (b"GET / HTTP/1.1\r\n\r\n", "refused: this is no message"),
        (HEADER.pack(MAGIC, 1, 5)[:-1], "it ended within a message"),
        (HEADER.pack(MAGIC, 1, 5) + b"abc", "it ended within a message"),
    ],
)
def test_what_a_listener_refuses(data: bytes, words: str) -> None:
    answers, said = talk(data)
    assert answers == b""
    assert words in said


def test_a_peer_that_says_nothing_is_let_go() -> None:
    _, said = talk(HEADER.pack(MAGIC, 1, 0)[:4], idle_s=0.05, end=False)
    assert said == "0 messages answered; refused: nothing came for 0.05 s"


def test_an_address_that_is_taken() -> None:
    with closing(socket.create_server((LOCAL, 0))) as server:
        port = server.getsockname()[1]
        with pytest.raises(MeasurementError, match=r"cannot listen there \(Address already in use"):
            listen(LOCAL, port, announce=lambda *_: None, log=print)


# ---------------------------------------------------------------------------- other bad peers


def test_nobody_listens() -> None:
    with closing(socket.create_server((LOCAL, 0))) as server:
        port = server.getsockname()[1]
    with pytest.raises(MeasurementError, match=rf"{LOCAL}:{port}: no connection \(Connection ref"):
        call(port)


def test_a_host_that_does_not_exist() -> None:
    with pytest.raises(MeasurementError, match="no connection"):
        time_round_trips("no-such-host.invalid", 1, payload_bytes=1, settings=Settings(1, 0))


def test_a_peer_that_never_answers() -> None:
    # Until its peer has gone: it reads and says nothing.
    words = r"has not answered within 0\.05 s"
    with (
        peer(lambda connection: bool(read(connection, 1000))) as port,
        pytest.raises(MeasurementError, match=words),
    ):
        call(port, connect_s=0.05)


def test_a_peer_that_speaks_something_else() -> None:
    with (
        peer(lambda connection: connection.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")) as port,
        pytest.raises(MeasurementError, match="no `dwell profile listen`"),
    ):
        call(port)


def answering(count: int) -> Callable[[socket.socket], None]:
    """Return a peer that answers so many messages without payload, or with one of 10 bytes."""

    def serve(connection: socket.socket) -> None:
        for _ in range(count):
            magic, number, length = HEADER.unpack(read(connection, HEADER.size))
            read(connection, length)
            connection.sendall(HEADER.pack(magic, number, 0))

    return serve


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "the first message"), (2, "round 0 of the warm-up"), (8, "round 1 ")],
)
def test_a_peer_that_goes_away(count: int, words: str) -> None:
    with (
        peer(answering(count)) as port,
        pytest.raises(MeasurementError, match=f"connection lost in {words}"),
    ):
        call(port)


def test_a_peer_that_falls_silent() -> None:
    def serve(connection: socket.socket) -> None:
        answering(1)(connection)
        read(connection, 1000)

    words = r"no answer within 0\.05 s in round 0 of the warm-up"
    with peer(serve) as port, pytest.raises(MeasurementError, match=words):
        call(port, answer_s=0.05)


# ------------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize("payload_bytes", [0, MAX_BYTES + 1])
def test_payloads_have_bounds(payload_bytes: int) -> None:
    with pytest.raises(ProblemError, match=r"^bytes: "):
        call(1, payload_bytes=payload_bytes)


def test_the_period_is_shorter_than_a_listeners_patience() -> None:
    with pytest.raises(ProblemError, match=r"^period_ms: .* to 10000$"):
        time_round_trips(LOCAL, 1, payload_bytes=1, settings=Settings(1, 0, 10_001.0))


def test_the_rate_of_a_payload() -> None:
    assert rate_mbps(1_250_000, 100.0) == pytest.approx(100)
    # The other way round: what the cell then computes is what was measured.
    rate = rate_mbps(307_200, 3.7)
    assert rate is not None
    assert 8 * 307_200 / (rate * 1e3) == pytest.approx(3.7)
    assert rate_mbps(10, 0.0) is None
    assert rate_mbps(10, -1.0) is None


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("edge.local:7411", ("edge.local", 7411)),
        ("127.0.0.1:1", ("127.0.0.1", 1)),
        ("[::1]:65535", ("::1", 65535)),
    ],
)
def test_addresses(text: str, address: tuple[str, int]) -> None:
    assert parse_address(text) == address


@given(st.text(max_size=12))
def test_addresses_are_read_or_refused(text: str) -> None:
    with contextlib.suppress(ProfileError):
        host, port = parse_address(text)
        assert host
        assert 1 <= port <= 65535


@pytest.mark.parametrize(
    "text", ["edge", "edge:", ":7411", "edge:0", "edge:65536", "::1:80", "e:-1"]
)
def test_no_address(text: str) -> None:
    with pytest.raises(ProfileError, match="HOST:PORT"):
        parse_address(text)


@pytest.mark.parametrize(("source", "target"), [("R1", "R1"), ("R->1", "E"), ("R1", "")])
def test_links_join_two_names(source: str, target: str) -> None:
    with pytest.raises(ProfileError, match=r"^(from|to): "):
        measure_link(source, target, LOCAL, 1, payload_bytes=1, settings=Settings(1, 0))
