"""Authority, keyrings and rosters: what they accept, and what they refuse."""

from __future__ import annotations

import json
import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from hypothesis import given, settings
from hypothesis import strategies as st

from dwell.errors import TrustError
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.roster import ROLES, Roster, Subject

DOMAIN = b"test"


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    made = Authority.create(tmp_path / "keys", "cell")
    made.issue("R1", "node", ["127.0.0.1", "robot.local"])
    made.issue("controller", "controller", ["127.0.0.1"])
    return made


def keyring(authority: Authority, name: str = "R1") -> Keyring:
    return Keyring.open(authority.folder / name)


def verifies(keys: Keyring, name: str, domain: bytes, data: bytes, signature: bytes) -> bool:
    """Return whether a subject of the roster has signed data for a purpose."""
    subject = keys.roster.subjects.get(name)
    if subject is None:
        return False
    try:
        subject.key.verify(signature, domain + b"\0" + data)
    except InvalidSignature:
        return False
    return True


def test_a_keyring_has_its_own_key_and_knows_everybody(authority: Authority) -> None:
    found = keyring(authority)
    assert found.own.name == "R1"
    assert found.own.common_name == "R1.1"
    assert set(found.roster.subjects) == {"R1", "controller"}
    signature = found.sign(DOMAIN, b"data")
    other = keyring(authority, "controller")
    assert verifies(other, "R1", DOMAIN, b"data", signature)
    assert not verifies(other, "R1", DOMAIN, b"date", signature)
    assert not verifies(other, "R1", b"else", b"data", signature)
    assert not verifies(other, "controller", DOMAIN, b"data", signature)
    assert not verifies(other, "nobody", DOMAIN, b"data", signature)
    assert not verifies(other, "R1", DOMAIN, b"data", b"short")


def test_only_the_owner_can_read(authority: Authority) -> None:
    files = [path for path in authority.folder.rglob("*") if path.is_file()]
    assert {path.name for path in files} == {"ca.pem", "cert.pem", "key.pem", "roster.json"}
    assert {path.stat().st_mode & 0o777 for path in files} == {0o600}
    assert {path.stat().st_mode & 0o777 for path in authority.folder.iterdir()} == {0o700}


def test_a_key_that_others_may_use_is_refused(authority: Authority) -> None:
    (authority.folder / "R1" / "key.pem").chmod(0o640)
    with pytest.raises(TrustError, match=r"key\.pem: others may use it \(mode 640\); chmod 600"):
        keyring(authority)


def test_one_issued_anew_revokes_the_one_before(authority: Authority, tmp_path: Path) -> None:
    before = keyring(authority)
    old = shutil.copytree(authority.folder / "R1", tmp_path / "old")
    Authority.open(authority.folder).issue("R1", "node", ["127.0.0.1"])
    found = keyring(authority)
    assert found.own.common_name == "R1.2"
    assert len(found.roster.revoked) == 1
    assert verifies(found, "R1", DOMAIN, b"data", found.sign(DOMAIN, b"data"))
    assert not verifies(found, "R1", DOMAIN, b"data", before.sign(DOMAIN, b"data"))
    shutil.copy(authority.folder / "R1" / "roster.json", old / "roster.json")
    with pytest.raises(TrustError, match=r"the certificate of R1\.1 has been revoked"):
        Keyring.open(old)


def test_the_revoked_are_no_subjects(authority: Authority) -> None:
    signature = keyring(authority).sign(DOMAIN, b"data")
    authority.revoke("R1")
    assert not verifies(keyring(authority, "controller"), "R1", DOMAIN, b"data", signature)
    # Its own folder is left as it was; whoever has a newer roster refuses it.
    shutil.copy(authority.folder / "controller/roster.json", authority.folder / "R1/roster.json")
    with pytest.raises(TrustError, match="revoked"):
        keyring(authority)
    authority.issue("R1", "node")
    assert keyring(authority).own.generation == 2
    with pytest.raises(TrustError, match=r"no subject 'R7' in .*; there is controller, R1"):
        authority.revoke("R7")


def test_another_authoritys_parts_are_refused(authority: Authority, tmp_path: Path) -> None:
    other = Authority.create(tmp_path / "others", "cell")
    other.issue("R1", "node")
    theirs, ours = other.folder / "R1", authority.folder / "R1"
    for name, refused in {
        "roster.json": "was not signed by the authority",
        "key.pem": "key.pem does not belong to cert.pem",
        "cert.pem": "was not issued by ca.pem",
    }.items():
        mixed = shutil.copytree(ours, tmp_path / f"mixed-{name}")
        shutil.copy(theirs / name, mixed / name)
        with pytest.raises(TrustError, match=refused):
            Keyring.open(mixed)
    with pytest.raises(TrustError, match="keys of cell 'cell', not of 'another'"):
        Keyring.open(ours, cell="another")


def test_what_ends_is_refused_and_what_ends_soon_is_warned_of(tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "keys", "cell")
    folder = authority.issue("R1", "node", days=20)
    found = Keyring.open(folder)
    assert "R1.1 ends on" in found.warning()
    assert Keyring.open(authority.issue("R1", "node")).warning() == ""
    late = datetime.now(UTC) + timedelta(days=360)
    assert "in 4 days" in keyring(authority).warning(late)


def test_an_expired_certificate_is_refused(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    long_ago = datetime.now(UTC) - timedelta(days=400)
    monkeypatch.setattr("dwell.live.trust.authority._now", lambda: long_ago)
    folder = authority.issue("R1", "node")
    with pytest.raises(TrustError, match=r"has expired on .*; issue another"):
        Keyring.open(folder)


def test_certificates_name_addresses_and_uses(authority: Authority) -> None:
    data = (authority.folder / "R1" / "cert.pem").read_bytes()
    certificate = x509.load_pem_x509_certificate(data)
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["robot.local"]
    assert [str(ip) for ip in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1"]
    basic = certificate.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert not basic.ca
    # One that is issued anew is reached where it was.
    again = (authority.issue("R1") / "cert.pem").read_bytes()
    renewed = x509.load_pem_x509_certificate(again)
    kept = renewed.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert kept == names


@pytest.mark.parametrize(
    ("name", "role", "days", "refused"),
    [
        ("R 1", "node", 10, "'R 1' is no name of a subject"),
        ("../R1", "node", 10, "is no name of a subject"),
        ("R.1", "node", 10, "is no name of a subject"),
        ("ca", "node", 10, "the authority's own name"),
        ("R2", "king", 10, "no role 'king'; there are node, controller"),
        ("R2", None, 10, "R2 is new; say its role"),
        ("R2", "node", 0, "days is 0; a certificate holds 1 to 3650 days"),
        ("R1", "observer", 10, "R1 has the role node; revoke it to make it observer"),
    ],
)
def test_bad_subjects(
    authority: Authority, name: str, role: str | None, days: int, refused: str
) -> None:
    before = sorted(authority.folder.rglob("*"))
    with pytest.raises(TrustError, match=refused):
        authority.issue(name, role, days=days)
    assert sorted(authority.folder.rglob("*")) == before


def test_an_authority_is_never_replaced(authority: Authority) -> None:
    with pytest.raises(TrustError, match="has an authority already"):
        Authority.create(authority.folder, "cell")
    with pytest.raises(TrustError, match="make an authority with dwell keys init"):
        Authority.open(authority.folder / "R1")


def test_missing_files_are_named(authority: Authority) -> None:
    for name in ("ca.pem", "cert.pem", "key.pem", "roster.json"):
        path = authority.folder / "R1" / name
        kept = path.read_bytes()
        path.unlink()
        with pytest.raises(TrustError, match=f"{name}: cannot be read"):
            keyring(authority)
        path.write_bytes(kept)
        path.chmod(0o600)
    assert keyring(authority).own.name == "R1"


@settings(max_examples=60, deadline=None)
@given(where=st.floats(0, 1, exclude_max=True), change=st.integers(1, 255))
def test_no_changed_roster_is_accepted(
    tmp_path_factory: pytest.TempPathFactory, where: float, change: int
) -> None:
    authority = Authority.create(tmp_path_factory.mktemp("keys") / "keys", "cell")
    authority.issue("R1", "node")
    path = authority.folder / "R1" / "roster.json"
    text = bytearray(path.read_bytes())
    text[int(where * len(text))] ^= change
    before = json.loads(path.read_bytes())
    path.write_bytes(bytes(text))
    key = authority._key.public_key()
    try:
        found = Roster.read(path, key)
    except TrustError:
        return
    # White space, and what JSON may write in two ways, may change; what it says may not.
    assert json.loads(path.read_bytes()) | {"signature": ""} == before | {"signature": ""}
    assert found.number == before["number"]


@given(
    name=st.text(max_size=60),
    role=st.sampled_from([*ROLES, "other"]),
    generation=st.integers(-1, 3),
    serial=st.integers(-1, 3),
)
def test_subjects_are_valid_or_refused(name: str, role: str, generation: int, serial: int) -> None:
    try:
        subject = Subject(name, role, generation, serial, "", "")  # type: ignore[arg-type]
    except TrustError:
        return
    assert os.sep not in subject.common_name
    assert subject.common_name.count(".") == 1
