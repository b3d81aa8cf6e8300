"""Failure detector: whose beats have come lately, directly or over the detour.

Every process sends a beat each period. A beat says which beats of others its sender heard last, so
that a node learns of links that it is no end of, and clocks can be compared (see `offsets`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dwell.live.wire.continuity import LATENESS_NS, OvershootDetector
from dwell.live.wire.messages import Beat, Heard


@dataclass(slots=True)
class _HeardProcess:
    """The last that was heard of a process."""

    beat: Beat
    at_ns: int
    direct_ns: int | None = None
    direct_beat_ns: int = 0
    overshoot: OvershootDetector = field(default_factory=OvershootDetector)

    def age_ns(self, now_ns: int) -> int:
        """Time since it was heard; where the clock has been set back, since then."""
        self.at_ns = min(self.at_ns, now_ns)
        return now_ns - self.at_ns


class FailureDetector:
    """Beats as one process has heard them.

    Parameters
    ----------
    patience_ns : int
        Age beyond which what was heard counts no more; g periods.
    """

    def __init__(self, who: str, patience_ns: int) -> None:
        self.who = who
        self.patience_ns = patience_ns
        self._processes: dict[str, _HeardProcess] = {}
        self._joined_ns: int | None = None

    def hear(self, beat: Beat, now_ns: int, *, direct: bool = True) -> bool:
        """Take a beat in; False if it is no news: an older one, or its second copy."""
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
                # A connection keeps the order, and so does the detour where all comes over it:
                # what was believed was false, or its node's clock has been set back.
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
        """Time since a process was last heard; None if never."""
        process = self._processes.get(who)
        return process.age_ns(now_ns) if process is not None else None

    def joined_age_ns(self, now_ns: int) -> int | None:
        """Time since somebody was heard for the first time; None if nobody was."""
        if self._joined_ns is None:
            return None
        self._joined_ns = min(self._joined_ns, now_ns)
        return now_ns - self._joined_ns

    def fresh(self, who: str, now_ns: int, patience_ns: int | None = None) -> bool:
        """Whether a process was heard within the patience."""
        age_ns = self.age_ns(who, now_ns)
        limit = self.patience_ns if patience_ns is None else patience_ns
        return age_ns is not None and age_ns <= limit

    def heard(self) -> tuple[Heard, ...]:
        """Return what the next beat says: the last direct beat of everybody."""
        return tuple(
            Heard(who, process.beat.node, process.direct_beat_ns, process.direct_ns)
            for who, process in self._processes.items()
            if process.direct_ns is not None
        )

    def everybody(self, now_ns: int) -> list[tuple[str, Beat, int]]:
        """Return who was heard: name, last beat, and its age."""
        return [(who, v.beat, v.age_ns(now_ns)) for who, v in self._processes.items()]
