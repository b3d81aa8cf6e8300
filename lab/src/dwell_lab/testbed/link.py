"""Emulated link of two hosts: a process between their TUN devices.

Differences from a real link:

* The unit is the burst: packets of one flow (addresses, protocol, ports) in one direction that
  follow each other within a gap. A burst is one message if the messages of a connection are further
  apart than the gap; closer messages share the delay of the first.
* Packets of a flow stay in order, because a TCP connection would restore the order anyway: a
  message with a shorter delay arrives right after the previous message. Flows can overtake each
  other.
* A bare acknowledgement of TCP is delayed like a message, and can overtake messages.
* A link that is up never loses a packet. If the sender repeats lost messages, a loss delays the
  burst by multiples of the timeout. If it does not, the sender's transport drops the message
  (`dwell.live.local.linked_transport`), because TCP would repeat it.
* A link that is down drops packets. TCP repeats them after the link is up again: 0.2 s later at the
  earliest, and twice as long after every further attempt.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dwell.errors import LiveError
from dwell.live.local.child import Child
from dwell.live.local.conditions import Conditions, Scheduling, changed, fields_of
from dwell.model import FrozenDict
from dwell_lab.testbed.forwarder import Passed


class TunLink(Child):
    """Context manager that runs the process of a link between two hosts.

    The conditions can be changed at any time.

    Parameters
    ----------
    nodes : pair of str
    descriptors : mapping of str to int
        TUN device of each node that leads to the other, without packet information.
    usual : mapping of (source, target) to Conditions
        Initial conditions; directions without an entry have no delay, loss or limit.
    retransmit_ms : mapping of (source, target) to float
        Timeout of the directions that repeat lost messages; other directions cannot have `loss`.
    seed : int
        Seed of delays and losses.

    Raises
    ------
    LiveError
        If a direction or descriptor does not belong to the nodes, or a condition is invalid.
    """

    def __init__(
        self,
        nodes: tuple[str, str],
        descriptors: Mapping[str, int],
        usual: Mapping[tuple[str, str], Conditions] = FrozenDict(),
        *,
        retransmit_ms: Mapping[tuple[str, str], float] = FrozenDict(),
        seed: int = 0,
    ) -> None:
        if nodes[0] == nodes[1] or set(descriptors) != set(nodes):
            raise LiveError(f"link {'-'.join(nodes)}: needs one device each of two nodes")
        files = [descriptors[node] for node in nodes]
        self.nodes, self.name = nodes, f"link {nodes[0]}-{nodes[1]}"
        for source, target in retransmit_ms:
            self._require(source, target)
        self._repeats = frozenset(source for source, _ in retransmit_ms)
        self._conditions = dict.fromkeys(self.ways, Conditions())
        for way, conditions in usual.items():
            self._change(*way, fields_of(conditions))
        settings = (
            *(nodes, files, {source: now for (source, _), now in self._conditions.items()}),
            {source: round(ms * 1e6) for (source, _), ms in retransmit_ms.items()},
            seed,
        )
        super().__init__("dwell_lab.testbed.forwarder", self.name, settings, descriptors=files)

    @property
    def scheduling(self) -> Scheduling:
        """Scheduling of the process: ``usual``, or ``short slices`` (punctual on a busy CPU)."""
        scheduling: Scheduling = self.answered or "usual"
        return scheduling

    @property
    def ways(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Both directions, as (source, target)."""
        first, second = self.nodes
        return (first, second), (second, first)

    def set(self, source: str, target: str, *, at_ns: int | None = None, **changes: Any) -> int:
        """Change conditions of a direction for all messages sent after an instant.

        Parameters
        ----------
        at_ns : int, optional
            Instant on the monotonic clock; immediately if omitted or past.
        **changes
            Fields of `Conditions`. With `down`, packets on their way still arrive.

        Returns
        -------
        int
            The instant of the change, ns on the monotonic clock.

        Raises
        ------
        LiveError
            If the direction, a field or a value is invalid for this link, or the process has ended.
        """
        news = self._change(source, target, changes)
        since_ns: int = self.ask(("set", source, news, at_ns or 0))
        return since_ns

    def read(self, *, reset: bool = True) -> dict[tuple[str, str], Passed]:
        """Return the counts of each direction since the last reset.

        Raises
        ------
        LiveError
            If the process has ended.
        """
        counts: dict[str, dict[str, Any]] = self.ask(("stats", reset))
        return {way: Passed(**counts[way[0]]) for way in self.ways}

    def _require(self, source: str, target: str) -> None:
        if (source, target) not in self.ways:
            raise LiveError(f"{self.name} does not go from {source} to {target}")

    def _change(self, source: str, target: str, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Save the conditions of a direction; return the changed fields.

        Raises
        ------
        LiveError
            If a condition is invalid for this link.
        """
        self._require(source, target)
        way = f"{self.name}, {source} to {target}"
        if changes.get("loss") and source not in self._repeats:
            raise LiveError(
                f"{way}: without retransmit_ms it loses nothing; the transport of the sender "
                "leaves messages out"
            )
        before = self._conditions[source, target]
        self._conditions[source, target] = changed(way, before, changes)
        # Unchanged fields are left out: a trace takes the process a while to read.
        return {name: value for name, value in changes.items() if value != getattr(before, name)}
