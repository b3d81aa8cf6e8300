"""An observer whose cell gets newer keys while it looks."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dwell.dash.observer import Observer
from dwell.live.host.operator_client import OperatorClient
from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.trust import KEYS
from dwell.live.trust.authority import Authority
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.messages import Answer, Ask, Stamped, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.model import Host, Problem
from tests.live.host.test_security import issued, security
from tests.live.wire.test_wiring import cell, housed
from tests.ports import free_ports
from tests.waiting import wait_until


@pytest.fixture
def problem() -> Problem:
    first = free_ports(300)
    nodes = enumerate(("R1", "E", "R2"))
    return housed(cell(), {node: Host("127.0.0.1", first + 100 * i) for i, node in nodes})


@contextmanager
def speaking(problem: Problem, authority: Authority) -> Iterator[ZenohTransport]:
    """Open the stamper's and the controller's sessions; the controller answers."""
    keys, names = Keys(problem.name), (f"controller@{problem.controller_node}", "stamper@R1")
    controller, stamper = (security(problem, authority.folder, one).transport(one) for one in names)

    def answer(sample: Arrival) -> None:
        ask = decode(sample.payload, Ask)
        said = {"health": "ok", "headline": None, "certificates": authority.roster.number}
        controller.put(keys.of(channels.ANSWER, ask.number), encode(Answer(ask.number, "", said)))

    controller.subscribe(keys.of(channels.LOOK), answer)
    try:
        yield stamper
    finally:
        controller.close()
        stamper.close()


def test_a_client_that_watches_uses_newer_keys(problem: Problem, tmp_path: Path) -> None:
    authority = issued(problem, tmp_path / "keys")
    mine = Path(shutil.copytree(authority.folder / "operator", tmp_path / "operator"))
    with OperatorClient(problem, {KEYS: str(mine)}) as client:
        looks = client.watch(0.4)

        def answers() -> bool:
            return next(looks).get("certificates") == authority.roster.number

        with speaking(problem, authority):
            wait_until(answers, "an answer")
        # First the controller gets a certificate, then the operator; the old ones are revoked.
        for name in ("controller", "operator"):
            authority.revoke(name)
            authority.issue(name, name, ["127.0.0.1"])
            with speaking(problem, authority):
                assert next(looks)["health"] == "absent"
                shutil.copytree(authority.folder / "operator", mine, dirs_exist_ok=True)
                wait_until(answers, "an answer by newer keys")


def test_newer_keys_are_used_while_it_looks(
    problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dwell.live.host.key_renewal.EVERY_S", 0.2)
    authority = issued(problem, tmp_path / "keys")
    mine = Path(shutil.copytree(authority.folder / "operator", tmp_path / "operator"))
    placements = [*problem.candidates]

    def seen(stamper: ZenohTransport, observer: Observer, cycle: int) -> bool:
        """Send a stamp; return whether such a stamp, and the controller's answer, arrived."""
        stamp = Stamped(1, cycle, cycle, placements[cycle], cycle)
        stamper.put(Keys(problem.name).of(channels.STAMPED), encode(stamp))
        now = observer.now()
        heard = now.status.get("certificates") == authority.roster.number
        return heard and now.placement == placements[cycle]

    with Observer(problem, {KEYS: str(mine)}) as observer:
        with speaking(problem, authority) as stamper:
            wait_until(lambda: seen(stamper, observer, 0), "a stamp and an answer")
        # The certificates of all that speak are replaced, and the old ones are revoked.
        for name, role in (("R1", "node"), ("controller", "controller")):
            authority.revoke(name)
            authority.issue(name, role, ["127.0.0.1"])
        with speaking(problem, authority) as stamper:
            shutil.copy(authority.folder / "operator" / "roster.json", mine)
            wait_until(lambda: seen(stamper, observer, 1), "a stamp and an answer by newer keys")
        assert observer.security.keyring is not None
        assert observer.security.keyring.roster.number == authority.roster.number
