"""Operator's client of a cell's controller: reads the status, pins candidates, drains nodes."""

from __future__ import annotations

import itertools
import queue
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import msgspec

from dwell.errors import LiveError, TrustError
from dwell.live.host.security import Security
from dwell.live.log import printable
from dwell.live.wire import channels
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.live.wire.local_addresses import running_elsewhere
from dwell.live.wire.messages import Answer, Ask, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role
from dwell.model import Problem

RESEND_S = 0.2


class OperatorClient:
    """Connection to a cell's controller from outside of the cell; a context manager.

    Raises a LiveError if the cell needs keys and has none, and a TrustError if the keys are a
    node's.
    """

    def __init__(
        self,
        problem: Problem,
        environment: Mapping[str, str] | None = None,
        security: Security | None = None,
    ) -> None:
        self.problem = problem
        self.name = f"visitor-{uuid.uuid4().hex[:8]}"
        self._controller = f"controller@{problem.controller_node}"
        self._keys = Keys(problem.name)
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._wishes = itertools.count(1)
        self._answered_s: float | None = None
        role = Role(self.name, problem.controller_node, "visitor")
        #: By default as the environment sets it.
        self.security = security or Security.of(problem, role, environment)
        self._connect()

    def _connect(self) -> None:
        self._transport = self.security.visit(self.name, self._controller)
        self._transport.subscribe(self._keys.of(channels.ANSWER, "*"), self._heard)

    def __enter__(self) -> OperatorClient:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self._transport.close()

    def _heard(self, sample: Arrival) -> None:
        # Skip the answers to other visitors.
        if not sample.key.startswith(self._keys.of(channels.ANSWER, self.name)):
            return
        try:
            answer = decode(sample.payload, Answer)
        except LiveError:
            return
        refused, status = printable(answer.refused), _shown(answer.status)
        self._answers.put(msgspec.structs.replace(answer, refused=refused, status=status))

    def ask(self, what: str, about: str = "", *, patience_s: float = 3.0) -> dict[str, Any]:
        """Send a request, and return the status of the cell.

        `what` is ``status``, ``pin``, ``unpin``, ``drain`` or ``undrain``; `about` is the candidate
        to pin or the node to drain. Raises a LiveError if the controller refuses the request or
        does not answer, and a TrustError if an observer's keys do not permit it.
        """
        keyring = self.security.keyring
        if what != "status" and keyring is not None and keyring.own.role == "observer":
            raise TrustError(f"{keyring.folder}: keys of an observer, who may look and no more")
        answer = self._answer(what, about, patience_s)
        if answer is None:
            raise LiveError(f"{self._absent()} {running_elsewhere(self.problem)}".rstrip())
        if answer.refused:
            raise LiveError(f"refused: {answer.refused}")
        return answer.status

    def look(self, *, patience_s: float = 3.0) -> dict[str, Any]:
        """Return the controller's status (`ControlledCell.status`) and ``answer_age_ms``.

        Without an answer, return ``cell``, ``health`` (``absent``), ``headline``, and the age of
        the last answer (None before the first).
        """
        answer = self._answer("status", "", patience_s)
        if answer is not None:
            return {**answer.status, "answer_age_ms": 0.0}
        status = {"cell": self.problem.name, "health": "absent", "headline": self._absent()}
        if self._answered_s is None:
            return {**status, "answer_age_ms": None}
        return {**status, "answer_age_ms": round((time.monotonic() - self._answered_s) * 1e3, 1)}

    def watch(self, every_s: float) -> Iterator[dict[str, Any]]:
        """Yield the status (see `look`) once per `every_s`, without end, also by newer keys."""
        while True:
            until_s = time.monotonic() + every_s
            status = self.look(patience_s=every_s)
            yield status
            self._renew(whole=status["health"] == "absent")
            time.sleep(max(until_s - time.monotonic(), 0.0))

    def _renew(self, *, whole: bool) -> None:
        """Connect again if the folder of the keys has a newer roster or, if `whole`, other keys.

        The cell rejects a new certificate until it uses a roster that lists it, so the certificate
        waits until the controller does not answer.
        """
        if (own := self.security.keyring) is None:
            return
        from dwell.live.trust.keyring import Keyring

        # Incomplete files, which a user is still copying, wait for the next look.
        with suppress(TrustError, OSError):
            new = Keyring.open(own.folder, cell=self.problem.name)
            newer = new.roster.number - own.roster.number
            if newer > 0 or (whole and not newer and new.own != own.own):
                keyring = new if whole else own.with_roster(new)
                self._transport.close()
                self.security = replace(self.security, keyring=keyring)
                self._connect()

    def _answer(self, what: str, about: str, patience_s: float) -> Answer | None:
        """Repeat a request until the controller answers, or the time is over."""
        # An observer's keys permit requests for the status.
        if what == "status":
            number, key = self.name, self._keys.of(channels.LOOK)
        else:
            # A unique number distinguishes the answer from late answers to earlier requests.
            number, key = f"{self.name}-{next(self._wishes)}", self._keys.of(channels.ASK)
        ask = encode(Ask(number, what, about))
        # Discard answers to the repeated messages of earlier requests.
        while not self._answers.empty():
            self._answers.get()
        for _ in range(max(round(patience_s / RESEND_S), 1)):
            self._transport.put(key, ask)
            answer = self._answer_to(number)
            if answer is not None:
                self._answered_s = time.monotonic()
                return answer
        return None

    def _answer_to(self, number: str) -> Answer | None:
        """Wait up to `RESEND_S` for the answer with a number."""
        until_s = time.monotonic() + RESEND_S
        while (left_s := until_s - time.monotonic()) > 0:
            try:
                answer = self._answers.get(timeout=left_s)
            except queue.Empty:
                break
            if answer.number == number:
                return answer
        return None

    def _absent(self) -> str:
        since = ""
        if self._answered_s is not None:
            since = f" since {time.monotonic() - self._answered_s:.0f} s"
        return (
            f"no controller of cell {self.problem.name!r} answers{since}; is `dwell controller` "
            f"running on {self.problem.controller_node}?{self._ended()}"
        )

    def _ended(self) -> str:
        """Return a sentence if the controller's certificate in the roster has expired, else ''."""
        keyring = self.security.keyring
        known = [] if keyring is None else keyring.roster.of(CONTROLLER)[:1]
        ends = [one.ends for one in known if one.ends < datetime.now(UTC)]
        return "".join(f" its certificate ended on {end:%Y-%m-%d %H:%M} UTC" for end in ends)


def _shown(value: Any) -> Any:
    """Return a JSON value with all strings made printable."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {_shown(key): _shown(one) for key, one in value.items()}
    return [_shown(one) for one in value] if isinstance(value, list) else value
