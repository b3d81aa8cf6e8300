"""Security of a process: its keys, or only loopback addresses if the cell has no keys.

Two variables of the environment set this, so an agent's processes inherit it.
"""

from __future__ import annotations

import base64
import ipaddress
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dwell.errors import Fault, LiveError, TrustError, installing
from dwell.files import write_whole
from dwell.live.failures import start_repeating
from dwell.live.transport.zenoh import ZenohSettings, ZenohTransport
from dwell.live.trust import KEYS
from dwell.live.wire.transport import Transport
from dwell.live.wire.wiring import Role, longest_message_bytes, wire
from dwell.model import FrozenDict, Problem

if TYPE_CHECKING:
    from dwell.live.roles.role import RolePlace
    from dwell.live.trust.keyring import Keyring

#: Variable of the environment: ``1`` allows addresses beyond this computer without keys.
INSECURE = "DWELL_INSECURE"
#: Period of warnings about keys in the log: one day.
REMIND_S = 86_400.0
#: Largest number of operators and observers connected to a process.
VISITORS_AT_ONCE = 8
#: Roles of keys that may visit; the controller's keys serve on its own node.
VISITORS = ("operator", "observer", "controller")


def environment(keys: Path | None, *, insecure: bool) -> dict[str, str]:
    """Return this process's environment with the given settings of its security.

    `keys` is a keyring [default: the keyring of the environment]; `insecure` allows addresses
    beyond this computer without keys.
    """
    named = {KEYS: str(keys.resolve())} if keys is not None else {}
    return {**os.environ, **named, **({INSECURE: "1"} if insecure else {})}


@dataclass(frozen=True, slots=True)
class Security:
    """Protection of a process of a cell; without a keyring, its ports accept any message."""

    problem: Problem
    keyring: Keyring | None = None

    @classmethod
    def of(
        cls, problem: Problem, role: Role, environment: Mapping[str, str] | None = None
    ) -> Security:
        """Return the protection of a process or visitor, as the environment sets it.

        Raises a TrustError if the keys belong to another cell or process, or are damaged, revoked
        or expired; and a LiveError without keys if the cell has addresses beyond this computer.
        """
        given = os.environ if environment is None else environment
        folder = given.get(KEYS, "")
        if folder:
            keyring = _keyring(Path(folder), problem, role)
            _require_own(keyring, role)
            return cls(problem, keyring)
        faults = list(exposed(problem))
        if faults and given.get(INSECURE, "") != "1":
            raise LiveError("\n".join(map(str, faults)))
        return cls(problem)

    def remember(self, folder: Path) -> None:
        """Record the number of the roster in a node's folder.

        Raises a TrustError if the node has used a newer roster before: with the older roster,
        certificates that were revoked since would be valid again.
        """
        if self.keyring is None:
            return
        number, kept = self.keyring.roster.number, folder / f"{self.problem.name}.roster"
        try:
            before = int(kept.read_text())
        except (OSError, ValueError):
            before = 0
        if number < before:
            raise TrustError(
                f"{self.keyring.folder}: roster {number} is older than {before}, which was used "
                f"here before ({kept}); take the newest from the authority's folder"
            )
        if number > before:
            write_whole(kept, str(number))

    def transport(self, who: str) -> ZenohTransport:
        """Open the sessions of a process of the cell; raises a LiveError if a port is taken."""
        wiring = wire(self.problem, protocol=self._protocol)
        # Twice the peers: old connections may still be open when all processes restart.
        most_peers = 2 * wiring.peers(who) + VISITORS_AT_ONCE
        return ZenohTransport(wiring.entry(who), self.settings(most_peers))

    def visit(self, who: str, *to: str) -> ZenohTransport:
        """Open a session of a visitor, which is outside of the cell, to processes of the cell."""
        wiring = wire(self.problem, protocol=self._protocol)
        return ZenohTransport(wiring.visitor(who, *to), self.settings(VISITORS_AT_ONCE))

    def place(
        self, who: str, node: str, transport: Transport, say: Callable[[str], None]
    ) -> RolePlace:
        """Return the place of a role that starts now."""
        from dwell.live.roles.role import RolePlace

        seals = None
        if self.keyring is not None:
            from dwell.live.trust.signing import Seals

            seals = Seals(self.keyring)
        return RolePlace(self.problem, who, node, transport, time.time_ns(), say=say, seals=seals)

    def warnings(self) -> Iterator[str]:
        """Yield the daily warnings: no keys, or a certificate that expires soon."""
        if self.keyring is None:
            addresses = sorted(set(_beyond(self.problem).values()))
            if addresses:
                yield (
                    "INSECURE: no keys; whoever reaches the ports at "
                    f"{', '.join(addresses)} can move the stages of cell {self.problem.name!r} "
                    "and command its actuators; make keys with dwell keys init"
                )
        elif ends := self.keyring.warning():
            yield f"warning: {ends}"

    def remind(self, say: Callable[[str], None], stopped: threading.Event) -> None:
        """Log the warnings now, and once per day until `stopped` is set."""

        def tell() -> None:
            for line in self.warnings():
                say(line)

        tell()
        start_repeating("keys", REMIND_S, stopped, tell)

    @property
    def _protocol(self) -> str:
        return "tcp" if self.keyring is None else "tls"

    def settings(self, most_peers: int) -> ZenohSettings:
        """Return the settings of a session with at most `most_peers` peers."""
        tls = {} if self.keyring is None else _tls(self.problem, self.keyring)
        return ZenohSettings(
            longest_bytes=longest_message_bytes(self.problem, "images"),
            longest_control_bytes=longest_message_bytes(self.problem, "control"),
            most_peers=most_peers,
            more=FrozenDict(tls),
        )


def _keyring(folder: Path, problem: Problem, role: Role) -> Keyring:
    """Open the keyring of a process; raises a TrustError if it is missing or invalid.

    The keyring is the folder itself, or a folder below it, named after the subject, the cell, or
    both.
    """
    try:
        from dwell.live.trust.keyring import Keyring
    except ImportError:
        raise TrustError(f"keys need cryptography; {installing('live')}") from None
    names = {"visitor": ("operator", "observer"), "controller": ("controller",)}
    places = [folder]
    for name in names.get(role.kind, (role.node,)):
        places += [folder / name, folder / problem.name / name]
    places.append(folder / problem.name)
    found = next((place for place in places if (place / "cert.pem").exists()), folder)
    return Keyring.open(found, cell=problem.name)


def _require_own(keyring: Keyring, role: Role) -> None:
    """Raise a TrustError if a keyring belongs to another process."""
    own = keyring.own
    where = f"{keyring.folder}: keys of {own.name}, a subject with the role {own.role}"
    if role.kind == "visitor":
        if own.role not in VISITORS:
            raise TrustError(f"{where}; visiting takes those of an operator, or of an observer")
    elif role.kind == "controller":
        if own.role != "controller" or own.name != "controller":
            raise TrustError(f"{where}; {role.who} takes those of the controller")
    elif (own.role, own.name) != ("node", role.node):
        raise TrustError(f"{where}; {role.who} takes those of node {role.node}")


def _tls(problem: Problem, keyring: Keyring) -> dict[str, object]:
    """Return Zenoh's settings that permit only mutual TLS."""
    from dwell.live.trust.acl import access_control
    from dwell.live.trust.permissions import subjects

    # Pass contents: Zenoh would read files at every connection, when they may have changed.
    authority, certificate, key = (
        base64.b64encode(keyring.files[name]).decode() for name in ("ca.pem", "cert.pem", "key.pem")
    )
    tls = "transport/link/tls"
    may_put = subjects(problem, keyring.roster)
    return {
        "transport/link/protocols": ["tls"],
        f"{tls}/root_ca_certificate_base64": authority,
        f"{tls}/listen_certificate_base64": certificate,
        f"{tls}/listen_private_key_base64": key,
        f"{tls}/connect_certificate_base64": certificate,
        f"{tls}/connect_private_key_base64": key,
        f"{tls}/enable_mtls": True,
        f"{tls}/verify_name_on_connect": True,
        f"{tls}/close_link_on_expiration": True,
        "access_control": access_control(keyring.roster, f"dwell/{problem.name}", may_put),
    }


def exposed(problem: Problem) -> Iterator[Fault]:
    """Yield a fault for each address of a cell beyond this computer."""
    for path, address in _beyond(problem).items():
        yield Fault(
            path,
            f"{address} is beyond this computer, and without keys whoever reaches it can move "
            "stages and command actuators; make keys with dwell keys init and name them with "
            "--keys, or say --insecure (DWELL_INSECURE=1) in a network that you trust",
        )


def _beyond(problem: Problem) -> dict[str, str]:
    """Return the addresses that are not loopback, by their path in the cell file."""
    addresses = {}
    for node, host in problem.live.hosts.items():
        addresses[f"live.hosts.{node}.address"] = host.address
        for other, end in host.seen_from.items():
            addresses[f"live.hosts.{node}.seen_from.{other}.address"] = end.address
    return {path: address for path, address in addresses.items() if not _loopback(address)}


def _loopback(address: str) -> bool:
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False
