"""Verdict on a recorded run for the page, with its moves and the placements that never move."""

from __future__ import annotations

from dataclasses import asdict

from dwell.dash.paged_cell import Plain
from dwell.errors import ProblemError, SimulationError
from dwell.model import Problem
from dwell.record import Run
from dwell.study.other_placements import PLACEMENTS
from dwell.study.summary import answer_of, moves_of
from dwell.study.verdict import verdict_of


def verdict_document(run: Run, problem: Problem) -> Plain:
    """Return the verdict, the moves after the warm-up and V_D of each placement without moves.

    The result is empty if the run has no window after its warm-up, or an unknown scenario.
    """
    try:
        answer = answer_of(run, problem)
        verdict = verdict_of(run, problem, answer["violation_rate"])
    except (SimulationError, ProblemError):
        return {}
    others = run.meta.get(PLACEMENTS) or {}
    return {
        "verdict": {**asdict(verdict), "text": str(verdict)},
        "moves": moves_of(run, problem),
        "never_moving": {name: one["violation_rate"] for name, one in others.items()},
    }
