"""Visiting: questions of a person to a cell's controller."""

from __future__ import annotations

import queue
import uuid
from collections.abc import Mapping
from typing import Any

from dwell.errors import LiveError, TrustError
from dwell.live.keys import Keys
from dwell.live.messages import Answer, Ask, decode, encode
from dwell.live.security import Security
from dwell.live.transport.protocol import Sample
from dwell.live.wiring import Role
from dwell.model import Problem

__all__ = ["Visitor"]

RESEND_S = 0.2


class Visitor:
    """Somebody who is no part of a cell and talks to its controller; a context manager.

    Parameters
    ----------
    problem : Problem
    environment : mapping of str to str, optional
        With the variables of `dwell.live.security`; this process's own if left out.

    Raises
    ------
    LiveError
        If the cell leaves this computer, and there are no keys.
    TrustError
        If the keys are not those of somebody who visits.
    """

    def __init__(self, problem: Problem, environment: Mapping[str, str] | None = None) -> None:
        self.problem = problem
        self._name = f"visitor-{uuid.uuid4().hex[:8]}"
        self._controller = f"controller@{problem.controller_node}"
        self._keys = Keys(problem.name)
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        role = Role(self._name, problem.controller_node, "visitor")
        security = self._security = Security.of(problem, role, environment)
        self._transport = security.visit(self._name, self._controller)
        self._transport.subscribe(self._keys.answer(self._name), self._heard)

    def __enter__(self) -> Visitor:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self._transport.close()

    def _heard(self, sample: Sample) -> None:
        try:
            self._answers.put(decode(sample.payload, Answer))
        except LiveError:
            return

    def ask(self, what: str, about: str = "", *, patience_s: float = 3.0) -> dict[str, Any]:
        """Ask, and return how the cell is.

        Parameters
        ----------
        what : str
            ``status``, ``pin``, ``unpin``, ``drain`` or ``undrain``.
        about : str
            Candidate to pin, node to drain.
        patience_s : float

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
        ask = encode(Ask(self._name, what, about))
        # Who only looks may do so with the keys of an observer.
        key = self._keys.look() if what == "status" else self._keys.ask()
        # One question is sent several times; what was answered to the one before is old.
        while not self._answers.empty():
            self._answers.get()
        for _ in range(max(round(patience_s / RESEND_S), 1)):
            self._transport.put(key, ask)
            try:
                answer = self._answers.get(timeout=RESEND_S)
            except queue.Empty:
                continue
            if answer.refused:
                raise LiveError(f"refused: {answer.refused}")
            return answer.status
        raise LiveError(
            f"no controller of cell {self.problem.name!r} answers; is `dwell controller` running "
            f"on {self.problem.controller_node}?"
        )
