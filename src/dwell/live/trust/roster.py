"""Roster: the subjects of a cell, as its authority has signed them."""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, TypeAlias

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from dwell.errors import TrustError
from dwell.files import write_whole

#: A `node` runs an agent and what it starts; the `controller` orders; an `operator` asks for pins
#: and drains; an `observer` reads.
Role: TypeAlias = Literal["node", "controller", "operator", "observer"]
ROLES: tuple[Role, ...] = ("node", "controller", "operator", "observer")

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,47}")
VERSION = 2
MAX_BYTES = 1 << 20
#: From when on before a certificate's end the status warns; a third of its life, if that is less.
WARNING = timedelta(days=14)
DOMAIN = b"dwell roster 1\0"


def require_name(name: object) -> None:
    """Raise a TrustError unless a subject can have a name."""
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise TrustError(
            f"{name!r} is no name of a subject; write letters, digits, - and _, "
            "beginning with a letter, 48 at most"
        )


@dataclass(frozen=True, slots=True)
class Subject:
    """A holder of a certificate.

    Parameters
    ----------
    name : str
        A node's name, or another one.
    generation : int
        Counts its certificates from 1: the name in a certificate has it, so that one that was
        revoked is not taken for the one that followed.
    public_key : str
        Ed25519, base64.
    issued, expires : str
        ISO 8601, with the offset to UTC.
    """

    name: str
    role: Role
    generation: int
    serial: int
    public_key: str
    issued: str
    expires: str

    def __post_init__(self) -> None:
        require_name(self.name)
        if self.role not in ROLES:
            raise TrustError(f"{self.name}: no role {self.role!r}; there are {', '.join(ROLES)}")
        if type(self.generation) is not int or self.generation < 1:
            raise TrustError(f"{self.name}: generation is {self.generation!r}, not 1 or more")
        if type(self.serial) is not int or self.serial < 1:
            raise TrustError(f"{self.name}: serial is {self.serial!r}, not 1 or more")
        for instant in (self.issued, self.expires):
            if datetime.fromisoformat(instant).tzinfo is None:
                raise TrustError(f"{self.name}: {instant} has no offset to UTC")

    @property
    def ends(self) -> datetime:
        """Instant at which its certificate ends."""
        return datetime.fromisoformat(self.expires)

    @property
    def warns_from(self) -> datetime:
        """Instant from which the cell's status warns of the end."""
        life = self.ends - datetime.fromisoformat(self.issued)
        return self.ends - min(WARNING, life / 3)

    @property
    def common_name(self) -> str:
        """Name in its certificate."""
        return f"{self.name}.{self.generation}"

    @property
    def key(self) -> Ed25519PublicKey:
        """Key that verifies its signatures.

        Raises
        ------
        TrustError
            If it is not a key.
        """
        try:
            data = base64.b64decode(self.public_key, validate=True)
            return Ed25519PublicKey.from_public_bytes(data)
        except (binascii.Error, ValueError, TypeError):
            raise TrustError(f"{self.name}: public_key is no Ed25519 key in base64") from None


@dataclass(frozen=True, slots=True)
class Roster:
    """Subjects of a cell.

    Parameters
    ----------
    number : int
        Grows with every change.
    subjects : mapping of str to Subject
        Subjects with their newest certificates, by name.
    revoked : tuple of int
        Serial numbers of certificates that are not in force.
    earlier : tuple of Subject
        Certificates before the newest that are in force until they end, so that hosts may take
        the newest in any order.
    """

    cell: str
    number: int
    subjects: Mapping[str, Subject]
    revoked: tuple[int, ...] = ()
    earlier: tuple[Subject, ...] = ()

    @property
    def certificates(self) -> tuple[Subject, ...]:
        """All that are in force; of one name the newest is the last."""
        return *self.earlier, *self.subjects.values()

    def of(self, name: str) -> list[Subject]:
        """Return the certificates of a name, the newest first."""
        return [one for one in reversed(self.certificates) if one.name == name]

    def signed(self, key: Ed25519PrivateKey) -> str:
        """Return it as JSON, signed by the authority."""
        document = self._document()
        signature = key.sign(DOMAIN + _canonical(document))
        document["signature"] = base64.b64encode(signature).decode()
        return json.dumps(document, indent=1) + "\n"

    def _document(self) -> dict[str, Any]:
        return {
            "dwell": VERSION,
            "cell": self.cell,
            "number": self.number,
            "subjects": [asdict(subject) for subject in self.certificates],
            "revoked": list(self.revoked),
        }

    @classmethod
    def read(cls, path: Path, authority: Ed25519PublicKey) -> Roster:
        """Read a roster and check who has signed it.

        Raises
        ------
        TrustError
            If it is missing, not a roster, or not signed by the authority.
        """
        try:
            if path.stat().st_size > MAX_BYTES:
                raise TrustError(f"{path}: {path.stat().st_size} bytes are too many for a roster")
            document = json.loads(path.read_text(encoding="utf-8"))
            signature = base64.b64decode(document.pop("signature"), validate=True)
            authority.verify(signature, DOMAIN + _canonical(document))
            if document["dwell"] != VERSION:
                raise TrustError(f"{path}: a roster of version {document['dwell']}, not {VERSION}")
            subjects = [Subject(**entry) for entry in document["subjects"]]
            cell, number, revoked = (document[key] for key in ("cell", "number", "revoked"))
        except OSError as error:
            raise TrustError(f"{path}: cannot be read ({error.strerror})") from None
        except InvalidSignature:
            raise TrustError(f"{path}: was not signed by the authority of ca.pem") from None
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            if isinstance(error, TrustError):
                raise
            raise TrustError(f"{path}: is no roster ({type(error).__name__}: {error})") from None
        newest = {subject.name: subject for subject in subjects}
        earlier = tuple(one for one in subjects if one is not newest[one.name])
        return cls(cell, number, newest, tuple(revoked), earlier)


def _canonical(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, sort_keys=True, separators=(",", ":")).encode("ascii")


def write_private(path: Path, data: bytes | str) -> None:
    """Write a file that only its owner can read, as a whole or not at all.

    Raises
    ------
    TrustError
        If it cannot be written.
    """
    try:
        write_whole(path, data, private=True)
    except OSError as error:
        raise TrustError(f"{path}: cannot be written ({error.strerror})") from None
