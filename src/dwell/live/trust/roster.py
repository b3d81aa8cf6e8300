"""Roster: the list of a cell's subjects, signed by its authority."""

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

#: A `node` runs an agent and its processes; the `controller` orders placements; an `operator` pins
#: candidates and drains nodes; an `observer` reads the status.
Role: TypeAlias = Literal["node", "controller", "operator", "observer"]
ROLES: tuple[Role, ...] = ("node", "controller", "operator", "observer")

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,47}")
VERSION = 2
MAX_BYTES = 1 << 20
#: Remaining validity below which the status warns, at most a third of the total validity.
WARNING = timedelta(days=14)
DOMAIN = b"dwell roster 1\0"


def require_name(name: object) -> None:
    """Raise a TrustError if a subject's name is invalid."""
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise TrustError(
            f"{name!r} is no name of a subject; write letters, digits, - and _, "
            "beginning with a letter, 48 at most"
        )


@dataclass(frozen=True, slots=True)
class Subject:
    """Owner of a certificate.

    `generation` counts the subject's certificates from 1. It is part of the common name, which
    distinguishes a revoked certificate from its successor. `public_key` is Ed25519 in base64;
    `issued` and `expires` are ISO 8601 with an offset to UTC.
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
        """Time at which the certificate expires."""
        return datetime.fromisoformat(self.expires)

    @property
    def warns_from(self) -> datetime:
        """Time from which the cell's status warns that the certificate will expire."""
        life = self.ends - datetime.fromisoformat(self.issued)
        return self.ends - min(WARNING, life / 3)

    @property
    def common_name(self) -> str:
        """Name in the certificate."""
        return f"{self.name}.{self.generation}"

    @property
    def key(self) -> Ed25519PublicKey:
        """Key that verifies the subject's signatures; raises a TrustError if it is invalid."""
        try:
            data = base64.b64decode(self.public_key, validate=True)
            return Ed25519PublicKey.from_public_bytes(data)
        except (binascii.Error, ValueError, TypeError):
            raise TrustError(f"{self.name}: public_key is no Ed25519 key in base64") from None


@dataclass(frozen=True, slots=True)
class Roster:
    """Subjects of a cell, by name, with their newest certificates.

    `number` grows with each change. `revoked` has serial numbers of revoked certificates. `earlier`
    has older certificates that are valid until they expire, so hosts may get their newest
    certificates in any order.
    """

    cell: str
    number: int
    subjects: Mapping[str, Subject]
    revoked: tuple[int, ...] = ()
    earlier: tuple[Subject, ...] = ()

    @property
    def certificates(self) -> tuple[Subject, ...]:
        """All valid certificates; the newest certificate of a name is its last."""
        return *self.earlier, *self.subjects.values()

    def of(self, name: str) -> list[Subject]:
        """Return the certificates of a name, the newest first."""
        return [one for one in reversed(self.certificates) if one.name == name]

    def signed(self, key: Ed25519PrivateKey) -> str:
        """Return the roster as JSON, with a signature by the authority's key."""
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
        """Read a roster and verify its signature.

        Raises a TrustError if it is missing or invalid, or the authority has not signed it.
        """
        return cls.decode(roster_content(path), path, authority)

    @classmethod
    def decode(cls, content: bytes, path: Path, authority: Ed25519PublicKey) -> Roster:
        """Decode the content of a file `path`, and verify the signature (see `read`)."""
        try:
            document = json.loads(content.decode("utf-8"))
            signature = base64.b64decode(document.pop("signature"), validate=True)
            authority.verify(signature, DOMAIN + _canonical(document))
            if document["dwell"] != VERSION:
                raise TrustError(f"{path}: a roster of version {document['dwell']}, not {VERSION}")
            subjects = [Subject(**entry) for entry in document["subjects"]]
            cell, number, revoked = (document[key] for key in ("cell", "number", "revoked"))
        except InvalidSignature:
            raise TrustError(f"{path}: was not signed by the authority of ca.pem") from None
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            if isinstance(error, TrustError):
                raise
            raise TrustError(f"{path}: is no roster ({type(error).__name__}: {error})") from None
        newest = {subject.name: subject for subject in subjects}
        earlier = tuple(one for one in subjects if one is not newest[one.name])
        return cls(cell, number, newest, tuple(revoked), earlier)


def roster_content(path: Path) -> bytes:
    """Read the file of a roster; raises a TrustError if it is missing or too long."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise TrustError(f"{path}: cannot be read ({error.strerror})") from None
    if len(content) > MAX_BYTES:
        raise TrustError(f"{path}: more than {MAX_BYTES} bytes are too many for a roster")
    return content


def _canonical(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document, sort_keys=True, separators=(",", ":")).encode("ascii")


def write_private(path: Path, data: bytes | str) -> None:
    """Write a file atomically, readable only by its owner; raises a TrustError if that fails."""
    try:
        write_whole(path, data, private=True)
    except OSError as error:
        raise TrustError(f"{path}: cannot be written ({error.strerror})") from None
