"""Offsets of the nodes' clocks from a reference node's, with the bounds of their errors.

No message arrives before it was sent. A message from a to b that was sent at s on a's clock and
arrived at r on b's says that b's clock is at most r - s ahead of a's; one from b to a bounds it
from below. The messages with the least delay give the tightest bounds, and the interval between
them is as wide as the best round trip (D. L. Mills, 1991, DOI 10.1109/26.103043, takes its middle).
It holds whatever the delays are, however unequal the two directions.

Beats carry all this: when they were sent, and when their sender heard the last beat of others. A
process that hears every beat of a cell therefore compares all its clocks with the reference's. All
processes of a node read the same clock.

Clocks drift. Between two samples the interval grows at the rate at which two bad oscillators part.
So an old sample with a small delay counts until a new one is better, on a link that is silent the
last bound is carried, and wrong clocks are found out: where samples contradict one another, a clock
was set or its computer restarted, and it all begins anew.
"""

from __future__ import annotations

from typing import NamedTuple

from dwell.live.wire.continuity import OvershootDetector
from dwell.live.wire.messages import Beat
from dwell.model.instants import NEVER_NS

#: Bound of an instant that could be anything.
UNBOUNDED_NS = 1 << 62

#: Two clocks that are each within 100 ppm of true time part by no more than this.
MAX_DRIFT_PPB = 200_100
PPB = 1_000_000_000
#: No message is later than this.
LATE_NS = 120_000_000_000

#: Nodes whose clocks are compared; what names more of them is none of the cell's.
MAX_NODES = 64
#: Processes whose last beats are remembered.
MAX_SENDERS = 1_024


class Instant(NamedTuple):
    """An instant on another clock, and how far from it the true one may be.

    Parameters
    ----------
    bound_ns : int
        `UNBOUNDED_NS` where messages have not gone both ways yet.
    """

    instant_ns: int
    bound_ns: int


class _Pair:
    """Offset of a node's clock from the reference's, as an interval that moves with its time."""

    def __init__(self) -> None:
        self.breaks = -1
        self._overshoot = OvershootDetector()
        self._begin(-NEVER_NS)

    def _begin(self, t_ns: int) -> None:
        self.breaks += 1
        self.t_ns = t_ns
        self.low_ns, self.high_ns = -UNBOUNDED_NS, UNBOUNDED_NS

    def at_most(self, t_ns: int, value_ns: int) -> None:
        """At `t_ns` the offset was no more than this."""
        value_ns += self._reach(t_ns)
        if value_ns < self.low_ns:
            self._begin(t_ns)
        self.high_ns = min(self.high_ns, value_ns)

    def at_least(self, t_ns: int, value_ns: int) -> None:
        """At `t_ns` the offset was no less than this."""
        value_ns -= self._reach(t_ns)
        if value_ns > self.high_ns:
            self._begin(t_ns)
        self.low_ns = max(self.low_ns, value_ns)

    def _reach(self, t_ns: int) -> int:
        """Move on to `t_ns`; where that is past, return what the offset can have grown by since."""
        if t_ns < self.t_ns - LATE_NS and self._overshoot.behind(t_ns):
            # The instant that was believed was false.
            self._begin(t_ns)
        elif t_ns >= self.t_ns - LATE_NS:
            self._overshoot.advanced()
        parted_ns = _parted(abs(t_ns - self.t_ns))
        if t_ns < self.t_ns:
            return parted_ns
        self.t_ns = t_ns
        self.low_ns -= parted_ns
        self.high_ns += parted_ns
        return 0

    def offset(self, t_ns: int) -> tuple[int, int]:
        """Return offset and bound about an instant of the reference's clock, past or to come."""
        if self.low_ns <= -UNBOUNDED_NS or self.high_ns >= UNBOUNDED_NS:
            known = (end for end in (self.low_ns, self.high_ns) if abs(end) < UNBOUNDED_NS)
            return next(known, 0), UNBOUNDED_NS
        half_ns = (self.high_ns - self.low_ns + 1) // 2
        # The instant itself may be off by as much.
        bound_ns = half_ns + _parted(half_ns + abs(t_ns - self.t_ns))
        return (self.low_ns + self.high_ns) // 2, bound_ns


def _parted(span_ns: int) -> int:
    """Most that two clocks part by in a span."""
    return -(-span_ns * MAX_DRIFT_PPB // PPB)


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
        #: By the other node.
        self._pairs: dict[str, _Pair] = {}
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
        if self._system_bound_ns is not None or source == target:
            return
        if self.reference not in (source, target):
            return
        node = target if source == self.reference else source
        pair = self._pairs.get(node)
        if pair is None:
            if len(self._pairs) >= MAX_NODES:
                return
            pair = self._pairs[node] = _Pair()
        if source == self.reference:
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
        offset_ns, _ = self._offset(node, instant_ns)
        shown_ns = instant_ns - offset_ns
        return Instant(shown_ns, self._offset(node, shown_ns)[1])

    def from_reference(self, node: str, instant_ns: int) -> Instant:
        """Convert an instant of the reference's clock to a node's (see `to_reference`)."""
        offset_ns, bound_ns = self._offset(node, instant_ns)
        return Instant(instant_ns + offset_ns, bound_ns)

    def _offset(self, node: str, t_ns: int) -> tuple[int, int]:
        """Return a node's offset from the reference and its bound, about an instant of that."""
        if node == self.reference:
            return 0, 0
        if self._system_bound_ns is not None:
            return 0, self._system_bound_ns
        pair = self._pairs.get(node)
        return (0, UNBOUNDED_NS) if pair is None else pair.offset(t_ns)
