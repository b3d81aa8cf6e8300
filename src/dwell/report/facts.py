"""What a page needs to know of a run besides its tables, read from the run's own record."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

from dwell.errors import RunError
from dwell.record import Run

__all__ = ["Facts"]


class Facts(NamedTuple):
    """Of what a run is the record.

    Parameters
    ----------
    kind : str
        ``simulated`` or ``live``.
    cell, scenario, policy, estimator, seed : str
        As text; a dash where there is none.
    candidates : mapping of str to mapping of str to str
        Node of every task that can move, or of every task.
    nodes : tuple of str
    period_ms, deadline_ms : float
    window_cycles : int
        W.
    versions : mapping of str to str
    """

    kind: str
    cell: str
    scenario: str
    policy: str
    estimator: str
    seed: str
    candidates: Mapping[str, Mapping[str, str]]
    nodes: tuple[str, ...]
    period_ms: float
    deadline_ms: float
    window_cycles: int
    versions: Mapping[str, str]

    @classmethod
    def of(cls, run: Run) -> Facts:
        """Read the facts of a run.

        Raises
        ------
        RunError
            If its record lacks the problem it was made from.
        """
        meta = run.meta
        try:
            problem = meta["problem"]
            return cls(
                kind=str(meta.get("kind", "simulated")),
                cell=str(problem["name"]),
                scenario=str(meta.get("scenario") or "–"),
                policy=str(meta.get("policy") or "–"),
                estimator=str(meta.get("estimator") or "–"),
                seed="–" if meta.get("seed") is None else str(meta["seed"]),
                candidates=problem["candidates"],
                nodes=tuple(problem["nodes"]),
                period_ms=float(problem["period_ms"]),
                deadline_ms=float(problem["deadline_ms"]),
                window_cycles=int(problem["window_cycles"]),
                versions=meta.get("versions", {}),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(
                f"this run cannot be reported: its record of the problem is incomplete ({error!r})"
            ) from None

    @property
    def policy_name(self) -> str:
        """The policy without its parameters."""
        return re.split(r"[(\s]", self.policy, maxsplit=1)[0] or self.policy
