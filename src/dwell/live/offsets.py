"""Offsets of the nodes' clocks from a reference node's, with the bounds of their errors.

No message arrives before it was sent. A message from a to b that was sent at s on a's clock and
arrived at r on b's says that b's clock is at most r - s ahead of a's; one from b to a bounds it
from below. The messages with the least delay give the tightest bounds, and the interval between
them is as wide as the best round trip (D. L. Mills, 1991, DOI 10.1109/26.103043, takes its middle).
It holds whatever the delays are, however unequal the two directions.

Beats carry all this: when they were sent, and when their sender heard the last beat of others. A
process that hears every beat of a cell therefore compares all its clocks, also those of two other
nodes. All processes of a node read the same clock.

Clocks drift. Between two samples the interval grows at the rate at which the clocks may part: at
first the sum of what two bad oscillators do, later what the intervals of the last two minutes leave
possible (K. Marzullo and S. Owicki, 1983, DOI 10.1145/800221.806730), widened by what an
oscillator's rate changes in that time. So an old sample with a small delay counts until a new one
is better, on a link that is silent the last bound is carried, and wrong clocks are found out: where
samples contradict one another, a clock was set or its computer restarted, and it all begins anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

from dwell.live.continuity import OvershootDetector
from dwell.live.messages import Beat
from dwell.model.instants import NEVER_NS

#: Bound of an instant that could be anything.
UNBOUNDED_NS = 1 << 62

#: Two clocks that are each within 100 ppm of true time part by no more than this.
MAX_DRIFT_PPB = 200_100
#: What the rate between two clocks changes within `MEMORY_NS`: temperature, not age.
WANDER_PPB = 10_000
#: Intervals of the past that the rate is bounded by: how far back, and how far apart.
MEMORY_NS = 120_000_000_000
ANCHOR_NS = 2_000_000_000

#: Nodes whose clocks are compared; what names more of them is none of the cell's.
MAX_NODES = 64
#: Processes whose last beats are remembered.
MAX_SENDERS = 1_024

PPB = 1_000_000_000


class Instant(NamedTuple):
    """An instant on another clock, and how far from it the true one may be.

    Parameters
    ----------
    bound_ns : int
        `UNBOUNDED_NS` where messages have not gone both ways yet.
    """

    instant_ns: int
    bound_ns: int


#: Lowest and highest, where they are known.
_Interval: TypeAlias = tuple[int | None, int | None]


class _Pair:
    """Offset of clock b from clock a, as an interval that moves with a's time."""

    __slots__ = (
        *("_overshoot", "anchors", "breaks", "fastest"),
        *("high_ns", "low_ns", "slowest", "t_ns"),
    )

    def __init__(self) -> None:
        self.breaks = -1
        self._overshoot = OvershootDetector()
        self._begin(0)

    def _begin(self, t_ns: int) -> None:
        self.breaks += 1
        self.t_ns = t_ns
        self.low_ns: int | None = None
        self.high_ns: int | None = None
        self.slowest, self.fastest = -MAX_DRIFT_PPB, MAX_DRIFT_PPB
        self.anchors: deque[tuple[int, int, int]] = deque()

    @property
    def known(self) -> bool:
        """Whether anything has been heard."""
        return self.low_ns is not None or self.high_ns is not None

    def at_most(self, t_ns: int, value_ns: int) -> None:
        """At `t_ns` the offset was no more than this."""
        value_ns = self._reach(t_ns, value_ns, self.fastest, self.slowest)
        if self.low_ns is not None and value_ns < self.low_ns:
            self._begin(t_ns)
        if self.high_ns is None or value_ns < self.high_ns:
            self.high_ns = value_ns

    def at_least(self, t_ns: int, value_ns: int) -> None:
        """At `t_ns` the offset was no less than this."""
        value_ns = -self._reach(t_ns, -value_ns, -self.slowest, -self.fastest)
        if self.high_ns is not None and value_ns > self.high_ns:
            self._begin(t_ns)
        if self.low_ns is None or value_ns > self.low_ns:
            self.low_ns = value_ns

    def _reach(self, t_ns: int, value_ns: int, fastest: int, slowest: int) -> int:
        """Bring the interval and an upper bound at `t_ns` to the same instant, the later one."""
        if self.low_ns is None and self.high_ns is None:
            self.t_ns = t_ns
        if t_ns >= self.t_ns:
            self._overshoot.advanced()
            self._advance(t_ns)
            return value_ns
        if t_ns >= self.t_ns - MEMORY_NS:
            self._overshoot.advanced()
        elif self._overshoot.behind(t_ns):
            # No message is that late: the instant that was believed was false.
            self._begin(t_ns)
            self._advance(t_ns)
            return value_ns
        return value_ns + _grown(self.t_ns - t_ns, fastest, slowest)

    def _advance(self, t_ns: int) -> None:
        self.low_ns, self.high_ns = self.at(t_ns)
        self.t_ns = t_ns
        anchors = self.anchors
        if self.low_ns is None or self.high_ns is None:
            return
        while anchors and t_ns - anchors[0][0] > MEMORY_NS:
            anchors.popleft()
        if anchors and t_ns - anchors[-1][0] < ANCHOR_NS:
            return
        self.slowest = max(
            [
                (self.low_ns - high_ns) * PPB // (t_ns - then_ns) - WANDER_PPB
                for then_ns, _, high_ns in anchors
            ],
            default=-MAX_DRIFT_PPB,
        )
        self.fastest = min(
            [
                -((low_ns - self.high_ns) * PPB // (t_ns - then_ns)) + WANDER_PPB
                for then_ns, low_ns, _ in anchors
            ],
            default=MAX_DRIFT_PPB,
        )
        self.slowest = max(self.slowest, -MAX_DRIFT_PPB)
        self.fastest = min(self.fastest, MAX_DRIFT_PPB)
        anchors.append((t_ns, self.low_ns, self.high_ns))
        if self.slowest > self.fastest:
            self._begin(t_ns)

    def at(self, t_ns: int) -> _Interval:
        """Return the interval at an instant of a's clock, past or to come."""
        low_ns, high_ns, span_ns = self.low_ns, self.high_ns, t_ns - self.t_ns
        if span_ns == 0:
            return low_ns, high_ns
        slowest, fastest = self.slowest, self.fastest
        if abs(span_ns) > MEMORY_NS:
            slowest, fastest = -MAX_DRIFT_PPB, MAX_DRIFT_PPB
        if span_ns < 0:
            slowest, fastest = fastest, slowest
        return (
            None if low_ns is None else low_ns - (span_ns * -slowest // PPB + 1),
            None if high_ns is None else high_ns + (span_ns * fastest // PPB + 1),
        )


def _grown(span_ns: int, fastest: int, slowest: int) -> int:
    """Most that an offset can have grown by over a span; backwards, most that it was above."""
    if span_ns == 0:
        return 0
    rate = fastest if span_ns > 0 else slowest
    return span_ns * rate // PPB + 1


class Offsets:
    """Offsets of the clocks of a cell's nodes against that of a reference node.

    Parameters
    ----------
    node : str
        Whose clock this process reads.
    reference : str
        Whose clock instants are converted to.
    system_bound_ns : int, optional
        Clocks are kept synchronous by others (PTP, chrony) to within this: nothing is estimated,
        all offsets are zero. The clocks are estimated where None.
    """

    def __init__(self, node: str, reference: str, *, system_bound_ns: int | None = None) -> None:
        self.node = node
        self.reference = reference
        self._system_bound_ns = system_bound_ns
        self._pairs: dict[tuple[str, str], _Pair] = {}
        self._known: set[str] = set()
        #: By its sender: when the last beat that came here was sent.
        self._said_ns: dict[str, int] = {}

    def hear(self, beat: Beat, at_ns: int) -> None:
        """Take in a beat that arrived here; copies and late ones do no harm.

        Parameters
        ----------
        at_ns : int
            When it arrived, on this node's clock.
        """
        self.sample(beat.node, self.node, beat.sent_ns, at_ns)
        # What its sender had heard by its last beat, that has said, unless its clock has gone back.
        said_ns = self._said_ns.get(beat.who, -NEVER_NS)
        again_ns = said_ns if said_ns < beat.sent_ns else -NEVER_NS
        if len(self._said_ns) > MAX_SENDERS:
            self._said_ns.clear()
        self._said_ns[beat.who] = beat.sent_ns
        for heard in beat.heard:
            if heard.at_ns > again_ns and heard.node != beat.node:
                self.sample(heard.node, beat.node, heard.beat_ns, heard.at_ns)

    def sample(self, source: str, target: str, sent_ns: int, arrived_ns: int) -> None:
        """Take in one message between two nodes, each instant on its own node's clock."""
        if source == target or self._system_bound_ns is not None:
            return
        ends = (source, target) if source < target else (target, source)
        pair = self._pairs.get(ends)
        if pair is None:
            if len(self._known.union(ends)) > MAX_NODES:
                return
            pair = self._pairs[ends] = _Pair()
            self._known.update(ends)
        if source < target:
            pair.at_most(sent_ns, arrived_ns - sent_ns)
        else:
            pair.at_least(arrived_ns, sent_ns - arrived_ns)

    @property
    def breaks(self) -> int:
        """How often clocks contradicted themselves: they were set, or their node restarted."""
        return sum(pair.breaks for pair in self._pairs.values())

    def to_reference(self, node: str, instant_ns: int) -> Instant:
        """Convert an instant of a node's clock to the reference's.

        Returns
        -------
        Instant
            With `UNBOUNDED_NS` the clocks have not been compared both ways: it is the best guess
            where they have been one way, else the same number.
        """
        return self._convert(node, self.reference, instant_ns)

    def from_reference(self, node: str, instant_ns: int) -> Instant:
        """Convert an instant of the reference's clock to a node's (see `to_reference`)."""
        return self._convert(self.reference, node, instant_ns)

    def _convert(self, node: str, to: str, instant_ns: int) -> Instant:
        if node == to:
            return Instant(instant_ns, 0)
        if self._system_bound_ns is not None:
            return Instant(instant_ns, self._system_bound_ns)
        low_ns, high_ns = self._between(node, to, instant_ns)
        if low_ns is not None and high_ns is not None:
            # Both paths bound the same instant: so does what they have in common.
            for other_low_ns, other_high_ns in self._through_others(node, to, instant_ns):
                if other_low_ns <= high_ns and other_high_ns >= low_ns:
                    low_ns, high_ns = max(low_ns, other_low_ns), min(high_ns, other_high_ns)
                elif other_high_ns - other_low_ns < high_ns - low_ns:
                    low_ns, high_ns = other_low_ns, other_high_ns
            return _middle(low_ns, high_ns)
        through = list(self._through_others(node, to, instant_ns))
        if through:
            return _middle(*min(through, key=lambda bounds: bounds[1] - bounds[0]))
        guess_ns = low_ns if low_ns is not None else high_ns
        return Instant(instant_ns if guess_ns is None else guess_ns, UNBOUNDED_NS)

    def _through_others(self, node: str, to: str, instant_ns: int) -> Iterator[tuple[int, int]]:
        for third in self._known:
            if third in (node, to):
                continue
            low_ns, high_ns = self._between(node, third, instant_ns)
            if low_ns is None or high_ns is None:
                continue
            there_ns = (low_ns + high_ns) // 2
            begin_ns, end_ns = self._between(third, to, there_ns)
            if begin_ns is None or end_ns is None:
                continue
            unsure_ns = _parted(high_ns - low_ns)
            yield (
                begin_ns - (there_ns - low_ns) - unsure_ns,
                end_ns + (high_ns - there_ns) + unsure_ns,
            )

    def _between(self, node: str, to: str, instant_ns: int) -> _Interval:
        """Bounds of an instant of a node's clock on that of another, directly compared."""
        if node < to:
            pair = self._pairs.get((node, to))
            if pair is None:
                return None, None
            low_ns, high_ns = pair.at(instant_ns)
            return (
                None if low_ns is None else instant_ns + low_ns,
                None if high_ns is None else instant_ns + high_ns,
            )
        pair = self._pairs.get((to, node))
        if pair is None or not pair.known:
            return None, None
        # Where we are on the other clock is what is asked for; the second guess is near enough.
        guess_ns = instant_ns - _any_of(pair.low_ns, pair.high_ns)
        guess_ns = instant_ns - _any_of(*pair.at(guess_ns))
        low_ns, high_ns = pair.at(guess_ns)
        unsure_ns = 0 if low_ns is None or high_ns is None else _parted(high_ns - low_ns)
        return (
            None if high_ns is None else instant_ns - high_ns - unsure_ns,
            None if low_ns is None else instant_ns - low_ns + unsure_ns,
        )


def _any_of(low_ns: int | None, high_ns: int | None) -> int:
    """Take the middle of an interval, or the end that is known."""
    if low_ns is None:
        return high_ns or 0
    return low_ns if high_ns is None else (low_ns + high_ns) // 2


def _parted(span_ns: int) -> int:
    """Most that two clocks part by in a span."""
    return span_ns * MAX_DRIFT_PPB // PPB + 1


def _middle(low_ns: int, high_ns: int) -> Instant:
    """Take the middle of an interval, and half its width as the bound."""
    bound_ns = (high_ns - low_ns + 1) // 2
    return Instant(low_ns + (high_ns - low_ns) // 2, bound_ns)
