"""Security of a process: its keys where the cell has some, and nothing but loopback where not.

Both settings come from the environment, so that an agent's processes have them of it.
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
from dwell.live.failures import start_thread
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
#: A certificate that ends soon is spoken of once a day.
REMIND_S = 86_400.0
#: People, and what watches, that a process is connected to besides the cell's processes.
VISITORS_AT_ONCE = 8
#: Of people, and of what runs where the controller does.
VISITORS = ("operator", "observer", "controller")


def environment(keys: Path | None, *, insecure: bool) -> dict[str, str]:
    """Return this process's environment with what was said of its keys.

    Parameters
    ----------
    keys : Path, optional
        Keyring; what the environment says if not given.
    insecure : bool
        Whether addresses beyond this computer are allowed without keys.
    """
    named = {KEYS: str(keys.resolve())} if keys is not None else {}
    return {**os.environ, **named, **({INSECURE: "1"} if insecure else {})}


@dataclass(frozen=True, slots=True)
class Security:
    """Protection of a process of a cell.

    Parameters
    ----------
    keyring : Keyring, optional
        Its keys; without, whoever reaches its ports can say anything.
    """

    problem: Problem
    keyring: Keyring | None = None

    @classmethod
    def of(
        cls, problem: Problem, role: Role, environment: Mapping[str, str] | None = None
    ) -> Security:
        """Return the protection that the environment gives a process.

        Parameters
        ----------
        role : Role
            A process of the cell, or a visitor.
        environment : mapping of str to str, optional
            This process's own if left out.

        Raises
        ------
        TrustError
            If the keys are not this cell's or not this process's, or are damaged, revoked or
            expired.
        LiveError
            If there are none, and the cell leaves this computer.
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
        """Take note of the roster in a node's folder; it never goes back to an earlier one.

        Raises
        ------
        TrustError
            If a later one was used there before: who has been revoked since would be back.
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
        """Open the sessions of a process of the cell.

        Raises
        ------
        LiveError
            If there is no such process, or a port is taken.
        """
        wiring = wire(self.problem, protocol=self._protocol)
        # Those of before may be there still when everybody starts again.
        most_peers = 2 * wiring.peers(who) + VISITORS_AT_ONCE
        return ZenohTransport(wiring.entry(who), self._settings(most_peers))

    def visit(self, who: str, *to: str) -> ZenohTransport:
        """Open a session of somebody who is no part of the cell, to processes that are."""
        wiring = wire(self.problem, protocol=self._protocol)
        return ZenohTransport(wiring.visitor(who, *to), self._settings(VISITORS_AT_ONCE))

    def place(
        self, who: str, node: str, transport: Transport, say: Callable[[str], None]
    ) -> RolePlace:
        """Return where a role runs that is just started."""
        from dwell.live.roles.role import RolePlace

        seals = None
        if self.keyring is not None:
            from dwell.live.trust.signing import Seals

            seals = Seals(self.keyring)
        return RolePlace(self.problem, who, node, transport, time.time_ns(), say=say, seals=seals)

    def warnings(self) -> Iterator[str]:
        """Yield warnings that belong into its log every day."""
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
        """Have the log say now what is wrong with the keys, and every day from now on."""

        def tell() -> None:
            for line in self.warnings():
                say(line)

        def repeat() -> None:
            while not stopped.wait(REMIND_S):
                tell()

        tell()
        start_thread("keys", repeat)

    @property
    def _protocol(self) -> str:
        return "tcp" if self.keyring is None else "tls"

    def _settings(self, most_peers: int) -> ZenohSettings:
        tls = {} if self.keyring is None else _tls(self.problem, self.keyring)
        return ZenohSettings(
            longest_bytes=longest_message_bytes(self.problem, "images"),
            longest_control_bytes=longest_message_bytes(self.problem, "control"),
            most_peers=most_peers,
            more=FrozenDict(tls),
        )


def _keyring(folder: Path, problem: Problem, role: Role) -> Keyring:
    """Open the keyring of a process.

    The folder is it, or has it by the name of its subject, of the cell, or of both.

    Raises
    ------
    TrustError
        If it is none.
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
    """Raise a TrustError unless a keyring is the one that a process has to have."""
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
    """Zenoh's settings for mutual TLS and nothing else."""
    from dwell.live.trust.acl import access_control
    from dwell.live.trust.permissions import subjects

    # Zenoh reads files at every connection, when newer ones may be there.
    authority, certificate, key = (
        base64.b64encode(path.read_bytes()).decode()
        for path in (keyring.folder / "ca.pem", keyring.folder / "cert.pem", keyring.key_file)
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
    """Yield every address of a cell that takes it beyond this computer."""
    for path, address in _beyond(problem).items():
        yield Fault(
            path,
            f"{address} is beyond this computer, and without keys whoever reaches it can move "
            "stages and command actuators; make keys with dwell keys init and name them with "
            "--keys, or say --insecure (DWELL_INSECURE=1) in a network that you trust",
        )


def _beyond(problem: Problem) -> dict[str, str]:
    """Return addresses that are not loopback, by where they stand in the cell file."""
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
