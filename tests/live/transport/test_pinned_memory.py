"""What somebody with a node's keys can have a process of another node keep in memory."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh

from dwell.live.host.security import VISITORS_AT_ONCE
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.wiring import Session, longest_message_bytes, wire
from dwell.model import Host, Problem
from tests.live.host.test_security import issued, tls
from tests.live.wire.test_wiring import cell, housed
from tests.ports import free_ports
from tests.waiting import PATIENCE_S

MB = 1 << 20
#: Of the messages: some longer and some shorter than what was read once.
LENGTHS = [(30 + 50 * i // 36) * MB for i in range(37)]
#: What Zenoh and Python take besides: 4 MB were seen, and 240 without a bound on messages.
MARGIN_BYTES = 100 * MB

#: The sessions of a process of a cell, which keeps its memory as those do.
VICTIM = """
import sys
from dwell.live.host.security import KEYS, Security
from dwell.live.wire.wiring import wire
from dwell.live.host.memory import keep_memory
from tests.live.transport.test_pinned_memory import housed_at

keep_memory()
who, first, folder = sys.argv[1:]
problem = housed_at(int(first))
transport = Security.of(problem, wire(problem).entry(who).role, {KEYS: folder}).transport(who)
transport.subscribe(f"dwell/{problem.name}/**", lambda sample: None)
print("ready", flush=True)
sys.stdin.read()
"""


def housed_at(first: int) -> Problem:
    hosts = {
        node: Host("127.0.0.1", first + 100 * place) for place, node in enumerate(("R1", "E", "R2"))
    }
    return housed(cell(), hosts)


class Victim:
    """A process of a cell, and somebody who has the keys of another node."""

    def __init__(self, who: str, session: Session, folder: Path) -> None:
        first = free_ports(300)
        self.who, self.session, self.problem = who, session, housed_at(first)
        self.stolen = issued(self.problem, folder).folder / "R2"
        self.port = wire(self.problem).entry(who).listen[session].port
        self.process = subprocess.Popen(
            [sys.executable, "-c", VICTIM, who, str(first), str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    @property
    def rss(self) -> int:
        return int(psutil.Process(self.process.pid).memory_info().rss)

    def connect(self) -> zenoh.Session:
        """Connect with the stolen keys, by Zenoh alone."""
        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "listen/endpoints": [],
            "connect/endpoints": [f"tls/127.0.0.1:{self.port}"],
            **tls(self.stolen),
        }
        for path, value in settings.items():
            config.insert_json5(path, json.dumps(value))
        return zenoh.open(config)

    def close(self) -> None:
        self.process.communicate("")


@pytest.mark.parametrize(("who", "session"), [("stamper@R1", "control"), ("sensing@R1", "images")])
def test_messages_that_are_too_long_take_no_memory(
    who: str, session: Session, tmp_path: Path
) -> None:
    """37 messages of 30 to 80 MB, of several connections, priorities and reliabilities at once."""
    victim = Victim(who, session, tmp_path)
    key = Keys(victim.problem.name).of(channels.LOAD, "R2")
    ways = [
        (priority, reliability)
        for priority in (zenoh.Priority.REAL_TIME, zenoh.Priority.DATA, zenoh.Priority.BACKGROUND)
        for reliability in (zenoh.Reliability.RELIABLE, zenoh.Reliability.BEST_EFFORT)
    ]

    def send(priority: zenoh.Priority, reliability: zenoh.Reliability, share: list[int]) -> None:
        with victim.connect() as peer:
            publisher = peer.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=priority,
                reliability=reliability,
            )
            for length in share:
                publisher.put(bytes(length))

    try:
        before = highest = victim.rss
        senders = [
            threading.Thread(target=send, args=(*way, LENGTHS[i :: len(ways)]))
            for i, way in enumerate(ways)
        ]
        for sender in senders:
            sender.start()
        while any(sender.is_alive() for sender in senders):
            highest = max(highest, victim.rss)
            time.sleep(0.01)
    finally:
        victim.close()
    each = longest_message_bytes(victim.problem, session)
    assert highest - before < len(ways) * each + MARGIN_BYTES


def test_somebody_with_keys_gets_so_many_connections_and_no_more(tmp_path: Path) -> None:
    victim = Victim("stamper@R1", "control", tmp_path)
    most = 2 * wire(victim.problem).peers("stamper@R1") + VISITORS_AT_ONCE
    with ExitStack() as stack:
        stack.callback(victim.close)
        peers = [stack.enter_context(victim.connect()) for _ in range(most + 10)]
        limit_s = time.monotonic() + PATIENCE_S
        connected = 0
        while connected < most and time.monotonic() < limit_s:
            connected = sum(bool(peer.info.peers_zid()) for peer in peers)
            time.sleep(0.1)
        assert connected == most
