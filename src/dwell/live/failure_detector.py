"""Failure detector: whose beats have come lately, directly or over the detour.

Every process sends a beat each period. A beat says which beats of others its sender heard last, so
that a node learns of links that it is no end of, and clocks can be compared (see `offsets`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dwell.live.continuity import LATENESS_NS, Retreat
from dwell.live.messages import Beat, Heard

__all__ = ["FailureDetector"]


@dataclass(slots=True)
class _Voice:
    """The last that was heard of a process."""

    beat: Beat
    at_ns: int
    direct_ns: int | None = None
    direct_beat_ns: int = 0
    retreat: Retreat = field(default_factory=Retreat)


class FailureDetector:
    """Beats as one process has heard them.

    Parameters
    ----------
    who : str
        The process that listens.
    patience_ns : int
        Age beyond which what was heard counts no more; g periods.
    """

    def __init__(self, who: str, patience_ns: int) -> None:
        self.who = who
        self.patience_ns = patience_ns
        self._voices: dict[str, _Voice] = {}

    def hear(self, beat: Beat, now_ns: int, *, direct: bool = True) -> bool:
        """Take a beat in; False if it is no news: an older one, or its second copy."""
        if beat.who == self.who:
            return False
        voice, order = self._voices.get(beat.who), (beat.life, beat.sent_ns)
        if voice is None:
            voice = self._voices[beat.who] = _Voice(beat, now_ns)
        else:
            last = voice.beat.life, voice.beat.sent_ns
            news = order > ((last[0], voice.direct_beat_ns) if direct else last)
            if order > last:
                voice.retreat.advanced()
                voice.beat, voice.at_ns = beat, now_ns
            elif (
                direct and order < (last[0], last[1] - LATENESS_NS) and voice.retreat.behind(*order)
            ):
                # A connection keeps the order: what was believed was false.
                voice.beat, voice.at_ns = beat, now_ns
            elif not news:
                return False
        if direct:
            voice.direct_ns, voice.direct_beat_ns = now_ns, beat.sent_ns
        return True

    def last(self, who: str) -> Beat | None:
        """Return the last beat of a process, however old."""
        voice = self._voices.get(who)
        return voice.beat if voice is not None else None

    def age_ns(self, who: str, now_ns: int) -> int | None:
        """Time since a process was last heard; None if never."""
        voice = self._voices.get(who)
        return now_ns - voice.at_ns if voice is not None else None

    def fresh(self, who: str, now_ns: int, patience_ns: int | None = None) -> bool:
        """Whether a process was heard within the patience."""
        age_ns = self.age_ns(who, now_ns)
        limit = self.patience_ns if patience_ns is None else patience_ns
        return age_ns is not None and age_ns <= limit

    def heard(self) -> tuple[Heard, ...]:
        """Return what the next beat says: the last direct beat of everybody."""
        return tuple(
            Heard(who, voice.beat.node, voice.direct_beat_ns, voice.direct_ns)
            for who, voice in self._voices.items()
            if voice.direct_ns is not None
        )

    def forget(self, now_ns: int, after_ns: int) -> None:
        """Forget who has been silent for longer than `after_ns`."""
        for who in [who for who, v in self._voices.items() if now_ns - v.at_ns > after_ns]:
            del self._voices[who]

    def everybody(self, now_ns: int) -> list[tuple[str, Beat, int]]:
        """Return who was heard: name, last beat, and its age."""
        return [(who, v.beat, now_ns - v.at_ns) for who, v in self._voices.items()]
