"""Key renewal: when newer keys are used, whatever order hosts get them in."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random

import pytest

from dwell.errors import TrustError
from dwell.live.host.hosting import Hosted
from dwell.live.host.key_renewal import KeyRenewal, installed
from dwell.live.roles.role import Pulse, RolePlace
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.request import request_certificate
from dwell.live.trust.roster import write_private
from dwell.live.trust.signing import Seals
from dwell.live.wire import channels
from dwell.live.wire.keys import CONTROLLER
from dwell.live.wire.messages import Beat, Beats
from dwell.live.wire.transport import Arrival, Transport
from dwell.model import Problem
from dwell.model.document import digests
from tests.live.memory_transport import Network
from tests.live.small_world import canonical


class Role:
    """A role with nothing but its pulse."""

    def __init__(self, place: RolePlace) -> None:
        self.place, self.pulse = place, Pulse(place, lambda: (True, ""))

    def subscriptions(self) -> tuple[str, ...]:
        return ()

    def receive(self, sample: object, now_ns: int) -> None:
        raise AssertionError

    def wake(self, now_ns: int) -> int:
        return now_ns


class Host:
    """Host of a node, or of the controller, with its keyring; time jumps between its checks.

    The agent of a node has a copy of the keyring for its processes.
    """

    def __init__(self, problem: Problem, authority: Authority, folder: Path, name: str) -> None:
        self.authority, self.name, self.source = authority, name, folder / name
        self.problem, self.copy = problem, folder / f"{name}.copy"
        self.controls = name == CONTROLLER
        self.node = problem.controller_node if self.controls else name
        self.fetch()
        used = Keyring.open(self.source)
        if not self.controls:
            used = installed(used, self.copy)
        self.network = Network()
        who = f"{CONTROLLER if self.controls else 'agent'}@{self.node}"
        transport = self.network.transport(who, self.node)
        self.place = RolePlace(problem, who, self.node, transport, seals=Seals(used))
        role = Role(self.place)
        self.pulse = role.pulse
        hosted = Hosted(role, transport, lambda: 0)
        self.connected: list[Keyring] = []
        copy = None if self.controls else self.copy
        self.renewal = KeyRenewal(self.source, hosted, self.pulse, self.connect, copy=copy)

    def connect(self, keyring: Keyring) -> Transport:
        self.connected.append(keyring)
        return self.network.transport(f"{self.place.who}.{len(self.connected)}", self.node)

    def fetch(self, *names: str) -> None:
        """Take files from the authority's folder."""
        self.source.mkdir(mode=0o700, exist_ok=True, parents=True)
        for path in (self.authority.folder / self.name).iterdir():
            if not names or path.name in names:
                shutil.copy(path, self.source)

    def hear(self, node: str, roster: int) -> None:
        """Hear the agent of another node, which uses a roster."""
        self._hear(f"agent@{node}", node, roster)

    def hear_controller(self, roster: int) -> None:
        """Hear the controller, which uses a roster."""
        node = self.problem.controller_node
        self._hear(f"{CONTROLLER}@{node}", node, roster)

    def _hear(self, who: str, node: str, roster: int) -> None:
        cell = digests(self.problem)["wiring"]
        beat = Beat(who, node, 1, roster, True, cell=cell, roster=roster)
        assert self.pulse.detector.hear(beat, roster)

    def uses(self) -> tuple[int, int]:
        """Look; return the generation and the roster that are used then."""
        assert self.place.seals is not None
        self.renewal._looked -= 1
        self.renewal.step()
        used = self.place.seals.keyring
        if not self.controls:
            # Whatever is started now reads the same.
            read = Keyring.open(self.copy)
            assert (read.own, read.roster) == (used.own, used.roster)
        return used.own.generation, used.roster.number

    def beat(self, others: list[Host], now_ns: int) -> None:
        """Send a beat by the relay; hosts whose roster lacks the certificate reject it."""
        place, beat = self.place, self.pulse.made(now_ns)
        if self.controls:
            key = place.keys.of(channels.BEAT, self.node, place.who)
            payload = place.sealed(channels.BEAT, beat)
        else:
            key = place.keys.of(channels.BEATS, self.node)
            payload = place.sealed(channels.BEATS, Beats((beat,)))
        sample = Arrival(place.keys.detour(key), payload)
        for other in others:
            other.pulse.receive(sample, now_ns)


@pytest.fixture
def problem() -> Problem:
    return canonical(20, estimator="profile")


@pytest.fixture
def authority(problem: Problem, tmp_path: Path) -> Authority:
    made = Authority.create(tmp_path / "keys", problem.name)
    for node in problem.fabric.nodes:
        made.issue(node, "node")
    made.issue("controller", "controller")
    return made


@pytest.fixture
def host(problem: Problem, authority: Authority, tmp_path: Path) -> Host:
    return Host(problem, authority, tmp_path / "host", "R1")


def test_nothing_happens_while_nothing_changes(host: Host, authority: Authority) -> None:
    number = authority.roster.number
    assert host.uses() == (1, number)
    assert not host.connected


def test_a_newer_roster_is_used_and_an_older_one_is_not(host: Host, authority: Authority) -> None:
    old = (host.source / "roster.json").read_bytes()
    authority.issue("E")
    number = authority.roster.number
    host.fetch("roster.json")
    assert host.uses() == (1, number)
    assert len(host.connected) == 1
    (host.source / "roster.json").write_bytes(old)
    assert host.uses() == (1, number)


def test_a_certificate_waits_until_all_agents_know_it(host: Host, authority: Authority) -> None:
    before = authority.roster.number
    authority.issue("R1")
    number = authority.roster.number
    host.fetch()
    assert host.uses() == (1, number)
    host.hear("E", number)
    host.hear("R2", before)
    assert host.uses() == (1, number)
    host.hear("R2", number)
    assert host.uses() == (2, number)
    assert len(host.connected) == 2


def test_a_certificate_waits_for_a_controller_that_is_there(
    host: Host, authority: Authority
) -> None:
    before = authority.roster.number
    authority.issue("R1")
    number = authority.roster.number
    host.fetch()
    host.hear("E", number)
    host.hear("R2", number)
    host.hear_controller(before)
    assert host.uses() == (1, number)
    host.hear_controller(number)
    assert host.uses() == (2, number)


def test_a_node_that_is_off_delays_a_certificate_until_the_last_hour(
    host: Host, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dwell.live.host.key_renewal.LAST", timedelta(days=366))
    authority.issue("R1")
    host.fetch()
    assert host.uses() == (2, authority.roster.number)


def test_a_certificate_that_was_revoked_is_replaced_at_once(
    host: Host, authority: Authority
) -> None:
    authority.revoke("R1")
    authority.issue("R1", "node")
    host.fetch()
    assert host.uses() == (2, authority.roster.number)


def test_two_hosts_that_wait_for_each_other_both_get_there(
    problem: Problem, authority: Authority, tmp_path: Path
) -> None:
    """Each has a new certificate, and hears that the other uses the newest roster."""
    hosts = [Host(problem, authority, tmp_path / node, node) for node in ("R1", "E")]
    for node in ("R1", "E"):
        authority.issue(node)
    number = authority.roster.number
    for one in hosts:
        one.fetch()
        assert one.uses() == (1, number)
    for one, other in (hosts, hosts[::-1]):
        other.hear("R2", number)
        other.hear(one.node, number)
    assert [one.uses() for one in hosts] == [(2, number), (2, number)]


def test_a_controller_uses_a_newer_roster_while_its_certificate_waits(
    problem: Problem, authority: Authority, tmp_path: Path
) -> None:
    """A node may use its new certificate before; without the roster its beats are rejected."""
    host = Host(problem, authority, tmp_path, CONTROLLER)
    for name in ("R1", CONTROLLER):
        authority.issue(name)
    number = authority.roster.number
    certificate = (host.source / "cert.pem").read_bytes()
    host.fetch()
    assert host.uses() == (1, number)
    assert host.connected[-1].files["cert.pem"] == certificate
    for node in problem.fabric.nodes:
        host.hear(node, number)
    assert host.uses() == (2, number)


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("pace", [1, 5, 100])
def test_files_copied_in_any_order_and_pace_end_in_the_new_keys(
    problem: Problem, authority: Authority, tmp_path: Path, pace: int, first: int
) -> None:
    """Hosts check in turn, after `pace` writes of half files; then each checks thrice."""
    names = (*problem.fabric.nodes, CONTROLLER)
    hosts = [Host(problem, authority, tmp_path, name) for name in names]
    for name in ("R1", CONTROLLER):
        authority.issue(name)
    random, writes = Random(first), list[tuple[Path, bytes]]()
    for host in random.sample(hosts, len(hosts)):
        files = sorted((authority.folder / host.name).iterdir())
        for file in random.sample(files, len(files)):
            content, path = file.read_bytes(), host.source / file.name
            writes += [(path, content[: len(content) // 2]), (path, content)]
    checks, turn = 3 * len(hosts), first
    while checks:
        for path, content in writes[:pace]:
            path.write_bytes(content)
        checks -= not writes
        del writes[:pace]
        host = hosts[turn % len(hosts)]
        host.uses()
        turn += 1
        for host in hosts:
            host.beat(hosts, turn)
        # No host uses a certificate that another host rejects.
        keyrings = [host.place.seals.keyring for host in hosts if host.place.seals]
        assert all(one.own in other.roster.certificates for one in keyrings for other in keyrings)
    newest = authority.roster.number
    found = {host.name: host.uses() for host in hosts}
    assert found == {name: (authority.roster.subjects[name].generation, newest) for name in names}


def test_files_that_are_copied_one_by_one_are_used_when_all_are_there(
    host: Host, authority: Authority
) -> None:
    used = host.uses()
    authority.issue("R1")
    for node in ("E", "R2"):
        host.hear(node, authority.roster.number)
    for name in ("key.pem", "cert.pem"):
        host.fetch(name)
        assert host.uses() == used
    host.fetch("roster.json")
    assert host.uses() == (2, authority.roster.number)


def test_a_key_that_was_requested_here_is_used_once_it_is_signed(
    host: Host, authority: Authority
) -> None:
    request = request_certificate(host.source.parent, "R1")
    used = host.uses()
    authority.sign(request)
    for node in ("E", "R2"):
        host.hear(node, authority.roster.number)
    assert host.uses() == used
    host.fetch()
    assert host.uses() == (2, authority.roster.number)


def test_a_copy_that_does_not_hold_is_replaced(host: Host, authority: Authority) -> None:
    """Also where another authority has made it, or it is damaged."""
    for content in (b"", b"-----BEGIN CERTIFICATE-----"):
        (host.copy / "cert.pem").write_bytes(content)
        assert installed(Keyring.open(host.source), host.copy).own.generation == 1
    other = Authority.create(authority.folder.parent / "other", host.problem.name)
    other.issue("R1", "node")
    found = installed(Keyring.open(other.folder / "R1"), host.copy)
    assert found.roster == other.roster
    with pytest.raises(TrustError):
        installed(found, host.source / "cert.pem")


def test_the_copy_is_valid_at_every_moment(
    host: Host, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that is started between two of its files finds keys that belong together."""
    authority.issue("R1")
    host.fetch()
    generations = []

    def written(path: Path, data: bytes) -> None:
        write_private(path, data)
        generations.append(Keyring.open(host.copy).own.generation)

    monkeypatch.setattr("dwell.live.host.key_renewal.write_private", written)
    installed(Keyring.open(host.source), host.copy, whole=True)
    assert generations == [1, 1, 1, 2]
    assert Keyring.open(host.copy).expires > datetime.now(UTC)
