"""Authority, keyrings and rosters: what they accept, and what they refuse."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.exceptions import InvalidSignature

from dwell.errors import TrustError
from dwell.live.trust.acl import access_control
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.signing import Seals

DOMAIN = b"test"


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


def test_the_certificate_before_holds_until_it_ends(
    authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = keyring(authority)
    old = shutil.copytree(authority.folder / "R1", tmp_path / "old")
    Authority.open(authority.folder).issue("R1")
    shutil.copy(authority.folder / "R1" / "roster.json", old / "roster.json")
    found, kept = keyring(authority), Keyring.open(old)
    assert (found.own.common_name, kept.own.common_name) == ("R1.2", "R1.1")
    assert (found.roster, found.roster.revoked) == (kept.roster, ())
    # Whichever of them R1 uses, others believe it.
    seals = Seals(keyring(authority, "controller"))
    for own in (before, found):
        seals.require("beat", "R1", Seals(own).seal("beat", b"data"))
    everybody = access_control(found.roster, "dwell/cell", {"dwell/cell/load/R1": ["R1"]})
    assert {"R1.1", "R1.2"} == set(everybody["policies"][1]["subjects"])
    # Those that have ended are not listed any more.
    later = datetime.now(UTC) + timedelta(days=400)
    monkeypatch.setattr("dwell.live.trust.authority.now", lambda: later)
    Authority.open(authority.folder).issue("R1", days=3_000)
    assert [one.generation for one in Authority.open(authority.folder).roster.of("R1")] == [3]


def test_all_certificates_of_a_name_are_revoked_together(
    authority: Authority, tmp_path: Path
) -> None:
    old = shutil.copytree(authority.folder / "R1", tmp_path / "old")
    authority.issue("R1")
    authority.revoke("R1")
    assert "R1" not in {one.name for one in authority.roster.certificates}
    for folder in (old, authority.folder / "R1"):
        shutil.copy(authority.folder / "controller" / "roster.json", folder)
        with pytest.raises(TrustError, match=r"the certificate of R1\.\d has been revoked"):
            Keyring.open(folder)
    authority.issue("R1", "node")
    assert [one.generation for one in authority.roster.of("R1")] == [3]


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
    monkeypatch.setattr("dwell.live.trust.authority.now", lambda: long_ago)
    folder = authority.issue("R1", "node")
    with pytest.raises(TrustError, match=r"has expired on .*; issue another"):
        Keyring.open(folder)


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
