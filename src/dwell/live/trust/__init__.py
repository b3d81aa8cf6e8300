"""Who may do what in a live cell: certificates of its own authority, and what is signed with them.

`authority` issues and revokes; `keyring` is what a host has of it; `roster` the list of all
subjects that both agree on. Every subject has one Ed25519 key (RFC 8032): for mutual TLS, and for
what is signed end to end.
"""

from __future__ import annotations

__all__ = ["KEYS"]

#: Variable of the environment that names a process's keyring.
KEYS = "DWELL_KEYS"
