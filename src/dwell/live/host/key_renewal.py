"""Key renewal: replaces the keys of a running cell by newer keys from a keyring.

A new roster is used at once. A new certificate of this host waits until all other agents, and the
controller if there is one, use a roster that lists it: they reject messages under certificates that
their roster lacks. So hosts may get their files in any order. The processes of a node read a copy
of its keyring in the state folder, which is always valid.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Protocol

from dwell.errors import TrustError
from dwell.live.host.supervision import Supervisor
from dwell.live.roles.role import Pulse
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.request import make_private_folder, own_key_file
from dwell.live.trust.roster import write_private
from dwell.live.trust.signing import Seals
from dwell.live.wire.transport import Transport
from dwell.live.wire.wiring import roles

#: Period of the checks for newer keys; each node has its own offset, so not all restart together.
EVERY_S = 20.0
#: Remaining validity of a certificate below which its successor is used in any case.
LAST = timedelta(hours=1)


class Listener(Protocol):
    """Receives the messages of a process."""

    def hear_through(self, transport: Transport) -> None:
        """Subscribe to the messages on a transport."""


class KeyRenewal:
    """Applies newer keys: restarts a node's processes in turn, then reconnects this process.

    Users put newer keys into `source`. Processes read the keyring `copy`, or else `source`.
    `connect` opens the sessions of this process, and `pulse` receives the agents' beats.
    """

    def __init__(
        self,
        source: Path,
        listener: Listener,
        pulse: Pulse,
        connect: Callable[[Keyring], Transport],
        *,
        copy: Path | None = None,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._source, self._listener, self._pulse = source, listener, pulse
        self._connect, self._copy, self._supervisor = connect, copy, supervisor
        self._place = pulse.place
        nodes = list(self._place.problem.fabric.nodes)
        part = len(nodes) if copy is None else nodes.index(self._place.node)
        self._offset_s = part * EVERY_S / (len(nodes) + 1)
        self._looked = self._count()
        self._new: Keyring | None = None

    def _count(self) -> int:
        return int((time.time() - self._offset_s) // EVERY_S)

    def step(self) -> None:
        """Check for newer keys once per `EVERY_S`, and apply them."""
        place, supervisor = self._place, self._supervisor
        if self._new is None and self._count() != self._looked and place.seals is not None:
            self._looked = self._count()
            # Incomplete files, which a user is still copying, wait for the next check.
            with suppress(TrustError, OSError):
                self._new = self._news(place.seals.keyring)
            if self._new is not None and supervisor is not None:
                supervisor.restart_in_turn()
        if self._new is None or (supervisor is not None and supervisor.restarting):
            return
        place.transport.close()
        place.seals, place.transport = Seals(self._new), self._connect(self._new)
        self._listener.hear_through(place.transport)
        self._new = None

    def _news(self, own: Keyring) -> Keyring | None:
        """Return newer keys that may be used now, else None."""
        new = Keyring.open(self._source, cell=own.roster.cell)
        changes = new.own != own.own
        whole = changes and self._may_use(new, own)
        newer = new.roster.number - own.roster.number
        if newer < 0 or not (newer or whole):
            return None
        if self._copy is not None:
            return installed(new, self._copy, whole=whole)
        return new if whole or not changes else own.with_roster(new)

    def _may_use(self, new: Keyring, own: Keyring) -> bool:
        place, last = self._place, self._pulse.detector.last
        agents = (r.who for r in roles(place.problem) if r.kind == "agent" and r.who != place.who)
        beats = [last(who) for who in agents]
        # A cell may run without a controller.
        if (beat := last(place.controller[1])) is not None:
            beats.append(beat)
        listed = all(beat and beat.roster >= new.roster.number for beat in beats)
        ends_soon = own.own.ends - datetime.now(UTC) < LAST
        return listed or ends_soon or own.own not in new.roster.certificates


def installed(source: Keyring, copy: Path, *, whole: bool = False) -> Keyring:
    """Copy a keyring's roster; also its certificate and key if `whole`, or if the copy is invalid.

    Raises a TrustError if the copy cannot be written.
    """
    make_private_folder(copy)
    write_private(copy / "roster.json", source.files["roster.json"])
    if not whole:
        with suppress(TrustError):
            return Keyring.open(copy, cell=source.roster.cell)
    # Write the certificate last: the name of the key file depends on it.
    write_private(copy / "ca.pem", source.files["ca.pem"])
    write_private(own_key_file(copy, source.own.key), source.files["key.pem"])
    write_private(copy / "cert.pem", source.files["cert.pem"])
    return Keyring.open(copy, cell=source.roster.cell)
