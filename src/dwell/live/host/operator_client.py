"""Asks a cell's controller for its status, and tells it what an operator wants."""

from __future__ import annotations

import itertools
import queue
import time
import uuid
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import msgspec

from dwell.errors import LiveError, TrustError
from dwell.live.host.security import Security
from dwell.live.log import printable
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.live.wire.local_addresses import running_elsewhere
from dwell.live.wire.messages import Answer, Ask, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role
from dwell.model import Problem

RESEND_S = 0.2


class OperatorClient:
    """Client of a cell's controller, outside of the cell; a context manager.

    Parameters
    ----------
    environment : mapping of str to str, optional
        With the variables of `dwell.live.host.security`; this process's own if left out.

    Raises
    ------
    LiveError
        If the cell leaves this computer, and there are no keys.
    TrustError
        If the keys are not those of somebody who visits.
    """

    def __init__(self, problem: Problem, environment: Mapping[str, str] | None = None) -> None:
        self.problem = problem
        self.name = f"visitor-{uuid.uuid4().hex[:8]}"
        self._controller = f"controller@{problem.controller_node}"
        self._keys = Keys(problem.name)
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._wishes = itertools.count(1)
        self._answered_s: float | None = None
        role = Role(self.name, problem.controller_node, "visitor")
        security = self._security = Security.of(problem, role, environment)
        self._transport = security.visit(self.name, self._controller)
        self._transport.subscribe(self._keys.answer("*"), self._heard)

    def __enter__(self) -> OperatorClient:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self._transport.close()

    def _heard(self, sample: Arrival) -> None:
        # All others' answers are heard, too.
        if not sample.key.startswith(self._keys.answer(self.name)):
            return
        try:
            answer = decode(sample.payload, Answer)
        except LiveError:
            return
        refused, status = printable(answer.refused), _shown(answer.status)
        self._answers.put(msgspec.structs.replace(answer, refused=refused, status=status))

    def ask(self, what: str, about: str = "", *, patience_s: float = 3.0) -> dict[str, Any]:
        """Ask, and return how the cell is.

        Parameters
        ----------
        what : str
            ``status``, ``pin``, ``unpin``, ``drain`` or ``undrain``.
        about : str
            Candidate to pin, node to drain.

        Raises
        ------
        LiveError
            If it is refused, or nobody answers.
        TrustError
            If the keys are those of somebody who may only look.
        """
        keyring = self._security.keyring
        if what != "status" and keyring is not None and keyring.own.role == "observer":
            raise TrustError(f"{keyring.folder}: keys of an observer, who may look and no more")
        answer = self._answer(what, about, patience_s)
        if answer is None:
            raise LiveError(f"{self._absent()} {running_elsewhere(self.problem)}".rstrip())
        if answer.refused:
            raise LiveError(f"refused: {answer.refused}")
        return answer.status

    def look(self, *, patience_s: float = 3.0) -> dict[str, Any]:
        """Return how the cell is, and that nobody answers where that is so.

        Returns
        -------
        dict
            The controller's status (`ControlledCell.status`) and ``answer_age_ms``. Without
            an answer: ``cell``, ``health`` (``absent``), ``headline``, and the age of the last
            answer to this visitor, None where there was none.
        """
        answer = self._answer("status", "", patience_s)
        if answer is not None:
            return {**answer.status, "answer_age_ms": 0.0}
        status = {"cell": self.problem.name, "health": "absent", "headline": self._absent()}
        if self._answered_s is None:
            return {**status, "answer_age_ms": None}
        return {**status, "answer_age_ms": round((time.monotonic() - self._answered_s) * 1e3, 1)}

    def _answer(self, what: str, about: str, patience_s: float) -> Answer | None:
        """Ask until there is an answer, or patience ends."""
        # Who only looks may do so with the keys of an observer.
        if what == "status":
            number, key = self.name, self._keys.look()
        else:
            # Each wish has a number of its own: no late answer to another is taken for its own.
            number, key = f"{self.name}-{next(self._wishes)}", self._keys.ask()
        ask = encode(Ask(number, what, about))
        # One question is sent several times; what was answered to the one before is old.
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
        """Wait a while for an answer with a number."""
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
        """Return that the controller's certificate has ended, by the roster; nothing otherwise."""
        keyring = self._security.keyring
        known = [] if keyring is None else keyring.roster.of(CONTROLLER)[:1]
        ends = [one.ends for one in known if one.ends < datetime.now(UTC)]
        return "".join(f" its certificate ended on {end:%Y-%m-%d %H:%M} UTC" for end in ends)


def _shown(value: Any) -> Any:
    """Return plain values with all their texts printable."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {_shown(key): _shown(one) for key, one in value.items()}
    return [_shown(one) for one in value] if isinstance(value, list) else value
