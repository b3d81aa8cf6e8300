"""Sink: an actuator that publishes commands on a ROS topic."""

from __future__ import annotations

import time
from typing import Any

from dwell.errors import LiveError
from dwell.live.ros2.images import with_stamp
from dwell.live.ros2.rmw_zenoh import PUBLISHER, Profile
from dwell.live.ros2.ros_session import RosSession
from dwell.live.stage import CellActuator, Message, StagePlace, StageReport
from dwell.model.ros_topics import RosCommands


class Sink(CellActuator):
    """An actuator that publishes each command: CDR bytes, or a struct with the type's fields.

    `hold` publishes nothing: the robot's own watchdog acts. A message whose type begins
    with a header gets the stamp of the oldest ROS source behind the command.

    Parameters
    ----------
    topic : str
        As ``/cmd_vel``.
    type : str
        As ``geometry_msgs/msg/Twist``.
    zero : mapping, optional
        Fields of the message that `zero` publishes; missing fields are zero. Only Twist and
        TwistStamped have one by default.
    qos : str
        ``default``, ``sensor_data`` or ``transient_local``.
    **options
        Further keys of `ros2` of an actuator in a cell file.
    """

    def __init__(
        self,
        topic: str,
        type: str,
        zero: Any = None,
        qos: Profile = "default",
        **options: Any,
    ) -> None:
        self.settings = RosCommands(topic, type, zero=zero, qos=qos, **options)
        self.stamp_from = self.settings.stamp_from or ""
        self._place = StagePlace()
        self._session: RosSession | None = None
        self._zero: bytes | None = None

    def placed(self, place: StagePlace) -> None:
        """Take the name of the ROS node."""
        self._place = place

    def check(self) -> None:
        """Raise a LiveError if the type or the zero message is unusable, or a package missing."""
        self._prepared()

    def _prepared(self) -> RosSession:
        session, settings = RosSession(self.settings, PUBLISHER, self._place), self.settings
        session.prepare()
        self._stamped = session.types.is_stamped(settings.type)
        if settings.stops:
            self._zero = session.types.encode(settings.zero or {}, settings.type)
        return session

    def start(self) -> None:
        """Open the session; without a router it is tried again."""
        self._session = self._prepared()
        self._session.open()

    def stop(self) -> None:
        """Close the session."""
        if self._session is not None:
            self._session.close()

    def apply(self, command: Message) -> None:
        """Publish a command; raise a LiveError if nothing can receive it."""
        session, payload = self._opened, command.payload
        if self.settings.require_subscriber:
            session.require_match()
        data = payload
        if not isinstance(payload, bytes):
            data = session.types.encode(payload, self.settings.type)
        if self._stamped and command.stamp_ns is not None:
            data = with_stamp(data, command.stamp_ns)
        session.put(data, time.time_ns())

    def hold(self) -> None:
        """Publish nothing."""

    def zero(self) -> None:
        """Publish the zero message, if there is one."""
        if self._zero is not None:
            self._opened.put(self._zero, time.time_ns())

    @property
    def _opened(self) -> RosSession:
        if self._session is None:
            raise LiveError(f"{self.settings.resolved}: start() was not called")
        return self._session

    def report(self) -> StageReport:
        """Report a missing router as not ready."""
        session = self._session
        return StageReport() if session is None else StageReport(not session.trouble, session.note)
