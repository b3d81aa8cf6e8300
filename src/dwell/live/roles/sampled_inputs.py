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
    then each newer message that still arrives. When the task comes back, or the inputs of jobs are
    forked to here, jobs use no value from before: the other node may have used newer ones. A shadow
    worker has no values, and a standby (`forwards` is false) keeps its own.
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
        # Node of the task under the newest stamp, this stamp, and the first stamp with which the
        # task last left this node, as run, cycle and term.
        self._at = place.node
        self._newest = self._left_at = (-1, -1, -1)
        # Highest cycles that other nodes may have passed by now, by flow.
        self._left: dict[str, tuple[int, int]] = {}

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
        if self.is_away and not copied:
            self._leave(source, forwards=self._forwards)
        return True

    def newest(self, stamp: Stamp) -> Inputs:
        """Return the values for a job with a stamp that begins now.

        After the task has left, only jobs of cycles from before use values from before.
        """
        if stamp.term:  # not a source's guess
            self.stamped(stamp)
        if (*stamp.key, stamp.term) < self._left_at:
            return dict(self._values)
        left, none = self._left, (-1, -1)
        values = self._values.items()
        return {name: one for name, one in values if one[0].stamp.key > left.get(name, none)}

    def forget(self) -> None:
        """Keep the values from later jobs here."""
        for source in self._values:
            self._leave(source, forwards=False)

    def stamped(self, stamp: Stamp) -> None:
        """Follow the task to its node under a stamp, unless a newer one is known."""
        placed = self._place.problem.candidates.get(stamp.placement)
        order = (*stamp.key, stamp.term)
        if placed is None or order <= self._newest:
            return
        was_here, self._newest = not self.is_away, order
        self._at = placed.first[self._task]
        if not self.is_away or (self._task, self._place.node) in stamp.forks:
            return
        if was_here:
            self._left_at = order
        for source in self._values:
            self._leave(source, forwards=self._forwards and was_here)

    def _leave(self, source: str, *, forwards: bool) -> None:
        """Keep a value from later jobs here; send it to the task's node, unless it was left."""
        header, payload, _ = self._values[source]
        cycle = header.stamp.key
        if self._left.get(source, (-1, -1)) >= cycle:
            return
        self._left[source] = cycle
        if forwards and self._at in self._linked:
            key = self._place.keys.of(channels.VALUE, self._task, self._at, self._place.node)
            lane = lane_of(self._bytes[source])
            self._place.transport.put(key, payload, encode(header), lane=lane)
