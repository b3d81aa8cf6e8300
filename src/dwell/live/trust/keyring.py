"""Keyring of a subject: its key and certificate, and the roster of all subjects."""

from __future__ import annotations

import stat
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import NameOID

from dwell.errors import TrustError
from dwell.live.trust.request import key_file
from dwell.live.trust.roster import Roster, Subject, roster_content

#: Remaining days of a certificate below which Dwell warns.
SOON_DAYS = 30


@dataclass(frozen=True, slots=True)
class Keyring:
    """A subject's key and certificate, and the roster.

    `folder` contains ``ca.pem``, ``cert.pem``, ``roster.json`` and the key (see `key_file`).
    `files` has their contents when they were read, by name; the key is ``key.pem``. A user may
    replace the files at any time.
    """

    folder: Path
    own: Subject
    roster: Roster
    expires: datetime
    files: Mapping[str, bytes] = field(repr=False)
    _key: Ed25519PrivateKey = field(repr=False)

    @classmethod
    def open(cls, folder: Path, *, cell: str | None = None) -> Keyring:
        """Read a keyring, and check that its parts match each other and the cell, if given.

        Raises a TrustError if a file is missing, damaged or readable by other users, or if the
        certificate is revoked, expired, or belongs to another cell.
        """
        authority, certificate, key, files = _read(folder)
        public = authority.public_key()
        if not isinstance(public, Ed25519PublicKey):
            raise TrustError(f"{folder / 'ca.pem'}: has no Ed25519 key")
        roster = Roster.decode(files["roster.json"], folder / "roster.json", public)
        if cell is not None and roster.cell != cell:
            raise TrustError(f"{folder}: keys of cell {roster.cell!r}, not of {cell!r}")
        try:
            certificate.verify_directly_issued_by(authority)
        except (InvalidSignature, ValueError, TypeError):
            raise TrustError(f"{folder / 'cert.pem'}: was not issued by ca.pem") from None
        if key.public_key() != certificate.public_key():
            name = key_file(folder, certificate.public_key()).name
            raise TrustError(f"{folder}: {name} does not belong to cert.pem")
        common = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        known = roster.of(common.rpartition(".")[0])
        if certificate.serial_number in roster.revoked or not known:
            raise TrustError(f"{folder}: the certificate of {common} has been revoked")
        own = next((one for one in known if one.serial == certificate.serial_number), None)
        if own is None:
            raise TrustError(
                f"{folder}: cert.pem is that of {common}, roster.json has {known[0].common_name}; "
                "take both from the authority's folder again"
            )
        expires = certificate.not_valid_after_utc
        if expires <= datetime.now(UTC):
            raise TrustError(
                f"{folder}: the certificate of {common} has expired on {expires:%Y-%m-%d}; "
                "issue another with dwell keys issue"
            )
        return cls(folder, own, roster, expires, files, key)

    def with_roster(self, other: Keyring) -> Keyring:
        """Return these keys with the roster of another keyring of the same authority."""
        files = {**self.files, "roster.json": other.files["roster.json"]}
        return replace(self, roster=other.roster, files=files)

    def warning(self, now: datetime | None = None) -> str:
        """Return a warning if the certificate expires soon, else an empty text."""
        days = (self.expires - (now or datetime.now(UTC))).days
        if days >= SOON_DAYS:
            return ""
        return (
            f"the certificate of {self.own.common_name} ends on {self.expires:%Y-%m-%d}, "
            f"in {days} days; issue another with dwell keys issue"
        )

    def sign(self, domain: bytes, data: bytes) -> bytes:
        """Return a signature (64 bytes) of data, which is valid only for this domain."""
        return self._key.sign(domain + b"\0" + data)


def _read(
    folder: Path,
) -> tuple[x509.Certificate, x509.Certificate, Ed25519PrivateKey, dict[str, bytes]]:
    try:
        files = {name: (folder / name).read_bytes() for name in ("ca.pem", "cert.pem")}
        authority = x509.load_pem_x509_certificate(files["ca.pem"])
        certificate = x509.load_pem_x509_certificate(files["cert.pem"])
        path = key_file(folder, certificate.public_key())
        mode = path.stat().st_mode
        if mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise TrustError(
                f"{path}: others may use it (mode {stat.S_IMODE(mode):o}); chmod 600 it"
            )
        files["key.pem"] = path.read_bytes()
        key = load_pem_private_key(files["key.pem"], password=None)
    except OSError as error:
        raise TrustError(f"{error.filename}: cannot be read ({error.strerror})") from None
    except (ValueError, TypeError) as error:
        if isinstance(error, TrustError):
            raise
        raise TrustError(f"{folder}: a key or certificate is damaged ({error})") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise TrustError(f"{path}: is no Ed25519 key")
    files["roster.json"] = roster_content(folder / "roster.json")
    return authority, certificate, key, files
