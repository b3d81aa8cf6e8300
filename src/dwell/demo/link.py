"""The link of two nodes, emulated: a process that forwards their connections, and spoils them.

The endpoints that one node dials go to a port of this process instead, which forwards both
directions to the real one, each under `Conditions` of its own that may change at any time. It knows
Zenoh's framing (`dwell.demo.link_batches`), so that the unit is the message: a loss takes all
fragments of one message of data and nothing else, and the session goes on.

What differs from a real link:

* Within one connection nothing overtakes, as within any TCP stream: a message whose delay is drawn
  shorter leaves right behind the one before it. At a high message rate that makes the mean delay
  longer, and the spread smaller, than what was asked for. Connections overtake each other.
* One delay is drawn for a batch: small messages that their sender has put into one travel together.
* TCP between sender and link never loses a segment: after a cut of `hold`, what waited goes on at
  once and not after a retransmission timeout. Headers of TCP and IP do not count at the rate.
* What a sender's kernel holds in front of a full queue is bounded by that kernel only (up to 4 MB;
  Zenoh's ``#so_sndbuf=...`` at the end of an endpoint makes it less). Shared memory passes it by.
* A cut hides the end of a connection too, and new ones wait until it is healed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

from dwell.demo.link_rate import Sharing
from dwell.errors import LiveError
from dwell.testbed.child import Json
from dwell.testbed.conditions import Conditions, Cut
from dwell.testbed.emulated_link import EmulatedLink

__all__ = ["Forward", "LinkProcess", "Traffic"]

#: Bytes that wait at the rate before reading stops: two packets of a bottleneck's buffer at 25 ms
#: and 20 Mbit/s. What does not fit waits in the sender's own buffers, as it does on a real link.
QUEUE_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class Forward:
    """A port of the link.

    Parameters
    ----------
    source : str
        Node of the side that dials.
    host : str
    port : int
        Where the other node listens.
    listen : int
        Port of this machine's 127.0.0.1 to dial instead; 0 takes a free one.
    """

    source: str
    host: str
    port: int
    listen: int = 0


@dataclass(frozen=True, slots=True)
class Traffic:
    """What has passed one direction.

    Parameters
    ----------
    messages : int
        Messages of data handed on.
    dropped : int
        Messages of data lost, to `loss` or to a cut.
    bytes : int
        Handed on, everything counted.
    unknown_bytes : int
        Of them, those of connections that are not Zenoh's: delayed and queued, never lost.
    delay_mean_ms, delay_std_ms : float
        From the first byte of a message of data read to its last one handed on.
    late_mean_ms, late_max_ms : float
        Of that, what this process was late.
    cpu_s : float
        CPU time of the process so far, both directions.
    """

    messages: int
    dropped: int
    bytes: int
    unknown_bytes: int
    delay_mean_ms: float
    delay_std_ms: float
    late_mean_ms: float
    late_max_ms: float
    cpu_s: float


class LinkProcess(EmulatedLink):
    """The link between two nodes, as its parent sees it.

    Parameters
    ----------
    nodes : pair of str
    forwards : sequence of Forward
    conditions : mapping of (source, target) to Conditions
        At the beginning; a direction that is not there has no delay, loss or limit.
    seed : int
        Of delays and losses.
    queue_bytes : int
        See `QUEUE_BYTES`; of one direction, or with `fair` of each connection in it.
    sharing : {"fifo", "fair"}
        Whether connections wait for the rate in one queue, or each in its own.
    cpus : collection of int, optional
        Where it runs; anywhere if left out.
    """

    def __init__(
        self,
        nodes: tuple[str, str],
        forwards: Sequence[Forward],
        conditions: Mapping[tuple[str, str], Conditions] | None = None,
        *,
        seed: int = 0,
        queue_bytes: int = QUEUE_BYTES,
        sharing: Sharing = "fifo",
        cpus: Collection[int] | None = None,
    ) -> None:
        super().__init__("dwell.demo.link_loop", nodes)
        foreign = sorted({item.source for item in forwards} - set(nodes))
        if foreign or nodes[0] == nodes[1]:
            raise LiveError(f"{self.name} does not begin at {', '.join(foreign)}")
        self._settings: Json = {
            "nodes": nodes,
            "forwards": [(item.source, item.host, item.port, item.listen) for item in forwards],
            "sets": self._usual(conditions or {}),
            "seed": seed,
            "queue_bytes": queue_bytes,
            "sharing": sharing,
            "cpus": sorted(cpus) if cpus is not None else None,
        }
        #: Where to dial, by forward.
        self.ports: tuple[int, ...] = ()

    def start(self) -> None:
        """Start it; returns when it listens. `ports` are those of the forwards, in their order.

        Raises
        ------
        LiveError
            If it cannot listen on a port, or a value of the conditions is out of its bounds.
        """
        answer = self._started(self._settings)
        self.ports = tuple(cast("list[int]", answer["ports"]))

    def cut(
        self, source: str | None = None, *, kind: Cut = "drop", at_ns: int | None = None
    ) -> int:
        """Cut the direction from `source`, or both; returns the instant, as `set`.

        Data of a direction that is cut is lost (`drop`) or waits (`hold`), and so do the sessions'
        keep-alive messages, so that they break after their lease. Messages already on the way
        arrive.
        """
        return self._send(self._cuts(source, kind), at_ns)

    def heal(self, source: str | None = None, *, at_ns: int | None = None) -> int:
        """End a cut of the direction from `source`, or of both; returns the instant, as `set`."""
        return self._send(self._cuts(source, None), at_ns)

    def _cuts(self, source: str | None, kind: Cut | None) -> list[Json]:
        asked = [pair for pair in self.ways if source is None or pair[0] == source]
        if not asked:
            raise LiveError(f"{self.name} does not begin at {source}")
        return [self._change(*pair, {"cut": kind}) for pair in asked]

    def stats(self, *, reset: bool = False) -> dict[tuple[str, str], Traffic]:
        """Return what has passed each direction since the start, or since the last reset.

        Raises
        ------
        LiveError
            If the process has ended.
        """
        answer = self._child.ask({"do": "stats", "reset": reset})
        counted = cast("dict[str, dict[str, float]]", answer["stats"])
        return {pair: Traffic(**cast("dict[str, int]", counted[pair[0]])) for pair in self.ways}
