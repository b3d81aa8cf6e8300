"""Declared cell: the undisturbed cell, with which windows are compared."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dwell.estimators.candidate_player import CandidatePlayer, PlayedWindows, with_windows_up_to
from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Meter, Part, parts_of, patience_of
from dwell.estimators.pool import Reference
from dwell.estimators.prices import SEED, Question, most_windows
from dwell.estimators.remembered import Remembered
from dwell.estimators.sent_shadows import SentShadows
from dwell.estimators.slow_processes import slow_processes
from dwell.kernels.advance import LoggedCycles
from dwell.kernels.arrays import CellArrays, flow_columns
from dwell.kernels.random_draws import Drawing
from dwell.kernels.realisation import Realisation
from dwell.model.frozen import FrozenDict
from dwell.model.problem import Problem
from dwell.model.shadow_plan import ShadowFraction

#: Longest simulated window, cycles; cycles of a step, which has at least one window.
LONGEST_WINDOW, STEP = 1000, 100
#: Sampled cycles, which repeat when all are simulated; fewest windows of these cycles.
DRAWN, FEWEST = 2400, 4
#: Number of undisturbed cells that are kept.
KEPT = 64


@dataclass(frozen=True, slots=True)
class Declared:
    """The undisturbed cell, as `StepwisePlayer` simulates it."""

    realisation: Realisation
    #: Demands of every part, as windows would measure them.
    references: Mapping[Part, Reference]
    #: Every window, by candidate.
    windows: Mapping[str, PlayedWindows]
    #: The simulated shadow jobs, if they slow any candidate down.
    shadows: SentShadows | None = None

    def __repr__(self) -> str:
        return f"<Declared: {self.realisation!r}, {len(self.references)} parts>"


_remembered = Remembered[Question, Declared](KEPT)


def declared_of(
    problem: Problem, seed: int = SEED, shadow_fraction: ShadowFraction = 0.0
) -> Declared:
    """Return the undisturbed cell; results of earlier calls are kept."""
    question = Question.of(problem, "baseline", seed, DRAWN, shadow_fraction)
    return _remembered.answer(question, lambda: _played(question))


def _played(question: Question) -> Declared:
    problem = with_windows_up_to(LONGEST_WINDOW, question.problem)
    if question.shadow_fractions:
        plain = declared_of(question.problem, question.seed)
        shadows = SentShadows(problem, plain.realisation, question.shadow_fractions)
        player = CandidatePlayer([(problem, plain.realisation)], shadows=shadows)
        # Shadow jobs delay only these candidates.
        slowed = _shown(player, [n for n, of in question.shadow_fractions.items() if of])
        return replace(plain, windows=FrozenDict({**plain.windows, **slowed}), shadows=shadows)
    windows = max(-(-DRAWN // problem.window_cycles), FEWEST)
    real = _drawn_as_declared(problem, question.seed, windows)
    shown = _shown(CandidatePlayer([(problem, real)]), problem.candidates)
    references = _references(problem, question.seed, windows)
    return Declared(real, FrozenDict(references), FrozenDict(shown))


def _references(problem: Problem, seed: int, windows: int) -> dict[Part, Reference]:
    """Return the demands of every part.

    They come from at least `windows` windows, and from enough to show all of the slow processes.
    """
    least = slow_processes(problem, "baseline").least_cycles(problem.pipeline.period_ms)
    most = max(most_windows(problem), windows)
    real = _drawn_as_declared(
        problem, seed, min(max(windows, math.ceil(least / problem.window_cycles)), most)
    )
    player, meter = CandidatePlayer([(problem, real)], log_jobs=True), Meter(problem)
    references: dict[Part, Reference] = {}
    for name, placement in problem.candidates.items():
        missing = [part for part in parts_of(problem.pipeline, placement) if part not in references]
        if missing:
            demands = meter.demands(_evidence_of(player, name))
            for part, patience_ns in zip(missing, patience_of(problem, missing), strict=True):
                patience_ms = max(patience_ns / 1e6, problem.pipeline.deadline_ms)
                values = demands.get(part, np.empty(0)).copy()
                block = min(problem.window_cycles, STEP)
                kept = windows * problem.window_cycles
                references[part] = Reference(values, block, kept, patience_ms)
    return references


def _drawn_as_declared(problem: Problem, seed: int, windows: int) -> Realisation:
    return Drawing(problem, "baseline", seed=seed, windows=windows, wraps=True).take(windows)


def _shown(player: CandidatePlayer, names: Iterable[str]) -> dict[str, PlayedWindows]:
    """Return every window of candidates, copied from the tables of the simulation."""
    shown = {name: player.windows(player.play({0: name})) for name in names}
    return {name: PlayedWindows._make(map(np.copy, windows)) for name, windows in shown.items()}


def _evidence_of(player: CandidatePlayer, name: str) -> Evidence:
    """Return the evidence of all cycles on a candidate."""
    problem, real = player.cells[0]
    logged = LoggedCycles(CellArrays(player.play({0: name})), flow_columns(problem))
    rows = logged.window(0, real.cycles)
    return Evidence(int(real.release_ns[-1]), real.release_ns[:-1], rows)
