"""Permissions in a live cell: certificates of the cell's own authority, and signatures.

`authority` issues and revokes certificates; `keyring` contains a host's keys; `roster` lists all
subjects. Each subject has one Ed25519 key (RFC 8032) for mutual TLS and for signed messages.
"""

from __future__ import annotations

__all__ = ["KEYS"]

#: Variable of the environment that names a process's keyring.
KEYS = "DWELL_KEYS"
