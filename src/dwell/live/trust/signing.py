"""Seals: signatures that prove the author of a message, even if another process relayed it.

A sealed message is a signature of 64 bytes (Ed25519, RFC 8032) and the encoded message. The signed
data begins with the cell and the kind of the message, so a signature is invalid for other kinds and
cells. The content of a message has to show that it is not a replayed old message.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from dwell.errors import TrustError
from dwell.live.trust.keyring import Keyring
from dwell.live.wire.messages import SIGNATURE_BYTES

#: Number of verified messages to remember: the second copy of a message needs no verification.
REMEMBERED = 512


class Seals:
    """Signs a process's messages, and verifies messages of other processes."""

    def __init__(self, keyring: Keyring) -> None:
        self.keyring = keyring
        self._domain = f"dwell message 1 {keyring.roster.cell} "
        self._keys: dict[str, list[Ed25519PublicKey]] = {}
        self._good: dict[tuple[str, str, bytes], None] = {}

    def seal(self, word: str, data: bytes) -> bytes:
        """Return this process's signature followed by the message.

        `word` is the kind of the message: the first word of its key.
        """
        return self.keyring.sign(self._of(word), data) + data

    def require(self, word: str, name: str, sealed: bytes) -> None:
        """Raise a TrustError unless a subject has sealed a message, with any of its valid keys."""
        known = word, name, sealed
        if known in self._good:
            return
        if not self._verifies(word, name, sealed):
            raise TrustError(f"{word}: not signed by {name}")
        if len(self._good) >= REMEMBERED:
            del self._good[next(iter(self._good))]
        self._good[known] = None

    def _verifies(self, word: str, name: str, sealed: bytes) -> bool:
        if name not in self._keys:
            self._keys[name] = [subject.key for subject in self.keyring.roster.of(name)]
        signature, data = sealed[:SIGNATURE_BYTES], sealed[SIGNATURE_BYTES:]
        return any(
            _is_signed(key, signature, self._of(word) + b"\0" + data) for key in self._keys[name]
        )

    def _of(self, word: str) -> bytes:
        return (self._domain + word).encode()


def _is_signed(key: Ed25519PublicKey, signature: bytes, data: bytes) -> bool:
    try:
        key.verify(signature, data)
    except InvalidSignature:
        return False
    return True
