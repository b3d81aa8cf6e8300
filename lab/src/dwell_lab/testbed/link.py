"""The link of two hosts, emulated: a process between the TUN devices that lead to the other one.

What differs from a real link:

* The unit is the burst: packets of one flow (addresses, protocol, ports) in one direction that
  follow each other within a gap. That is a message, as long as messages of one connection are
  further apart than the gap; of closer ones the first draws the delay of all.
* Within a flow nothing overtakes, as a TCP connection would put it in order anyway: a message whose
  delay is drawn shorter arrives right behind the one before it. Flows overtake each other.
* A bare acknowledgement of TCP is delayed like a message, and overtakes them.
* It never loses a packet while it is up. Where a loss means that a message is sent again, its burst
  is held back by whole timeouts. Where it means that the message is gone, the transport of the
  sender leaves it out (`dwell.live.local.linked_transport`), because TCP would send it again.
* While it is down packets vanish, and TCP sends them again after it is up: after 0.2 s at the
  soonest, and twice as long after every further attempt.
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
    """The link between two hosts, as its parent sees it; a context manager.

    Its conditions can be changed at any time.

    Parameters
    ----------
    nodes : pair of str
    descriptors : mapping of str to int
        TUN device of each node that leads to the other, without packet information.
    usual : mapping of (source, target) to Conditions
        At the beginning; a direction that is not there has no delay, loss or limit.
    retransmit_ms : mapping of (source, target) to float
        Timeout of the directions that send again what was lost; others may have no `loss`.
    seed : int
        Seed of delays and losses.

    Raises
    ------
    LiveError
        If a direction or descriptor is not of the nodes, or conditions are none of such a link.
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
        """How well it can keep its instants beside busy threads."""
        scheduling: Scheduling = self.answered or "usual"
        return scheduling

    @property
    def ways(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Both directions, as (source, target)."""
        first, second = self.nodes
        return (first, second), (second, first)

    def set(self, source: str, target: str, *, at_ns: int | None = None, **changes: Any) -> int:
        """Change some conditions of a direction for messages that begin their way from then on.

        Parameters
        ----------
        at_ns : int, optional
            When, by the monotonic clock; at once if left out or past.
        **changes
            Fields of `Conditions`. Packets on their way arrive in spite of `down`.

        Returns
        -------
        int
            The instant from which they hold, ns of the monotonic clock.

        Raises
        ------
        LiveError
            If there is no such direction or field, a value is out of its bounds or none that this
            kind of link has, or the process has ended.
        """
        news = self._change(source, target, changes)
        since_ns: int = self.ask(("set", source, news, at_ns or 0))
        return since_ns

    def read(self, *, reset: bool = True) -> dict[tuple[str, str], Passed]:
        """Return counts of each direction since they were last read.

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
        """Note the conditions of a direction; returns those that are others than before.

        Raises
        ------
        LiveError
            If no such link has them.
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
        # What stays may be a trace, which takes the process a while to read.
        return {name: value for name, value in changes.items() if value != getattr(before, name)}
