"""Failure detector: age of the last beat of each process, received directly or over the detour.

Every process makes one beat per period, which its agent sends. A beat lists the last beats that
its maker has received. With this list other nodes detect failed links, and compare clocks (see
`offsets`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dwell.live.wire.continuity import LATENESS_NS, OvershootDetector
from dwell.live.wire.messages import Beat, Heard


@dataclass(slots=True)
class _HeardProcess:
    """Last beat of a process."""

    beat: Beat
    at_ns: int
    direct_ns: int | None = None
    direct_beat_ns: int = 0
    overshoot: OvershootDetector = field(default_factory=OvershootDetector)

    def age_ns(self, now_ns: int) -> int:
        """Time since the last beat, or since the clock was set back."""
        self.at_ns = min(self.at_ns, now_ns)
        return now_ns - self.at_ns


class FailureDetector:
    """Beats received by a process; they are fresh for `patience_ns` (g periods)."""

    def __init__(self, who: str, patience_ns: int) -> None:
        self.who = who
        self.patience_ns = patience_ns
        self._processes: dict[str, _HeardProcess] = {}
        self._joined_ns: int | None = None

    def hear(self, beat: Beat, now_ns: int, *, direct: bool = True) -> bool:
        """Process a beat; return False if it is an old beat or a second copy."""
        if beat.who == self.who:
            return False
        process, order = self._processes.get(beat.who), (beat.life, beat.sent_ns)
        if process is None:
            process = self._processes[beat.who] = _HeardProcess(beat, now_ns)
            self._joined_ns = now_ns
        else:
            last = process.beat.life, process.beat.sent_ns
            news = order > ((last[0], process.direct_beat_ns) if direct else last)
            if order > last:
                process.overshoot.advanced()
                process.beat, process.at_ns = beat, now_ns
            elif (
                (direct or process.direct_ns is None)
                and order < (last[0], last[1] - LATENESS_NS)
                and process.overshoot.behind(*order)
            ):
                # A connection keeps the order of beats, and so does the detour if there is no
                # direct connection. The last beat was false, or its node's clock was set back.
                process.beat, process.at_ns = beat, now_ns
            elif not news:
                return False
        if direct:
            process.direct_ns, process.direct_beat_ns = now_ns, beat.sent_ns
        return True

    def last(self, who: str) -> Beat | None:
        """Return the last beat of a process, however old."""
        process = self._processes.get(who)
        return process.beat if process is not None else None

    def age_ns(self, who: str, now_ns: int) -> int | None:
        """Time since the last beat of a process; None before its first beat."""
        process = self._processes.get(who)
        return process.age_ns(now_ns) if process is not None else None

    def direct_age_ns(self, who: str, now_ns: int) -> int | None:
        """Time since the last direct beat of a process; None before its first direct beat."""
        process = self._processes.get(who)
        at_ns = None if process is None else process.direct_ns
        return None if at_ns is None else now_ns - at_ns

    def joined_age_ns(self, now_ns: int) -> int | None:
        """Time since the last process sent its first beat; None before the first beat."""
        if self._joined_ns is None:
            return None
        self._joined_ns = min(self._joined_ns, now_ns)
        return now_ns - self._joined_ns

    def fresh(self, who: str, now_ns: int, patience_ns: int | None = None) -> bool:
        """Whether the last beat of a process is at most `patience_ns` old."""
        age_ns = self.age_ns(who, now_ns)
        limit = self.patience_ns if patience_ns is None else patience_ns
        return age_ns is not None and age_ns <= limit

    def heard(self, now_ns: int) -> tuple[Heard, ...]:
        """Return the last direct beats of at most twice `patience_ns` ago, for the next beat."""
        return tuple(
            Heard(who, process.beat.node, process.direct_beat_ns, process.direct_ns)
            for who, process in self._processes.items()
            if process.direct_ns is not None
            and 0 <= now_ns - process.direct_ns <= 2 * self.patience_ns
        )

    def everybody(self, now_ns: int) -> list[tuple[str, Beat, int]]:
        """Return name, last beat and its age of every process."""
        return [(who, v.beat, v.age_ns(now_ns)) for who, v in self._processes.items()]
