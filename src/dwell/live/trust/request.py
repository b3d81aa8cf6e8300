"""Requests for certificates: a key is made where it is used, and its public half is signed."""

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
    """Return the name of a certificate's subject."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def private_pem(key: Ed25519PrivateKey) -> bytes:
    """Return a key as the content of its file."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def make_private_folder(folder: Path) -> None:
    """Make a folder that only its owner can read.

    Raises
    ------
    TrustError
        If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.chmod(0o700)
    except OSError as error:
        raise TrustError(f"{folder}: cannot be made ({error.strerror})") from None


def key_file(folder: Path, public: object) -> Path:
    """Return the file in which a keyring has the private half of a key.

    A key that was requested with has a file of its own, so that a request for the next certificate
    leaves the key of the present one in place.
    """
    if isinstance(public, Ed25519PublicKey):
        own = own_key_file(folder, public)
        if own.exists():
            return own
    return folder / "key.pem"


def own_key_file(folder: Path, public: Ed25519PublicKey) -> Path:
    """Return the file of a keyring that is for one key alone, by its public half."""
    digits = public.public_bytes(Encoding.Raw, PublicFormat.Raw).hex()
    return folder / f"key-{digits[:16]}.pem"


def request_certificate(out: Path, name: str) -> Path:
    """Make a key in a subject's keyring, and a request for its certificate.

    Parameters
    ----------
    out : Path
        Folder that has the keyring by the subject's name.

    Returns
    -------
    Path
        The request (PKCS 10), which may travel.

    Raises
    ------
    TrustError
        If the name is not valid, or a file cannot be written.
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
    """Return the name and the key that a request is for.

    Raises
    ------
    TrustError
        If it cannot be read, is none, or was not signed with the key itself.
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
