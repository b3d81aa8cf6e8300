"""Authority: whom it issues certificates to, and what these say."""

from __future__ import annotations

import pytest
from cryptography import x509

from dwell.errors import TrustError
from dwell.live.trust.authority import Authority


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
