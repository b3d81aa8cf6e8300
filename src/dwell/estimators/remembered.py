"""Remembered: a cache of answers, by the content of their questions."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Generic, TypeVar

Asked = TypeVar("Asked", bound=Hashable)
Answer = TypeVar("Answer")


class Remembered(Generic[Asked, Answer]):
    """The newest answers by their questions, at most `most`."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._known: dict[Asked, Answer] = {}

    def __repr__(self) -> str:
        return f"<Remembered: {len(self._known)} of at most {self._most} answers>"

    @property
    def known(self) -> dict[Asked, Answer]:
        """The known answers, the oldest first."""
        return dict(self._known)

    def answer(self, question: Asked, find: Callable[[], Answer]) -> Answer:
        """Return the answer to a question; find and keep it if it is unknown."""
        known = self._known.get(question)
        if known is None:
            known = find()
            self.add({question: known})
        return known

    def add(self, known: Mapping[Asked, Answer]) -> None:
        """Add answers, and drop the oldest beyond `most`."""
        self._known.update(known)
        for question in list(self._known)[: -self._most]:
            del self._known[question]
