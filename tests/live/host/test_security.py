"""Sessions with keys: who gets in, who is heard, and that nobody else is."""

from __future__ import annotations

import base64
import shutil
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from dwell.errors import LiveError, TrustError
from dwell.live.host.security import INSECURE, Security
from dwell.live.transport.zenoh import ZenohSettings, ZenohTransport
from dwell.live.trust import KEYS
from dwell.live.trust.authority import Authority, general_name
from dwell.live.trust.request import private_pem
from dwell.live.trust.roster import Subject, write_private
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Locator, Role, WiringEntry, wire
from dwell.model import Endpoint, Host, Problem
from tests.live.trust.rosters import LIFE
from tests.live.wire.test_wiring import cell, housed
from tests.ports import free_ports
from tests.waiting import PATIENCE_S

STAMPER = "stamper@R1"
HERE = ["127.0.0.1"]


@pytest.fixture(scope="module")
def problem() -> Problem:
    first = free_ports(300)
    hosts = {
        node: Host("127.0.0.1", first + 100 * place) for place, node in enumerate(("R1", "E", "R2"))
    }
    return housed(cell(), hosts)


@pytest.fixture(scope="module")
def authority(problem: Problem, tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return issued(problem, tmp_path_factory.mktemp("keys"))


@pytest.fixture(autouse=True)
def _no_secret_is_told(
    tmp_path_factory: pytest.TempPathFactory,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> Iterator[None]:
    """Whatever is attacked: nothing that is printed or logged has a part of a private key."""
    yield
    told = caplog.text + "".join(capfd.readouterr())
    assert "PRIVATE KEY" not in told
    for path in filter(Path.is_file, tmp_path_factory.getbasetemp().rglob("*key.pem")):
        lines = path.read_text().splitlines()
        assert not any(line[:20] in told for line in lines if not line.startswith("-----"))


def issued(problem: Problem, folder: Path) -> Authority:
    made = Authority.create(folder, problem.name)
    for node in problem.fabric.nodes:
        made.issue(node, "node", HERE)
    made.issue("controller", "controller", HERE)
    made.issue("operator", "operator")
    made.issue("observer", "observer")
    return made


def security(problem: Problem, folder: Path, who: str) -> Security:
    role = wire(problem).entry(who).role
    return Security.of(problem, role, {KEYS: str(folder)})


class Victim:
    """The stamper's sessions, and what they were handed."""

    def __init__(self, problem: Problem, folder: Path) -> None:
        self.heard: list[tuple[str, bytes]] = []
        self.transport = security(problem, folder, STAMPER).transport(STAMPER)
        self.transport.subscribe(f"dwell/{problem.name}/**", self._hear)
        entry = wire(problem).entry(STAMPER)
        self.port = entry.listen["control"].port

    def _hear(self, sample: Arrival) -> None:
        self.heard.append((sample.key, sample.payload))


@pytest.fixture(scope="module")
def victim(problem: Problem, authority: Authority) -> Iterator[Victim]:
    made = Victim(problem, authority.folder)
    yield made
    made.transport.close()


def tls(folder: Path, **files: Path | None) -> dict[str, object]:
    """What somebody sets who has those files, and no scruples about anybody's names."""
    own: dict[str, Path | None] = {
        "root_ca_certificate": folder / "ca.pem",
        "connect_certificate": folder / "cert.pem",
        "connect_private_key": folder / "key.pem",
    }
    own |= files
    more: dict[str, object] = {
        f"transport/link/tls/{name}": str(path) for name, path in own.items() if path is not None
    }
    return {
        **more,
        "transport/link/tls/enable_mtls": own["connect_certificate"] is not None,
        "transport/link/tls/verify_name_on_connect": False,
    }


class Intruder:
    """Connects to the stamper as the settings say; a context manager."""

    def __init__(self, port: int, more: dict[str, object], protocol: str = "tls") -> None:
        end = Locator("127.0.0.1", port, protocol)
        entry = WiringEntry(Role("intruder", "R2", "visitor"), {}, {"control": (end,)})
        self.transport = ZenohTransport(entry, ZenohSettings(more=more))

    def __enter__(self) -> ZenohTransport:
        return self.transport

    def __exit__(self, *_: object) -> None:
        self.transport.close()


def until(holds: Callable[[], object], again: Callable[[], None] = lambda: None) -> None:
    limit_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < limit_s:
        again()
        if holds():
            return
        time.sleep(0.02)
    raise AssertionError("waited in vain")


def greet(victim: Victim, problem: Problem, authority: Authority, word: bytes) -> None:
    """Have somebody with good keys come later, and be heard."""
    with Intruder(victim.port, tls(authority.folder / "R2")) as friend:
        key = Keys(problem.name).of(channels.LOAD, "R2")
        until(lambda: (key, word) in victim.heard, lambda: friend.put(key, word))


def expired(authority: Authority, folder: Path, seconds: float = -60.0) -> Path:
    """R2's keyring, with a certificate that ends in so many seconds."""
    folder.mkdir()
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
    ends = datetime.now(UTC) + timedelta(seconds=seconds)
    subject = Subject("R2", "node", 1, 77, base64.b64encode(public).decode(), *LIFE)
    made = authority.certificate_of(subject, key.public_key(), [general_name("127.0.0.1")], ends)
    write_private(folder / "key.pem", private_pem(key))
    write_private(folder / "cert.pem", made.public_bytes(Encoding.PEM))
    write_private(folder / "ca.pem", authority.certificate.public_bytes(Encoding.PEM))
    return folder


@pytest.mark.parametrize("kind", ["tcp", "no certificate", "another authority", "expired"])
def test_who_has_no_good_certificate_gets_no_connection(
    problem: Problem, authority: Authority, victim: Victim, tmp_path: Path, kind: str
) -> None:
    order = Keys(problem.name).of(channels.ORDER)
    protocol = "tcp" if kind == "tcp" else "tls"
    more: dict[str, object] = {}
    if kind == "no certificate":
        folder = authority.folder / "controller"
        more = tls(folder, connect_certificate=None, connect_private_key=None)
    elif kind == "another authority":
        # With all the right names; and it trusts the real one, so that only the victim refuses.
        other = issued(problem, tmp_path / "other").folder / "controller"
        more = tls(other, root_ca_certificate=authority.folder / "controller" / "ca.pem")
    elif kind == "expired":
        more = tls(expired(authority, tmp_path / "R2"))
    with Intruder(victim.port, more, protocol) as intruder:
        for _ in range(3):
            intruder.put(order, b"mine")
        greet(victim, problem, authority, kind.encode())
        # Whoever came later has long been heard.
        assert intruder.peers["control"] == 0
        intruder.put(order, b"mine")
    assert all(payload != b"mine" for _, payload in victim.heard)


def test_a_connection_ends_with_its_certificate(
    problem: Problem, authority: Authority, victim: Victim, tmp_path: Path
) -> None:
    key = Keys(problem.name).of(channels.LOAD, "R2")
    with Intruder(victim.port, tls(expired(authority, tmp_path / "R2", 3.0))) as late:
        until(lambda: (key, b"early") in victim.heard, lambda: late.put(key, b"early"))
        until(lambda: not late.peers["control"])
        late.put(key, b"late")
        greet(victim, problem, authority, b"later")
        assert late.peers["control"] == 0
        late.put(key, b"late")
    assert (key, b"late") not in victim.heard


def test_a_server_of_another_authority_is_not_spoken_to(
    problem: Problem, authority: Authority, tmp_path: Path
) -> None:
    other = issued(problem, tmp_path / "other")
    port = free_ports(3)
    listen = {"control": Locator("127.0.0.1", port, "tls")}
    entry = WiringEntry(Role(STAMPER, "R1", "stamper"), listen, {})  # type: ignore[arg-type]
    more = security(problem, other.folder, STAMPER).settings(8)
    pretender = ZenohTransport(entry, more)
    try:
        settings = security(problem, authority.folder, "agent@R2").settings(8)
        end = {"control": (Locator("127.0.0.1", port, "tls"),)}
        agent = ZenohTransport(WiringEntry(Role("agent@R2", "R2", "agent"), {}, end), settings)  # type: ignore[arg-type]
        try:
            time.sleep(1.0)
            assert agent.peers["control"] == pretender.peers["control"] == 0
        finally:
            agent.close()
    finally:
        pretender.close()


@pytest.mark.parametrize("name", ["R2", "operator", "observer"])
def test_only_the_controller_orders(
    problem: Problem, authority: Authority, victim: Victim, name: str
) -> None:
    keys, word = Keys(problem.name), name.encode()
    with (
        Intruder(victim.port, tls(authority.folder / name)) as intruder,
        Intruder(victim.port, tls(authority.folder / "controller")) as controller,
    ):
        until(lambda: intruder.peers["control"] == controller.peers["control"] == 1)
        for key in (
            keys.of(channels.ORDER),
            keys.of(channels.CARRIED),
            keys.of(channels.STAMPED),
            keys.of(channels.LOAD, "E"),
            "dwell/other/x",
        ):
            intruder.put(key, b"false " + word)
        until(
            lambda: (keys.of(channels.ORDER), b"true " + word) in victim.heard,
            lambda: controller.put(keys.of(channels.ORDER), b"true " + word),
        )
        greet(victim, problem, authority, b"after " + word)
    assert all(payload != b"false " + word for _, payload in victim.heard)


def test_who_is_revoked_is_not_heard(problem: Problem, tmp_path: Path) -> None:
    authority = issued(problem, tmp_path / "keys")
    key = Keys(problem.name).of(channels.LOAD, "R2")
    old = tmp_path / "old"
    shutil.copytree(authority.folder / "R2", old)
    authority.revoke("R2")
    authority.issue("R2", "node", ["127.0.0.1"])
    write_private(old / "roster.json", (authority.folder / "R2" / "roster.json").read_bytes())
    with pytest.raises(TrustError, match=r"the certificate of R2\.1 has been revoked"):
        security(problem, old, "agent@R2")
    # Beside the module's victim this one has ports of its own.
    first = free_ports(300)
    hosts = {
        node: Host("127.0.0.1", first + 100 * place) for place, node in enumerate(("R1", "E", "R2"))
    }
    victim = Victim(housed(cell(), hosts), authority.folder)
    try:
        with (
            Intruder(victim.port, tls(old)) as revoked,
            Intruder(victim.port, tls(authority.folder / "R2")) as renewed,
        ):
            until(lambda: renewed.peers["control"] == 1)
            revoked.put(key, b"old")
            until(lambda: (key, b"new") in victim.heard, lambda: renewed.put(key, b"new"))
            revoked.put(key, b"old")
            time.sleep(0.3)
        assert {payload for _, payload in victim.heard} == {b"new"}
    finally:
        victim.transport.close()


# ------------------------------------------------------------------------ before the start


@pytest.mark.parametrize(
    ("who", "name", "told"),
    [
        ("agent@R1", "R2", r"keys of R2, a subject with the role node; agent@R1 takes those of"),
        ("stamper@R1", "controller", r"keys of controller.*; stamper@R1 takes those of node R1"),
        ("controller@E", "E", r"keys of E.*; controller@E takes those of the controller"),
        ("controller@E", "operator", r"takes those of the controller"),
    ],
)
def test_each_process_has_keys_of_its_own(
    problem: Problem, authority: Authority, who: str, name: str, told: str
) -> None:
    with pytest.raises(TrustError, match=told):
        security(problem, authority.folder / name, who)


def test_nodes_do_not_visit(problem: Problem, authority: Authority) -> None:
    visitor = Role("visitor-1", "E", "visitor")
    with pytest.raises(TrustError, match="visiting takes those of an operator"):
        Security.of(problem, visitor, {KEYS: str(authority.folder / "R1")})
    for name in ("operator", "observer", "controller"):
        found = Security.of(problem, visitor, {KEYS: str(authority.folder / name)})
        assert found.keyring is not None
    # Of a folder with many, the operator's.
    found = Security.of(problem, visitor, {KEYS: str(authority.folder)})
    assert found.keyring is not None
    assert found.keyring.own.name == "operator"


def test_keys_of_another_cell_are_refused(problem: Problem, tmp_path: Path) -> None:
    other = Authority.create(tmp_path / "keys", "another")
    other.issue("R1", "node", HERE)
    with pytest.raises(TrustError, match="keys of cell 'another', not of"):
        security(problem, other.folder / "R1", STAMPER)


@pytest.mark.parametrize("path", ["address", "seen_from.E.address"])
def test_without_keys_nothing_leaves_this_computer(problem: Problem, path: str) -> None:
    far = {"E": Endpoint("10.0.0.3", 9_000)}
    near = Host("127.0.0.1", 7_000, far) if "seen" in path else Host("10.0.0.3", 7_000)
    hosts = {**problem.live.hosts, "R1": near}
    beyond, role = housed(problem, hosts), wire(problem).entry(STAMPER).role
    with pytest.raises(LiveError, match=rf"live\.hosts\.R1\.{path}: 10\.0\.0\.3 is beyond") as told:
        Security.of(beyond, role, {})
    assert "--insecure" in str(told.value)
    assert "dwell keys init" in str(told.value)
    (warning,) = Security.of(beyond, role, {INSECURE: "1"}).warnings()
    assert warning.startswith("INSECURE: no keys; whoever reaches the ports at 10.0.0.3 can move")


@pytest.mark.parametrize("address", ["127.0.0.1", "127.8.9.1", "::1", "localhost"])
def test_loopback_needs_no_keys(problem: Problem, address: str) -> None:
    hosts = {**problem.live.hosts, "R1": Host(address, 7_000)}
    found = Security.of(housed(problem, hosts), wire(problem).entry(STAMPER).role, {})
    assert found.keyring is None
    assert not list(found.warnings())


def test_a_roster_never_goes_back(problem: Problem, tmp_path: Path) -> None:
    authority = issued(problem, tmp_path / "keys")
    shutil.copytree(authority.folder / "R1", tmp_path / "old")
    security(problem, tmp_path / "old", "agent@R1").remember(tmp_path)
    authority.revoke("E")
    now = security(problem, authority.folder, "agent@R1")
    now.remember(tmp_path)
    now.remember(tmp_path)
    with pytest.raises(TrustError, match=r"roster 8 is older than 9, which was used here before"):
        security(problem, tmp_path / "old", "agent@R1").remember(tmp_path)


def test_a_certificate_that_ends_soon_is_spoken_of(problem: Problem, tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys", problem.name)
    authority.issue("R1", "node", HERE, days=12)
    (warning,) = security(problem, authority.folder / "R1", STAMPER).warnings()
    assert warning.startswith("warning: the certificate of R1.1 ends on ")
    assert "in 11 days; issue another with dwell keys issue" in warning
