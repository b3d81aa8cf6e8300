"""Requests for certificates: a host makes its key, and the authority signs the public half."""

from __future__ import annotations

from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)
from cryptography.x509.oid import NameOID

from dwell.errors import TrustError
from dwell.live.trust.roster import require_name, write_private


def common_name(text: str) -> x509.Name:
    """Return the X.509 name with this common name."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def private_pem(key: Ed25519PrivateKey) -> bytes:
    """Return a key in PKCS 8 as PEM, without encryption."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def make_private_folder(folder: Path) -> None:
    """Make a folder that only its owner can read; raises a TrustError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)
    except OSError as error:
        raise TrustError(f"{folder}: cannot be made ({error.strerror})") from None


def key_file(folder: Path, public: object) -> Path:
    """Return the file of a keyring with the private half of a key.

    Each requested key has a separate file, so a request for the next certificate keeps the key of
    the present certificate.
    """
    if isinstance(public, Ed25519PublicKey):
        own = own_key_file(folder, public)
        if own.exists():
            return own
    return folder / "key.pem"


def own_key_file(folder: Path, public: Ed25519PublicKey) -> Path:
    """Return the separate file of a requested key, which is named after its public half."""
    digits = public.public_bytes(Encoding.Raw, PublicFormat.Raw).hex()
    return folder / f"key-{digits[:16]}.pem"


def request_certificate(out: Path, name: str) -> Path:
    """Make a key in the keyring ``OUT/NAME``, and a request for its certificate.

    Returns the request (PKCS 10), which contains no secret. Raises a TrustError if the name is
    invalid, or a file cannot be written.
    """
    require_name(name)
    key = Ed25519PrivateKey.generate()
    make_private_folder(out / name)
    write_private(own_key_file(out / name, key.public_key()), private_pem(key))
    builder = x509.CertificateSigningRequestBuilder().subject_name(common_name(name))
    path = out / f"{name}.csr"
    write_private(path, builder.sign(key, None).public_bytes(Encoding.PEM))
    return path


def read_request(path: Path) -> tuple[str, Ed25519PublicKey]:
    """Return the name and the key of a request.

    Raises a TrustError if the request cannot be read, is invalid, or is not signed with its key.
    """
    try:
        request = x509.load_pem_x509_csr(path.read_bytes())
        (name,) = request.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        public = request.public_key()
        signed = request.is_signature_valid
    except OSError as error:
        raise TrustError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, UnsupportedAlgorithm) as error:
        raise TrustError(f"{path}: is no request of dwell keys request ({error})") from None
    if not (signed and isinstance(public, Ed25519PublicKey)):
        raise TrustError(f"{path}: is not signed with an Ed25519 key of its own")
    subject = str(name.value)
    require_name(subject)
    return subject, public
