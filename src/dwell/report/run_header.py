"""Header of a run's page: cell, scenario, policy, seed, versions, from the run's record."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from dwell.errors import RunError
from dwell.record import Run
from dwell.report.phases import Disturbed, disturbed
from dwell.report.tracking import Tracking
from dwell.study.drawn_disturbances import disturbances_of


class RunHeader(NamedTuple):
    """Of what a run is the record.

    Parameters
    ----------
    kind : str
        ``simulated`` or ``live``.
    cell, scenario, policy, estimator, seed : str
        As text; a dash where there is none.
    candidates : mapping of str to mapping of str to str
        Node of every task.
    nodes : tuple of str
    window_cycles : int
        W.
    versions : mapping of str to str
    disturbed : tuple of Disturbed
        What was done to nodes and links: as it was played, where the run says so, and as its
        scenario has it elsewhere.
    recovered : mapping of str to object
        What was lost of a live run's journal.
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
    disturbed: tuple[Disturbed, ...] = ()
    tracking: Tracking | None = None
    recovered: Mapping[str, Any] = {}

    @classmethod
    def of(cls, run: Run) -> RunHeader:
        """Read the facts of a run.

        Raises
        ------
        RunError
            If its record lacks the problem it was made from, or that cannot be read.
        """
        meta = run.meta
        try:
            problem, disturbances = run.problem, disturbances_of(run)
        except RunError as error:
            raise RunError(
                f"this run cannot be reported: its record of the problem is incomplete ({error})"
            ) from None
        return cls(
            kind=str(meta.get("kind", "simulated")),
            cell=problem.name,
            scenario=str(meta.get("scenario") or "–"),
            policy=str(meta.get("policy") or "–"),
            estimator=str(meta.get("estimator") or "–"),
            seed="–" if meta.get("seed") is None else str(meta["seed"]),
            candidates=problem.candidates,
            nodes=tuple(problem.fabric.nodes),
            period_ms=problem.pipeline.period_ms,
            deadline_ms=problem.pipeline.deadline_ms,
            window_cycles=problem.window_cycles,
            versions=meta.get("versions", {}),
            disturbed=tuple(disturbed(disturbances, problem.fabric)),
            tracking=Tracking.of(meta),
            recovered=meta.get("recovered", {}),
        )

    @property
    def policy_name(self) -> str:
        """The policy without its parameters."""
        return re.split(r"[(\s]", self.policy, maxsplit=1)[0] or self.policy

    @property
    def live(self) -> bool:
        """Whether real processes ran."""
        return self.kind == "live"
