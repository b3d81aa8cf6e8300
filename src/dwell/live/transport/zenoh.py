"""Messages over Eclipse Zenoh: up to three sessions a process, explicit endpoints, nothing blocks.

Small messages and payloads have sessions of their own, because one TCP connection that is full of
images delays everything behind them whatever its priority. Payloads that stay on their node have
a third one, in which large ones go through shared memory.

A put copies its message into the queue of every receiver and returns; where a queue is full, it is
dropped there, and no other receiver notices. Payloads that fill a queue by themselves have to wait
for the network, however fast it is: a thread for each of their keys does that, and puts what is
newest.
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

# What was measured to work.
#: Silence, ms, after which a peer counts as gone and its connection is given up. Nothing waits for
#: it: who is there is known by beats, and a process that has died closes its connections.
LEASE_MS = 1_500
#: Signs of life sent in that time. At one each 100 ms they were a third of what an idle worker took
#: of a core.
KEEP_ALIVES = 3
#: Shortest and longest pause between attempts to connect, ms.
RETRY_MS = 50, 200
#: Messages, or fragments of 48 kB, that wait for one peer at most, 1 to 16.
QUEUE_BATCHES = 16
#: How long a put waits for room in a full queue before it drops the message, µs. Each batch that a
#: larger message has found room for doubles that, until here for fragments.
DROP_AFTER_US, DROP_FRAGMENTS_AFTER_US = 100, 50_000
#: Payloads above that are put by a thread, which may wait as long as the former says.
PATIENT_BYTES = 150_000
#: Payloads from here on go through shared memory where they stay on the node.
SHARED_BYTES = 100_000
#: Shared memory for payloads under way from one process.
POOL_BYTES = 16 << 20
#: Longest message that is put together from its fragments; Zenoh's own limit is 1 GiB.
LONGEST_BYTES = 64 << 20
#: Begins an attachment that says which key it was put under. No header does: MessagePack never
#: uses this byte.
MARK = b"\xc1"
MARKED_BYTES = 5

_LOG = logging.getLogger(__name__)
#: Different failures of receivers that are logged.
MOST_FAILURES = 100
#: Publishers kept declared; more keys than a process ever puts, answers to questions aside.
_PUBLISHERS = 256
#: Large payloads of one key that wait while another is on its way.
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
def _mark(key: str) -> bytes:
    """Return the mark of a key, which every message that is put under it carries.

    Zenoh sends a number for a key that was declared in a session. Where sessions end and begin
    anew, a message may be read with the numbers of another one, and be delivered under another key.
    """
    return MARK + zlib.crc32(key.encode()).to_bytes(MARKED_BYTES - 1, "little")


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """Bounds of a process's sessions, and what protects them.

    Parameters
    ----------
    longest_bytes, longest_control_bytes : int
        Longest message that arrives in fragments, in a session for payloads and in `control`; of a
        longer one what has come is dropped, with the connection. A peer can have a process keep
        that much for each of its connections, of 8 priorities and 2 reliabilities.
    most_peers : int
        Processes that a session is connected to at most.
    more : mapping of str to object
        Further settings of Zenoh by path, as ``transport/link/tls/root_ca_certificate``.
    """

    longest_bytes: int = LONGEST_BYTES
    longest_control_bytes: int = LONGEST_BYTES
    most_peers: int = 1_000
    more: Mapping[str, object] = field(default_factory=FrozenDict)


class ZenohTransport:
    """Sessions of a process; see `Transport`.

    It returns at once, whoever else is there yet, and connects in the background for as long as it
    is open. Callbacks run in Zenoh's own threads.

    Parameters
    ----------
    entry : WiringEntry
        Where it listens and to whom it connects, from `Wiring.entry`.

    Raises
    ------
    LiveError
        If Zenoh is not installed, or it cannot listen.
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
        #: Messages that arrived under another key than they were put under.
        self.misled = 0
        #: Messages that nobody could handle.
        self.failed = 0
        self._failures: set[str] = set()
        # Read and filled without a lock: a publisher too many does no harm.
        self._routes: dict[tuple[str, Lane], _Route] = {}
        self._locks: dict[Lane, threading.RLock] = {
            "control": threading.RLock(),
            "images": threading.RLock(),
        }
        self._growing = threading.Lock()
        self._pool: _Pool | None = None
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
            self._pool = _Pool.of()

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message; returns at once, whatever the receivers do."""
        route = self._routes.get((key, lane)) or self._route(key, lane)
        if route is None or self._closed:
            return
        # Zenoh takes no views: whoever has one pays for a copy more.
        data = payload if isinstance(payload, bytes) else bytes(payload)
        if route.sender is None:
            content = route.content(data)
            if content is not data or len(data) <= PATIENT_BYTES:
                self._send(route, content, header)
                return
        self._sender(route).send(data, header)

    def subscribe(self, key: str, receive: Receive) -> None:
        """Have `receive` called with every message under a key expression (``*``, ``**``)."""
        require_expression(key)
        self._subscribed.append((key, receive))
        for name, session in list(self._sessions.items()):
            self._declare(name, session, key, receive)

    def _declare(self, name: Session, session: zenoh.Session, key: str, receive: Receive) -> None:
        lock = self._locks["control" if name == "control" else "images"]
        # Called in the thread that read the message: one hand-over less, and a receiver that
        # is behind makes its senders drop instead of growing a queue here.
        session.declare_subscriber(
            key,
            self._zenoh.handlers.Callback(partial(self._deliver, receive, lock), indirect=False),
            allowed_origin=self._zenoh.Locality.REMOTE,
        )

    def close(self) -> None:
        """Send and deliver nothing more; safe to call twice."""
        # With both locks no callback is running, unless it is this thread's own.
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
        """Open the session that listens on a port anew, which closes all its connections.

        What is put meanwhile is lost; its peers connect again at once.
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
        """How many processes each session is connected to at the moment."""
        return {name: len(session.info.peers_zid()) for name, session in self._sessions.items()}

    def _open(self, name: Session) -> zenoh.Session:
        """Open one session.

        Raises
        ------
        LiveError
            With where it should have listened, and why it cannot.
        """
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

    def _route(self, key: str, lane: Lane) -> _Route | None:
        """Declare a publisher in the session that a key and a lane belong to."""
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
        route = _Route(publisher.put, pool, mark=_mark(key))
        while len(self._routes) >= _PUBLISHERS:
            dropped = self._routes.pop(next(iter(self._routes)), None)
            if dropped is not None and dropped.sender is not None:
                dropped.sender.stop()
        self._routes[key, lane] = route
        return route

    def _sender(self, route: _Route) -> _Sender:
        """Return the thread that puts for a key; from then on it puts everything for it."""
        with self._growing:
            if route.sender is None:
                route.sender = _Sender(route, self._send)
                if self._closed:
                    route.sender.stop()
            return route.sender

    def _send(self, route: _Route, content: Any, header: bytes) -> None:
        try:
            route.put(content, attachment=route.mark + header)
        except self._zenoh.ZError:
            if not (self._closed or route.closed):
                raise

    def _deliver(self, receive: Receive, lock: threading.RLock, sample: zenoh.Sample) -> None:
        """Hand a message to a receiver, in Zenoh's thread; log each kind of failure once."""
        _keep_thread_state()
        attachment, key = sample.attachment, str(sample.key_expr)
        header = b"" if attachment is None else attachment.to_bytes()
        if header.startswith(MARK):
            if not header.startswith(_mark(key)):
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
    """Have Python keep what it knows of this thread, which is Zenoh's, until the thread ends.

    It would be made anew for every message: a third of what taking one costs (55 instead of 80 µs).
    """
    if not getattr(_kept, "done", False):
        ctypes.pythonapi.PyGILState_Ensure()
        _kept.done = True


@dataclass(slots=True)
class _Route:
    """How messages of a key and lane go out."""

    put: Callable[..., None]
    pool: _Pool | None
    #: Once there is one, everything goes through it, so that the order stays.
    sender: _Sender | None = None
    mark: bytes = b""
    #: Whether its session has been closed.
    closed: bool = False

    def content(self, data: bytes) -> Any:
        """Return a payload as Zenoh is handed it: in shared memory, or as it is."""
        if self.pool is None or len(data) < SHARED_BYTES:
            return data
        return self.pool.filled(data)


class _Sender:
    """Puts the newest messages of one key in a thread of its own, which may have to wait."""

    def __init__(self, route: _Route, send: Callable[[_Route, Any, bytes], None]) -> None:
        self._route = route
        self._send = send
        self._changed = threading.Condition()
        self._waiting: deque[tuple[bytes, bytes]] = deque(maxlen=_WAITING)
        self._stopped = False
        self._thread = start_thread("dwell-sender", self._run)

    def send(self, data: bytes, header: bytes) -> None:
        """Have a message put next; the oldest that waits is dropped where there are too many."""
        with self._changed:
            self._waiting.append((data, header))
            self._changed.notify()

    def stop(self) -> None:
        """Put nothing more."""
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


class _Pool:
    """Shared memory that payloads are copied into for as long as a receiver needs them."""

    def __init__(self, pool_bytes: int) -> None:
        from zenoh import ZError, shm

        self._error = ZError
        self._provider = shm.ShmProvider.default_backend(pool_bytes)
        # What receivers have let go of is collected only where there is no room.
        self._policy = shm.Defragment(shm.GarbageCollect())

    @classmethod
    def of(cls, pool_bytes: int = POOL_BYTES) -> _Pool | None:
        """Return a pool, or None where there is no shared memory for it."""
        try:
            room = os.statvfs(SHARED_MEMORY)
        except OSError:
            return None
        # The file is sparse: writing to one that does not fit would kill the process.
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
            # Zenoh locks it into memory, of which a user may lock 8 MB only by default.
            _LOG.warning(
                "no %d bytes of shared memory can be had (%s; LimitMEMLOCK, ulimit -l): images are "
                "copied through sockets",
                pool_bytes,
                error,
            )
            return None

    def filled(self, payload: bytes) -> Any:
        """Return the payload in shared memory, or as it is where there is no room."""
        try:
            buffer = self._provider.alloc(len(payload), self._policy)
        except self._error:
            return payload
        buffer[:] = payload
        return buffer


def _configuration(entry: WiringEntry, name: Session, settings: ZenohSettings) -> dict[str, object]:
    """Zenoh's settings for one session, by path."""
    listen = entry.listen.get(name)
    first_ms, last_ms = RETRY_MS
    retry = {"period_init_ms": first_ms, "period_max_ms": last_ms, "period_increase_factor": 2}
    queue = "transport/link/tx/queue"
    return {
        "mode": "peer",
        # Nobody is looked for: who is there stands in the cell file.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "open/return_conditions/connect_scouted": False,
        "open/return_conditions/declares": False,
        "listen/endpoints": [] if listen is None else [str(listen)],
        # A predecessor that has just been killed may hold the port for a moment.
        "listen/timeout_ms": 1_000,
        "listen/retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 2},
        "connect/endpoints": [str(end) for end in entry.connect.get(name, ())],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": retry,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/keep_alive": KEEP_ALIVES,
        # One message is one batch: nothing waits for company, and 100 kB cost 25 us, not 130.
        f"{queue}/batching/enabled": False,
        f"{queue}/size": dict.fromkeys(_PRIORITIES, QUEUE_BATCHES),
        f"{queue}/congestion_control/drop/wait_before_drop": DROP_AFTER_US,
        f"{queue}/congestion_control/drop/max_wait_before_drop_fragments": DROP_FRAGMENTS_AFTER_US,
        "transport/link/rx/max_message_size": (
            settings.longest_control_bytes if name == "control" else settings.longest_bytes
        ),
        "transport/unicast/max_sessions": settings.most_peers,
        "transport/shared_memory/enabled": name == "local",
        # Payloads are put there by `_Pool`, with a plain copy where it is full.
        "transport/shared_memory/transport_optimization/enabled": False,
        **settings.more,
    }
