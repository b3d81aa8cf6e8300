"""Session of one endpoint: its node and tokens in the graph of ROS, and who matches it."""

from __future__ import annotations

import json
import logging
import os
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dwell.errors import LiveError, installing
from dwell.live.failures import start_thread
from dwell.live.ros2 import matching
from dwell.live.ros2.message_types import types_of
from dwell.live.ros2.rmw_zenoh import (
    ADMIN,
    PUBLISHER,
    QOS,
    Attachment,
    RosEndpoint,
    RosNode,
    Topic,
    gid,
    node_name,
    read_token,
)
from dwell.live.stage import StagePlace
from dwell.model.ros_topics import RosTopic

if TYPE_CHECKING:
    import zenoh

_LOG = logging.getLogger(__name__)
ROUTER = "tcp/localhost:7447"
#: Variables of the environment that ROS reads, too.
CONFIG, DOMAIN = "ZENOH_SESSION_CONFIG_URI", "ROS_DOMAIN_ID"
#: Time between two looks at the connections, and two attempts to open the session.
LOOK_S = 0.25
#: Pauses between attempts to connect.
RETRY = {"period_init_ms": 250, "period_max_ms": 1_000, "period_increase_factor": 2}
#: Number of an endpoint in the session; its node has the number 0.
_ENDPOINT = 1
#: Most different warnings of one endpoint.
_MOST_WARNINGS = 100


def domain_of(settings: RosTopic, environment: Mapping[str, str] = os.environ) -> int:
    """Return the domain of a topic; raise a LiveError if the environment's is no number."""
    if settings.domain is not None:
        return settings.domain
    given = environment.get(DOMAIN) or "0"
    if not given.isdecimal():
        raise LiveError(f"{DOMAIN} is {given!r}; it must be a whole number")
    return int(given)


def configuration(settings: RosTopic, environment: Mapping[str, str] = os.environ) -> Any:
    """Return the configuration of a session, as rmw_zenoh's where nothing else is given."""
    import zenoh

    file, is_client = environment.get(CONFIG, ""), settings.mode == "client"
    config = zenoh.Config.from_file(file) if file else zenoh.Config()
    values: dict[str, object] = {
        "connect/timeout_ms": 0 if is_client else -1,
        "connect/exit_on_failure": is_client,
        "connect/retry": RETRY,
        # The caches of transient-local publishers order their messages by time stamps.
        "timestamping/enabled": True,
    }
    if is_client or not file:
        values["mode"] = settings.mode
        values["listen/endpoints"] = [] if is_client else ["tcp/localhost:0"]
    if settings.connect or not file:
        values["connect/endpoints"] = [settings.connect or ROUTER]
    if not file:
        values["scouting/multicast/enabled"] = False
        values["transport/shared_memory/enabled"] = True
    for path, value in values.items():
        config.insert_json5(path, json.dumps(value))
    return config


def is_encrypted(settings: RosTopic) -> bool:
    """Whether the session of a topic connects by TLS or QUIC alone."""
    ends = configuration(settings).get_json("connect/endpoints")
    protocols = set(re.findall(r'"([a-z-]+)/', ends))
    return bool(protocols) and protocols <= {"tls", "quic"}


class RosSession:
    """A Zenoh session with one node and one endpoint, opened and watched by a thread.

    `prepare` must succeed before `open`, which returns at once; without a router the thread tries
    again.
    `receive` gets each message of a subscription, in Zenoh's thread.
    """

    def __init__(
        self,
        settings: RosTopic,
        kind: str,
        place: StagePlace,
        receive: Callable[[zenoh.Sample, Attachment], None] | None = None,
    ) -> None:
        self.settings, self.kind, self._place = settings, kind, place
        self._receive = receive
        #: Reason that nothing is connected; empty if the endpoint has a router or a peer.
        self.trouble = "not open yet"
        #: Endpoints of the topic that are not connected, with the reason; QoS that gives less.
        self.faults: tuple[str, ...] = ()
        self.notes: tuple[str, ...] = ()
        #: Sessions on this computer to which ours has a direct connection.
        self._here: set[str] = set()
        self._others: dict[str, RosEndpoint] = {}
        self._warned: set[str] = set()
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._publisher: Any = None
        self._gid, self._sequence = b"", 0

    def prepare(self) -> None:
        """Read the type; raise a LiveError if it or a setting is unusable, or a package missing."""
        try:
            import xxhash  # noqa: F401
            import zenoh  # noqa: F401
        except ImportError as error:
            raise LiveError(f"{error.name} is not installed; {installing('ros2')}") from None
        settings = self.settings
        self.types = types_of(settings, self._place.folder)
        self.topic = Topic(settings.resolved, settings.type, self.types.hash(settings.type))
        usual = QOS[settings.qos]
        self.qos = replace(usual, depth=settings.depth or usual.depth)
        self.domain = domain_of(settings)

    def open(self) -> None:
        """Let a thread open the session; `prepare` comes first."""
        start_thread("ros2", self._run)

    def close(self) -> None:
        """Close the session, which ends its tokens."""
        self._stopped.set()
        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            session.close()

    # ------------------------------------------------------------------------ session

    def _run(self) -> None:
        while not self._stopped.is_set():
            if self._session is None:
                self._open()
            self._look()
            self._stopped.wait(LOOK_S)

    def _open(self) -> None:
        import zenoh

        where = self.settings.connect or ROUTER
        try:
            session = zenoh.open(configuration(self.settings))
            with self._lock:
                self._session = session
            self._declare(session)
        except (zenoh.ZError, OSError) as error:
            self.trouble = f"no router at {where}: {error}"
        if self._stopped.is_set():
            self.close()

    def _declare(self, session: zenoh.Session) -> None:
        import zenoh
        from zenoh import ext

        namespace = self.settings.namespace.strip("/")
        names = node_name(self._place), f"/{namespace}" if namespace else ""
        node = RosNode(self.domain, str(session.zid()), 0, *names)
        self.endpoint = RosEndpoint(node, _ENDPOINT, self.kind, self.topic, self.qos)
        token, key, depth = self.endpoint.token(), self.topic.key(self.domain), self.qos.depth
        self._gid = gid(token)
        heard = zenoh.handlers.Callback(self._heard, indirect=False)
        live = session.liveliness()
        graph = live.declare_subscriber(f"{ADMIN}/{self.domain}/**", heard, history=True)
        late = self.qos.transient_local
        end: Any
        if self.kind == PUBLISHER:
            self._publisher = end = ext.declare_advanced_publisher(
                *(session, key),
                # Never block the actuator's thread, on which the watchdog runs.
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
                cache=ext.CacheConfig(max_samples=depth) if late else None,
                publisher_detection=late,
            )
        else:
            taken = zenoh.handlers.Callback(self._taken, indirect=False)
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=depth)
            end = ext.declare_advanced_subscriber(
                session, key, taken, history=history if late else None
            )
        tokens = [live.declare_token(name) for name in (node.token(), token)]
        self._declared = [graph, end, *tokens]

    def _look(self) -> None:
        """Look at the connections and at the graph."""
        session = self._session
        if session is None:
            return
        info = session.info
        connected = bool(info.routers_zid() or info.peers_zid())
        where = self.settings.connect or ROUTER
        self.trouble = "" if connected else f"no router at {where}, and no other peer"
        # A connection within a computer has one address at both ends.
        self._here = {
            str(link.zid) for link in info.links() if _address(link.src) == _address(link.dst)
        }
        others = self.others
        self.faults = tuple(matching.faults(self.endpoint, others))
        self.notes = tuple(matching.notes(self.endpoint, others))
        for line in (*self.faults, *self.notes):
            self.warn(line)

    @property
    def note(self) -> str:
        """Trouble, or else faults and notes, with the topic; empty if there are none."""
        note = self.trouble or "; ".join((*self.faults, *self.notes))
        return note and f"{self.settings.resolved}: {note}"

    @property
    def others(self) -> list[RosEndpoint]:
        """Other endpoints of the topic."""
        with self._lock:
            return list(self._others.values())

    @property
    def has_match(self) -> bool:
        """Whether an endpoint of the other kind has the same topic, type and hash."""
        return any(matching.matches(self.endpoint, one) for one in self.others)

    @property
    def is_local(self) -> bool:
        """Whether all matching endpoints are known to be on this computer."""
        zids = {one.node.zid for one in self.others if matching.matches(self.endpoint, one)}
        return bool(zids) and zids <= self._here

    def _heard(self, sample: zenoh.Sample) -> None:
        """Take a token that begins or ends."""
        import zenoh

        key = str(sample.key_expr)
        try:
            found = read_token(key)
        except ValueError as error:
            self.warn(f"an unusable token, {key[:300]}: {error}")
            return
        node = found.node if isinstance(found, RosEndpoint) else found
        if isinstance(found, RosNode) or node.zid == self.endpoint.node.zid:
            return
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._others.pop(key, None)
            elif found.topic.name == self.topic.name:
                self._others[key] = found

    # ------------------------------------------------------------------------ messages

    def _taken(self, sample: zenoh.Sample) -> None:
        """Pass a message on; drop it without its attachment."""
        attachment = sample.attachment
        try:
            if attachment is None:
                raise LiveError("a message without an attachment: no ROS node has sent it")
            about = Attachment.read(attachment.to_bytes())
        except LiveError as error:
            self.warn(f"{self.topic.name}: {error}; it is dropped")
            return
        if self._receive is not None:
            self._receive(sample, about)

    def put(self, data: bytes, sent_ns: int) -> None:
        """Publish a message; `sent_ns` is the time of day.

        Raises a LiveError while the session has neither a router nor a peer: Zenoh drops the
        message then without an error.
        """
        if self.trouble or self._publisher is None:
            raise LiveError(f"{self.settings.resolved}: {self.trouble}")
        self._sequence += 1
        attachment = Attachment(self._sequence, sent_ns, self._gid).pack()
        self._publisher.put(data, attachment=attachment)

    def require_match(self) -> None:
        """Raise a LiveError unless a subscription matches."""
        if not self.trouble and not self.has_match:
            why = f"; {self.faults[0]}" if self.faults else ""
            raise LiveError(f"{self.settings.resolved}: no subscription{why}")

    def warn(self, line: str) -> None:
        """Log a line once."""
        if line not in self._warned and len(self._warned) < _MOST_WARNINGS:
            self._warned.add(line)
            _LOG.warning("%s", line)


def _address(locator: str) -> str:
    """Return the host of a locator, as 127.0.0.1 of tcp/127.0.0.1:7447."""
    return locator.partition("/")[2].rpartition(":")[0]
