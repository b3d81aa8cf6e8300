"""Requests: keys that are made where they are used, and signed elsewhere."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding

from dwell.errors import TrustError
from dwell.live.trust.authority import Authority
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.request import common_name, request_certificate


def travel(source: Path, target: Path) -> None:
    """Take the files of a keyring to its host."""
    shutil.copytree(source, target, dirs_exist_ok=True)


def test_a_key_that_was_made_here_is_signed_elsewhere(authority: Authority, tmp_path: Path) -> None:
    host = tmp_path / "host"
    folder = authority.sign(request_certificate(host, "R1"))
    assert {path.name for path in folder.iterdir()} == {"ca.pem", "cert.pem", "roster.json"}
    travel(folder, host / "R1")
    found = Keyring.open(host / "R1", cell="cell")
    assert found.own.common_name == "R1.2"
    found.own.key.verify(found.sign(b"test", b"data"), b"test\0data")
    files = [path for path in host.rglob("*") if path.is_file()]
    assert {path.stat().st_mode & 0o777 for path in files} == {0o600}
    # The addresses are those that it had.
    before, after = (
        x509.load_pem_x509_certificate((path / "cert.pem").read_bytes())
        .extensions.get_extension_for_class(x509.SubjectAlternativeName)
        .value
        for path in (authority.issue("R1"), host / "R1")
    )
    assert before == after


def test_a_request_leaves_the_key_in_use_in_place(authority: Authority, tmp_path: Path) -> None:
    """Also the request after the next, and where the first key came from the authority."""
    host = tmp_path / "host"
    travel(authority.folder / "R1", host / "R1")
    for generation in (1, 2, 3):
        request = request_certificate(host, "R1")
        assert Keyring.open(host / "R1").own.generation == generation
        travel(authority.sign(request), host / "R1")
        assert Keyring.open(host / "R1").own.generation == generation + 1


def test_a_key_that_was_requested_may_not_be_readable(authority: Authority, tmp_path: Path) -> None:
    travel(authority.sign(request_certificate(tmp_path, "R1")), tmp_path / "R1")
    (path,) = (tmp_path / "R1").glob("key-*.pem")
    path.chmod(0o644)
    with pytest.raises(TrustError, match=rf"{path.name}: others may use it"):
        Keyring.open(tmp_path / "R1")


def unsigned(path: Path) -> bytes:
    """A request whose name was changed after it was signed."""
    whole = request_certificate(path.parent, "R1").read_bytes()
    request = x509.load_pem_x509_csr(whole).public_bytes(Encoding.DER)
    other = request.replace(b"R1", b"E1")
    return x509.load_der_x509_csr(other).public_bytes(Encoding.PEM)


def another_kind(path: Path) -> bytes:
    builder = x509.CertificateSigningRequestBuilder().subject_name(common_name("R1"))
    key = ec.generate_private_key(ec.SECP256R1())
    return builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)


def elsewhere(path: Path) -> bytes:
    builder = x509.CertificateSigningRequestBuilder().subject_name(common_name("../R1"))
    return builder.sign(Ed25519PrivateKey.generate(), None).public_bytes(Encoding.PEM)


@pytest.mark.parametrize(
    ("content", "refused"),
    [
        (lambda path: b"", "is no request of dwell keys request"),
        (unsigned, "is not signed with an Ed25519 key of its own"),
        (another_kind, "is not signed with an Ed25519 key of its own"),
        (elsewhere, "'../R1' is no name of a subject"),
    ],
)
def test_what_is_no_request_is_refused(
    authority: Authority, tmp_path: Path, content: Callable[[Path], bytes], refused: str
) -> None:
    path = tmp_path / "other.csr"
    path.write_bytes(content(path))
    before = authority.roster
    with pytest.raises(TrustError, match=refused):
        authority.sign(path)
    with pytest.raises(TrustError, match="cannot be read"):
        authority.sign(tmp_path / "none.csr")
    assert authority.roster == before


def test_a_name_that_nobody_can_have_is_not_requested(tmp_path: Path) -> None:
    with pytest.raises(TrustError, match=r"'\.\./R1' is no name"):
        request_certificate(tmp_path / "keys", "../R1")
    assert not (tmp_path / "keys").exists()
