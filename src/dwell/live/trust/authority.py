"""Authority of a cell: issues and revokes the certificates with its own key."""

from __future__ import annotations

import base64
import ipaddress
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import cast

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from dwell.errors import TrustError
from dwell.live.trust.request import (
    common_name,
    make_private_folder,
    private_pem,
    read_request,
)
from dwell.live.trust.roster import ROLES, Role, Roster, Subject, write_private

#: Folder of the authority's own key, which stays on the computer that issues certificates.
AUTHORITY = "ca"
#: Default validity of certificates; the authority's own certificate is valid ten times as long.
DAYS = 365
MOST_DAYS = 3_650
#: Age of new certificates, as the clocks of hosts may be late.
BACKDATED = timedelta(hours=1)


class Authority:
    """Issues and revokes certificates; each change is written to the folders of all subjects.

    `folder` contains one folder for the authority, and one keyring per subject to copy to its host.
    """

    def __init__(
        self, folder: Path, key: Ed25519PrivateKey, certificate: x509.Certificate, roster: Roster
    ) -> None:
        self.folder, self._key, self.certificate, self.roster = folder, key, certificate, roster

    @classmethod
    def create(cls, folder: Path, cell: str, *, days: int = DAYS) -> Authority:
        """Make an authority with a new key and without subjects.

        Raises a TrustError if the folder has an authority already, or cannot be made.
        """
        _require_days(days)
        if (folder / AUTHORITY).exists():
            raise TrustError(f"{folder}: has an authority already; keys are never replaced by it")
        make_private_folder(folder / AUTHORITY)
        key = Ed25519PrivateKey.generate()
        name = common_name(f"dwell authority of {cell}"[:64])
        usage = x509.KeyUsage(
            digital_signature=True,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            key_cert_sign=True,
            crl_sign=True,
            encipher_only=False,
            decipher_only=False,
        )
        certificate = (
            _builder(name, name, key.public_key(), now() + timedelta(days=10 * days))
            .serial_number(x509.random_serial_number())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .sign(key, None)
        )
        made = cls(folder, key, certificate, Roster(cell, 1, {}))
        write_private(folder / AUTHORITY / "key.pem", private_pem(key))
        write_private(folder / AUTHORITY / "ca.pem", certificate.public_bytes(Encoding.PEM))
        made._publish(made.roster)
        return made

    @classmethod
    def open(cls, folder: Path) -> Authority:
        """Read an authority; raises a TrustError if it is missing or damaged."""
        own = folder / AUTHORITY
        try:
            key = load_pem_private_key((own / "key.pem").read_bytes(), password=None)
            certificate = x509.load_pem_x509_certificate((own / "ca.pem").read_bytes())
        except OSError as error:
            raise TrustError(
                f"{error.filename}: cannot be read ({error.strerror}); "
                "make an authority with dwell keys init"
            ) from None
        except ValueError as error:
            raise TrustError(f"{own}: key.pem or ca.pem is damaged ({error})") from None
        if not isinstance(key, Ed25519PrivateKey):
            raise TrustError(f"{own / 'key.pem'}: is no Ed25519 key")
        if key.public_key() != certificate.public_key():
            raise TrustError(f"{own}: key.pem does not belong to ca.pem")
        return cls(folder, key, certificate, Roster.read(own / "roster.json", key.public_key()))

    def issue(
        self,
        name: str,
        role: str | None = None,
        addresses: Collection[str] | None = None,
        *,
        days: int = DAYS,
    ) -> Path:
        """Issue a certificate with a new key; earlier certificates stay valid until they expire.

        Parameters
        ----------
        role : {"node", "controller", "operator", "observer"}, optional
            Role of the subject [default: the role of its last certificate].
        addresses : collection of str, optional
            Host names and IP addresses [default: the addresses of its last certificate].
        days : int
            Validity, 1 to 3650.

        Returns
        -------
        Path
            Folder of the subject's keyring.

        Raises
        ------
        TrustError
            If the name, role or validity is invalid, or a file cannot be written.
        """
        key = Ed25519PrivateKey.generate()
        return self._certify(name, key.public_key(), role, addresses, days, secret=key)

    def sign(
        self,
        request: Path,
        role: str | None = None,
        addresses: Collection[str] | None = None,
        *,
        days: int = DAYS,
    ) -> Path:
        """Issue a certificate for a request of `request_certificate` (see `issue`).

        Returns the folder of a keyring without the private key. Also raises a TrustError if the
        request is invalid.
        """
        name, key = read_request(request)
        return self._certify(name, key, role, addresses, days)

    def _certify(
        self,
        name: str,
        key: Ed25519PublicKey,
        role: str | None,
        addresses: Collection[str] | None,
        days: int,
        *,
        secret: Ed25519PrivateKey | None = None,
    ) -> Path:
        """Issue a certificate for a key; return the folder of the subject's keyring."""
        _require_days(days)
        roster, before = self.roster, self.roster.subjects.get(name)
        if name == AUTHORITY:
            raise TrustError(f"{name!r} is the authority's own name; choose another")
        if role is None and before is None:
            raise TrustError(f"{name} is new; say its role, {', '.join(ROLES)}")
        if before is not None and role not in (None, before.role):
            raise TrustError(f"{name} has the role {before.role}; revoke it to make it {role}")
        serial = x509.random_serial_number()
        generation = 1 + max(before.generation if before else 0, self._last_generation(name))
        public = key.public_bytes(Encoding.Raw, PublicFormat.Raw)
        expires = min(now() + timedelta(days=days), self.certificate.not_valid_after_utc)
        encoded = base64.b64encode(public).decode()
        played = cast("Role", role or (before.role if before else None))
        instants = now().isoformat(), expires.isoformat()
        subject = Subject(name, played, generation, serial, encoded, *instants)
        names = self._names(name) if addresses is None else map(general_name, addresses)
        certificate = self.certificate_of(subject, key, list(dict.fromkeys(names)), expires)
        folder = self.folder / name
        make_private_folder(folder)
        if secret is None:
            (folder / "key.pem").unlink(missing_ok=True)
        else:
            write_private(folder / "key.pem", private_pem(secret))
        write_private(folder / "cert.pem", certificate.public_bytes(Encoding.PEM))
        write_private(folder / "ca.pem", self.certificate.public_bytes(Encoding.PEM))
        subjects = {**roster.subjects, name: subject}
        earlier = [one for one in (*roster.earlier, before) if one and one.ends > now()]
        self._publish(replace(roster, subjects=subjects, earlier=tuple(earlier)))
        return folder

    def revoke(self, name: str) -> None:
        """Revoke a subject's certificates, which takes effect on hosts with the new roster.

        Raises a TrustError if the subject is unknown.
        """
        roster = self.roster
        if name not in roster.subjects:
            known = ", ".join(roster.subjects) or "nobody"
            raise TrustError(f"no subject {name!r} in {self.folder}; there is {known}")
        rest = {one: its for one, its in roster.subjects.items() if one != name}
        earlier = tuple(one for one in roster.earlier if one.name != name)
        revoked = (*roster.revoked, *(one.serial for one in roster.of(name)))
        self._publish(replace(roster, subjects=rest, revoked=revoked, earlier=earlier))

    def _last(self, name: str) -> x509.Certificate | None:
        """Return the newest certificate of a subject, from its folder."""
        try:
            return x509.load_pem_x509_certificate((self.folder / name / "cert.pem").read_bytes())
        except (OSError, ValueError):
            return None

    def _last_generation(self, name: str) -> int:
        last = self._last(name)
        if last is None:
            return 0
        found = str(last.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        return int(found.rpartition(".")[2])

    def _names(self, name: str) -> Iterable[x509.GeneralName]:
        """Return the addresses in a subject's newest certificate."""
        last = self._last(name)
        if last is None:
            return ()
        try:
            return last.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except x509.ExtensionNotFound:
            return ()

    def _publish(self, roster: Roster) -> None:
        """Write the roster to the folders of all subjects that are not revoked."""
        self.roster = replace(roster, number=roster.number + 1)
        signed = self.roster.signed(self._key)
        for name in (AUTHORITY, *self.roster.subjects):
            write_private(self.folder / name / "roster.json", signed)

    def certificate_of(
        self,
        subject: Subject,
        key: Ed25519PublicKey,
        names: Sequence[x509.GeneralName],
        expires: datetime,
    ) -> x509.Certificate:
        """Return a signed certificate of a subject, until `expires`."""
        uses = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = (
            _builder(common_name(subject.common_name), self.certificate.subject, key, expires)
            .serial_number(subject.serial)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        )
        if names:
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return builder.sign(self._key, None)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: Ed25519PublicKey, expires: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .not_valid_before(now() - BACKDATED)
        .not_valid_after(expires)
    )


def now() -> datetime:
    """Return the time of day in whole seconds."""
    return datetime.now(UTC).replace(microsecond=0)


def general_name(address: str) -> x509.GeneralName:
    """Return an address or a host's name as a name of a certificate."""
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        pass
    try:
        return x509.DNSName(address)
    except ValueError:
        raise TrustError(f"{address!r} is neither a host's name nor an address") from None


def _require_days(days: int) -> None:
    if not 1 <= days <= MOST_DAYS:
        raise TrustError(f"days is {days}; a certificate holds 1 to {MOST_DAYS} days")
