"""Sampled inputs: the newest message of each flow that a task does not wait for."""

from __future__ import annotations

from collections.abc import Iterable

from dwell.errors import LiveError
from dwell.live.roles.joins import Inputs
from dwell.live.roles.role import RolePlace
from dwell.live.wire import channels
from dwell.live.wire.messages import Header, Stamp, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import lane_of


class SampledInputs:
    """Values of a worker: the newest message of each sampled flow that has arrived here.

    When the task moves, its old node forwards its values to the new one over the direct link, and
    then each newer message that still arrives. A worker whose task comes back drops the values that
    it has passed on: the other node may have used newer ones. A shadow worker has no values, and a
    standby (`forwards` is false) keeps its own.
    """

    def __init__(self, place: RolePlace, task: str, *, forwards: bool) -> None:
        self._place, self._task = place, task
        problem = place.problem
        self._nodes = frozenset(problem.pipeline.tasks[task].on)
        flows = [flow for flow in problem.pipeline.inputs(task) if flow.sampled]
        self._bytes = {flow.source: flow.payload_bytes for flow in flows}
        #: Tasks whose messages it samples.
        self.sources = frozenset(self._bytes)
        self._moves = bool(flows) and len(self._nodes) > 1
        self._linked = {
            link.target for link in problem.fabric.links.values() if link.source == place.node
        }
        self._forwards = forwards
        self._values: Inputs = {}
        # Node of the task under the newest stamp, and this stamp's run, cycle and term.
        self._at, self._newest = place.node, (-1, -1, -1)
        # Highest cycles passed on, by flow and, if they were sent, by node.
        self._left: dict[str, tuple[int, int]] = {}
        self._sent: dict[tuple[str, str], tuple[int, int]] = {}

    @property
    def is_away(self) -> bool:
        """Whether the task runs on another node."""
        return self._at != self._place.node

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""
        if self._moves:
            keys = self._place.keys
            yield keys.of(channels.STAMPED)
            yield keys.of(channels.VALUE, self._task, self._place.node, "*")

    def receive(self, sample: Arrival, now_ns: int) -> None:
        """Process a stamp, or a value from an old node; raise a LiveError if invalid."""
        if self._place.channel(sample) is channels.STAMPED:
            self.stamped(self._place.read(channels.STAMPED, sample))
            return
        header, node = self._place.header(sample), sample.key.rpartition("/")[2]
        if header is None:
            return
        if header.source not in self.sources or node not in self._nodes:
            raise LiveError(f"{sample.key}: a value of {header.source} from {node}")
        self.take(header, sample.payload, now_ns)

    def take(self, header: Header, payload: bytes, at_ns: int) -> bool:
        """Take a message if it is newer than the value; return whether it is."""
        source, stamp = header.source, header.stamp
        known = self._values.get(source)
        if known is not None and stamp.key <= known[0].stamp.key:
            return False
        self._values[source] = header, payload, at_ns
        # Guesses of a source and forked inputs also reach nodes on which the task does not run.
        copied = not stamp.term or (self._task, self._place.node) in stamp.forks
        if not copied:
            self._forward(source)
        return True

    def newest(self, stamp: Stamp) -> Inputs:
        """Return the values for a job with a stamp that begins now."""
        if stamp.term:  # not a source's guess
            self.stamped(stamp)
        return dict(self._values)

    def stamped(self, stamp: Stamp) -> None:
        """Follow the task to its node under a stamp, unless a newer one is known."""
        placed, order = (
            self._place.problem.candidates.get(stamp.placement),
            (*stamp.key, stamp.term),
        )
        if placed is None or order <= self._newest:
            return
        self._newest = order
        if placed.first[self._task] == self._at:
            return
        self._at = placed.first[self._task]
        if self._at == self._place.node:
            for source, last in self._left.items():
                if source in self._values and self._values[source][0].stamp.key <= last:
                    del self._values[source]
            self._left.clear()
        for source in self._values:
            self._forward(source)

    def _forward(self, source: str) -> None:
        """Send a value to the task's node, unless it is here, or this or a newer one was sent."""
        node, (header, payload, _) = self._at, self._values[source]
        if node == self._place.node:
            return
        cycle = header.stamp.key
        self._left[source] = max(self._left.get(source, cycle), cycle)
        known = self._sent.get((source, node))
        if not self._forwards or node not in self._linked or (known is not None and known >= cycle):
            return
        self._sent[source, node] = cycle
        key = self._place.keys.of(channels.VALUE, self._task, node, self._place.node)
        lane = lane_of(self._bytes[source])
        self._place.transport.put(key, payload, encode(header), lane=lane)
