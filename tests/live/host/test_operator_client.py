"""Who asks a cell's controller: what is told where nobody answers, and what it imports."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.host.operator_client import OperatorClient
from dwell.live.local.loopback import on_this_machine
from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import Answer, Ask, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import roles, wire
from tests.cli.live_cell import EXAMPLE
from tests.waiting import PATIENCE_S


def test_asking_for_the_status_imports_nothing_heavy() -> None:
    code = (
        "import sys, dwell, dwell.cli.commands, dwell.live.host.operator_client\n"
        f"dwell.load({str(EXAMPLE / 'cell.yaml')!r})\n"
        "print(*{'numpy', 'polars', 'psutil', 'rich'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []


def test_where_nobody_answers_it_says_so() -> None:
    problem = on_this_machine(dwell.load(EXAMPLE / "cell.yaml"))
    words = "no controller of cell 'light-follower' answers; is `dwell controller` running on E?"
    with OperatorClient(problem) as client:
        with pytest.raises(LiveError, match=re.escape(words)):
            client.ask("status", patience_s=0.2)
        found = client.look(patience_s=0.2)
    assert (found["health"], found["headline"], found["answer_age_ms"]) == ("absent", words, None)


def test_a_late_answer_to_another_wish_is_not_taken_for_an_answer() -> None:
    problem = on_this_machine(dwell.load(EXAMPLE / "cell.yaml"))
    keys = Keys(problem.name)
    role = next(role for role in roles(problem) if role.kind == "controller")
    server = ZenohTransport(wire(problem).entry(role.who))
    pins: list[Ask] = []

    def answer(sample: Arrival) -> None:
        ask = decode(sample.payload, Ask)
        if ask.what == "pin":
            pins.append(ask)
            return
        # What was not answered before is answered now, and first.
        for one in (*pins, ask):
            refused = "late" if one.what == "pin" else ""
            server.put(
                keys.of(channels.ANSWER, one.number), encode(Answer(one.number, refused, {}))
            )

    for key in (keys.of(channels.ASK), keys.of(channels.LOOK)):
        server.subscribe(key, answer)
    try:
        with OperatorClient(problem) as client:
            client.ask("status", patience_s=PATIENCE_S)
            with pytest.raises(LiveError, match="answers"):
                client.ask("pin", "SO", patience_s=0.2)
            assert client.ask("unpin", patience_s=PATIENCE_S) == {}
    finally:
        server.close()
    assert pins


def test_an_answer_is_shown_without_what_a_terminal_would_obey() -> None:
    """Without keys anybody may be the controller."""
    problem = on_this_machine(dwell.load(EXAMPLE / "cell.yaml"))
    keys = Keys(problem.name)
    role = next(role for role in roles(problem) if role.kind == "controller")
    server = ZenohTransport(wire(problem).entry(role.who))

    def answer(sample: Arrival) -> None:
        ask = decode(sample.payload, Ask)
        refused = "" if ask.what == "status" else "no\x1b[2Jbody"
        status = {"health": "ok", "note": "\x1b]0;mine\x07", "list": ["a\nb", 3]}
        server.put(
            keys.of(channels.ANSWER, ask.number), encode(Answer(ask.number, refused, status))
        )

    for key in (keys.of(channels.ASK), keys.of(channels.LOOK)):
        server.subscribe(key, answer)
    try:
        with OperatorClient(problem) as client:
            status = client.ask("status", patience_s=PATIENCE_S)
            assert status["note"] == "\\x1b]0;mine\\x07"
            assert status["list"] == ["a\\nb", 3]
            assert client.look(patience_s=PATIENCE_S)["answer_age_ms"] == 0.0
            with pytest.raises(LiveError, match=re.escape("refused: no\\x1b[2Jbody")):
                client.ask("pin", "SO", patience_s=PATIENCE_S)
    finally:
        server.close()
