"""Key renewal: newer keys in a keyring are taken over while the cell runs.

A roster is used at once, the certificate of this node only when all other agents use a roster that
lists it: so hosts may get their files in any order. The processes of a node read a copy of its
keyring in the state folder, which is valid at every moment.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dwell.errors import TrustError
from dwell.live.host.hosting import Hosted
from dwell.live.host.supervision import Supervisor
from dwell.live.roles.role import Pulse
from dwell.live.trust.keyring import Keyring
from dwell.live.trust.request import make_private_folder, own_key_file
from dwell.live.trust.roster import write_private
from dwell.live.trust.signing import Seals
from dwell.live.wire.transport import Transport
from dwell.live.wire.wiring import roles

#: Time between two looks; each node has its own part of it, so that not all restart together.
EVERY_S = 20.0
#: Time before the end of a certificate from which its successor is used in any case.
LAST = timedelta(hours=1)


class KeyRenewal:
    """Takes newer keys over: in the processes of a node in turn, then in this process.

    Parameters
    ----------
    source : Path
        The keyring into which newer keys are put.
    hosted : Hosted
        Role of this process, whose pulse hears the agents.
    connect : callable
        Opens the sessions of this process with some keys.
    copy : Path, optional
        The keyring that processes read; the source itself if left out.
    supervisor : Supervisor, optional
        Has the processes of the node.
    """

    def __init__(
        self,
        source: Path,
        hosted: Hosted,
        pulse: Pulse,
        connect: Callable[[Keyring], Transport],
        *,
        copy: Path | None = None,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._source, self._hosted, self._pulse = source, hosted, pulse
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
        """Look for newer keys when it is time, and use them."""
        place, supervisor = self._place, self._supervisor
        if self._new is None and self._count() != self._looked and place.seals is not None:
            self._looked = self._count()
            # Files that are being copied are passed over.
            with suppress(TrustError, OSError):
                self._new = self._news(place.seals.keyring)
            if self._new is not None and supervisor is not None:
                supervisor.restart_in_turn()
        if self._new is None or (supervisor is not None and supervisor.restarting):
            return
        place.transport.close()
        place.seals, place.transport = Seals(self._new), self._connect(self._new)
        self._hosted.hear_through(place.transport)
        self._new = None

    def _news(self, own: Keyring) -> Keyring | None:
        """Return the keys to use from now on, where they differ from the present keys."""
        new = Keyring.open(self._source, cell=own.roster.cell)
        changes = new.own != own.own
        whole = changes and self._may_use(new, own)
        newer = new.roster.number - own.roster.number
        if newer < 0 or not (newer or whole):
            return None
        if self._copy is not None:
            return installed(new, self._copy, whole=whole)
        return new if whole or not changes else None

    def _may_use(self, new: Keyring, own: Keyring) -> bool:
        place = self._place
        agents = (r.who for r in roles(place.problem) if r.kind == "agent" and r.who != place.who)
        beats = [self._pulse.detector.last(who) for who in agents]
        listed = all(beat and beat.roster >= new.roster.number for beat in beats)
        ends_soon = own.own.ends - datetime.now(UTC) < LAST
        return listed or ends_soon or own.own not in new.roster.certificates


def installed(source: Keyring, copy: Path, *, whole: bool = False) -> Keyring:
    """Copy a keyring; its certificate and key only if asked, or if those of the copy do not hold.

    Raises
    ------
    TrustError
        If it cannot be written.
    """
    make_private_folder(copy)
    write_private(copy / "roster.json", (source.folder / "roster.json").read_bytes())
    if not whole:
        with suppress(TrustError):
            return Keyring.open(copy, cell=source.roster.cell)
    # The certificate is the last: it chooses the key.
    write_private(copy / "ca.pem", (source.folder / "ca.pem").read_bytes())
    write_private(own_key_file(copy, source.own.key), source.key_file.read_bytes())
    write_private(copy / "cert.pem", (source.folder / "cert.pem").read_bytes())
    return Keyring.open(copy, cell=source.roster.cell)
