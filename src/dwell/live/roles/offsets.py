"""Offsets of the nodes' clocks from a reference node's, with the bounds of their errors.

A message arrives after it is sent. A message from a to b that was sent at s on a's clock and
arrived at r on b's clock bounds the lead of b's clock over a's clock: it is at most r - s. A
message from b to a bounds the lead from below. The messages with the least delay give the tightest
bounds, and the interval between them is as wide as the best round trip (D. L. Mills, 1991,
DOI 10.1109/26.103043, takes its middle). The bounds are valid for any delays, even if the two
directions differ.

Beats carry these times: when they were sent, and when their sender received the last beats of
others. A process that receives every beat of a cell can therefore compare all its clocks with the
reference's. All processes of a node read the same clock.

Clocks drift. Between two samples the interval grows at the rate at which two bad oscillators
diverge. So an old sample with a small delay counts until a new sample is better, and on a silent
link the last bound remains valid, with its growth. If samples contradict each other, a clock was
set or its computer restarted, and the interval starts again from the new sample.
"""

from __future__ import annotations

from typing import NamedTuple

from dwell.live.wire.continuity import OvershootDetector
from dwell.live.wire.messages import Beat
from dwell.model.instants import NEVER_NS

#: Error bound of an unknown instant.
UNBOUNDED_NS = 1 << 62

#: Largest drift between two clocks that are each within 100 ppm of true time.
MAX_DRIFT_PPB = 200_100
PPB = 1_000_000_000
#: Largest delay of a message.
LATE_NS = 120_000_000_000

#: Largest number of nodes whose clocks are compared; more names are not from the cell.
MAX_NODES = 64
#: Largest number of processes whose last beats are remembered.
MAX_SENDERS = 1_024


class Instant(NamedTuple):
    """An instant on another clock, and the bound of its error.

    The bound is `UNBOUNDED_NS` until messages have arrived in both directions.
    """

    instant_ns: int
    bound_ns: int


class ClockOffset(NamedTuple):
    """Offset of a node's clock: between `low_ns` and `high_ns` at `t_ns` of the reference."""

    t_ns: int = -NEVER_NS
    low_ns: int = -UNBOUNDED_NS
    high_ns: int = UNBOUNDED_NS


class _Pair:
    """Offset of a node's clock from the reference's: an interval at an instant of the reference."""

    def __init__(self) -> None:
        self.breaks = -1
        self._overshoot = OvershootDetector()
        self._begin(-NEVER_NS)

    def _begin(self, t_ns: int) -> None:
        self.breaks += 1
        self.t_ns = t_ns
        self.low_ns, self.high_ns = -UNBOUNDED_NS, UNBOUNDED_NS

    def at_most(self, t_ns: int, value_ns: int) -> None:
        """Add an upper bound of the offset at `t_ns`."""
        value_ns += self._reach(t_ns)
        if value_ns < self.low_ns:
            self._begin(t_ns)
        self.high_ns = min(self.high_ns, value_ns)

    def at_least(self, t_ns: int, value_ns: int) -> None:
        """Add a lower bound of the offset at `t_ns`."""
        value_ns -= self._reach(t_ns)
        if value_ns > self.high_ns:
            self._begin(t_ns)
        self.low_ns = max(self.low_ns, value_ns)

    def _reach(self, t_ns: int) -> int:
        """Move the interval on to `t_ns`; if that is past, return the possible drift since then."""
        if t_ns < self.t_ns - LATE_NS and self._overshoot.behind(t_ns):
            # The interval's own instant was false.
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
        """Return offset and bound at a past or future instant of the reference's clock."""
        if self.low_ns <= -UNBOUNDED_NS or self.high_ns >= UNBOUNDED_NS:
            known = (end for end in (self.low_ns, self.high_ns) if abs(end) < UNBOUNDED_NS)
            return next(known, 0), UNBOUNDED_NS
        half_ns = (self.high_ns - self.low_ns + 1) // 2
        # The error of the instant itself may be as large.
        bound_ns = half_ns + _parted(half_ns + abs(t_ns - self.t_ns))
        return (self.low_ns + self.high_ns) // 2, bound_ns


def _parted(span_ns: int) -> int:
    """Return the largest drift between two clocks in a span."""
    return -(-span_ns * MAX_DRIFT_PPB // PPB)


class Offsets:
    """Offsets of the clocks of a cell's nodes from the clock of a reference node.

    `node` is the node of this process. With `system_bound_ns`, the system keeps the clocks
    synchronous (PTP, chrony) within this bound, and all offsets are zero; if it is None, they
    are estimated.
    """

    def __init__(self, node: str, reference: str, *, system_bound_ns: int | None = None) -> None:
        self.node = node
        self.reference = reference
        self._system_bound_ns = system_bound_ns
        #: Interval by the other node.
        self._pairs: dict[str, _Pair] = {}
        #: Time at which the last received beat was sent, by sender.
        self._said_ns: dict[str, int] = {}
        self._adopted_life: int | None = None

    @property
    def interval(self) -> ClockOffset:
        """Offset of this node's clock, for other processes of this node."""
        pair = self._pairs.get(self.node)
        return ClockOffset() if pair is None else ClockOffset(pair.t_ns, pair.low_ns, pair.high_ns)

    def adopt(self, interval: ClockOffset, life: int) -> None:
        """Use the interval of the node's agent, of a life.

        A restarted agent has compared no clocks: then the last interval stays valid.
        """
        if interval.low_ns > -UNBOUNDED_NS and interval.high_ns < UNBOUNDED_NS:
            self._adopted_life = life
        elif life != self._adopted_life:
            return
        pair = self._pairs.setdefault(self.node, _Pair())
        pair.t_ns, pair.low_ns, pair.high_ns = interval

    def hear(self, beat: Beat, at_ns: int) -> None:
        """Add a beat that arrived at `at_ns` on this node's clock; it may be late or a copy."""
        self.sample(beat.node, self.node, beat.sent_ns, at_ns)
        # Skip entries that the sender's previous beat had, unless its clock was set back.
        said_ns = self._said_ns.get(beat.who, -NEVER_NS)
        again_ns = said_ns if said_ns < beat.sent_ns else -NEVER_NS
        if len(self._said_ns) > MAX_SENDERS:
            self._said_ns.clear()
        self._said_ns[beat.who] = beat.sent_ns
        for heard in beat.heard:
            if heard.at_ns > again_ns and heard.node != beat.node:
                self.sample(heard.node, beat.node, heard.beat_ns, heard.at_ns)

    def sample(self, source: str, target: str, sent_ns: int, arrived_ns: int) -> None:
        """Add a message between two nodes, with the instants on the clocks of source and target."""
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
        """Number of contradictions between samples: a clock was set, or its node restarted."""
        return sum(pair.breaks for pair in self._pairs.values())

    def to_reference(self, node: str, instant_ns: int) -> Instant:
        """Convert an instant of a node's clock to the reference's.

        The bound is `UNBOUNDED_NS` if the clocks have not been compared in both directions. The
        instant is then a guess from one direction, or the same number if there was no message.
        """
        offset_ns, _ = self._offset(node, instant_ns)
        shown_ns = instant_ns - offset_ns
        return Instant(shown_ns, self._offset(node, shown_ns)[1])

    def from_reference(self, node: str, instant_ns: int) -> Instant:
        """Convert an instant of the reference's clock to a node's (see `to_reference`)."""
        offset_ns, bound_ns = self._offset(node, instant_ns)
        return Instant(instant_ns + offset_ns, bound_ns)

    def _offset(self, node: str, t_ns: int) -> tuple[int, int]:
        """Return a node's offset from the reference, and its bound, at a reference instant."""
        if node == self.reference:
            return 0, 0
        if self._system_bound_ns is not None:
            return 0, self._system_bound_ns
        pair = self._pairs.get(node)
        return (0, UNBOUNDED_NS) if pair is None else pair.offset(t_ns)
