"""Transport over Eclipse Zenoh: up to three sessions per process, explicit endpoints, no blocking.

Small messages and payloads use separate sessions, because images that fill a TCP connection delay
all later messages, whatever their priority. Payloads that stay on their node use a third session,
with shared memory for large payloads.

A put copies its message into the queue of each receiver and returns. A full queue drops the
message without an effect on other receivers. A payload larger than a queue has to wait for the
network: one thread per key waits, and then puts the newest payload.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import threading
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

from dwell.errors import LiveError, describe_raised, installing
from dwell.live.failures import start_thread
from dwell.live.transport.abandoned import AbandonedConnections
from dwell.live.transport.forked import SessionDescriptors
from dwell.live.transport.no_linger import Connections
from dwell.live.transport.orphans import SHARED_MEMORY
from dwell.live.wire.local_addresses import why_not_listen
from dwell.live.wire.transport import Arrival, Lane, Receive, require_expression, require_key
from dwell.live.wire.wiring import Session, WiringEntry, session_of
from dwell.model import FrozenDict

if TYPE_CHECKING:
    import zenoh

# These values were measured.
#: Silence, ms, after which Zenoh closes the connection to a peer. Nothing depends on it: beats show
#: which processes live, and the connections of a dead process are closed.
LEASE_MS = 1_500
#: Keep-alive messages per lease. One per 100 ms took a third of the CPU time of an idle worker.
KEEP_ALIVES = 3
#: Shortest and longest pause between attempts to connect, ms.
RETRY_MS = 50, 200
#: Most messages, or fragments of 48 kB, that wait for one peer, 1 to 16.
QUEUE_BATCHES = 16
#: Longest wait of a put for space in a full queue before it drops the message, µs. For a larger
#: message, each queued fragment doubles the wait, up to the second value.
DROP_AFTER_US, DROP_FRAGMENTS_AFTER_US = 100, 50_000
#: Size above which a thread puts a payload, as it may wait for `DROP_FRAGMENTS_AFTER_US`.
PATIENT_BYTES = 150_000
#: Least size of a payload for shared memory, if the payload stays on its node.
SHARED_BYTES = 100_000
#: Shared memory of one process for payloads on their way.
POOL_BYTES = 16 << 20
#: Longest message that Zenoh assembles from fragments; its own limit is 1 GiB.
LONGEST_BYTES = 64 << 20
#: First byte of an attachment that contains the checksum of its key. No header begins with it, as
#: MessagePack never uses it.
MARK = b"\xc1"
MARKED_BYTES = 5

_LOG = logging.getLogger(__name__)
#: Most different failures of receivers to log.
MOST_FAILURES = 100
#: Most declared publishers, above the number of keys of any process (without answers to requests).
_PUBLISHERS = 256
#: Most large payloads of one key that wait while another payload is on its way.
_WAITING = 2
_PRIORITIES = (
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
)


@lru_cache(maxsize=1_024)
def mark_of(key: str) -> bytes:
    """Return the mark of a key, which is part of each message with this key.

    Zenoh sends a number instead of a key that was declared in a session. After a restart of a
    session, the receiver may read the numbers of another session, and deliver the message under
    another key.
    """
    return MARK + zlib.crc32(key.encode()).to_bytes(MARKED_BYTES - 1, "little")


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """Bounds and protection of a process's sessions.

    `longest_bytes` and `longest_control_bytes` bound the messages that arrive in fragments, in a
    session for payloads and in `control`. A longer message is dropped, and its connection closed. A
    peer can make a process store that many bytes per connection, priority (8) and reliability (2).
    `most_peers` bounds the processes that connect to a session. `more` has further settings of
    Zenoh by path, such as ``transport/link/tls/root_ca_certificate``.
    """

    longest_bytes: int = LONGEST_BYTES
    longest_control_bytes: int = LONGEST_BYTES
    most_peers: int = 1_000
    more: Mapping[str, object] = field(default_factory=FrozenDict)


class ZenohTransport:
    """Sessions of a process; see `Transport`.

    The constructor does not wait for peers: the sessions connect in the background. Callbacks run
    in Zenoh's threads. Raises a LiveError if Zenoh is missing, or a session cannot listen.
    """

    def __init__(self, entry: WiringEntry, settings: ZenohSettings | None = None) -> None:
        try:
            import zenoh
        except ImportError:
            raise LiveError(f"Zenoh is not installed; {installing('live')}") from None
        self.entry = entry
        self.settings = settings or ZenohSettings()
        self._zenoh = zenoh
        self._closed = False
        self._connections = Connections()
        self._descriptors = SessionDescriptors(entry)
        ports = (end.port for end in entry.listen.values())
        self._abandoned = AbandonedConnections(ports, self._renew)
        self._subscribed: list[tuple[str, Receive]] = []
        #: Number of messages that arrived under a wrong key.
        self.misled = 0
        #: Number of messages whose receiver failed.
        self.failed = 0
        self._failures: set[str] = set()
        # Used without a lock: a superfluous publisher does no harm.
        self._routes: dict[tuple[str, Lane], KeyRoute] = {}
        self._locks: dict[Lane, threading.RLock] = {
            "control": threading.RLock(),
            "images": threading.RLock(),
        }
        self._growing = threading.Lock()
        self._pool: PayloadPool | None = None
        self._sessions: dict[Session, zenoh.Session] = {}
        try:
            for name in entry.sessions:
                self._sessions[name] = self._open(name)
        except BaseException:
            self.close()
            raise
        self._connections.start()
        self._abandoned.start()
        if "local" in self._sessions:
            self._pool = PayloadPool.of()

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message without waiting for the receivers."""
        route = self._routes.get((key, lane)) or self._route(key, lane)
        if route is None or self._closed:
            return
        # Zenoh accepts no views, so a view costs another copy.
        data = payload if isinstance(payload, bytes) else bytes(payload)
        if route.sender is None:
            content = route.content(data)
            if content is not data or len(data) <= PATIENT_BYTES:
                self._send(route, content, header)
                return
        self._sender(route).send(data, header)

    def subscribe(self, key: str, receive: Receive) -> None:
        """Call `receive` for each message that matches a key expression (``*``, ``**``)."""
        require_expression(key)
        self._subscribed.append((key, receive))
        for name, session in list(self._sessions.items()):
            self._declare(name, session, key, receive)

    def _declare(self, name: Session, session: zenoh.Session, key: str, receive: Receive) -> None:
        lock = self._locks["control" if name == "control" else "images"]
        # Call it in the thread that reads the message. This saves a change of threads; and if a
        # receiver is late, its senders drop messages, instead of a queue that grows here.
        session.declare_subscriber(
            key,
            self._zenoh.handlers.Callback(partial(self._deliver, receive, lock), indirect=False),
            allowed_origin=self._zenoh.Locality.REMOTE,
        )

    def close(self) -> None:
        """Stop sending and delivering messages; may be called twice."""
        # While this thread has both locks, no other thread runs a callback.
        with self._locks["control"], self._locks["images"]:
            self._closed = True
            self._connections.stop()
            self._abandoned.stop()
            self._descriptors.stop()
            sessions, self._sessions = self._sessions, {}
            routes, self._routes = self._routes, {}
        with self._growing:
            senders = [route.sender for route in routes.values() if route.sender is not None]
        for sender in senders:
            sender.stop()
        for session in sessions.values():
            session.close()

    def _renew(self, port: int) -> None:
        """Reopen the session that listens on a port, which closes all its connections.

        Messages that are put during this time are lost; the peers reconnect at once.
        """
        (name,) = (name for name, end in self.entry.listen.items() if end.port == port)
        with self._locks["control"], self._locks["images"]:
            session = self._sessions.pop(name, None)
        if session is None:
            return
        _LOG.warning(
            "%s: many connections to port %d were abandoned; it is opened anew",
            *(self.entry.role.who, port),
        )
        with self._growing:
            gone = [at for at in list(self._routes) if session_of(self.entry, at[1], at[0]) == name]
            routes = [self._routes.pop(at) for at in gone]
        for route in routes:
            route.closed = True
            if route.sender is not None:
                route.sender.stop()
        session.close()
        session = self._open(name)
        for key, receive in self._subscribed:
            self._declare(name, session, key, receive)
        with self._locks["control"], self._locks["images"]:
            if not self._closed:
                self._sessions[name] = session
                return
        session.close()

    @property
    def peers(self) -> Mapping[Session, int]:
        """Present number of connected processes by session."""
        return {name: len(session.info.peers_zid()) for name, session in self._sessions.items()}

    def _open(self, name: Session) -> zenoh.Session:
        """Open a session; raises a LiveError with address and reason if it cannot listen."""
        config = self._zenoh.Config()
        for path, value in _configuration(self.entry, name, self.settings).items():
            config.insert_json5(path, json.dumps(value))
        try:
            return self._zenoh.open(config)
        except self._zenoh.ZError as error:
            where = self.entry.listen.get(name)
            why = "" if where is None else why_not_listen(where.address, where.port)
            raise LiveError(
                f"{self.entry.role.who} cannot open its session {name!r}"
                f"{f' on {where}' if where else ''}: {why or error}"
            ) from None

    def _route(self, key: str, lane: Lane) -> KeyRoute | None:
        """Declare a publisher in the session of a key and a lane; None if it is closed."""
        require_key(key)
        name = session_of(self.entry, lane, key)
        session = self._sessions.get(name)
        priority = self._zenoh.Priority.REAL_TIME
        if lane == "images":
            alone = name != "control"
            priority = self._zenoh.Priority.DATA if alone else self._zenoh.Priority.DATA_LOW
        if session is None:
            return None
        try:
            publisher = session.declare_publisher(
                key,
                congestion_control=self._zenoh.CongestionControl.DROP,
                priority=priority,
                express=True,
                allowed_destination=self._zenoh.Locality.REMOTE,
            )
        except self._zenoh.ZError:
            if self._closed:
                return None
            raise
        pool = self._pool if name == "local" else None
        route = KeyRoute(publisher.put, pool, mark=mark_of(key))
        while len(self._routes) >= _PUBLISHERS:
            dropped = self._routes.pop(next(iter(self._routes)), None)
            if dropped is not None and dropped.sender is not None:
                dropped.sender.stop()
        self._routes[key, lane] = route
        return route

    def _sender(self, route: KeyRoute) -> PatientSender:
        """Return the thread of a key, which puts all further messages of the key."""
        with self._growing:
            if route.sender is None:
                route.sender = PatientSender(route, self._send)
                if self._closed:
                    route.sender.stop()
            return route.sender

    def _send(self, route: KeyRoute, content: Any, header: bytes) -> None:
        try:
            route.put(content, attachment=route.mark + header)
        except self._zenoh.ZError:
            if not (self._closed or route.closed):
                raise

    def _deliver(self, receive: Receive, lock: threading.RLock, sample: zenoh.Sample) -> None:
        """Pass a message to a receiver in Zenoh's thread; log each kind of failure once."""
        _keep_thread_state()
        attachment, key = sample.attachment, str(sample.key_expr)
        header = b"" if attachment is None else attachment.to_bytes()
        if header.startswith(MARK):
            if not header.startswith(mark_of(key)):
                self.misled += 1
                if self.misled == 1:
                    who = self.entry.role.who
                    _LOG.warning("%s: heard under %s what was put elsewhere", who, key)
                return
            header = header[MARKED_BYTES:]
        message = Arrival(key, sample.payload.to_bytes(), header)
        try:
            with lock:
                if not self._closed:
                    receive(message)
        except Exception as error:
            what = describe_raised(error)
            self.failed += 1
            if what not in self._failures and len(self._failures) < MOST_FAILURES:
                self._failures.add(what)
                _LOG.exception("%s: a receiver of %s failed", self.entry.role.who, key)


_kept = threading.local()


def _keep_thread_state() -> None:
    """Keep Python's state of this thread of Zenoh until the thread ends.

    Otherwise Python would create the state for each message, which would then take 80 instead of
    55 µs.
    """
    if not getattr(_kept, "done", False):
        ctypes.pythonapi.PyGILState_Ensure()
        _kept.done = True


@dataclass(slots=True)
class KeyRoute:
    """Publisher of a key and lane."""

    put: Callable[..., None]
    pool: PayloadPool | None
    #: Thread that sends all messages of the key after its first large payload, to keep their order.
    sender: PatientSender | None = None
    mark: bytes = b""
    #: Whether the session has been closed.
    closed: bool = False

    def content(self, data: bytes) -> Any:
        """Return a large payload in shared memory, if the key has a pool, else the payload."""
        if self.pool is None or len(data) < SHARED_BYTES:
            return data
        return self.pool.filled(data)


class PatientSender:
    """Thread that puts the newest messages of one key, and may wait for the network."""

    def __init__(self, route: KeyRoute, send: Callable[[KeyRoute, Any, bytes], None]) -> None:
        self._route = route
        self._send = send
        self._changed = threading.Condition()
        self._waiting: deque[tuple[bytes, bytes]] = deque(maxlen=_WAITING)
        self._stopped = False
        self._thread = start_thread("dwell-sender", self._run)

    def send(self, data: bytes, header: bytes) -> None:
        """Queue a message; drop the oldest waiting message if the queue is full."""
        with self._changed:
            self._waiting.append((data, header))
            self._changed.notify()

    def stop(self) -> None:
        """Stop the thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join(timeout=1.0)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._waiting)
                if self._stopped:
                    return
                data, header = self._waiting.popleft()
            try:
                self._send(self._route, self._route.content(data), header)
            except Exception:
                _LOG.exception("a payload of %d bytes could not be sent", len(data))


class PayloadPool:
    """Shared memory for copies of payloads, which stay as long as a receiver needs them."""

    def __init__(self, pool_bytes: int) -> None:
        from zenoh import ZError, shm

        self._error = ZError
        self._provider = shm.ShmProvider.default_backend(pool_bytes)
        # Payloads that receivers have released are collected only when the pool is full.
        self._policy = shm.Defragment(shm.GarbageCollect())

    @classmethod
    def of(cls, pool_bytes: int = POOL_BYTES) -> PayloadPool | None:
        """Return a pool, or None if the system lacks shared memory for it."""
        try:
            room = os.statvfs(SHARED_MEMORY)
        except OSError:
            return None
        # The file is sparse: writes beyond the free memory would kill the process.
        if room.f_bavail * room.f_frsize < 2 * pool_bytes:
            _LOG.warning(
                "%s has less than %d bytes free: images are copied through sockets",
                SHARED_MEMORY,
                2 * pool_bytes,
            )
            return None
        from zenoh import ZError

        try:
            return cls(pool_bytes)
        except ZError as error:
            # Zenoh locks the pool into memory; by default a user may lock only 8 MB.
            _LOG.warning(
                "no %d bytes of shared memory can be had (%s; LimitMEMLOCK, ulimit -l): images are "
                "copied through sockets",
                pool_bytes,
                error,
            )
            return None

    def filled(self, payload: bytes) -> Any:
        """Return the payload in shared memory, or the payload itself if the pool is full."""
        try:
            buffer = self._provider.alloc(len(payload), self._policy)
        except self._error:
            return payload
        buffer[:] = payload
        return buffer


def _configuration(entry: WiringEntry, name: Session, settings: ZenohSettings) -> dict[str, object]:
    """Return Zenoh's settings for a session, by path."""
    listen = entry.listen.get(name)
    first_ms, last_ms = RETRY_MS
    retry = {"period_init_ms": first_ms, "period_max_ms": last_ms, "period_increase_factor": 2}
    queue = "transport/link/tx/queue"
    return {
        "mode": "peer",
        # No search for peers: the cell file lists them.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "open/return_conditions/connect_scouted": False,
        "open/return_conditions/declares": False,
        "listen/endpoints": [] if listen is None else [str(listen)],
        # A predecessor that was just killed may still occupy the port.
        "listen/timeout_ms": 1_000,
        "listen/retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 2},
        "connect/endpoints": [str(end) for end in entry.connect.get(name, ())],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": retry,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/keep_alive": KEEP_ALIVES,
        # Send each message as one batch, without waiting: 100 kB cost 25 us instead of 130.
        f"{queue}/batching/enabled": False,
        f"{queue}/size": dict.fromkeys(_PRIORITIES, QUEUE_BATCHES),
        f"{queue}/congestion_control/drop/wait_before_drop": DROP_AFTER_US,
        f"{queue}/congestion_control/drop/max_wait_before_drop_fragments": DROP_FRAGMENTS_AFTER_US,
        "transport/link/rx/max_message_size": (
            settings.longest_control_bytes if name == "control" else settings.longest_bytes
        ),
        "transport/unicast/max_sessions": settings.most_peers,
        "transport/shared_memory/enabled": name == "local",
        # `PayloadPool` puts payloads there, and falls back to sockets when it is full.
        "transport/shared_memory/transport_optimization/enabled": False,
        **settings.more,
    }
