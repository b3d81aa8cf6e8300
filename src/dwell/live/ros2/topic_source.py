"""Source: a stage whose frames are the messages of a ROS topic."""

from __future__ import annotations

import statistics
import threading
import time
from collections import deque
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from dwell.errors import LiveError
from dwell.live.ros2.images import COMPRESSED, IMAGE, read_compressed, read_image, stamp_ns
from dwell.live.ros2.rmw_zenoh import SUBSCRIPTION, Attachment, Profile
from dwell.live.ros2.ros_session import RosSession
from dwell.live.stage import CellStage, Message, StagePlace, StageReport, TopicRates
from dwell.live.wire.wiring import SPARE, longest_bytes
from dwell.model.ros_topics import RosTopic

if TYPE_CHECKING:
    import zenoh

#: Messages over which rate and jitter are taken.
_RECENT = 64
#: Publishers whose sequence numbers are remembered.
_MOST_PUBLISHERS = 16
#: Least silence of a topic after which its task is not ready.
SILENT_NS = 500_000_000


class Source(CellStage):
    """A stage whose jobs pass on the newest message of a ROS topic.

    Images arrive as arrays, compressed images as the bytes of their format, all other types as
    their CDR bytes (`dwell.ros2.decode`). A message that arrived more than ``live.max_age_ms``
    ago is not passed on: the job fails.

    Parameters
    ----------
    topic : str
        As ``/camera/image_raw``.
    type : str
        As ``sensor_msgs/msg/Image``.
    qos : str
        ``default``, ``sensor_data`` or ``transient_local``.
    **options
        Further keys of `tasks.NAME.ros2` in a cell file.
    """

    def __init__(self, topic: str, type: str, qos: Profile = "default", **options: Any) -> None:
        self.settings = RosTopic(topic, type, qos=qos, **options)
        self._place = StagePlace()
        self._changed = threading.Condition()
        self._newest: tuple[bytes, int] | None = None
        self._count = self._waited = 0
        self._stopped = False
        self._arrivals: deque[int] = deque(maxlen=_RECENT)
        self._sequences: dict[bytes, int] = {}
        self._lost = 0
        self._began_ns = 0
        self._stamp_age_ns: int | None = None
        self._session: RosSession | None = None

    def placed(self, place: StagePlace) -> None:
        """Take the name of the ROS node and the limits of messages."""
        self._place = place

    def check(self) -> None:
        """Raise a LiveError if the type is unknown, or a package is missing."""
        RosSession(self.settings, SUBSCRIPTION, self._place).prepare()

    def start(self) -> None:
        """Open the session; without a router it is tried again."""
        self._session = RosSession(self.settings, SUBSCRIPTION, self._place, self._arrived)
        self._session.prepare()
        self._session.open()
        self._stamped = self._session.types.is_stamped(self.settings.type)
        self._began_ns = time.monotonic_ns()

    def stop(self) -> None:
        """Close the session."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._session is not None:
            self._session.close()

    def _arrived(self, sample: zenoh.Sample, about: Attachment) -> None:
        """Keep a message as the newest one."""
        length, longest = len(sample.payload), longest_bytes(self._place.payload_bytes)
        session = self._session
        if length > longest and session is not None:
            session.warn(
                f"{self.settings.resolved}: a message of {length} bytes is dropped; at most "
                f"{longest} are taken: raise the flow's bytes, {SPARE} times which may arrive"
            )
            return
        data, now_ns = sample.payload.to_bytes(), time.monotonic_ns()
        with self._changed:
            last = self._sequences.pop(about.gid, None)
            self._lost += max(about.sequence - last - 1, 0) if last is not None else 0
            self._sequences[about.gid] = about.sequence
            if len(self._sequences) > _MOST_PUBLISHERS:
                del self._sequences[next(iter(self._sequences))]
            self._arrivals.append(now_ns)
            self._newest, self._count = (data, now_ns), self._count + 1
            if self._stamped and len(data) >= 12:
                self._stamp_age_ns = time.time_ns() - stamp_ns(data)
            self._changed.notify_all()

    def wait(self) -> None:
        """Wait for a message."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._count > self._waited)
            self._waited = self._count
        if self._stopped:
            raise LiveError(f"{self.settings.resolved}: stopped")

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the newest message; raise a LiveError if it is too old."""
        newest = self._newest
        age_ms = self._age_ms(newest)
        if newest is None or age_ms > self._place.max_age_ms:
            raise LiveError(f"{self.settings.resolved}: {self._silence(age_ms)}")
        data = newest[0]
        if self.settings.type == IMAGE:
            payload: object = read_image(data)
        else:
            payload = read_compressed(data) if self.settings.type == COMPRESSED else data
        return Message(payload, stamp_ns=stamp_ns(data) if self._stamped else None)

    def _age_ms(self, newest: tuple[bytes, int] | None) -> float:
        since_ns = self._began_ns if newest is None else newest[1]
        return (time.monotonic_ns() - since_ns) / 1e6

    def _silence(self, age_ms: float) -> str:
        session = self._session
        why = (session.trouble, *session.faults) if session is not None else ()
        because = "; ".join(filter(None, why)) or (
            "" if session is not None and session.has_match else "no publisher"
        )
        return f"no message for {age_ms / 1e3:.1f} s{f': {because}' if because else ''}"

    def report(self) -> StageReport:
        """Report silence as not ready, and the rates of the topic."""
        session, newest = self._session, self._newest
        if session is None:
            return StageReport()
        age_ms = self._age_ms(newest)
        silent = newest is None or age_ms > max(self._place.max_age_ms, SILENT_NS / 1e6)
        note = f"{self.settings.resolved}: {self._silence(age_ms)}" if silent else session.note
        return StageReport(not silent, note, self.rates())

    def rates(self) -> TopicRates:
        """Return the rate of the topic, its jitter, and its lost messages."""
        with self._changed:
            arrivals, newest, lost = list(self._arrivals), self._newest, self._lost
        gaps_ms = [(later - one) / 1e6 for one, later in pairwise(arrivals)]
        age_ms = self._age_ms(newest) if newest is not None else None
        rate_hz = jitter_ms = 0.0
        if gaps_ms and age_ms is not None:
            # After the last message the rate falls, as if the next came now.
            rate_hz = 1e3 / max(statistics.fmean(gaps_ms), age_ms / len(gaps_ms), 1e-6)
            jitter_ms = statistics.pstdev(gaps_ms)
        is_local = self._session is not None and self._session.is_local
        stamp_ms = None
        if self._stamp_age_ns is not None and (is_local or self._place.is_system_clock):
            stamp_ms = self._stamp_age_ns / 1e6
        return TopicRates(self.settings.resolved, rate_hz, jitter_ms, lost, age_ms, stamp_ms)
