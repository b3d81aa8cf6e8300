"""Shadow jobs in a realisation whose cycles all run under one candidate.

Shadow jobs use the capacity that own jobs leave, and most candidates have the same price with and
without them. A candidate is simulated with shadows if they may delay its own jobs: on links, on
accelerators, or on nodes with a quota.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.measured import Message, message_of, parts_of, sending_ns
from dwell.kernels.random_draws import draw_shadows
from dwell.kernels.realisation import Realisation
from dwell.model.placement import Copy, Placement
from dwell.model.problem import Problem
from dwell.model.shadow_plan import ShadowFraction, ShadowPlan, alternatives, by_candidate

#: Share of D for which a shadow may occupy links of own messages and still count as harmless.
NEGLIGIBLE = 0.002


class SentShadows:
    """Shadow jobs of an estimator in a realisation.

    `fraction` is the share of cycles sent through each alternative, by active candidate. The
    attribute `realisation` has the sampled conditions of the shadow jobs.
    """

    def __init__(
        self, problem: Problem, realisation: Realisation, fraction: ShadowFraction
    ) -> None:
        fractions = by_candidate(fraction, problem.candidates)
        others = alternatives(problem.candidates)
        self._plan = ShadowPlan(0, realisation.cycles, [*fractions.values()], others)
        self._hindered = [name in hindered(problem) for name in problem.candidates]
        self.realisation = draw_shadows(problem, realisation, self._plan.sent, wraps=True)

    def __repr__(self) -> str:
        return f"<SentShadows: {self._plan!r}>"

    def stamps(self, index: int) -> NDArray[np.int16] | int:
        """Return the stamps under a candidate; -1 (no shadows) if shadows cannot delay its jobs."""
        if not self._hindered[index]:
            return -1
        return self._plan.stamps(0, self.realisation.cycles, index)


@lru_cache(maxsize=64)
def hindered(problem: Problem) -> frozenset[str]:
    """Return the candidates whose own jobs may have to wait for shadows."""
    placed, others = [*problem.candidates.values()], alternatives(problem.candidates)
    return frozenset(
        name
        for name, here, row in zip(problem.candidates, placed, others, strict=True)
        if any(_is_hindered(problem, here, placed[i].first) for i in row)
    )


def _is_hindered(problem: Problem, here: Placement, there: Copy) -> bool:
    """Return whether own jobs may wait if cycles are also sent through another candidate.

    They may if shadow messages use an own link that keeps messages in order, if shadow messages
    occupy own links for longer than `NEGLIGIBLE` allows, or if both candidates use the same
    accelerator or the same CPU with a quota.
    """
    pipeline, links = problem.pipeline, problem.fabric.links
    apart = pipeline.diverging(here, there)
    own_links = {part.link for part in parts_of(pipeline, here) if isinstance(part, Message)}
    held_ns = 0.0
    for flow in pipeline.flows:
        # A shadow job sends its sampled outputs; a shared job sends none to the shadow.
        is_sent = (flow.source if flow.sampled else flow.target) in apart
        message = message_of(flow.source, flow.target, there) if is_sent else None
        if message is not None and message.link in own_links:
            if links[message.link].in_order:
                return True
            held_ns += sending_ns(problem, message)
    if held_ns > NEGLIGIBLE * pipeline.deadline_ms * 1e6:
        return True
    shadowed = [name for name in apart if pipeline.outputs(name)]
    own = set[str]().union(*(_scarce(problem, copy, pipeline.tasks) for copy in here.copies))
    return not own.isdisjoint(_scarce(problem, there, shadowed))


def _scarce(problem: Problem, placement: Copy, tasks: Iterable[str]) -> set[str]:
    """Return the accelerators, and the CPUs with a quota, that tasks use."""
    found = set()
    for name in tasks:
        node = problem.fabric.nodes[placement[name]]
        execution = problem.pipeline.tasks[name].on[node.name]
        if execution.accelerator is not None or node.quota is not None:
            found.add(execution.resource(node.name))
    return found
